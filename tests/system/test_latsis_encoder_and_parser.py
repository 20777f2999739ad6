"""The simulator's encoder and the driver's parser were written apart from each other: they must agree."""

from hypothesis import given, settings
from hypothesis import strategies as st

from config.schema.temperatures import GrammarConfig
from drivers.latsis.frames import Frame, FrameParser
from drivers.sim.wires.latsis_encoding import encode_frame

GRAMMARS = st.builds(
    GrammarConfig,
    start=st.sampled_from(["", ":"]),
    id_digits=st.sampled_from([2, 3]),
    separator=st.sampled_from(["", ",", " "]),
    status=st.booleans(),
    checksum=st.sampled_from(["none", "sum8", "lrc8", "crc8"]),
    end=st.sampled_from(["CR", "LF", "CRLF"]),
)


@settings(deadline=None, max_examples=60)
@given(
    GRAMMARS,
    st.lists(
        st.tuples(st.integers(0, 255), st.sampled_from([3, 4]), st.integers(0, 0xFFF), st.integers(0, 255)),
        unique_by=lambda row: row[0],
        max_size=20,
    ),
)
def test_what_the_nodes_send_is_what_the_driver_reads(
    grammar: GrammarConfig, rows: list[tuple[int, int, int, int]]
) -> None:
    digits = {wire_id: width for wire_id, width, _, _ in rows}
    stream = b"".join(encode_frame(grammar, wire_id, width, code, status) for wire_id, width, code, status in rows)
    records = FrameParser(grammar, digits).feed(stream)
    assert all(isinstance(record, Frame) for record in records)
    read = [(r.wire_id, r.code, r.status) for r in records if isinstance(r, Frame)]
    assert read == [(wire_id, code, status if grammar.status else 0) for wire_id, _, code, status in rows]
