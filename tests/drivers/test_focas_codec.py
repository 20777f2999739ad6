"""FOCAS2 bytes: frames of the published layout, values with their decimals, and anything else refused."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.focas.codec import (
    Answer,
    Ask,
    Direction,
    FocasFormatError,
    Frame,
    FrameBuffer,
    Function,
    Kind,
    encode_answers,
    encode_asks,
    encode_frame,
    encode_value,
    parse_answers,
    parse_asks,
    parse_values,
)
from drivers.focas.requests import macro_asks, macro_values, write_asks
from drivers.power_on import CalendarError, power_on_count, power_on_utc_s

OPEN = bytes.fromhex("A0A0A0A0 0001 0101 0002 0002")
CLOSE = bytes.fromhex("A0A0A0A0 0001 0201 0000")
READ_500 = bytes.fromhex("0001 001C 0001 0001 0015 000001F4 000001F8 00000000 00000000 00000000")
VALUES = st.one_of(st.none(), st.floats(-2e9, 2e9).map(lambda value: round(value, 6)))


def test_frames_have_the_layout_of_the_open_implementations() -> None:
    assert encode_frame(Frame(Kind.OPEN, Direction.REQUEST, b"\0\2")) == OPEN
    assert encode_frame(Frame(Kind.CLOSE, Direction.REQUEST)) == CLOSE
    assert encode_asks([Ask(Function.READ_MACRO, (500, 504))]) == READ_500


@given(st.lists(st.integers(1, 30), max_size=8))
def test_a_stream_is_cut_into_its_frames_wherever_it_breaks(sizes: list[int]) -> None:
    stream, buffer = OPEN + CLOSE + OPEN, FrameBuffer()
    found, place = [], 0
    for size in [*sizes, len(stream)]:
        found += list(buffer.feed(stream[place : place + size]))
        place += size
    assert found == [Frame(1, 1, b"\0\2"), Frame(2, 1), Frame(1, 1, b"\0\2")]
    assert not buffer.unfinished


@given(VALUES)
def test_values_keep_nine_decimals_or_nine_digits(value: float | None) -> None:
    (found,) = parse_values(encode_value(value), 1)
    if value is None or found is None:
        assert found is value
    else:
        assert abs(found - value) <= max(5e-9, abs(value) * 5e-9)
        mantissa, _, decimals = struct.unpack(">iHh", encode_value(value))
        assert abs(mantissa) <= 999_999_999 or decimals == 0, "one of ten digits is refused, as by the maker's library"


def test_an_answer_counts_only_for_what_was_asked_for() -> None:
    asks = [Ask(Function.STATUS), Ask(Function.READ_MACRO, (500, 500))]
    status, value = Answer(0, bytes(14)), Answer(0, encode_value(1.5))
    right = encode_answers([(1, 1, Function.STATUS, status), (1, 1, Function.READ_MACRO, value)])
    assert parse_answers(right, asks) == [status, value]
    swapped = encode_answers([(1, 1, Function.READ_MACRO, value), (1, 1, Function.STATUS, status)])
    other_path = encode_answers([(1, 2, Function.STATUS, status), (1, 1, Function.READ_MACRO, value)])
    for wrong in (swapped, other_path, encode_answers([(1, 1, Function.STATUS, status)]), right[:-1], right + b"\0"):
        with pytest.raises(FocasFormatError):
            parse_answers(wrong, asks)


@given(st.binary(max_size=120), st.integers(0, 3))
def test_any_bytes_are_blocks_or_refused(data: bytes, count: int) -> None:
    for parse in (parse_asks, lambda body: parse_answers(body, [Ask(Function.STATUS)] * count)):
        try:
            parse(data)
        except FocasFormatError as error:
            assert str(error)


def test_a_group_is_written_as_doubles_or_one_by_one() -> None:
    group = [(503, 0.5), (501, 1.0), (502, 2.0), (100, 9.0)]
    doubles = write_asks(group, doubles=True)
    assert [(run.start, len(run), ask.extra) for run, ask in doubles] == [
        (100, 1, struct.pack(">d", 9.0)),
        (501, 3, struct.pack(">3d", 1.0, 2.0, 0.5)),
    ]
    single = write_asks(group, doubles=False)
    assert [(ask.function, ask.arguments) for _, ask in single] == [(0x16, (n, n, 0, 0)) for n in (100, 501, 502, 503)]


def test_the_instant_of_power_on_is_calendar_minus_clock_and_keeps_its_number_near_an_edge() -> None:
    assert power_on_utc_s(20261122.0, 80510.0, 310_000.0) == 1795305600.0 + 8 * 3600
    for date, time, word in ((20261322.0, 0.0, "no date"), (20261122.0, 246060.0, "no time"), (0.5, 0.0, "no date")):
        with pytest.raises(CalendarError, match=word):
            power_on_utc_s(date, time, 0.0)
    assert [power_on_count(at, None) for at in (599.9, 600.0)] == [0, 1]
    assert [power_on_count(at, 1) for at in (541.0, 1259.0, 539.0, 1261.0)] == [1, 1, 0, 2]


def test_a_wrong_value_is_told_with_its_macro_variable() -> None:
    values = encode_value(1.0) + struct.pack(">ihh", 5, 7, 0)
    asked = macro_asks([502, 503])
    with pytest.raises(FocasFormatError, match=r"#503 is of base 7"):
        macro_values(asked, [Answer(0, values)])
    huge = struct.pack(">iHh", 123_456_789, 10, -4)  # else a program that writes it ends the link for good
    assert macro_values(asked, [Answer(0, encode_value(1.0) + huge)]) == {502: 1.0, 503: 1.23456789e12}
