"""Where the request counts from: references that settle, probes, weights, and zero_first."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from output_machine import AXES, LIMITS, ON, Machine

from models.control.baseline import request_um
from models.control.compensation import LONGEST_INTERVAL_S, first_inhibit, initial_memory, step
from models.control.probe_values import probe_inhibit, tool_setting_inhibit, weight_of
from models.control.state import NO_REQUEST, Inhibit, InhibitCode, OperatorRequest
from models.records import OutputState, Phase

# --- a reference settles ---------------------------------------------------------------

STALE = Inhibit(code=InhibitCode.STALE, text="temperatures are stale", remedy="bring them back")


def test_what_the_guard_applies_before_the_new_command_is_held_becomes_the_baseline():
    machine = Machine().following()
    machine.set(thermal_error_um=np.array([-3.0, -26.0])).step(6, guard=False)
    pending = machine.written.copy()
    assert pending[1] > machine.applied[1] + 4.0
    new = {"reference_id": "r2", "estimate_reference_id": "r2", "thermal_error_um": np.zeros(2)}
    machine.set(**new)
    machine.now_s += 1.0
    machine.memory, _ = step(machine.memory, machine.inputs(), LIMITS)
    machine.guard()  # before the new command is written, the guard applies the old one
    after_guard = machine.applied.copy()
    machine.step(60)
    assert machine.applied == pytest.approx(after_guard, abs=1e-9)
    assert machine.memory.baseline_um == pytest.approx(after_guard)


def test_what_the_guard_applies_stays_the_baseline_however_far_the_control_rounds():
    """With a scale of 5 an increment of 1 um is 5 um of the axis: the tool went back by 2 um on the part."""
    machine = Machine(limits=replace(LIMITS, rounding_um=np.array([0.05, 2.55]), step_um=np.array([5.0, 30.0])))
    machine.following().set(thermal_error_um=np.array([-3.0, -23.0])).step(6, guard=False)
    machine.set(reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.zeros(2))
    machine.step(guard=False)
    machine.applied = np.array([3.0, 25.0])  # of the 23 um that the block held
    machine.step(60)
    assert machine.applied == pytest.approx([3.0, 25.0])


def test_a_reference_that_settled_is_followed_again():
    machine = Machine().following()
    machine.set(reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.zeros(2)).step(3)
    assert not machine.memory.settling
    machine.set(thermal_error_um=np.array([1.0, -2.0])).step(30)
    assert machine.applied == pytest.approx([2.0, 22.0], abs=0.02)


def test_zero_is_reached_although_a_reference_arrives_on_the_way_and_the_control_rounds():
    slow = replace(LIMITS, slew_um_per_min=np.array([4.0, 4.0]))
    machine = Machine(limits=slow).set(thermal_error_um=np.array([0.0, -12.0])).step(request=ON).step(400)
    machine.step(request=OperatorRequest(zero=True))
    for minute in range(12):
        if minute == 1:
            new = {"reference_id": "r2", "estimate_reference_id": "r2", "thermal_error_um": np.zeros(2)}
            machine.set(**new)
        machine.step(60, guard=False)
        machine.guard()
        machine.applied = np.round(machine.applied / 0.1) * 0.1
    assert machine.memory.state is OutputState.OFF and not machine.applied.any()


def test_a_guard_that_goes_elsewhere_than_the_block_said_moves_no_baseline():
    machine = Machine().following()
    before = machine.applied.copy()
    machine.set(reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.zeros(2))
    machine.now_s += 1.0
    machine.memory, _ = step(machine.memory, machine.inputs(), LIMITS)
    machine.applied = before - 8.0
    machine.step(60)
    assert machine.memory.baseline_um == pytest.approx(before)
    assert machine.applied == pytest.approx(before, abs=0.02)


def test_a_model_that_is_released_while_a_tool_setting_settles_moves_nothing():
    machine = Machine().following()
    machine.step(tool_setting=(False, True), guard=False)
    assert machine.memory.settling
    machine.set(model_id="m2", thermal_error_um=np.array([-5.0, -14.0])).step(60)
    assert machine.applied == pytest.approx([3.0, 20.0], abs=0.02)
    machine.set(thermal_error_um=np.array([-6.0, -15.0])).step(60)
    assert machine.applied == pytest.approx([4.0, 21.0], abs=0.02)


# --- probes ------------------------------------------------------------------------------


def test_a_probe_value_is_cancelled_from_then_on():
    machine = Machine().following()
    deviation = np.array([np.nan, 4.0])
    inputs = machine.inputs()
    assert probe_inhibit(machine.memory, inputs, LIMITS, None, deviation) is None
    machine.step(probe_um=deviation).step(60)
    assert machine.applied == pytest.approx([3.0, 16.0], abs=0.02)
    machine.set(thermal_error_um=np.array([-3.0, -22.0])).step(60)
    assert machine.applied == pytest.approx([3.0, 18.0], abs=0.02)


@pytest.mark.parametrize("phase", [Phase.CUTTING, Phase.SAFE_POINT])
def test_a_probe_after_a_cut_with_sensors_away_is_not_counted_twice_once_they_weigh_again(phase):
    """Seed 1001, day 11: the weight of before the probe was renewed after it, and Z stood 1.7 um off in ACTIVE."""
    machine = Machine().following()
    machine.set(confidence=0.7).step(60)
    machine.set(phase=Phase.CUTTING).step(60)
    machine.set(confidence=1.0).step(60)
    assert (machine.memory.weight, machine.applied[1]) == (pytest.approx(0.5), pytest.approx(10.0, abs=0.02))
    deviation = np.array([np.nan, -9.0])  # the model is 1 um off
    machine.set(phase=phase)
    assert probe_inhibit(machine.memory, machine.inputs(), LIMITS, None, deviation) is None
    machine.step(probe_um=deviation).step(60)
    machine.set(phase=Phase.SAFE_POINT).step(60)
    assert machine.applied == pytest.approx([3.0, 19.0], abs=0.02)


@pytest.mark.parametrize(
    ("deviation", "changes", "inhibit", "words"),
    [
        ([np.nan, 11.0], {}, None, "more than the bound of 10 um"),
        ([np.nan, np.nan], {}, None, "no axis was probed"),
        ([np.nan, 1.0], {}, STALE, "temperatures are stale"),
        ([np.nan, 1.0], {"thermal_error_um": np.array([0.0, np.nan])}, None, "no estimate"),
        ([np.nan, 1.0], {"fading_um": 1.4}, None, "goes over to what they say by 1.4 um; measure again"),
    ],
)
def test_a_probe_value_that_cannot_be_used_is_refused_in_words(deviation, changes, inhibit, words):
    machine = Machine().following()
    inputs = machine.inputs(**changes)
    assert words in str(probe_inhibit(machine.memory, inputs, LIMITS, inhibit, np.array(deviation)))


def test_a_tool_is_not_set_while_the_step_of_a_sensor_s_return_still_fades():
    machine = Machine().following()
    assert tool_setting_inhibit(machine.memory, machine.inputs(fading_um=0.2), LIMITS, None) is None
    refusal = tool_setting_inhibit(machine.memory, machine.inputs(fading_um=1.4), LIMITS, None)
    assert "sensors have just returned" in str(refusal)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fading_um": 0.6}, "goes over to what they say by 0.6 um"),
        ({"held_s": 25.0}, "the oldest temperature that counts is from 25 s ago"),
        ({"estimate_age_s": 0.6 * LIMITS.stale_after_s}, "the oldest temperature that counts"),
        ({"confidence": LIMITS.full_confidence - 0.01}, "sensors are missing: confidence"),
    ],
)
def test_nothing_is_counted_from_an_estimate_that_fades_or_is_held(changes, words):
    machine = Machine().following()
    usual, inputs = machine.inputs(), machine.inputs(**changes)
    deviation = np.array([np.nan, 1.0])
    assert tool_setting_inhibit(machine.memory, usual, LIMITS, None) is None
    assert words in str(tool_setting_inhibit(machine.memory, inputs, LIMITS, None))
    assert words in str(probe_inhibit(machine.memory, inputs, LIMITS, None, deviation))


@pytest.mark.parametrize("acknowledged", [False, True])
def test_nothing_that_is_measured_in_a_fault_counts_after_it(acknowledged):
    """Nothing is written in FAULT, so the program hears neither yes nor no; the tool must not move later."""
    machine = Machine().following()
    fault = {} if acknowledged else {"output_fault": "macro #501 holds 0.002, we wrote 0"}
    in_fault = replace(machine.memory, state=OutputState.FAULT) if acknowledged else machine.memory
    deviation = np.array([np.nan, -5.6])
    for refusal in (
        probe_inhibit(in_fault, machine.inputs(**fault), LIMITS, None, deviation),
        tool_setting_inhibit(in_fault, machine.inputs(**fault), LIMITS, None),
    ):
        assert "in FAULT" in str(refusal) and "acknowledge the fault, then measure again" in str(refusal)
    if not acknowledged:
        machine.step(probe_um=deviation, tool_setting=(False, True), **fault)
        assert machine.memory.offset_um == pytest.approx([0.0, 0.0])
        assert not machine.memory.tools


# --- confidence --------------------------------------------------------------------------


def test_between_cuts_the_weight_scales_the_estimate_but_not_the_baseline():
    machine = Machine(applied=(0.0, 10.0))
    machine.set(thermal_error_um=np.array([0.0, -20.0]))
    machine.step(request=ON).step(120)
    assert machine.applied[1] == pytest.approx(30.0, abs=0.02)
    machine.set(confidence=0.7).step(120)
    assert machine.applied[1] == pytest.approx(10.0 + 0.5 * 20.0, abs=0.02)


def test_in_a_cut_a_falling_confidence_freezes_and_never_scales():
    machine = Machine().following()
    before = machine.written.copy()
    machine.set(phase=Phase.CUTTING, confidence=0.7).step(60)
    assert machine.memory.state is OutputState.HOLD
    assert "within a cut" in machine.memory.reason
    assert np.array_equal(machine.written, before)
    machine.set(phase=Phase.SAFE_POINT).step(60)
    assert machine.memory.state is OutputState.ACTIVE
    assert machine.applied == pytest.approx([1.5, 10.0], abs=0.02)


def test_in_a_cut_a_rising_confidence_changes_no_weight():
    machine = Machine().following()
    machine.set(confidence=0.7).step(60)
    machine.set(phase=Phase.CUTTING, confidence=1.0).step(60)
    assert machine.applied == pytest.approx([1.5, 10.0], abs=0.02)


# --- zero first --------------------------------------------------------------------------


def test_zero_first_takes_the_offset_out_and_comes_back_with_the_next_reference():
    machine = Machine().following()
    machine.set(reference_id=None, zero_first=True).step(5)
    assert machine.memory.state is OutputState.RETREAT
    machine.step(120)
    assert machine.memory.state is OutputState.OFF and not machine.applied.any()
    assert machine.memory.wanted == (True, True), "nobody switched it off"
    machine.step(30)
    assert machine.memory.state is OutputState.OFF
    new = {"reference_id": "r2", "estimate_reference_id": "r2", "thermal_error_um": np.array([0.0, -2.0])}
    machine.set(zero_first=False, **new).step(60)
    assert machine.memory.state is OutputState.ACTIVE
    assert machine.applied == pytest.approx([0.0, 2.0], abs=0.02)


SLOW = replace(LIMITS, slew_um_per_min=np.array([2.0, 4.0]), deadband_um=np.array([0.1, 0.1]))
FAST = replace(LIMITS, slew_um_per_min=np.array([900.0, 900.0]), step_um=np.array([40.0, 80.0]))
ERRORS_UM = st.tuples(st.floats(-200, 200), st.floats(-200, 200))
SOME_AXES = [frozenset({"y"}), frozenset({"z"}), frozenset({"y", "z"})]
REQUESTS = [OperatorRequest(enable=axes) for axes in SOME_AXES] + [OperatorRequest(disable=axes) for axes in SOME_AXES]
REQUESTS += [OperatorRequest(zero=True)]
TROUBLES = [{"thermal_error_um": np.array([bad, bad])} for bad in (np.nan, np.inf, -np.inf)]
TROUBLES += [{"reference_id": None}, {"output_fault": "read-back differs"}, {"link": False}]


class Histories(RuleBasedStateMachine):
    """Random histories of inputs, faults, guard runs and operators, and of everything that the request counts from."""

    @initialize(
        applied=st.sampled_from([(0.0, 0.0), (5.0, -20.0)]),
        limits=st.sampled_from([LIMITS, SLOW, FAST]),
        request=st.sampled_from([NO_REQUEST, ON, ON]),
        reference=st.sampled_from([None, "r1", "r1"]),
    )
    def start(self, applied, limits, request, reference):
        self.machine = Machine(applied=applied, limits=limits)
        self.machine.set(reference_id=reference, estimate_reference_id=reference).step(request=request)
        self.references = 1

    def take(self, elapsed_s=1.0, *, guard_before=False, **once):
        machine = self.machine
        if guard_before:
            machine.guard()
        before, applied, limits = machine.memory.command_um.copy(), machine.applied.copy(), machine.limits
        machine.step(guard=False, elapsed_s=elapsed_s, **once)
        now = machine.command.compensation_um
        reach = limits.slew_um_per_min * min(elapsed_s, LONGEST_INTERVAL_S) / 60.0 + 1e-9
        assert np.all(np.isfinite(now))
        assert np.all((np.abs(now - before) <= reach) | (np.abs(now - applied) <= reach))
        assert np.all(np.abs(now) <= np.maximum(limits.absolute_bound_um, np.abs(before)) + 1e-9)
        assert np.all(np.abs(now - applied) <= np.maximum(limits.step_um, np.abs(before - applied)) + 1e-9)
        assert 0.0 <= machine.memory.weight <= 1.0
        assert machine.command.write or machine.memory.state is OutputState.FAULT or not machine.state.link

    @rule(errors=ERRORS_UM, term=st.floats(-20, 20), elapsed=st.sampled_from([0.3, 1.0, 1.0, 5.0, 30.0, 3600.0]))
    def estimate(self, errors, term, elapsed):
        self.machine.set(thermal_error_um=np.array(errors), tool_term_um=np.array([0.0, term]), estimate_age_s=0.1)
        self.take(elapsed)

    @rule(trouble=st.sampled_from(TROUBLES))
    def trouble(self, trouble):
        self.machine.set(**trouble)
        self.take()

    @rule(in_domain=st.booleans(), age=st.sampled_from([0.1, 30.0, 90.0, np.inf]))
    def quality(self, in_domain, age):
        machine = self.machine
        command, frozen = machine.memory.command_um.copy(), machine.memory.state is OutputState.ACTIVE
        machine.set(in_domain=in_domain, estimate_age_s=age)
        self.take()
        if frozen and (not in_domain or age > 60) and all(machine.memory.wanted) and not machine.memory.settling:
            assert np.allclose(machine.memory.command_um, command, rtol=0.0, atol=1e-9)

    @rule()
    def guard_runs(self):
        self.machine.guard()

    @rule(guard_before=st.booleans())
    def new_reference(self, guard_before):
        self.references += 1
        name = f"r{self.references}"
        self.machine.set(reference_id=name, estimate_reference_id=name, thermal_error_um=np.zeros(2))
        machine = self.machine
        self.take(guard_before=guard_before)
        if machine.memory.reference_id == name and machine.memory.state in (OutputState.ACTIVE, OutputState.HOLD):
            moved, on = np.abs(machine.command.compensation_um - machine.applied), np.array(machine.memory.wanted)
            assert np.all(moved[on] <= (machine.limits.slew_um_per_min / 60.0 + 1e-9)[on])
        if machine.memory.reference_id == name and machine.memory.state is OutputState.ACTIVE:
            assert np.allclose(machine.command.compensation_um, machine.memory.baseline_um)

    @rule(request=st.sampled_from(REQUESTS), elapsed=st.sampled_from([1.0, 30.0]))
    def operator(self, request, elapsed):
        self.take(elapsed, request=request)

    @precondition(lambda self: self.machine.memory.state is OutputState.FAULT)
    @rule()
    def acknowledge(self):
        self.machine.set(output_fault=None)
        self.take(request=OperatorRequest(acknowledge=1))

    @rule(errors=ERRORS_UM, guard=st.booleans(), elapsed=st.sampled_from([1.0, 5.0, 3600.0]))
    def a_person_sets_everything_right(self, errors, guard, elapsed):
        """Else a history would stand in FAULT, OFF and HOLD for most of its steps."""
        name = f"r{self.references}"
        self.machine.set(link=True, output_fault=None, zero_first=False, reference_id=name, estimate_reference_id=name)
        self.machine.set(confidence=1.0, in_domain=True, estimate_age_s=0.1, phase=Phase.SAFE_POINT)
        self.take(request=OperatorRequest(enable=frozenset(AXES), acknowledge=1))
        self.machine.set(thermal_error_um=np.array(errors), tool_term_um=np.zeros(2))
        for _ in range(5):
            self.take(elapsed, guard_before=guard)

    @rule()
    def restart(self):
        """The daemon dies and begins again from the CNC's echo."""
        machine = self.machine
        wanted = machine.memory.wanted
        machine.memory = initial_memory(now_s=machine.now_s, applied_um=machine.applied, wanted=wanted)
        assert np.array_equal(machine.memory.command_um, machine.applied)

    @rule(axes=st.sampled_from([(True, False), (False, True), (True, True)]))
    def tool_setting(self, axes):
        machine = self.machine
        set_before = machine.applied.copy()
        self.take(tool_setting=axes)
        if machine.memory.reference_id is not None and machine.memory.state is OutputState.ACTIVE:
            chosen = np.array(axes)
            assert np.allclose(machine.command.compensation_um[chosen], set_before[chosen])

    @rule(number=st.integers(1, 3))
    def tool_change(self, number):
        self.machine.set(tool_number=number)
        self.take()

    @rule(deviation=st.floats(-30, 30))
    def probe(self, deviation):
        machine = self.machine
        deviations = np.array([np.nan, deviation])
        inputs = machine.inputs()
        inhibit = first_inhibit(machine.memory, inputs, machine.limits)
        if probe_inhibit(machine.memory, inputs, machine.limits, inhibit, deviations) is None:
            self.take(probe_um=deviations)
            if not machine.memory.settling:
                after = request_um(machine.memory, machine.inputs())
                assert np.isfinite(after[1])

    @rule(confidence=st.floats(0, 1), phase=st.sampled_from(list(Phase)))
    def confidence(self, confidence, phase):
        machine = self.machine
        weight, state, command = machine.memory.weight, machine.memory.state, machine.memory.command_um.copy()
        begun = machine.memory.model_id is not None  # nothing has counted since a restart: its weight is still 1
        same = begun and machine.memory.reference_id == machine.state.reference_id
        machine.set(confidence=confidence, phase=phase)
        self.take()
        following = same and state in (OutputState.ACTIVE, OutputState.HOLD)
        if phase is Phase.CUTTING and following:
            assert machine.memory.weight == weight
            if (
                weight_of(confidence, machine.limits) < weight
                and all(machine.memory.wanted)
                and not machine.memory.settling
            ):
                assert np.allclose(machine.memory.command_um, command, rtol=0.0, atol=1e-9), "in a cut it freezes"

    @rule(zero_first=st.booleans())
    def zero_first(self, zero_first):
        self.machine.set(zero_first=zero_first, reference_id=None if zero_first else f"r{self.references}")
        self.take()

    @rule(model=st.sampled_from(["m1", "m2"]), errors=st.tuples(st.floats(-50, 50), st.floats(-50, 50)))
    def change_model(self, model, errors):
        machine = self.machine
        changed = machine.memory.model_id not in (None, model) and machine.memory.reference_id is not None
        before = request_um(machine.memory, machine.inputs())
        machine.set(model_id=model, thermal_error_um=np.array(errors))
        same = machine.memory.reference_id == machine.state.reference_id and not machine.memory.settling
        self.take()
        if changed and same and machine.memory.state is OutputState.ACTIVE:
            moved = np.abs(request_um(machine.memory, machine.inputs()) - before)
            assert np.all(moved[np.array(machine.memory.wanted) & np.isfinite(before)] <= 1e-9)

    @rule(link=st.booleans())
    def link(self, link):
        self.machine.set(link=link)
        self.take()

    @invariant()
    def off_applies_nothing(self):
        if (machine := getattr(self, "machine", None)) is not None and machine.memory.state is OutputState.OFF:
            assert not machine.memory.command_um.any()


TestHistories = Histories.TestCase
TestHistories.settings = settings(max_examples=120, stateful_step_count=60, deadline=None)
