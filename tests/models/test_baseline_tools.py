"""Tool settings and tool terms: where the request of a tool counts from, and for how long."""

from dataclasses import replace

import numpy as np
import pytest
from output_machine import Machine

from models.records import OutputState


def test_a_tool_setting_moves_nothing_and_is_kept_for_that_tool_alone():
    machine = Machine().following()
    machine.set(tool_number=2, thermal_error_um=np.array([-3.0, -24.0])).step(30)
    assert machine.applied[1] == pytest.approx(24.0, abs=0.02)
    before = machine.applied.copy()
    machine.step(tool_setting=(False, True)).step(30)
    assert machine.applied == pytest.approx(before, abs=1e-9)
    machine.set(thermal_error_um=np.array([-3.0, -30.0])).step(30)
    assert machine.applied[1] == pytest.approx(before[1] + 6.0, abs=0.02)
    machine.set(tool_number=1).step(60)
    assert machine.applied[1] == pytest.approx(30.0, abs=0.02), "tool 1 counts from the work's reference"


def test_a_tool_that_is_set_with_the_first_estimate_after_a_restart_counts_from_that_estimate():
    """Before, it counted from no thermal error at all: 20 um off, ACTIVE."""
    machine = Machine().following()
    machine.memory = replace(machine.memory, error_um=None)  # no record keeps the estimate
    machine.step(tool_setting=(False, True)).step(60)
    assert machine.applied == pytest.approx([3.0, 20.0], abs=0.02)


def test_the_setting_of_another_tool_survives_a_new_reference_of_the_work():
    machine = Machine().following()
    machine.set(tool_number=2).step(2).step(tool_setting=(False, True)).step(5)
    machine.set(tool_number=1, thermal_error_um=np.array([-3.0, -25.0])).step(30)
    wanted_of_tool_2 = 20.0 + 5.0
    machine.set(reference_id="r2", estimate_reference_id="r2", thermal_error_um=np.zeros(2)).step(30)
    machine.set(tool_number=2, thermal_error_um=np.array([0.0, -1.0])).step(60)
    assert machine.applied[1] == pytest.approx(wanted_of_tool_2 + 1.0, abs=0.02)


def renewed(reference_id, z_um=0.0):
    """What arrives with a new reference."""
    names = {"reference_id": reference_id, "estimate_reference_id": reference_id, "kept_reference_id": reference_id}
    return {**names, "thermal_error_um": np.array([0.0, z_um])}


def with_tool_2_set():
    """Tool 2 is set with 20 um applied; then tool 1 is in the spindle, and the machine has gone on by 5 um."""
    machine = Machine().set(kept_reference_id="r1").following()
    machine.set(tool_number=2).step(2).step(tool_setting=(False, True)).step(5)
    return machine.set(tool_number=1, thermal_error_um=np.array([-3.0, -25.0])).step(30)


def test_a_tool_setting_outlives_the_reference_of_the_work():
    machine = with_tool_2_set()
    machine.set(reference_id=None).step(5)
    machine.set(thermal_error_um=np.array([-3.0, -28.0])).step(5)
    assert machine.memory.state is OutputState.HOLD and 2 in machine.memory.tools
    assert machine.applied[1] == pytest.approx(25.0, abs=0.02), "nothing is followed without a reference"
    machine.set(**renewed("r2")).step(30)
    assert machine.applied[1] == pytest.approx(25.0, abs=0.02)
    machine.set(tool_number=2, thermal_error_um=np.array([0.0, -1.0])).step(60)
    assert machine.applied[1] == pytest.approx(20.0 + 8.0 + 1.0, abs=0.02), "all that has come since it was set"


def test_a_tool_setting_ends_with_what_it_counts_from():
    machine = with_tool_2_set()
    machine.set(reference_id=None, kept_reference_id=None).step(1)
    assert not machine.memory.tools


def test_a_tool_setting_ends_when_nobody_knows_how_far_the_machine_had_gone_at_the_new_reference():
    machine = with_tool_2_set()
    machine.set(reference_id=None, estimate_age_s=1e3).step(100)
    assert machine.memory.tools
    machine.set(estimate_age_s=1.0, **renewed("r2")).step(1)
    assert not machine.memory.tools


def test_another_model_without_a_reference_leaves_a_tool_setting_where_it_is():
    machine = with_tool_2_set()
    machine.set(reference_id=None).step(5)
    machine.set(model_id="m2", thermal_error_um=np.array([-3.0, -100.0])).step(5)
    machine.set(thermal_error_um=np.array([-3.0, -102.0])).step(5)
    machine.set(**renewed("r2")).step(5).set(tool_number=2).step(60)
    assert machine.applied[1] == pytest.approx(20.0 + 5.0 + 2.0, abs=0.02)


def test_the_tool_in_the_spindle_is_set_anew_by_the_reference_and_kept_over_the_next():
    machine = with_tool_2_set()
    machine.set(tool_number=2).step(60).set(**renewed("r2")).step(5)
    positioned_with_um = machine.applied[1]
    machine.set(thermal_error_um=np.array([0.0, -4.0]), tool_number=1).step(60).set(**renewed("r3")).step(5)
    machine.set(tool_number=2).step(60)
    assert machine.applied[1] == pytest.approx(positioned_with_um + 4.0, abs=0.02)


def test_the_tool_term_counts_beside_the_nose():
    machine = Machine().following()
    machine.set(tool_term_um=np.array([0.0, -4.0])).step(60)
    assert machine.applied == pytest.approx([3.0, 24.0], abs=0.02)
    machine.set(tool_term_um=np.array([0.0, 0.0])).step(60)
    assert machine.applied == pytest.approx([3.0, 20.0], abs=0.02)


def test_a_tool_term_without_a_temperature_freezes():
    machine = Machine().following()
    before = machine.written.copy()
    machine.set(tool_term_um=np.array([0.0, np.nan])).step(10)
    assert machine.memory.state is OutputState.HOLD
    assert np.array_equal(machine.written, before)


def test_a_tool_setting_leaves_the_probe_correction_of_the_other_tools_alone():
    machine = Machine().following()
    machine.step(probe_um=np.array([np.nan, 4.0])).step(60)
    machine.set(tool_number=2).step(2).step(tool_setting=(False, True)).step(30)
    assert machine.applied[1] == pytest.approx(16.0, abs=0.02)
    machine.set(tool_number=1).step(60)
    assert machine.applied[1] == pytest.approx(16.0, abs=0.02)
    machine.set(tool_number=2, thermal_error_um=np.array([-3.0, -21.0])).step(60)
    assert machine.applied[1] == pytest.approx(17.0, abs=0.02)
