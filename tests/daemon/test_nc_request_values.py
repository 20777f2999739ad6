"""Whatever the request macros hold, the tool goes where it would have gone, or the output says why it holds."""

import math

import pytest
from control_rig import running
from nc_requests import (
    ACKNOWLEDGE,
    AXIS,
    COUNTER,
    KIND,
    PROBE,
    REFERENCE,
    TOOL_CHANGE,
    VALUE,
    Z_AXIS,
    answer,
    ask,
    last_asked,
    requesting_bench,
)

from daemon.history.reader import HistoryReader

SPECIAL = (None, math.nan, math.inf, -math.inf, -0.0, 1e300, -1e300, 2.5, 1e-9, -3.0)
FEW = (None, math.nan, -math.inf, 1e300, 2.5)
GOOD = {REFERENCE: (0, 0.0), PROBE: (Z_AXIS, 0.001), TOOL_CHANGE: (0, 4.0)}
"""Axis and value of a request as it should be."""
GROWTH_UM = 3.0


@pytest.fixture
def bench(tmp_path):
    return requesting_bench(tmp_path)


def put(bench, number, value):
    """Let a macro hold what a careless program, a person or a defective server may have put there."""
    bench.nc.macros._values[number] = value


def ask_with(bench, rig, kind, number, value):
    """Make the next request, with one macro that holds something else."""
    counter = (rig.control._references._handshake.counter or 0) + 1
    axis, value_mm = GOOD[kind]
    ask(bench, counter - 1, kind, axis, value_mm)
    put(bench, number, value)
    if number != COUNTER:
        put(bench, COUNTER, float(counter))


async def told(rig):
    """Return what was recorded of requests that were refused."""
    await rig.history.flushed()
    assert rig.history.problem == ""
    with HistoryReader(rig.history.path) as reader:
        return [event.text for event in reader.events(0.0, 2.0**40) if event.kind == "refused"]


@pytest.mark.parametrize("number", [COUNTER, KIND, AXIS, VALUE])
@pytest.mark.parametrize("kind", [REFERENCE, PROBE, TOOL_CHANGE])
async def test_one_macro_that_holds_what_it_must_not_never_moves_the_tool(rig, bench, kind, number):
    await rig.active(handshake=True)
    grown_um = GROWTH_UM
    for count, value in enumerate(SPECIAL):
        if (kind, number) == (PROBE, VALUE) and value is not None and abs(value) < 0.01:
            continue  # a value that a probe may have measured
        rig.set_reference(f"r{count + 2}", handshake=True)
        await rig.follow(0.0, 0.0, 2)
        case = f"kind {kind}, #{number} = {value}"
        assert rig.state == "ACTIVE", case
        begun_um = rig.applied["z"]
        await rig.turn(rig.estimate(0.0, -grown_um))
        ask_with(bench, rig, kind, number, value)
        stood_um = rig.applied["z"]
        await rig.follow(0.0, -grown_um, 12)
        end = f"{case}: {rig.control.memory}"
        assert rig.control.journal.fault is None, end
        undisturbed = rig.applied["z"] == pytest.approx(begun_um + grown_um, abs=0.11)
        frozen = rig.applied["z"] == pytest.approx(stood_um, abs=0.5)
        known = rig.control.reference is not None
        assert rig.state == ("ACTIVE" if known else "HOLD") and (undisturbed or (frozen and not known)), end
        grown_um = -grown_um
    assert rig.history.problem == ""


@pytest.mark.parametrize(
    ("kind", "number", "value", "words"),
    [
        (PROBE, VALUE, None, "the probe value in macro #523 is vacant"),
        (PROBE, VALUE, math.inf, "the probe value inf in macro #523"),
        (PROBE, AXIS, 3.4, "axis 3.4 in macro #522"),
        (PROBE, AXIS, None, "axis in macro #522 is vacant"),
        (PROBE, KIND, 2.5, "kind 2.5 in macro #521"),
        (PROBE, KIND, None, "kind in macro #521 is vacant"),
        (TOOL_CHANGE, VALUE, None, "the tool number in macro #523 is vacant"),
        (TOOL_CHANGE, VALUE, 2.5, "the tool number 2.5 in macro #523"),
        (REFERENCE, AXIS, None, "axis in macro #522 is vacant"),
    ],
)
async def test_a_refusal_names_macro_and_value_and_the_next_request_is_served(rig, bench, kind, number, value, words):
    await rig.active(handshake=True)
    ask_with(bench, rig, kind, number, value)
    await rig.turn()
    await rig.turn()
    assert answer(bench) == -1.0
    (text,) = await told(rig)
    assert text.startswith("request 1 of the NC program: ") and words in text
    assert rig.control.memory.tools == {} and not rig.control.memory.offset_um.any()
    ask(bench, 2, TOOL_CHANGE, 0, 5.0)
    await rig.turn()
    await rig.turn()
    assert answer(bench) == 2.0


@pytest.mark.parametrize("value", [None, math.inf, 1e300, 2.5, -3.0])
async def test_a_counter_that_is_none_ends_the_reference_in_words_and_requests_go_on_from_zero(rig, bench, value):
    await rig.active(handshake=True)
    ask(bench, 1, TOOL_CHANGE, 0, 5.0)
    await rig.turn()
    await rig.turn()
    assert answer(bench) == 1.0
    put(bench, COUNTER, value)
    for _ in range(3):
        await rig.turn()
    assert answer(bench) == (-2.5 if value == 2.5 else 1.0)
    (text,) = await told(rig)
    assert "the request counter" in text and "#520" in text and "set it to 0 and ask again" in text
    assert rig.control.reference is None and rig.state == "HOLD"
    assert any("may have been positioned" in notice for notice in rig.control.journal.notices)
    ask(bench, 0, REFERENCE)
    await rig.turn()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    rig.set_reference(last_asked(rig).reference_id, handshake=True)
    await rig.follow(0.0, 0.0, 3)
    assert answer(bench) == 1.0 and rig.state == "ACTIVE"


@pytest.mark.parametrize("value", FEW)
async def test_an_answer_macro_that_holds_something_else_is_at_most_a_fault_in_words(rig, bench, value):
    await rig.active(handshake=True)
    put(bench, ACKNOWLEDGE, value)
    ask(bench, 1, TOOL_CHANGE, 0, 5.0)
    await rig.follow(0.0, 0.0, 3)
    fault = rig.control.journal.fault
    assert (answer(bench) == 1.0) == (fault is None)
    if fault is not None:
        assert fault.startswith("an answer to the NC program could not be written: macro #524 is vacant")
        put(bench, ACKNOWLEDGE, 0.0)
        assert rig.acknowledge("a person") == ""
        await rig.turn()
        await rig.turn()
        assert answer(bench) == 1.0 and rig.control.journal.fault is None


@pytest.mark.parametrize("value", FEW)
async def test_a_request_of_before_the_start_is_refused_whatever_its_answer_holds(bench, value):
    put(bench, ACKNOWLEDGE, value)
    put(bench, COUNTER, 4.0)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.turn()
        vacant = value is None or math.isnan(value)
        assert ("#524 is vacant" in (rig.control.journal.fault or "")) == vacant
        assert vacant or answer(bench) == -4.0


@pytest.mark.parametrize("value", [value for value in FEW if value is None or not math.isnan(value)])
async def test_no_macro_that_is_polled_ends_in_an_unexpected_error(bench, value):
    for number in bench.configuration.cnc.macros.block:
        before = dict(bench.nc.macros._values)
        put(bench, number, value)
        async with running(bench.rig()) as rig:
            for _ in range(3):
                await rig.turn()
            assert "unexpected" not in (rig.control.journal.fault or ""), (number, rig.control.journal.fault)
            assert rig.history.problem == ""
        bench.nc.macros._values.update(before)
        bench.configuration.history.path.unlink()
