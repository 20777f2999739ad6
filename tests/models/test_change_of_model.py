"""A change of model moves nothing, whatever is in force when it comes, and an identical one changes nothing at all."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from output_machine import LIMITS, Machine

from models.control.baseline import request_um
from models.control.state import OperatorRequest
from models.records import OutputState

errors = st.tuples(st.floats(-12.0, 12.0), st.floats(-12.0, 12.0)).map(np.array)
terms = st.tuples(st.floats(-5.0, 5.0), st.one_of(st.just(float("nan")), st.floats(-5.0, 5.0))).map(np.array)


def requested(machine):
    return request_um(machine.memory, machine.inputs())


@given(
    error=errors,
    other=errors,
    term=terms,
    confidence=st.floats(0.5, 1.0),
    probe=st.floats(-3.0, 3.0),
    lag=st.integers(0, 30),
    tool=st.booleans(),
    later=errors,
)
@settings(max_examples=20, deadline=None)
def test_a_release_leaves_the_request_where_it_is_and_the_same_model_equals_its_twin(
    error, other, term, confidence, probe, lag, tool, later
):
    machine = Machine().following()
    machine.step(probe_um=np.array([np.nan, probe]))
    if tool:
        machine.step(tool_setting=(False, True))
    machine.set(thermal_error_um=np.array([-3.0, -20.0]) + error, tool_term_um=term, confidence=confidence).step(
        lag + 1
    )
    twin, before = copy.copy(machine), requested(machine)
    machine.set(model_id="m2", thermal_error_um=machine.state.thermal_error_um + other).step(1)
    known = np.isfinite(before)
    assert np.all(np.abs(requested(machine) - before)[known] <= 1e-6), "the request goes on"
    back = {"tool_term_um": np.zeros(2), "confidence": 1.0}
    machine.set(thermal_error_um=twin.state.thermal_error_um + other + later / 4.0, **back).step(200)
    twin.step(1).set(thermal_error_um=twin.state.thermal_error_um + later / 4.0, **back).step(200)
    if confidence < LIMITS.min_confidence:  # nobody knows what the new model goes on from
        assert machine.memory.state is OutputState.HOLD
        return
    assert np.all(np.abs(machine.applied - twin.applied) <= 0.05), "it contributes what the first one would have"


def test_a_release_while_the_tool_s_sensors_are_silent_compensates_nothing_twice():
    machine = Machine().following()
    machine.set(tool_term_um=np.array([0.0, np.nan])).step(5)
    machine.set(model_id="m2").step(5).set(tool_term_um=np.zeros(2)).step(60)
    np.testing.assert_allclose(machine.applied, [3.0, 20.0], atol=0.02)


def test_a_release_with_a_sensor_missing_goes_on_when_it_is_back():
    machine = Machine().following()
    machine.set(confidence=0.7).step(60)
    machine.set(model_id="m2").step(30).set(confidence=1.0).step(60)
    np.testing.assert_allclose(machine.applied, [3.0, 20.0], atol=0.02)


def test_a_model_without_an_estimate_for_an_axis_waits_there():
    machine = Machine().following()
    machine.set(model_id="m2", thermal_error_um=np.array([np.nan, -30.0])).step(30)
    np.testing.assert_allclose(machine.applied, [3.0, 20.0], atol=0.02)
    machine.set(thermal_error_um=np.array([7.0, -30.0])).step(60)
    np.testing.assert_allclose(machine.applied, [3.0, 20.0], atol=0.02)


def test_an_axis_that_begins_late_while_a_return_fades_leaves_the_others_out_of_doubt():
    machine = Machine().following()
    machine.step(tool_setting=(False, True))
    machine.set(model_id="m2", thermal_error_um=np.array([np.nan, -20.0])).step(5)
    assert machine.memory.counted_found_um == pytest.approx([0.0, 0.0])
    machine.set(fading_um=4.0).step(2).set(thermal_error_um=np.array([-3.0, -20.0])).step(2)
    assert machine.memory.counted_found_um == pytest.approx([-4.0, 0.0])
    assert machine.step(request=OperatorRequest(disable=frozenset({"y"}))).step(5).memory.state is OutputState.ACTIVE


def test_on_a_machine_with_an_axis_without_a_model_a_moment_of_doubt_after_a_release_holds_no_longer_than_it_lasts():
    machine = Machine().following(y=0.0).step(request=OperatorRequest(disable=frozenset({"y"})))
    machine.set(model_id="m2", thermal_error_um=np.array([np.nan, -20.0])).step(5)
    counted = machine.memory.counted_found_um, machine.memory.tools, machine.memory.model_shift_um
    machine.set(confidence=0.0).step(5).set(confidence=1.0).step(5)
    assert machine.memory.state is OutputState.ACTIVE
    now = machine.memory.counted_found_um, machine.memory.tools, machine.memory.model_shift_um
    assert all(one is other for one, other in zip(now, counted, strict=True)), "what a restart takes up is kept once"
