"""Training: what is left out, what is chosen on it, and what the model says of its data."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import DatasetError, Recording
from models.thermal.training.train import TrainingChoices, TrainingResult, sensor_ids_from_names, train
from models.thermal.training.validation import BAND_QUANTILE, make_folds

CREATED = "2026-01-01T00:00:00+00:00"
WEIGHTS = np.random.default_rng(3).normal(0.0, 2.0, (5, 2))


def day(seed: int, *, rows: int = 240, noise_k: float = 0.02, period_s: float = 60.0, speed: bool = False) -> Recording:
    rng = np.random.default_rng(seed)
    true = 20.0 + np.cumsum(rng.normal(0.0, 0.08, (rows, 5)), axis=0)
    return Recording(
        name=f"day {seed}",
        time_s=period_s * np.arange(rows),
        speed_rpm=np.where(np.arange(rows) // 20 % 2, 3000.0, 0.0) if speed else None,
        temperature_names=("T3", "T1", "T4", "T10", "T5"),
        temperatures_degc=true + rng.normal(0.0, noise_k, true.shape),
        displacement_names=("Y1", "Z1"),
        displacements_um=(true - true[0]) @ WEIGHTS,
    )


def trained(recordings: list[Recording], **choices: object) -> TrainingResult:
    return train(recordings, TrainingChoices(**choices), created=CREATED)  # type: ignore[arg-type]


def test_days_are_left_out_as_a_whole_and_the_true_weights_are_found() -> None:
    result = trained([day(1, noise_k=0.0), day(2, noise_k=0.0), day(3, noise_k=0.0)])
    np.testing.assert_allclose(result.model.coefficients_um_per_k, WEIGHTS.T, rtol=1e-6)
    assert result.report.folds == ("day 1", "day 2", "day 3")
    assert result.report.score == pytest.approx(0.0, abs=1e-6)
    assert result.model.sensor_ids == (3, 1, 4, 10, 5)
    assert result.report.increments_used == 3 * 239


def test_a_held_out_day_was_not_seen() -> None:
    """A day with other physics is predicted badly when left out, however well it would be fitted."""
    odd = day(3, noise_k=0.0)
    odd = replace(odd, displacements_um=-odd.displacements_um)
    result = trained([day(1, noise_k=0.0), odd])
    assert result.report.held_out is not None
    assert np.all(result.report.held_out.rmse_with_um > 1.2 * result.report.held_out.rmse_without_um)
    assert result.report.score > 1.2


def test_the_penalty_is_the_one_that_predicts_left_out_days_best() -> None:
    noise_um = np.random.default_rng(7).normal(0.0, 4.0, (3, 60, 2))
    days = [day(seed, rows=60) for seed in (1, 2, 3)]
    days = [replace(d, displacements_um=d.displacements_um + n) for d, n in zip(days, noise_um, strict=True)]
    auto = trained(days, kind="ridge")
    scores = {
        penalty: trained(days, kind="ridge", ridge_k2=penalty).report.score
        for penalty in (auto.report.ridge_k2 * factor for factor in (0.1, 1.0, 10.0))
    }
    assert scores[auto.report.ridge_k2] == pytest.approx(auto.report.score)
    assert sorted(scores.values())[1] > min(scores.values()) == pytest.approx(auto.report.score)
    assert auto.model.ridge_k2 == auto.report.ridge_k2 > 0.0


def test_the_band_is_the_largest_quantile_of_the_folds() -> None:
    days = [day(1), day(2)]
    result = trained(days)
    expected = []
    for left_out, other in ((0, 1), (1, 0)):
        model = trained([days[other]]).model
        raw = days[left_out]
        estimate = (raw.temperatures_degc - raw.temperatures_degc[0]) @ model.coefficients_um_per_k.T
        residual = np.abs(raw.displacements_um - raw.displacements_um[0] - estimate)
        expected.append(np.quantile(residual, BAND_QUANTILE, axis=0))
    np.testing.assert_allclose(result.model.band_um, np.max(expected, axis=0), rtol=1e-9)


def test_one_recording_is_cut_into_cycles_or_blocks() -> None:
    assert trained([day(1, speed=True)]).report.folds == tuple(f"cycle {n}" for n in range(1, 7))
    assert trained([day(1)]).report.folds == tuple(f"block {n}" for n in range(1, 6))
    fast = day(1, rows=600, speed=True)
    assert trained([fast]).report.folds == tuple(f"block {n}" for n in range(1, 6))


def test_cycles_begin_where_the_spindle_starts() -> None:
    one = day(1, speed=True)
    folds = make_folds([one], [one], TrainingChoices(), 60.0)
    assert [float(fold.measured.time_s[0]) / 60.0 for fold in folds] == [0.0, 60.0, 100.0, 140.0, 180.0, 220.0]
    turning = replace(one.part(30, 240))
    folds = make_folds([turning], [turning], TrainingChoices(), 60.0)
    assert [float(fold.measured.time_s[0]) / 60.0 for fold in folds] == [30.0, 60.0, 100.0, 140.0, 180.0, 220.0]


def test_a_recording_too_short_to_leave_anything_out_says_so() -> None:
    short = trained([day(1, rows=10)])
    assert short.report.held_out is None
    assert np.isnan(short.report.score)
    assert np.isnan(short.model.band_um).all()
    with pytest.raises(DatasetError, match="two stretches to leave out"):
        trained([day(1, rows=10)], kind="ridge", interval_min=5.0)


def test_jumps_at_switching_are_removed_from_training_and_kept_in_the_judgement() -> None:
    clean = day(1, speed=True, noise_k=0.0)
    jumps = clean.displacements_um + np.where(np.asarray(clean.speed_rpm) > 0.0, 8.0, 0.0)[:, None]
    jumping = replace(clean, displacements_um=jumps)
    result = trained([jumping])
    untouched = trained([jumping], jump_threshold_um=None)
    wrong = [np.abs(r.model.coefficients_um_per_k - WEIGHTS.T).max() for r in (result, untouched)]
    assert wrong[0] < 0.4 * wrong[1]  # the rule takes the true change of that minute off as well: not exact
    assert result.report.held_out is not None
    assert np.all(result.report.held_out.max_with_um > 7.0)


def test_differences_across_a_change_of_speed_can_be_left_out() -> None:
    result = trained([day(1, speed=True)], split_at_speed_changes=True)
    assert result.report.increments_used == 12 * 19


def test_a_drift_is_fitted_per_minute() -> None:
    drifting = day(1, noise_k=0.0)
    drifting = replace(drifting, displacements_um=drifting.displacements_um + 0.03 * np.arange(240)[:, None])
    with_drift = trained([drifting], intercept=True, interval_min=5.0)
    np.testing.assert_allclose(with_drift.model.drift_um_per_min, 0.03, rtol=1e-6)
    assert not trained([drifting], interval_min=5.0).model.drift_um_per_min.any()


def test_recordings_are_averaged_to_the_minute_first() -> None:
    result = trained([day(1, rows=960, period_s=15.0)])
    assert result.report.increments_used == 239


def test_the_range_of_increments_holds_for_a_reference_at_any_earlier_time() -> None:
    one = day(1)
    values = one.temperatures_degc.copy()
    values[:, 0] = 20.0
    values[50:100, 0] = 23.0
    values[100:, 0] = 18.0
    model = trained([replace(one, temperatures_degc=values)]).model
    assert (model.lowest_increment_k[0], model.highest_increment_k[0]) == (-5.0, 3.0)


def test_the_model_names_its_data() -> None:
    model = trained([day(1), day(2)]).model
    assert [data.name for data in model.training] == ["day 1", "day 2"]
    assert (model.training[0].from_hours, model.training[0].rows) == (0.0, 240)
    again = trained([day(1), day(2)]).model
    assert (again.model_id, again.training) == (model.model_id, model.training)
    other = replace(day(1), displacements_um=day(1).displacements_um + 1e-9)
    assert trained([other, day(2)]).model.training[0].sha256 != model.training[0].sha256


def test_progress_ends_at_its_total() -> None:
    steps: list[tuple[int, int]] = []
    train([day(1), day(2)], TrainingChoices(), created=CREATED, progress=lambda *step: steps.append(step))
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_recordings_that_do_not_belong_together_are_refused() -> None:
    other = replace(day(2), temperature_names=("T3", "T1", "T4", "T10", "T6"))
    with pytest.raises(DatasetError, match="day 1 and day 2 have different temperature names: T5, T6"):
        trained([day(1), other])
    with pytest.raises(DatasetError, match="raise sample_s"):
        trained([day(1), day(2, period_s=120.0)])
    with pytest.raises(DatasetError, match="no recording"):
        trained([])
    kelvin = replace(day(2), temperatures_degc=day(2).temperatures_degc + 273.15)
    with pytest.raises(DatasetError, match=r"day 2: column T3: .*kelvin"):
        trained([day(1), kelvin])


def test_averaging_over_too_long_a_time_is_said_with_the_rows_that_remain() -> None:
    with pytest.raises(
        DatasetError, match=r"day 1: averaged to sample_s 1e\+09 s, 1 of 240 rows remain, too few for 5"
    ):
        trained([day(1)], sample_s=1e9)
    with pytest.raises(DatasetError, match="no multiple of the 300 s between rows; choose 5 min or a multiple"):
        trained([day(1, period_s=300.0)], interval_min=1.0)


def test_a_single_impossible_value_changes_no_more_than_a_missing_one() -> None:
    good = day(1)
    broken, gap = good.temperatures_degc.copy(), good.temperatures_degc.copy()
    broken[100, 2], gap[100, 2] = 850.0, np.nan
    result = trained([replace(good, temperatures_degc=broken), day(2), day(3)])
    other = trained([replace(good, temperatures_degc=gap), day(2), day(3)])
    np.testing.assert_array_equal(result.model.coefficients_um_per_k, other.model.coefficients_um_per_k)
    assert any("day 1: column T4, row 101: 850 degC cannot be" in warning for warning in result.report.warnings)


def test_temperatures_that_never_change_make_no_model() -> None:
    still = replace(day(1), temperatures_degc=np.full((240, 5), 25.0))
    with pytest.raises(DatasetError, match="no temperature changes in these recordings"):
        trained([still])


def test_choices_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="needs kind ridge"):
        TrainingChoices(ridge_k2=1.0)
    with pytest.raises(ValueError, match="interval_min"):
        TrainingChoices(interval_min=0.0)


def test_sensor_ids_are_the_numbers_of_the_columns_or_their_places() -> None:
    assert sensor_ids_from_names(("T301", "T2", "t7")) == (301, 2, 7)
    assert sensor_ids_from_names(("room", "T2")) == (1, 2)
    assert sensor_ids_from_names(("T2", "t2")) == (1, 2)
    assert sensor_ids_from_names(("T0", "T1")) == (1, 2)
