"""Training the model of increments: what is left out, what is chosen on it, and what the model says of its data."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models.recordings.dataset import DatasetError, Recording
from models.thermal.linear import LinearModel
from models.thermal.training.increment_family import IncrementChoices
from models.thermal.training.recipes import increment_recipe
from models.thermal.training.train_family import FamilyTraining, train_family

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


def trained(recordings: list[Recording], *, sample_s: float = 60.0, **choices: Any) -> FamilyTraining:
    recipe = increment_recipe(IncrementChoices(**{"split_at_speed_changes": False, **choices}))
    return train_family(recordings, recipe, sample_s=sample_s, created=CREATED)


def model_of(recordings: list[Recording], **choices: Any) -> LinearModel:
    made = trained(recordings, **choices).model
    assert isinstance(made, LinearModel)
    return made


def test_days_are_left_out_as_a_whole_and_the_true_weights_are_found() -> None:
    days = [day(seed, noise_k=0.0) for seed in (1, 2, 3)]
    result = trained(days)
    np.testing.assert_allclose(model_of(days).coefficients(), WEIGHTS, rtol=1e-6)
    assert result.fold_names == ("day 1", "day 2", "day 3")
    assert result.trust.held_out_relative_rmse == pytest.approx(0.0, abs=1e-6)
    assert result.model.sensor_ids == (3, 1, 4, 10, 5)
    assert result.counts == {"used": 3 * 239, "left_out": 0, "rank": 5}


def test_a_held_out_day_was_not_seen() -> None:
    """A day with other physics is predicted badly when left out, however well it would be fitted."""
    odd = day(3, noise_k=0.0)
    odd = replace(odd, displacements_um=-odd.displacements_um)
    result = trained([day(1, noise_k=0.0), odd])
    assert result.fold_names == ("day 1", "day 3")
    assert result.trust.held_out is not None and result.trust.refused is not None
    assert np.all(result.trust.held_out.rmse_with_um > 1.2 * result.trust.held_out.rmse_without_um)
    assert result.model.refused == result.trust.refused


def test_the_penalty_is_the_one_that_predicts_left_out_days_best() -> None:
    noise_um = np.random.default_rng(7).normal(0.0, 4.0, (3, 60, 2))
    days = [day(seed, rows=60) for seed in (1, 2, 3)]
    days = [replace(d, displacements_um=d.displacements_um + n) for d, n in zip(days, noise_um, strict=True)]
    auto = trained(days, ridge_k2="auto")
    chosen, score = auto.hyper_parameters["ridge_k2"], auto.trust.held_out_relative_rmse
    assert isinstance(chosen, float) and chosen > 0.0
    scores = {f: trained(days, ridge_k2=chosen * f).trust.held_out_relative_rmse for f in (0.1, 1.0, 10.0)}
    assert scores[1.0] == pytest.approx(score)
    assert sorted(scores.values())[1] > min(scores.values()) == pytest.approx(score)
    assert (auto.model.kind, model_of(days).kind) == ("ridge", "increments")


def test_a_recording_too_short_to_leave_anything_out_is_refused_with_the_reason() -> None:
    short = trained([day(1, rows=10)])
    assert short.trust.held_out is None and short.fold_names == ()
    assert short.model.refused is not None
    assert np.isnan(short.model.band_um).all()
    with pytest.raises(DatasetError, match="two stretches to leave out"):
        trained([day(1, rows=10)], ridge_k2="auto", interval_min=5.0)
    with pytest.raises(DatasetError, match="every run is shorter"):
        trained([day(1, rows=10)], interval_min=10.0)


def test_jumps_at_switching_are_removed_from_training_and_kept_in_the_judgement() -> None:
    clean = day(1, speed=True, noise_k=0.0)
    jumps = clean.displacements_um + np.where(np.asarray(clean.speed_rpm) > 0.0, 8.0, 0.0)[:, None]
    jumping = replace(clean, displacements_um=jumps)
    untouched = replace(jumping, speed_rpm=None)  # without a speed nobody knows of switching
    wrong = [np.abs(model_of([each]).coefficients() - WEIGHTS).max() for each in (jumping, untouched)]
    assert wrong[0] < 0.4 * wrong[1]  # the rule takes the true change of that minute off as well: not exact
    held_out = trained([jumping]).trust.held_out
    assert held_out is not None
    assert np.all(held_out.max_with_um > 7.0)


def test_a_drift_is_fitted_per_minute() -> None:
    drifting = day(1, noise_k=0.0)
    drifting = replace(drifting, displacements_um=drifting.displacements_um + 0.03 * np.arange(240)[:, None])
    with_drift = model_of([drifting], intercept=True, interval_min=5.0)
    np.testing.assert_allclose(with_drift.drift_um_per_min, 0.03, rtol=1e-6)
    assert not model_of([drifting], interval_min=5.0).drift_um_per_min.any()


def test_the_range_of_increments_holds_for_a_reference_at_any_earlier_time() -> None:
    one = day(1)
    values = one.temperatures_degc.copy()
    values[:, 0] = 20.0
    values[50:100, 0] = 23.0
    values[100:, 0] = 18.0
    domain = model_of([replace(one, temperatures_degc=values)]).domain
    assert domain.of_increments and (domain.lowest[0], domain.highest[0]) == (-5.0, 3.0)


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


def test_a_single_impossible_value_changes_no_more_than_a_missing_one() -> None:
    good = day(1)
    broken, gap = good.temperatures_degc.copy(), good.temperatures_degc.copy()
    broken[100, 2], gap[100, 2] = 850.0, np.nan
    result = trained([replace(good, temperatures_degc=broken), day(2), day(3)])
    other = trained([replace(good, temperatures_degc=gap), day(2), day(3)])
    assert (result.model.model_id, result.trust.held_out_relative_rmse) == (
        other.model.model_id,
        other.trust.held_out_relative_rmse,
    )
    assert any("day 1: column T4, row 101: 850 degC cannot be" in warning for warning in result.warnings)


def test_temperatures_that_never_change_make_no_model() -> None:
    still = replace(day(1), temperatures_degc=np.full((240, 5), 25.0))
    with pytest.raises(DatasetError, match="no temperature can be used: T3: constant at 25 in training; T1: constant"):
        trained([still])
