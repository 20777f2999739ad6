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
    encode_fields,
    encode_query,
    encode_write,
    parse_answer,
    parse_request,
    value_text,
)
from drivers.haas.requests import ProgramState, mode_of
from models.records import CncMode, CncRun

FRAMED = b"\x02MACRO, 801, 333.339996\x17\r\n>\x02SERIAL NUMBER, 3093228\x17\r\n>"
PROMPTED = b">MACRO, 801, 333.339996\r\n>SERIAL NUMBER, 3093228\r\n"


def read(line: str) -> Answer:
    answer = parse_answer(line)
    assert isinstance(answer, Answer)
    return answer


@pytest.mark.parametrize("stream", [FRAMED, PROMPTED])
@given(sizes=st.lists(st.integers(1, 20), max_size=10))
def test_a_stream_is_cut_into_its_lines_wherever_it_breaks(stream: bytes, sizes: list[int]) -> None:
    buffer, place = LineBuffer(), 0
    found = []
    for size in [*sizes, len(stream)]:
        found += list(buffer.feed(stream[place : place + size]))
        place += size
    assert found == ["MACRO, 801, 333.339996", "SERIAL NUMBER, 3093228"]


def test_an_endless_line_is_refused() -> None:
    for data in (b"x" * 600, b"x" * 600 + b"\n"):
        with pytest.raises(HaasFormatError, match="characters"):
            list(LineBuffer().feed(data))


def test_answers_name_their_variable_or_none_and_an_empty_value_is_vacant() -> None:
    assert (read("MACRO, 801, 333.339996").number, read("MACRO, 801, 333.339996").value) == (801, 333.339996)
    assert (read("MACRO, 12.5").number, read("MACRO, 12.5").value) == (None, 12.5)
    assert read("MACRO, 502, ").value is None and read("MACRO, ").value is None
    assert parse_answer("UNKNOWN") == Unknown() and parse_answer("!") is None and parse_answer("PART 7 DONE") is None


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


def test_requests_are_what_the_vendor_describes() -> None:
    assert encode_query(Query.MACRO, 801) == b"?Q600 801\r\n" and encode_query(Query.SERIAL_NUMBER) == b"?Q100\r\n"
    assert encode_write(501, 3.0) == b"?E501 3.\r\n"
    assert parse_request("?Q600 801") == (600, 801) and parse_request("?Q100") == (100, None)
    assert [parse_request(line) for line in ("?q600 801", "?Q600 x", "?E501", "?E501 1e3", "")] == [None] * 5
    assert encode_fields("MODE", "MEM") == b"\x02MODE, MEM\x17\r\n>"
    with pytest.raises(OverflowError, match="more digits"):
        value_text(1e12)


def test_the_words_of_the_state() -> None:
    assert mode_of(read("MODE, (MDI)")) is CncMode.MDI and mode_of(read("MODE, ZERO RET")) is CncMode.UNKNOWN
    assert ProgramState.of(read("STATUS, BUSY")) == ProgramState(CncRun.START, False, None)
    assert ProgramState.of(read("PROGRAM, O00110, IDLE, PARTS, 4523")) == ProgramState(CncRun.RESET, False, 110)
    assert ProgramState.of(read("PROGRAM, O0100, STATUS, FEED HOLD, PARTS, 9")).run is CncRun.HOLD
    assert ProgramState.of(read("PROGRAM, MDI, ALARM ON, PARTS, 143")) == ProgramState(CncRun.STOP, True, None)
    assert ProgramState.of(read("PROGRAM, O1")).run is CncRun.UNKNOWN
    for line in ("STATUS, STATUS", "PROGRAM, STATUS", "PROGRAM, "):
        assert ProgramState.of(read(line)) == ProgramState(CncRun.UNKNOWN, False, None), line
