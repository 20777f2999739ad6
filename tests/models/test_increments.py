"""The increment model against scikit-learn, and what increments never cross."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression, Ridge

from models.recordings.blocks import contiguous_runs
from models.recordings.dataset import DatasetError, Recording
from models.thermal.training.increments import Factor, Increments, LinearFit, combine, factorise, fit_each
from models.thermal.training.increments import increments as increments_of


def run(rows: int = 200, sensors: int = 6, channels: int = 3, seed: int = 1) -> Recording:
    rng = np.random.default_rng(seed)
    temperatures = 20.0 + np.cumsum(rng.normal(0.01, 0.05, (rows, sensors)), axis=0)
    weights = np.random.default_rng(99).normal(0.0, 3.0, (sensors, channels))
    displacements = temperatures @ weights + rng.normal(0.0, 0.05, (rows, channels)) + 0.02 * np.arange(rows)[:, None]
    return Recording(
        name=f"run {seed}",
        time_s=60.0 * np.arange(rows),
        speed_rpm=None,
        temperature_names=tuple(f"t{i}" for i in range(sensors)),
        temperatures_degc=temperatures,
        displacement_names=tuple(f"c{i}" for i in range(channels)),
        displacements_um=displacements,
    )


def increments(runs: list[Recording], interval_min: float, period_s: float) -> Increments:
    """Increments of stretches without a gap, as training makes them."""
    stretches = [
        (one.temperatures_degc[first:stop], one.displacements_um[first:stop])
        for one in runs
        for first, stop in contiguous_runs(one.time_s, period_s)
    ]
    return increments_of(stretches, interval_min, period_s)


def fit(factor: Factor, *, intercept: bool, ridge: float = 0.0) -> LinearFit:
    return fit_each(factor, intercept=intercept, penalties=[ridge])[0]


@pytest.mark.parametrize("intercept", [True, False])
@pytest.mark.parametrize("interval_min", [1.0, 5.0])
def test_least_squares_equals_scikit_learn(intercept: bool, interval_min: float) -> None:
    data = increments([run(seed=1), run(seed=2)], interval_min, 60.0)
    fitted = fit(factorise(data), intercept=intercept)
    other = LinearRegression(fit_intercept=intercept).fit(data.temperature_k, data.displacement_um)
    np.testing.assert_allclose(fitted.coefficients_um_per_k, other.coef_, rtol=1e-9)
    np.testing.assert_allclose(fitted.intercept_um, other.intercept_ if intercept else 0.0, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("intercept", [True, False])
@pytest.mark.parametrize("ridge", [1e-4, 0.3, 50.0])
def test_ridge_equals_scikit_learn(intercept: bool, ridge: float) -> None:
    data = increments([run()], 3.0, 60.0)
    fitted = fit(factorise(data), intercept=intercept, ridge=ridge)
    other = Ridge(alpha=ridge, fit_intercept=intercept, solver="svd").fit(data.temperature_k, data.displacement_um)
    np.testing.assert_allclose(fitted.coefficients_um_per_k, other.coef_, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(fitted.intercept_um, other.intercept_, rtol=1e-7, atol=1e-10)


def test_collinear_sensors_share_the_shortest_solution() -> None:
    base = run(sensors=2)
    doubled = replace(
        base,
        temperature_names=("a", "b", "c"),
        temperatures_degc=np.column_stack([base.temperatures_degc, base.temperatures_degc[:, 0]]),
    )
    data = increments([doubled], 1.0, 60.0)
    fitted = fit(factorise(data), intercept=True)
    assert fitted.rank == 2
    np.testing.assert_allclose(fitted.coefficients_um_per_k[:, 0], fitted.coefficients_um_per_k[:, 2], rtol=1e-6)
    other = LinearRegression().fit(data.temperature_k, data.displacement_um)
    np.testing.assert_allclose(fitted.coefficients_um_per_k, other.coef_, rtol=1e-6, atol=1e-9)


def test_factors_of_runs_add_up() -> None:
    runs = [run(seed=seed) for seed in (1, 2, 3)]
    together = fit(factorise(increments(runs, 2.0, 60.0)), intercept=True, ridge=0.1)
    added = fit(combine([factorise(increments([one], 2.0, 60.0)) for one in runs]), intercept=True, ridge=0.1)
    assert added.rows == together.rows
    np.testing.assert_allclose(added.coefficients_um_per_k, together.coefficients_um_per_k, rtol=1e-9)
    np.testing.assert_allclose(added.intercept_um, together.intercept_um, rtol=1e-9)


def test_differences_cross_neither_runs_nor_gaps() -> None:
    gap = np.r_[60.0 * np.arange(100), 60.0 * np.arange(130, 230)]
    broken = replace(run(), time_s=gap)
    step = run().temperatures_degc.copy()
    step[100:] += 50.0
    broken = replace(broken, temperatures_degc=step)
    data = increments([broken, run(seed=2)], 5.0, 60.0)
    assert len(data.temperature_k) == 95 + 95 + 195
    assert np.abs(data.temperature_k).max() < 5.0
    assert np.abs(increments([replace(broken, time_s=run().time_s)], 5.0, 60.0).temperature_k).max() > 45.0


def test_rows_with_a_missing_value_are_left_out_and_counted() -> None:
    values = run().temperatures_degc.copy()
    values[50, 2] = np.nan
    data = increments([replace(run(), temperatures_degc=values)], 4.0, 60.0)
    assert (len(data.temperature_k), data.left_out) == (194, 2)


def test_what_cannot_be_fitted_is_refused() -> None:
    with pytest.raises(DatasetError, match="no multiple of the 60 s"):
        increments([run()], 1.5, 60.0)
    assert not len(increments([run(rows=5)], 10.0, 60.0).temperature_k)
    few = increments([run(rows=6)], 1.0, 60.0)
    with pytest.raises(DatasetError, match="5 increments cannot determine 6 coefficients"):
        fit(factorise(few), intercept=False)
    fit(factorise(few), intercept=False, ridge=1.0)
    with pytest.raises(ValueError, match="not negative"):
        fit(factorise(few), intercept=False, ridge=-1.0)
