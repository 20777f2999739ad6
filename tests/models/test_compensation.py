"""The output step: the table of states, and what must hold in every history."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.control.compensation import LONGEST_INTERVAL_S, TRANSITIONS, first_inhibit, initial_memory, step
from models.control.state import Inhibit, InhibitCode, OperatorRequest, OutputInputs, OutputLimits
from models.records import OutputState, Phase

AXES = ("y", "z")
LIMITS = OutputLimits(
    axes=AXES,
    absolute_bound_um=np.array([30.0, 60.0]),
    slew_um_per_min=np.array([2.0, 4.0]),
    step_um=np.array([5.0, 8.0]),
    rounding_um=np.array([0.05, 0.05]),
    deadband_um=np.array([0.1, 0.1]),
    stale_after_s=60.0,
    hold_limit_s=600.0,
    min_confidence=0.7,
)


def inputs(**changes):
    good = OutputInputs(
        now_s=0.0,
        phase=Phase.SAFE_POINT,
        link=True,
        applied_um=np.zeros(2),
        thermal_error_um=np.array([-3.0, -20.0]),
        estimate_age_s=1.0,
        confidence=1.0,
        in_domain=True,
        reference_id="r1",
        estimate_reference_id="r1",
        model_id="m1",
    )
    return replace(good, **changes)


def started(applied=(0.0, 0.0), wanted=(False, False)):
    return initial_memory(now_s=0.0, applied_um=np.array(applied), wanted=wanted)


def run(memory, count, *, start_s=0.0, follow=True, **changes):
    """Take `count` steps a second apart, with a guard that applies at once."""
    applied = changes.pop("applied_um", memory.command_um)
    command = None
    for k in range(count):
        memory, command = step(memory, inputs(now_s=start_s + k + 1.0, applied_um=applied, **changes), LIMITS)
        if follow and command.write:
            applied = command.compensation_um
        changes.pop("request", None)
    return memory, command


@cache
def active(seconds=600):
    return run(started(), seconds, request=OperatorRequest(enable=frozenset(AXES)))


@pytest.mark.parametrize(
    ("changes", "state", "first"),
    [
        ({"confidence": 0.1}, OutputState.HOLD, [0.0, 0.0]),
        ({"request": OperatorRequest(disable=frozenset({"y"}))}, OutputState.ACTIVE, [0.0, 20.0]),
        ({"request": OperatorRequest(disable=frozenset(AXES))}, OutputState.RETREAT, [0.0, 0.0]),
    ],
)
def test_what_the_guard_has_taken_out_comes_back_with_an_estimate_alone(changes, state, first):
    memory, command = active()
    assert command.compensation_um == pytest.approx([3.0, 20.0], abs=0.1)
    out = {"applied_um": np.zeros(2), "withdrawn": True}
    memory, command = step(memory, inputs(now_s=601.0, **out, **changes), LIMITS)
    assert memory.state is state
    assert command.compensation_um == pytest.approx(first, abs=0.1)
    _, command = step(active()[0], inputs(now_s=601.0, applied_um=np.zeros(2), **changes), LIMITS)
    assert command.compensation_um[1] == pytest.approx(20.0, abs=0.2), "a guard that merely lags catches up"


def test_starts_off_and_writes_nothing_but_zero():
    memory, command = run(started(), 3)
    assert memory.state is OutputState.OFF
    assert command.enable == (False, False)
    assert not command.compensation_um.any()


def test_follows_minus_the_error_at_the_slew_rate():
    memory, command = active(60)
    assert memory.state is OutputState.ACTIVE
    assert command.compensation_um == pytest.approx([2.0, 4.0], rel=0.05)
    memory, command = active(600)
    assert command.compensation_um == pytest.approx([3.0, 20.0], abs=0.1)


def test_an_echo_from_before_the_start_leads_to_hold_with_that_value():
    memory = started(applied=(0.0, 12.0))
    assert memory.state is OutputState.HOLD
    memory, command = step(memory, inputs(now_s=1.0, applied_um=np.array([0.0, 12.0]), reference_id=None), LIMITS)
    assert command.compensation_um[1] == pytest.approx(12.0, abs=0.1)


def test_setting_a_reference_moves_nothing_and_makes_the_applied_value_the_baseline():
    memory, command = active()
    before = command.compensation_um.copy()
    memory, command = run(
        memory, 1, start_s=600.0, reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.zeros(2)
    )
    assert command.compensation_um == pytest.approx(before)
    assert memory.baseline_um == pytest.approx(before)
    memory, command = run(
        memory, 600, start_s=601.0, reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.array([0, -5.0])
    )
    assert command.compensation_um == pytest.approx(before + [0.0, 5.0], abs=0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"link": False}, "no link"),
        ({"reference_id": None}, "no valid reference"),
        ({"estimate_age_s": 61.0}, "stale"),
        ({"estimate_age_s": np.inf}, "no estimate"),
        ({"confidence": 0.69}, "confidence"),
        ({"in_domain": False}, "outside the range"),
        ({"inhibits": (Inhibit(code=InhibitCode.COMMISSIONING, text="no commissioning record"),)}, "commissioning"),
        ({"thermal_error_um": np.array([np.nan, 1.0])}, "no estimate"),
        ({"estimate_reference_id": "old"}, "first estimate"),
    ],
)
def test_bad_input_freezes_and_says_why(change, words):
    memory, command = active()
    before = command.compensation_um.copy()
    changed = inputs(now_s=601.0, applied_um=before, **change)
    memory, command = step(memory, changed, LIMITS)
    assert memory.state is OutputState.HOLD
    assert words in memory.reason
    assert words in str(first_inhibit(memory, changed, LIMITS))
    assert command.compensation_um == pytest.approx(before)


def test_held_too_long_retreats_to_the_baseline_and_is_no_longer_wanted():
    memory, _ = active()
    memory, command = run(memory, 1900, start_s=600.0, estimate_age_s=999.0)
    assert memory.state is OutputState.OFF
    assert memory.wanted == (False, False)
    assert not command.compensation_um.any()
    assert memory.reason.startswith(
        "held too long, so a person must switch it on again; the reason then: temperatures are stale"
    ), "who comes later must read what held, that it is past, and what to do"


def test_retreat_stays_at_a_baseline_until_the_reference_ends_and_then_goes_to_zero():
    memory = started(applied=(0.0, 12.0), wanted=(False, True))
    memory, command = run(memory, 5)
    assert memory.state is OutputState.ACTIVE
    memory, command = run(memory, 1200, start_s=5.0, request=OperatorRequest(disable=frozenset({"z"})))
    assert memory.state is OutputState.RETREAT
    assert command.compensation_um[1] == pytest.approx(12.0)
    memory, command = run(memory, 600, start_s=1205.0, reference_id=None)
    assert memory.state is OutputState.OFF
    assert not command.compensation_um.any()


def test_a_person_who_asks_for_zero_gets_zero_even_with_a_valid_reference():
    memory = started(applied=(0.0, 12.0), wanted=(False, True))
    memory, _ = run(memory, 5)
    memory, command = run(memory, 600, start_s=5.0, request=OperatorRequest(zero=True))
    assert memory.state is OutputState.OFF
    assert not command.compensation_um.any()


def test_one_axis_disabled_retreats_alone():
    memory, before = active()
    memory, command = run(memory, 600, start_s=600.0, request=OperatorRequest(disable=frozenset({"y"})))
    assert memory.state is OutputState.ACTIVE
    assert command.compensation_um == pytest.approx([0.0, before.compensation_um[1]], abs=0.2)
    assert command.enable == (False, True)


def test_an_axis_that_is_switched_off_retreats_while_the_other_is_held():
    memory, before = active()
    memory, command = run(memory, 60, start_s=600.0, confidence=0.0)
    assert memory.state is OutputState.HOLD
    off = OperatorRequest(disable=frozenset({"y"}))
    memory, command = run(memory, 300, start_s=660.0, confidence=0.0, request=off)
    assert memory.state is OutputState.HOLD
    assert command.compensation_um == pytest.approx([0.0, before.compensation_um[1]], abs=1e-9)


@pytest.mark.parametrize(
    ("phase", "state"), [(Phase.SAFE_POINT, OutputState.ACTIVE), (Phase.CUTTING, OutputState.HOLD)]
)
def test_less_confidence_lets_go_of_the_offset_at_a_safe_point_and_freezes_it_in_a_cut(phase, state):
    memory, before = active()
    partly = {"confidence": 0.5 * (LIMITS.min_confidence + LIMITS.full_confidence), "phase": phase}
    memory, command = run(memory, 300, start_s=600.0, **partly)
    assert memory.state is state
    left = 1.0 if state is OutputState.HOLD else 0.5
    assert command.compensation_um == pytest.approx(left * before.compensation_um, abs=0.2)


def test_switching_on_in_a_retreat_stops_it_where_it_is_written_whatever_the_guard_has_done_since_the_last_poll():
    memory, _ = active()
    memory, command = run(memory, 30, start_s=600.0, reference_id=None, request=OperatorRequest(zero=True))
    written = command.compensation_um.copy()
    assert memory.state is OutputState.RETREAT
    stale_echo = written + 0.7
    again = inputs(
        now_s=631.0, applied_um=stale_echo, reference_id=None, request=OperatorRequest(enable=frozenset(AXES))
    )
    memory, command = step(memory, again, LIMITS)
    assert memory.state is OutputState.ARMED
    assert command.compensation_um == pytest.approx(written)


def test_a_fault_latches_writes_nothing_and_leads_to_hold_with_the_echo():
    memory, command = active()
    memory, command = run(memory, 1, start_s=600.0, output_fault="read-back differs")
    assert memory.state is OutputState.FAULT
    assert not command.write
    memory, command = run(memory, 100, start_s=601.0, applied_um=np.array([1.0, 9.0]), follow=False)
    assert memory.state is OutputState.FAULT
    acknowledged = inputs(
        now_s=702.0, applied_um=np.array([1.0, 9.0]), request=OperatorRequest(acknowledge=1), reference_id=None
    )
    memory, command = step(memory, acknowledged, LIMITS)
    assert memory.state is OutputState.HOLD
    assert command.compensation_um == pytest.approx([1.0, 9.0])


def test_acknowledging_while_the_cause_stands_stays_in_fault():
    memory, _ = active()
    memory, _ = run(memory, 1, start_s=600.0, output_fault="foreign value")
    still = inputs(now_s=602.0, output_fault="foreign value", request=OperatorRequest(acknowledge=1))
    memory, _ = step(memory, still, LIMITS)
    assert memory.state is OutputState.FAULT


def test_a_change_of_model_keeps_the_output_where_it_is():
    memory, command = active()
    before = command.compensation_um.copy()
    memory, command = run(memory, 30, start_s=600.0, model_id="m2", thermal_error_um=np.array([-9.0, 11.0]))
    assert command.compensation_um == pytest.approx(before)
    memory, command = run(memory, 600, start_s=630.0, model_id="m2", thermal_error_um=np.array([-9.0, 10.0]))
    assert command.compensation_um == pytest.approx(before + [0.0, 1.0], abs=0.15)


def test_what_is_written_never_runs_ahead_of_the_guard_by_more_than_its_step():
    memory, command = run(
        started(), 3000, follow=False, applied_um=np.zeros(2), request=OperatorRequest(enable=frozenset(AXES))
    )
    assert np.all(np.abs(command.compensation_um) <= LIMITS.step_um + 1e-9)
    assert "z:step" in command.limits_hit


def test_the_deadband_keeps_small_changes_from_being_written():
    memory, command = active()
    before = command.compensation_um.copy()
    memory, command = run(memory, 60, start_s=600.0, thermal_error_um=np.array([-3.0, -20.0]) + 0.05)
    assert np.array_equal(command.compensation_um, before)


def test_every_state_can_be_left():
    assert set(TRANSITIONS) == set(OutputState)
    assert all(rows for rows in TRANSITIONS.values())


@given(error=st.floats(allow_nan=True, allow_infinity=True), elapsed=st.floats(0, 1e6))
@settings(max_examples=100, deadline=None)
def test_no_single_estimate_moves_further_than_the_slew_rate(error, elapsed):
    memory, command = active()
    before = command.compensation_um.copy()
    _, command = step(
        memory,
        inputs(now_s=600.0 + elapsed, applied_um=before, thermal_error_um=np.array([error, error])),
        LIMITS,
    )
    reach = LIMITS.slew_um_per_min * min(elapsed, LONGEST_INTERVAL_S) / 60.0
    assert np.all(np.isfinite(command.compensation_um))
    assert np.all(np.abs(command.compensation_um - before) <= reach + 1e-9)
