"""Probe values in the output and on recordings: one filter, never worse than the model or the probe alone."""

from dataclasses import replace

import numpy as np
import pytest
from output_machine import LIMITS, Machine

from models.control.state import OperatorRequest
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.bias import BiasFilter, Wander
from models.thermal.training.inputs import build_inputs
from models.thermal.training.probing import probed_residual_um
from models.thermal.training.trust import fit_bias_filter

WANDER = Wander(um2_per_min=np.array([0.02, 0.02]), correlation_min=np.array([240.0, 240.0]))


def kalman(noise_um: float, correlation_min: float = 240.0) -> BiasFilter:
    one = np.ones(1)
    return BiasFilter(
        wander_um2_per_min=0.02 * one,
        noise_um=noise_um * one,
        largest_step_um=np.inf * one,
        correlation_min=correlation_min * one,
    )


def test_the_output_corrects_as_the_evaluation_of_a_recording_does() -> None:
    """Probes of known noise at odd times: the request's offset is what the filter says of the same values."""
    machine = Machine(limits=replace(LIMITS, probe_noise_um=1.5)).following()
    machine.set(probe_wander=WANDER)
    rng = np.random.default_rng(3)
    missed_um, offline = 0.0, kalman(1.5).begin(0.0)
    for pause_s in (600.0, 60.0, 2400.0, 30.0, 1200.0):
        missed_um += float(rng.normal(0.0, 2.0))
        for _ in range(20):
            machine.step(elapsed_s=pause_s / 20.0)
        left_um = -20.0 + missed_um + machine.applied[1]
        machine.step(elapsed_s=1.0, probe_um=np.array([np.nan, left_um]))
        offline = kalman(1.5).correct(offline, machine.now_s / 60.0, np.array([missed_um]))
        assert -machine.memory.offset_um[1] == pytest.approx(offline.bias_um[0], abs=0.05)
        assert machine.memory.offset_um[0] == 0.0
        assert abs(machine.command.compensation_um - machine.applied).max() <= LIMITS.step_um.max()


def test_the_longer_ago_the_surer_a_probe_against_what_the_one_before_has_left() -> None:
    """By hand: what is not known of the offset fades with the offset, and grows by what wanders meanwhile."""
    noisy, state, now_min = kalman(2.0), kalman(2.0).begin(0.0), 0.0
    bias_um, variance_um2 = 0.0, 0.0
    for pause_min, residual_um in ((60.0, 5.0), (1.5, 3.0), (240.0, -4.0)):
        now_min += pause_min
        kept = np.exp(-pause_min / 240.0)
        variance_um2 = kept**2 * variance_um2 + 0.02 * 240.0 / 2.0 * (1.0 - kept**2)
        gain = variance_um2 / (variance_um2 + 2.0**2)
        bias_um = kept * bias_um + gain * (residual_um - kept * bias_um)
        variance_um2 *= 1.0 - gain
        state = noisy.correct(state, now_min, np.array([residual_um]))
        assert state.bias_um[0] == pytest.approx(bias_um), pause_min
        assert state.variance_um2[0] == pytest.approx(variance_um2), pause_min


def test_left_alone_the_offset_returns_slowly_and_within_the_slew_rate() -> None:
    machine = Machine().following().set(probe_wander=WANDER)
    machine.step(probe_um=np.array([np.nan, 4.0])).step(60)
    assert machine.applied[1] == pytest.approx(16.0, abs=0.1)
    for _ in range(480):
        before = machine.applied[1]
        machine.step(elapsed_s=30.0)
        assert abs(machine.applied[1] - before) < 0.1
    assert machine.applied[1] == pytest.approx(20.0 - 4.0 * np.exp(-1.0), abs=0.05)
    assert machine.memory.offset_um[0] == 0.0


def test_after_a_restart_the_first_probe_resets_and_a_new_reference_begins_at_nothing() -> None:
    machine = Machine(limits=replace(LIMITS, probe_noise_um=1.0)).following()
    machine.set(probe_wander=WANDER)
    machine.memory = replace(machine.memory, probed=None)
    machine.step(probe_um=np.array([np.nan, 4.0]))
    assert machine.memory.offset_um[1] == pytest.approx(-4.0, abs=0.02)
    machine.set(reference_id="r2", estimate_reference_id="r2").step()
    assert machine.memory.probed is not None and not machine.memory.probed.variance_um2.any()


def recording(time_min: FloatArray, um: FloatArray) -> Recording:
    return Recording(
        name="days",
        time_s=60.0 * time_min,
        speed_rpm=None,
        temperature_names=("T1",),
        temperatures_degc=20.0 + np.sin(time_min / 100.0)[:, None],
        displacement_names=("z",),
        displacements_um=um,
    )


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("missed", "probes", "noise_um"),
    [
        *(("slow", "10", 0.0), ("slow", "30", 1.0), ("slow", "60", 3.0), ("slow", "random", 3.0)),
        *(("fast", "10", 1.0), ("fast", "30", 3.0), ("fast", "60", 0.0), ("fast", "random", 0.0)),
        *(("much", "10", 3.0), ("much", "30", 0.0), ("much", "60", 1.0), ("much", "random", 1.0)),
        *(("little", "10", 3.0), ("little", "30", 3.0), ("little", "60", 0.0), ("little", "random", 1.0)),
    ],
)
def test_a_probe_never_makes_it_worse_than_the_better_of_the_two(noise_um: float, probes: str, missed: str) -> None:
    """What the model misses wanders over hours; how fast comes from other days of the same kind."""
    hours, tau_min, missed_um = 400.0, {"fast": 40.0}.get(missed, 200.0), {"much": 12.0, "little": 0.5}.get(missed, 3.0)
    time_min = np.arange(0.0, 60.0 * hours)
    rng = np.random.default_rng([int(noise_um), len(probes), len(missed)])

    def wandering(size_um: float, over_min: float) -> FloatArray:
        found, keep = np.zeros(len(time_min)), np.exp(-1.0 / over_min)
        steps = rng.normal(0.0, size_um * np.sqrt(1.0 - keep**2), len(time_min))
        for row in range(1, len(time_min)):
            found[row] = keep * found[row - 1] + steps[row]
        return found[:, None]

    trained_um, residual_um = wandering(missed_um, tau_min), wandering(missed_um, tau_min)
    error_um = residual_um + 15.0 * np.sin(time_min / 45.0)[:, None]
    if probes == "random":
        at_min: float | FloatArray = np.sort(rng.uniform(0.0, time_min[-1], int(time_min[-1] / 45.0)))
    else:
        at_min = float(probes)
    noise = rng.normal(0.0, noise_um, residual_um.shape)
    inputs = build_inputs([recording(time_min, trained_um)], sample_s=60.0, lags_min=(), speed_lags_min=())
    both = fit_bias_filter(inputs, np.ones(inputs.rows, dtype=np.bool_), trained_um, 60.0)
    both = replace(both, noise_um=np.array([noise_um]), largest_step_um=np.array([np.inf]))
    left = rms(probed_residual_um(time_min, residual_um, at_min, both, noise))
    alone = rms(residual_um), rms(probed_residual_um(time_min, error_um, at_min, None, noise))
    assert left <= 1.02 * min(alone), (left, alone)


def left_by(model_um: FloatArray, truth_um: FloatArray, pause_min: int) -> FloatArray:
    """What model and exact probes leave of a truth minute by minute [um], by the filter of a model with a wander."""
    exact = kalman(0.0)
    state, left = exact.begin(0.0), []
    for minute, (said, true) in enumerate(zip(model_um, truth_um, strict=True)):
        now = np.array([said])
        state = exact.advanced(state, float(minute), now)
        if minute and minute % pause_min == 0:
            state = exact.correct(state, float(minute), np.array([true - said]), now)
        left.append(true - said - float(state.bias_um[0]))
    return np.array(left)


@pytest.mark.parametrize("pause_min", [10, 30, 60])
def test_between_probes_a_model_of_the_wrong_sign_is_not_followed_and_a_right_one_is(pause_min: int) -> None:
    minutes = np.arange(601.0)
    truth = 40.0 * (1.0 - np.exp(-minutes / 240.0))
    alone = np.array([true - truth[int(m) // pause_min * pause_min] for m, true in zip(minutes, truth, strict=True)])
    told = slice(pause_min, None)
    wrong = left_by(-truth, truth, pause_min)
    assert np.abs(wrong[told]).max() <= np.abs(alone[told]).max() + 1e-9, "from the first probe on as the probe alone"
    right = left_by(0.9 * truth, truth, pause_min)
    assert np.abs(right[told]).max() < 0.5 * np.abs(alone[told]).max()


@pytest.mark.parametrize("y_has_a_model", [True, False])
def test_the_output_stops_following_a_model_of_the_wrong_sign_and_a_new_reference_begins_anew(
    y_has_a_model: bool,
) -> None:
    nobody_knows = Wander(um2_per_min=np.array([np.inf, 0.02]), correlation_min=np.array([np.inf, 240.0]))
    machine = Machine().following(z=0.0).set(probe_wander=WANDER if y_has_a_model else nobody_knows)
    machine.step(request=OperatorRequest(disable=frozenset({"y"})))
    for hour in range(1, 4):
        machine.set(thermal_error_um=np.array([-3.0 if y_has_a_model else np.nan, -5.0 * hour]))
        for _ in range(60):
            machine.step(elapsed_s=60.0)
        left_um = 5.0 * hour + machine.applied[1]
        assert abs(left_um) < (10.5 if hour == 1 else 5.5), "twice the change before the first probe, then once"
        machine.step(probe_um=np.array([np.nan, left_um])).step(120)
        assert machine.memory.probed is not None
        assert machine.memory.probed.follows.tolist() == [True, False]
        assert machine.applied[1] == pytest.approx(-5.0 * hour, abs=0.3)
    offset_um = machine.memory.offset_um.copy()
    machine.set(thermal_error_um=np.zeros(2), estimate_reference_id="another").step(2, elapsed_s=90.0)
    np.testing.assert_allclose(machine.memory.offset_um, offset_um, atol=0.01)
    machine.set(reference_id="r2", estimate_reference_id="r2").step()
    assert machine.memory.probed is not None and machine.memory.probed.follows.all()
