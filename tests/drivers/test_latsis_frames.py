"""Frames of a LATSIS line: any stream, in any pieces, gives frames or error records, never an exception."""

import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from config.schema.temperatures import BARE, CHECKED, GrammarConfig
from drivers.latsis.frames import (
    CHECKSUMS,
    MAX_LINE_BYTES,
    Frame,
    FrameError,
    FrameFault,
    FrameParser,
    crc8,
    frame_bytes,
    lrc8,
    sum8,
)

ENDS = {"CR": b"\r", "LF": b"\n", "CRLF": b"\r\n"}
THOROUGH = settings(max_examples=60, deadline=None)


def encode(grammar: GrammarConfig, wire_id: int, code: int, digits: int = 3, status: int = 0) -> bytes:
    """The grammar of the interface, written down a second time."""
    body = f"{wire_id:0{grammar.id_digits}X}{grammar.separator}{code:0{digits}X}"
    if grammar.status:
        body += f"{grammar.separator}{status:02X}"
    check = "" if grammar.checksum == "none" else f"*{CHECKSUMS[grammar.checksum](body.encode()):02X}"
    return f"{grammar.start}{body}{check}".encode() + ENDS[grammar.end]


def frames(records: list[Frame | FrameError]) -> list[tuple[int, int]]:
    return [(record.wire_id, record.code) for record in records if isinstance(record, Frame)]


def errors(records: list[Frame | FrameError]) -> list[FrameFault]:
    return [record.kind for record in records if isinstance(record, FrameError)]


def in_pieces(parser: FrameParser, data: bytes, cuts: list[int]) -> list[Frame | FrameError]:
    bounds = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [record for a, b in pairwise(bounds) for record in parser.feed(data[a:b])]


grammars = st.builds(
    GrammarConfig,
    start=st.sampled_from(["", ":"]),
    id_digits=st.sampled_from([2, 3]),
    separator=st.sampled_from(["", ",", " "]),
    status=st.booleans(),
    checksum=st.sampled_from(["none", "sum8", "lrc8", "crc8"]),
    end=st.sampled_from(["CR", "LF", "CRLF"]),
)
frame_values = st.lists(
    st.tuples(st.integers(0, 255), st.sampled_from([3, 4]), st.integers(0, 0xFFFF), st.integers(0, 255)), max_size=8
)


def test_checksums_against_published_values() -> None:
    assert crc8(b"123456789") == 0xF4  # CRC-8/SMBUS
    assert lrc8(bytes.fromhex("F7031389000A")) == 0x60  # Modbus over serial line, ASCII mode
    assert (sum8(b"anything") + lrc8(b"anything")) % 256 == 0


@THOROUGH
@given(grammars, frame_values)
def test_every_grammar_is_read_back(grammar: GrammarConfig, values: list[tuple[int, int, int, int]]) -> None:
    values = [(i, digits, code % 16**digits, status) for i, digits, code, status in values]
    stream = b"".join(encode(grammar, i, code, digits, status) for i, digits, code, status in values)
    records = FrameParser(grammar, {}).feed(stream)
    expected = [(i, code, status if grammar.status else 0) for i, _, code, status in values]
    assert [(r.wire_id, r.code, r.status) for r in records if isinstance(r, Frame)] == expected
    assert len(records) == len(expected)
    lengths = [frame_bytes(grammar, digits) for _, digits, _, _ in values]
    assert [record.end - record.offset for record in records] == lengths


@THOROUGH
@given(
    grammars,
    st.lists(st.one_of(st.binary(max_size=40), st.tuples(st.integers(0, 255), st.integers(0, 0xFFF))), max_size=12),
    st.lists(st.integers(0, 600), max_size=30),
    st.integers(0, 3),
)
def test_any_chunking_gives_the_same_records(
    grammar: GrammarConfig, parts: list[bytes | tuple[int, int]], cuts: list[int], repeat_noise: int
) -> None:
    stream = b"".join(
        part * (1 + 9 * repeat_noise) if isinstance(part, bytes) else encode(grammar, *part) for part in parts
    )
    whole = FrameParser(grammar, {}).feed(stream)
    assert in_pieces(FrameParser(grammar, {}), stream, cuts) == whole
    single = FrameParser(grammar, {})
    assert [record for byte in stream for record in single.feed(bytes([byte]))] == whole


@THOROUGH
@given(grammars, st.binary(max_size=2000))
def test_garbage_is_reported_with_its_place(grammar: GrammarConfig, garbage: bytes) -> None:
    parser = FrameParser(grammar, {})
    records = parser.feed(garbage)
    assert all(a.end <= b.offset for a, b in pairwise(records))
    for record in records:
        if isinstance(record, FrameError):
            assert garbage[record.offset :].startswith(record.excerpt)
            assert f"bytes {record.offset}-{record.end - 1}" in str(record)
    assert parser.bytes_fed == len(garbage)
    assert parser.bytes_fed - parser.bytes_judged < MAX_LINE_BYTES


@THOROUGH
@given(st.integers(0, 2**32))
def test_a_fifth_of_all_bytes_lost_yields_no_value_that_was_not_sent(seed: int) -> None:
    chance = random.Random(seed)
    sent = [(wire_id, chance.randrange(0x1000)) for wire_id in range(200, 0, -1)]
    stream = b"".join(encode(CHECKED, *value) for value in sent)
    kept = bytes(byte for byte in stream if chance.random() >= 0.2)
    records = FrameParser(CHECKED, dict.fromkeys(range(1, 201), 3)).feed(kept)
    assert set(frames(records)) <= set(sent)
    assert errors(records)


@THOROUGH
@given(st.integers(0, 2**32))
def test_a_flipped_bit_in_each_frame_yields_no_value_that_was_not_sent(seed: int) -> None:
    chance = random.Random(seed)
    sent = [(wire_id, chance.randrange(0x1000)) for wire_id in range(100, 0, -1)]
    stream = bytearray()
    for value in sent:
        frame = bytearray(encode(CHECKED, *value))
        frame[chance.randrange(len(frame))] ^= 1 << chance.randrange(8)
        stream += frame
    records = FrameParser(CHECKED, {}).feed(bytes(stream))
    assert set(frames(records)) <= set(sent)


@pytest.mark.parametrize(
    ("stream", "kind"),
    [
        (b":0C8,190,00*FE\r\n", FrameFault.CHECKSUM),
        (b":0c8,190,00*FD\r\n", FrameFault.FORM),
        (b":0C8,190,00*fd\r\n", FrameFault.FORM),
        (b":0C8;190,00*FD\r\n", FrameFault.FORM),
        (b":0C8,19,00*FD\r\n", FrameFault.LENGTH),
        (b"0C8,190,00*FD\r\n", FrameFault.NO_START),
        (b":0C8,1900,00*2D\r\n", FrameFault.TOO_WIDE),
        (b":0C7,190,00*FC\r\n", FrameFault.TOO_NARROW),
    ],
)
def test_reason_of_a_refusal(stream: bytes, kind: FrameFault) -> None:
    parser = FrameParser(CHECKED, {0xC8: 3, 0xC7: 4})
    good = encode(CHECKED, 0xC8, 0x191)
    records = parser.feed(good + stream + good)
    assert frames(records) == [(0xC8, 0x191), (0xC8, 0x191)]
    (error,) = [record for record in records if isinstance(record, FrameError)]
    assert (error.kind, error.offset, error.end) == (kind, 16, 16 + len(stream))


def test_value_width_follows_the_sensor_of_the_id() -> None:
    parser = FrameParser(BARE, {1: 3, 2: 4})
    records = parser.feed(b"023A2B\r\n01190\r\n02190\r\n013A2B\r\n")
    assert frames(records) == [(2, 0x3A2B), (1, 0x190)]
    assert [(e.kind, e.wire_id) for e in records if isinstance(e, FrameError)] == [
        (FrameFault.TOO_NARROW, 2),
        (FrameFault.TOO_WIDE, 1),
    ]


def test_a_lost_line_end_costs_the_frames_that_it_joins_and_no_more() -> None:
    assert frames(FrameParser(BARE, {}).feed(b"0519004191\r\n03192\r\n")) == [(3, 0x192)]
    # With a start character even the second of them is found.
    joined = encode(CHECKED, 5, 1)[:-2] + encode(CHECKED, 4, 2)
    assert frames(FrameParser(CHECKED, {}).feed(joined)) == [(4, 2)]


def test_without_line_end_the_buffer_stays_small_and_the_parser_recovers() -> None:
    for grammar in (BARE, CHECKED):
        parser = FrameParser(grammar, {})
        records = [record for _ in range(200) for record in parser.feed(b"7" * 5000)]
        assert set(errors(records)) == {FrameFault.OVERLONG}
        assert parser.bytes_fed - parser.bytes_judged < MAX_LINE_BYTES
        rest = parser.feed(b"7\r\n" + encode(grammar, 9, 0x123))
        assert frames(rest) == [(9, 0x123)]
