"""What the NC program asks for: every macro holds what it must, or the request is refused in words."""

import math

import hypothesis.strategies as st
import pytest
from hypothesis import given

from models.control.nc_request import (
    LAST_COUNTER,
    NcRequest,
    Refusal,
    RequestKind,
    RequestMacros,
    missed_requests,
    parse_request,
)

NUMBERS = RequestMacros(counter=520, kind=521, axis=522, value_mm=523, acknowledge=524)
AXES = ("x", "y", "z")
SPECIAL = (None, math.nan, math.inf, -math.inf, -1.0, 0.5, 2.5, 3.4, 1e-9, 1e10, 1e300, -1e300)


def request(counter=7.0, kind=2.0, axis=3.0, value_mm=0.012):
    return parse_request({520: counter, 521: kind, 522: axis, 523: value_mm, 524: 0.0}, NUMBERS, AXES)


def test_what_the_programs_of_the_guard_ask_for_is_understood():
    assert request(kind=1.0, axis=0.0, value_mm=0.0) == NcRequest(counter=7, kind=RequestKind.REFERENCE)
    assert request(kind=1.0) == NcRequest(counter=7, kind=RequestKind.REFERENCE, axis="z")
    assert request() == NcRequest(counter=7, kind=RequestKind.PROBE, axis="z", value_mm=0.012)
    assert request(value_mm=-0.0).value_mm == 0.0
    change = NcRequest(counter=7, kind=RequestKind.TOOL_CHANGE, tool_number=12)
    assert request(kind=3.0, axis=0.0, value_mm=12.0) == change
    assert str(change) == "request 7 of the NC program (tool change)"
    assert request(kind=0.0, axis=None, value_mm=None) == NcRequest(counter=7, kind=RequestKind.WITHDRAWN)


@pytest.mark.parametrize("value", SPECIAL)
@pytest.mark.parametrize(
    ("changed", "kind", "words"),
    [
        ("kind", 2.0, "kind"),
        ("axis", 1.0, "axis"),
        ("axis", 2.0, "axis"),
        ("value_mm", 3.0, "tool number"),
    ],
)
def test_a_whole_number_is_needed_and_none_is_made(value, changed, kind, words):
    refusal = request(**({"kind": kind, "value_mm": 7.0} | {changed: value}))
    assert isinstance(refusal, Refusal)
    assert refusal.number == 7.0
    assert words in refusal.why and f"#{getattr(NUMBERS, changed)}" in refusal.why
    assert ("vacant" if value is None else f"{value:.12g}") in refusal.why


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf])
def test_a_probe_value_that_nobody_measured_is_refused(value):
    refusal = request(value_mm=value)
    assert isinstance(refusal, Refusal) and "the probe value" in refusal.why and "#523" in refusal.why


@pytest.mark.parametrize("value", [*SPECIAL, 0.0, -0.0, 1e6])
def test_a_counter_that_is_none_is_answered_only_where_minus_it_is_an_answer(value):
    refusal = request(counter=value)
    assert isinstance(refusal, Refusal) and refusal.may_have_positioned == (value != 0.0)
    assert "#520" in refusal.why and "set it to 0 and ask again" in refusal.why
    assert refusal.number == (value if value in (0.5, 2.5, 3.4, 1e-9) else None)


@pytest.mark.parametrize(
    ("content", "may"),
    [
        ({"kind": 1.0, "axis": None}, True),
        ({"kind": 1.0, "axis": 0.4}, True),
        ({"kind": 1.0, "axis": 9.0}, False),
        ({"kind": None}, True),
        ({"kind": 1.5}, True),
        ({"kind": 7.0}, True),
        ({"kind": 2.0, "axis": 9.0}, False),
        ({"kind": 3.0, "value_mm": None}, False),
    ],
)
def test_only_what_cannot_have_told_of_a_positioning_leaves_the_reference(content, may):
    assert request(**content).may_have_positioned is may


@given(*(st.none() | st.floats() for _ in range(4)))
def test_whatever_the_macros_hold_there_is_a_request_or_a_sentence(counter, kind, axis, value_mm):
    found = request(counter, kind, axis, value_mm)
    if isinstance(found, NcRequest):
        assert counter == found.counter and kind == found.kind and math.isfinite(found.value_mm)
    else:
        assert found.why and found.number in (None, counter)


@pytest.mark.parametrize(
    ("latest", "counter", "words"),
    [(4, 5, ""), (0, 1, ""), (LAST_COUNTER, 1, ""), (5, 5, ""), (0, 3, "2 request(s)"), (5, 1, "from 5 to 1")],
)
def test_the_counter_says_what_was_missed(latest, counter, words):
    missed = missed_requests(latest, counter)
    assert words in missed and bool(words) == bool(missed)
