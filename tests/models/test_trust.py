"""The gate, the band, the folds and the probe's filter."""

import numpy as np
import pytest

from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.thermal.bias import BiasFilter
from models.thermal.features import lag_table
from models.thermal.solution import band_factor, leverage_and_size
from models.thermal.training import trust
from models.thermal.training.domain import farthest_leverage, leverage_positions
from models.thermal.training.families import held_out_um
from models.thermal.training.folds import cycles, few_folds_factor, inner_folds
from models.thermal.training.inputs import build_inputs
from models.thermal.training.probing import probed_residual_um
from models.thermal.training.ridge_member import DEPARTURES, RidgeFamily
from models.thermal.training.trust import (
    fit_bias_filter,
    half_width_um,
    judge,
    recent_skill,
)


def recording(um: FloatArray, degc: FloatArray, rpm: FloatArray | None, step_s: float = 60.0) -> Recording:
    return Recording(
        name="r",
        time_s=step_s * np.arange(float(len(um))),
        speed_rpm=rpm,
        temperature_names=tuple(f"T{i + 1}" for i in range(degc.shape[1])),
        temperatures_degc=degc,
        displacement_names=("c1",),
        displacements_um=um[:, None],
    )


def warming(hours: int = 10, speed: bool = True) -> Recording:
    rng = np.random.default_rng(1)
    time_min = np.arange(60.0 * hours)
    rpm = np.where((time_min // 60) % 2 == 0, 3000.0 + 500.0 * (time_min // 120), 0.0)
    slow = lag_table(time_min, (rpm / 4000.0)[:, None], (25.0,))[0, :, 0]
    degc = 20.0 + np.column_stack([8.0 * slow, 5.0 * slow]) + rng.normal(0.0, 0.02, (len(rpm), 2))
    return recording(15.0 * slow, degc, rpm if speed else None)


def test_what_is_left_out_are_cycles_blocks_or_runs() -> None:
    with_speed = build_inputs([warming()], sample_s=60.0)
    rows = np.ones(with_speed.rows, dtype=np.bool_)
    assert inner_folds(with_speed, rows)[1] == "cycle"
    silent = build_inputs([warming(speed=False)], sample_s=60.0)
    fold, kind = inner_folds(silent, rows)
    assert (kind, np.bincount(fold).tolist()) == ("block", [120] * 5)
    with pytest.raises(DatasetError, match="speed column"):
        cycles(silent, rows)
    three = build_inputs([warming(), warming(), warming()], sample_s=60.0)
    assert inner_folds(three, np.ones(three.rows, dtype=np.bool_))[1] == "run"


def test_a_long_gap_begins_a_run_and_a_short_one_does_not() -> None:
    whole = warming()
    kept = np.ones(whole.rows, dtype=np.bool_)
    kept[100:130] = kept[300:400] = False
    cut = recording(whole.displacements_um[:, 0], whole.temperatures_degc, whole.speed_rpm)
    cut = Recording(
        name="cut",
        time_s=whole.time_s[kept],
        speed_rpm=None if whole.speed_rpm is None else whole.speed_rpm[kept],
        temperature_names=cut.temperature_names,
        temperatures_degc=whole.temperatures_degc[kept],
        displacement_names=("c1",),
        displacements_um=whole.displacements_um[kept],
    )
    inputs = build_inputs([cut], sample_s=60.0)
    assert np.bincount(inputs.run).tolist() == [270, 200]


def test_a_useful_recording_passes_the_gate() -> None:
    inputs = build_inputs([warming()], sample_s=60.0)
    rows = inputs.trainable()
    fold, _ = inner_folds(inputs, rows)
    trust = judge(inputs, rows, fold, RidgeFamily(inputs, rows, fold, None, DEPARTURES))
    assert trust.refused is None
    assert min(trust.forward_skill) > 0.0 and trust.held_out_relative_rmse < 0.5
    assert np.isfinite(trust.band_um).all()


def test_a_band_widens_in_proportion_to_the_distance_beyond_the_domain() -> None:
    inputs = build_inputs([warming()], sample_s=60.0)
    rows = inputs.trainable()
    fold, _ = inner_folds(inputs, rows)
    fit = RidgeFamily(inputs, rows, fold, None, DEPARTURES).fit()
    limit = farthest_leverage(inputs, rows, fit.solutions)
    points = leverage_positions(fit.solutions, inputs.features)
    change = inputs.features - inputs.features[0]
    np.testing.assert_allclose(
        np.square(points - points[0]).sum(axis=1),
        leverage_and_size(fit.solutions, change)[0],
        rtol=1e-6,
        atol=1e-9 * limit,
    )
    farthest = np.sqrt(leverage_and_size(fit.solutions, change)[0].max() / limit)
    assert 0.0 < farthest <= 1.0 + 1e-9
    distance = np.sqrt(leverage_and_size(fit.solutions, 4.0 * change)[0].max() / limit)
    assert distance == pytest.approx(4.0 * farthest)
    assert band_factor(np.array([0.3 * farthest, 4.0])).tolist() == [1.0, 4.0]


@pytest.mark.parametrize("seed", range(4))
def test_a_machine_that_wanders_on_its_own_is_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows_count = 1200
    degc = 22.0 + np.cumsum(rng.normal(0.0, 0.01, (rows_count, 4)), axis=0)
    inputs = build_inputs([recording(np.cumsum(rng.normal(0.0, 0.05, rows_count)), degc, None)], sample_s=60.0)
    rows = inputs.trainable()
    fold, _ = inner_folds(inputs, rows)
    assert judge(inputs, rows, fold, RidgeFamily(inputs, rows, fold, None, DEPARTURES)).refused is not None


def test_one_warm_up_alone_is_refused() -> None:
    time_min = np.arange(300.0)
    rise = 1.0 - np.exp(-time_min / 80.0)
    inputs = build_inputs([recording(20.0 * rise, 20.0 + 5.0 * rise[:, None], None)], sample_s=60.0)
    rows = inputs.trainable()
    fold, _ = inner_folds(inputs, rows)
    refused = judge(inputs, rows, fold, RidgeFamily(inputs, rows, fold, None, DEPARTURES)).refused
    assert refused is not None and "training saw 1 excursion of more than 30% of the span in 1 run;" in refused
    assert "record 2 more runs of about 4 h, each warming for half of the time and then cooling" in refused


@pytest.mark.parametrize("runs", [2, 10])
def test_the_band_of_so_many_runs_holds_on_a_further_run(runs: int) -> None:
    """What is left differs from run to run and hardly within one, so that the number of rows says nothing."""
    rng = np.random.default_rng(runs)
    inside = []
    for _ in range(4000):
        offsets_um = rng.normal(0.0, 3.0, runs + 1)
        half_um = half_width_um([np.full((50, 1), each) for each in offsets_um[1:]], runs)
        inside.append(abs(offsets_um[0]) <= half_um[0])
    assert 0.82 < np.mean(inside) < 0.95


def test_the_band_of_whole_runs_that_differ_in_size_alone_is_not_wider_than_they_need() -> None:
    rng = np.random.default_rng(4)
    inside = []
    for _ in range(1000):
        sizes_um, begins = 3.0 * np.exp(0.2 * rng.normal(size=5)), rng.uniform(0.0, 6.0, 5)
        left_um = [a * np.sin(np.linspace(0.0, 12.0, 50) + b) for a, b in zip(sizes_um, begins, strict=True)]
        half_um = [
            half_width_um([each[:, None] for each in left_um[1:]], 4, whole_runs=whole)[0] for whole in (False, True)
        ]
        inside.append([(np.abs(left_um[0]) <= half).mean() for half in half_um])
    narrow_enough = np.mean(inside, axis=0)
    assert narrow_enough[0] > 0.97 > narrow_enough[1] > 0.93


@pytest.mark.parametrize(("days", "hours", "whole"), [(3, 4, True), (2, 4, False), (1, 10, False)])
def test_three_whole_runs_are_told_from_cycles_and_from_two(
    monkeypatch: pytest.MonkeyPatch, days: int, hours: int, whole: bool
) -> None:
    inputs = build_inputs([warming(hours)] * days, sample_s=60.0)
    rows = inputs.trainable()
    fold, _ = inner_folds(inputs, rows)
    told = []
    monkeypatch.setattr(trust, "half_width_um", lambda *_, whole_runs: told.append(whole_runs) or np.ones(1))
    judge(inputs, rows, fold, RidgeFamily(inputs, rows, fold, None, DEPARTURES))
    assert told == [whole]


def test_the_band_of_two_runs_tells_how_they_differ_and_not_how_their_cycles_do() -> None:
    rng = np.random.default_rng(3)
    first = warming()
    slow_um = first.displacements_um[:, 0]

    def another(share: float) -> Recording:
        """Return another day, on which the same temperatures make so much of the error."""
        degc = first.temperatures_degc + rng.normal(0.0, 0.02, first.temperatures_degc.shape)
        return recording(share * slow_um, degc, first.speed_rpm)

    inputs = build_inputs([first, another(0.7), another(1.1)], sample_s=60.0)
    rows = inputs.trainable() & (inputs.recording < 2)
    fold, kind = inner_folds(inputs, rows)
    assert kind == "cycle"
    problem = RidgeFamily(inputs, rows, fold, None, DEPARTURES)
    measured, estimated = held_out_um(inputs, inputs.recording == 2, problem.fit())
    assert (np.abs(measured[0] - estimated[0]) <= judge(inputs, rows, fold, problem).band_um).mean() > 0.85


def test_few_folds_widen_limits() -> None:
    factors = [few_folds_factor(folds) for folds in range(2, 12)]
    assert factors == sorted(factors, reverse=True) and factors[-1] == 1.0


def test_a_noisy_probe_is_believed_in_part_and_never_beyond_its_bound() -> None:
    fresh = BiasFilter(wander_um2_per_min=np.array([0.1]), noise_um=np.array([2.0]), largest_step_um=np.array([3.0]))
    state = fresh.correct(fresh.begin(0.0), 40.0, np.array([4.0]))
    assert state.bias_um[0] == pytest.approx(4.0 * 4.0 / (4.0 + 4.0))
    assert fresh.correct(state, 80.0, np.array([1000.0])).bias_um[0] == pytest.approx(state.bias_um[0] + 3.0)
    unmeasured = fresh.correct(state, 80.0, np.array([np.nan]))
    assert unmeasured.bias_um[0] == state.bias_um[0]
    with pytest.raises(ValueError, match="must not be negative"):
        BiasFilter(wander_um2_per_min=np.array([-1.0]), noise_um=np.zeros(1), largest_step_um=np.ones(1))


def test_against_noisy_probes_the_filter_beats_the_full_reset() -> None:
    rng = np.random.default_rng(7)
    time_min = np.arange(0.0, 6000.0)
    drift_um = np.cumsum(rng.normal(0.0, 0.1, len(time_min)))[:, None]
    noise_um = rng.normal(0.0, 3.0, drift_um.shape)
    kalman = BiasFilter(wander_um2_per_min=np.array([0.01]), noise_um=np.array([3.0]), largest_step_um=np.array([50.0]))
    reset = BiasFilter(wander_um2_per_min=np.array([0.01]), noise_um=np.zeros(1), largest_step_um=np.array([50.0]))
    rmse = [
        float(np.sqrt(np.mean(np.square(probed_residual_um(time_min, drift_um, 60.0, f, noise_um)))))
        for f in (kalman, reset)
    ]
    assert rmse[0] < 0.8 * rmse[1]


@pytest.mark.parametrize("noise_um", [0.0, 0.05, 1.0])
def test_frequent_probes_correct_a_drift_that_a_minute_does_not_show(noise_um: float) -> None:
    """The drift gains 0.05 um in a minute, which no single step shows within the scatter; the probe must follow it."""
    rng = np.random.default_rng(11)
    true_um = 0.05 * np.abs((np.arange(600.0) + 150.0) % 300.0 - 150.0)
    measured_um = true_um + rng.normal(0.0, noise_um, len(true_um))
    degc = 20.0 + rng.normal(0.0, 0.01, (len(true_um), 2))
    inputs = build_inputs([recording(measured_um, degc, None)], sample_s=60.0)
    kalman = fit_bias_filter(inputs, np.ones(600, dtype=np.bool_), inputs.measured_um, 1.0)
    noise = (measured_um - true_um)[:, None]
    left_um = probed_residual_um(inputs.time_min, true_um[:, None] - true_um[0], 1.0, kalman, noise)
    assert np.sqrt(np.mean(np.square(left_um))) < max(0.05, 0.5 * noise_um)


def test_one_bad_fold_does_not_refuse_for_good_and_a_bad_latest_one_counts_most() -> None:
    assert recent_skill([-0.67, 0.49, 0.55]) > 0.0
    assert recent_skill([0.4, -0.9, 0.9]) > 0.0 > recent_skill([0.9, 0.4, -0.9, -0.9])
    assert recent_skill([-0.1]) < 0.0 and recent_skill([float("nan")]) < 0.0
    assert recent_skill([-50.0, 0.8, 0.8, 0.8]) > 0.0
