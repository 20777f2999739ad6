"""What was measured with a sensor that is found wrong later: in doubt until it is measured again."""

from dataclasses import replace

import numpy as np
import pytest
from output_machine import LIMITS, Machine

from models.control.compensation import first_inhibit
from models.control.probe_values import probe_inhibit, tool_setting_inhibit
from models.records import OutputState

NOTHING = {"reference_id": "r2", "estimate_reference_id": "r2", "thermal_error_um": np.zeros(2), "found_wrong_um": 0.0}


def wrong_by(machine: Machine, um: float) -> Machine:
    """Z's estimate goes off by this, which nobody knows."""
    machine.truth_um = machine.state.thermal_error_um
    return machine.set(thermal_error_um=machine.truth_um + [0.0, um]).step(60)


def found(machine: Machine, um: float) -> Machine:
    """The sensor is left out: the estimate goes back."""
    machine.set(thermal_error_um=machine.truth_um, found_wrong_um=machine.state.found_wrong_um + um)
    return machine.step(60)


def probed(machine: Machine, um: float) -> Machine:
    inputs = machine.inputs()
    deviation_um = np.array([np.nan, um])
    inhibit = first_inhibit(machine.memory, inputs, LIMITS)
    assert probe_inhibit(machine.memory, inputs, LIMITS, inhibit, deviation_um) is None
    return machine.step(probe_um=deviation_um).step(60)


def tool_set(machine: Machine) -> Machine:
    inputs = machine.inputs()
    inhibit = first_inhibit(machine.memory, inputs, LIMITS)
    assert tool_setting_inhibit(machine.memory, inputs, LIMITS, inhibit) is None
    return machine.step(tool_setting=(False, True)).step(60)


@pytest.mark.parametrize(("worth_um", "state"), [(0.9, OutputState.ACTIVE), (4.0, OutputState.HOLD)])
def test_a_tool_that_was_set_before_is_held_by_what_the_sensor_was_worth(worth_um, state):
    machine = found(tool_set(wrong_by(Machine().following(), worth_um)), worth_um)
    assert machine.memory.state is state
    assert machine.set(tool_number=2).step(2).memory.state is OutputState.ACTIVE, "no other tool counts from that"


def test_a_tool_that_is_set_again_is_followed_and_a_probe_with_it_is_refused_until_then():
    machine = found(tool_set(wrong_by(Machine().following(), 4.0)), 4.0)
    inputs = machine.inputs()
    assert "found wrong later" in str(probe_inhibit(machine.memory, inputs, LIMITS, None, np.array([np.nan, 1.0])))
    assert tool_set(machine).memory.state is OutputState.ACTIVE
    probed(machine, 1.0)


def test_a_probe_before_holds_every_tool_that_counts_from_it_until_it_is_repeated():
    machine = probed(wrong_by(Machine().following(), 4.0), -4.0)
    found(machine, 4.0)
    assert machine.memory.state is OutputState.HOLD
    here_um = machine.applied[1]
    assert probed(machine, 2.0).memory.state is OutputState.ACTIVE
    assert machine.applied[1] == pytest.approx(here_um - 2.0, abs=0.02), "whatever is known of the probe before"


def test_a_tool_that_was_set_on_a_probe_of_before_is_held_when_the_probe_is_repeated_with_another():
    machine = probed(wrong_by(Machine().following(), 4.0), -4.0)
    machine.set(tool_number=2).step(10)
    found(machine, 4.0)
    assert tool_set(machine).memory.state is OutputState.ACTIVE, "the probe's value is in both and cancels"
    machine.set(tool_number=1).step(2)
    probed(machine, 2.0)
    assert machine.memory.state is OutputState.ACTIVE
    assert machine.set(tool_number=2).step(2).memory.state is OutputState.HOLD, "now it is in one of them"


def test_another_model_that_went_on_from_a_wrong_estimate_is_held_until_a_reference_or_a_probe():
    machine = wrong_by(Machine().following(), 4.0)
    machine.set(model_id="m2").step(5)
    assert machine.memory.state is OutputState.ACTIVE
    found(machine, 4.0)
    assert machine.memory.state is OutputState.HOLD
    assert machine.set(**NOTHING).step(3).memory.state is OutputState.ACTIVE


def test_what_is_in_doubt_of_a_tool_stays_in_doubt_with_the_next_reference():
    machine = found(tool_set(wrong_by(Machine().following(), 4.0)), 4.0)
    machine.set(tool_number=2).step(2)
    machine.set(**NOTHING).step(3)
    assert machine.memory.state is OutputState.ACTIVE
    assert machine.set(tool_number=1).step(2).memory.state is OutputState.HOLD
    machine.set(reference_id="r3", estimate_reference_id="r3").step(3)
    assert machine.memory.state is OutputState.ACTIVE, "the tool in the spindle is set by a reference"


@pytest.mark.parametrize(("fading_um", "state"), [(0.9, OutputState.ACTIVE), (2.5, OutputState.HOLD)])
def test_a_tool_of_before_is_held_when_the_work_is_positioned_while_a_return_fades(fading_um, state):
    """Its setting is counted anew by the estimate of then, which is off by what fades, and stayed off by that."""
    machine = tool_set(Machine().following()).set(tool_number=2).step(2).set(fading_um=fading_um).step(3)
    machine.set(**NOTHING, fading_um=0.0).step(3)
    assert machine.memory.state is OutputState.ACTIVE, "the tool in the spindle is set by the reference"
    assert machine.set(tool_number=1).step(2).memory.state is state
    assert tool_set(machine).memory.state is OutputState.ACTIVE


@pytest.mark.parametrize("doubt", [{"confidence": 0.0}, {"in_domain": False}])
def test_a_tool_of_before_is_held_when_the_work_is_positioned_while_the_estimate_is_not_followed(doubt):
    machine = tool_set(Machine().following()).set(tool_number=2).step(2)
    trusted = {key: getattr(machine.state, key) for key in doubt}
    machine.set(**doubt).step(3).set(**NOTHING, **trusted).step(3)
    assert machine.memory.state is OutputState.ACTIVE, "the tool in the spindle is set by the reference"
    assert machine.set(tool_number=1).step(2).memory.state is OutputState.HOLD
    assert "any number of um off" in machine.memory.reason
    refused = probe_inhibit(machine.memory, machine.inputs(), LIMITS, None, np.array([np.nan, 1.0]))
    assert "before a positioning at which the estimate was in doubt" in str(refused)
    assert tool_set(machine).memory.state is OutputState.ACTIVE


def test_a_sensor_that_was_wrong_at_the_reference_already_holds_tools_of_before():
    machine = tool_set(Machine().following())
    machine.set(tool_number=2).step(2)
    machine.set(**NOTHING).step(3)
    machine.set(found_wrong_um=4.0).step(3)
    assert machine.memory.state is OutputState.ACTIVE, "the reference itself holds no estimate"
    assert machine.set(tool_number=1).step(2).memory.state is OutputState.HOLD


def test_what_was_kept_before_there_was_such_a_doubt_is_in_none():
    machine = tool_set(Machine().following())
    kept = {number: replace(tool, found_wrong_um=None) for number, tool in machine.memory.tools.items()}
    machine.memory = replace(machine.memory, tools=kept, counted_found_um=None)
    assert machine.step(2).memory.state is OutputState.ACTIVE


def test_another_model_that_counts_on_from_an_estimate_which_is_not_trusted_holds_until_the_work_is_positioned():
    """A refused reference had let it begin: what both made of a wrong sensor would stay as their difference."""
    machine = tool_set(Machine().following())
    wrong_by(machine.set(confidence=0.0), 4.0)
    machine.set(model_id="m2", thermal_error_um=machine.truth_um + [0.0, 1.0]).step(2)
    stood = machine.applied[1]
    machine.set(thermal_error_um=machine.truth_um, confidence=1.0).step(60)
    assert machine.memory.state is OutputState.HOLD and machine.applied[1] == stood
    assert machine.set(tool_number=2).step(60).memory.state is OutputState.HOLD, "every tool counts from that"
    assert machine.set(**NOTHING).step(60).memory.state is OutputState.ACTIVE
    assert machine.applied[1] == pytest.approx(stood, abs=0.02)


@pytest.mark.parametrize("fading_um", [0.0, 0.5])
def test_a_model_that_goes_on_from_one_that_is_trusted_is_followed(fading_um):
    machine = tool_set(Machine().following()).set(fading_um=fading_um).step(2)
    machine.set(model_id="m2", thermal_error_um=np.array([1.0, 2.0])).step(60)
    assert machine.memory.state is OutputState.ACTIVE and machine.applied[1] == pytest.approx(20.0, abs=0.02)
