"""Lines of machine data collection: framed as either generation of the control does, and anything else refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.haas.codec import (
    Answer,
    HaasFormatError,
    LineBuffer,
    Query,
    Unknown,
    Write,
    encode_write,
    parse_answer,
    parse_request,
)

FRAMED = b"\x02MACRO, 801, 333.339996\x17\r\n>\x02SERIAL NUMBER, 3093228\x17\r\n>"
PROMPTED = b">MACRO, 801, 333.339996\r\n>SERIAL NUMBER, 3093228\r\n"
SERIAL = b"\xff\xfd\x01?Q600 801\r\x02MACRO, 801, 333.339996\x17\0\r\n>\0\x11\x02SERIAL NUMBER, 3093228\x17\x13\r\n>"
"""Through a server for serial ports: its own negotiation, an echo, filling and flow control around what is framed."""


def read(line: str) -> Answer:
    answer = parse_answer(line)
    assert isinstance(answer, Answer)
    return answer


@pytest.mark.parametrize("stream", [FRAMED, PROMPTED, SERIAL])
@given(sizes=st.lists(st.integers(1, 20), max_size=10))
def test_a_stream_is_cut_into_its_lines_wherever_it_breaks(stream: bytes, sizes: list[int]) -> None:
    buffer, place = LineBuffer(), 0
    found = []
    for size in [*sizes, len(stream)]:
        found += list(buffer.feed(stream[place : place + size]))
        place += size
    assert found == ["MACRO, 801, 333.339996", "SERIAL NUMBER, 3093228"]


def test_answers_name_their_variable_or_none_and_an_empty_value_is_vacant() -> None:
    assert (read("MACRO, 801, 333.339996").number, read("MACRO, 801, 333.339996").value) == (801, 333.339996)
    assert (read("MACRO, 12.5").number, read("MACRO, 12.5").value) == (None, 12.5)
    assert read("MACRO, 502, ").value is None and read("MACRO, ").value is None
    assert parse_answer("UNKNOWN") == parse_answer("?, ?E 500 1.0") == Unknown()
    assert read("SOFTWARE, VER M18.26A").query is read("SOFTWARE VERSION, 100.17.000.2037").query is Query.SOFTWARE
    assert parse_answer("!") is None and parse_answer("PART 7 DONE") is None


@pytest.mark.parametrize(
    "line",
    [
        "MACRO",
        "MACRO, 503, 1.0, 2.0",
        "MACRO, -5, 1.0",
        "MACRO, 503, nan",
        "MACRO, 503, 1e5",
        "MACRO, 503, 1_0",
        "MODE",
    ],
)
def test_an_answer_that_cannot_be_is_refused(line: str) -> None:
    with pytest.raises(HaasFormatError):
        parse_answer(line)


def test_a_wrong_value_is_told_with_its_macro_variable() -> None:
    with pytest.raises(HaasFormatError, match=r"'MACRO, 503, 0\.0x': '0\.0x' is no number"):
        parse_answer("MACRO, 503, 0.0x")


@given(st.binary(max_size=80))
def test_any_bytes_are_lines_or_refused(data: bytes) -> None:
    for line in LineBuffer().feed(data):
        parse_request(line)
        try:
            parse_answer(line)
        except HaasFormatError as error:
            assert str(error)


@given(st.integers(1, 99999), st.floats(-1e8, 1e8), st.booleans())
def test_what_is_written_arrives_with_six_decimals(number: int, value: float, spaced: bool) -> None:
    found = parse_request(encode_write(number, value, spaced=spaced).decode().strip())
    assert isinstance(found, Write) and found.number == number
    assert found.value == pytest.approx(value, rel=0, abs=5.1e-7)
