"""The Gaussian process against scikit-learn's, whose kernels and linear algebra are its own."""

from typing import Any

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, DotProduct, Kernel, Matern

from models.records import FloatArray
from models.thermal.features import Design, Layout
from models.thermal.gaussian import Bend
from models.thermal.solution import Solution
from models.thermal.training.gaussian_process import (
    RUN_VARIANCE,
    GaussianProcess,
    Rows,
    principal_coordinates,
)

GROUPS = (np.arange(4), np.arange(4, 8), np.array([8]))
LOGARITHMS = np.log([0.8, 0.3, 1.2, 0.5, 1.7, 0.2, 25.0, 0.1])
COORDINATES = 3


class OfParts(Kernel):  # type: ignore[misc]
    """The kernel of the docstring, put together from scikit-learn's; a row is columns, coordinates, time and run."""

    def __init__(self, scale: FloatArray) -> None:
        self.scale = scale

    def __call__(self, one: FloatArray, other: FloatArray | None = None, eval_gradient: bool = False) -> Any:
        assert not eval_gradient
        other = one if other is None else other
        found = np.zeros((len(one), len(other)))
        for size, group in zip(self.scale, GROUPS, strict=False):
            found += size**2 * DotProduct(sigma_0=0.0)(one[:, group], other[:, group])
        bend, length, residual, persists = self.scale[3:7]
        at = slice(9, 9 + COORDINATES)
        found += bend**2 * RBF(length)(one[:, at], other[:, at])
        same = (one[:, -1:] == other[:, -1]).astype(float)
        found += residual**2 * same * Matern(persists, nu=0.5)(one[:, -2:-1], other[:, -2:-1])
        return found + RUN_VARIANCE * same

    def diag(self, rows: FloatArray) -> FloatArray:
        return np.diag(self(rows))

    def is_stationary(self) -> bool:
        return False


def made(count: int, seed: int) -> Rows:
    rng = np.random.default_rng(seed)
    columns = np.cumsum(rng.normal(0.0, 0.3, (count, 9)), axis=0)
    columns -= columns.mean(axis=0)
    return Rows(
        columns=columns,
        groups=GROUPS,
        coordinates=columns @ principal_coordinates(columns, GROUPS)[:, :COORDINATES],
        run=np.repeat(np.arange(3), count // 3),
        time_min=np.tile(np.arange(0.0, 4.0 * (count // 3), 4.0), 3),
        values=np.column_stack([np.sin(columns[:, 0]) + columns[:, 8], columns[:, 1] ** 2])
        + rng.normal(0, 0.1, (count, 2)),
    )


def table(rows: Rows, run: FloatArray) -> FloatArray:
    return np.column_stack([rows.columns, rows.coordinates, rows.time_min, run])


@pytest.fixture(scope="module")
def rows() -> Rows:
    return made(60, 0)


@pytest.fixture(scope="module")
def other(rows: Rows) -> GaussianProcessRegressor:
    found = GaussianProcessRegressor(OfParts(np.exp(LOGARITHMS[:-1])), alpha=np.exp(2 * LOGARITHMS[-1]), optimizer=None)
    return found.fit(table(rows, rows.run), rows.values)


def test_the_evidence_is_that_of_scikit_learn(rows: Rows, other: GaussianProcessRegressor) -> None:
    value, _ = GaussianProcess(rows).surprise(LOGARITHMS, np.arange(60))
    constant = rows.values.size / 2.0 * np.log(2.0 * np.pi)
    assert -60.0 * value - constant == pytest.approx(other.log_marginal_likelihood_value_, rel=1e-10)


def test_mean_and_covariance_are_those_of_scikit_learn(rows: Rows, other: GaussianProcessRegressor) -> None:
    posterior = GaussianProcess(rows).posterior(LOGARITHMS, np.arange(60))
    columns = rows.columns[::7] + 0.3
    coordinates = rows.coordinates[::7] - 0.2
    elsewhere = np.column_stack([columns, coordinates, np.zeros(len(columns)), 100.0 + np.arange(len(columns))])
    mean, covariance = other.predict(elsewhere, return_cov=True)
    np.testing.assert_allclose(posterior.mean(columns, coordinates), mean, atol=1e-8)
    own = (np.exp(2.0 * LOGARITHMS[5]) + RUN_VARIANCE) * np.eye(len(columns))  # of a run that nobody saw
    np.testing.assert_allclose(posterior.covariance(columns, coordinates), covariance[:, :, 0] - own, atol=1e-8)


def test_leaving_rows_out_is_fitting_the_others(rows: Rows) -> None:
    kept = np.flatnonzero(rows.run != 1)
    some = Rows(
        columns=rows.columns[kept],
        groups=GROUPS,
        coordinates=rows.coordinates[kept],
        run=rows.run[kept],
        time_min=rows.time_min[kept],
        values=rows.values[kept],
    )
    one = GaussianProcess(rows).posterior(LOGARITHMS, kept)
    two = GaussianProcess(some).posterior(LOGARITHMS, np.arange(len(kept)))
    np.testing.assert_allclose(one.mean(rows.columns, rows.coordinates), two.mean(rows.columns, rows.coordinates))


def test_what_bends_follows_when_a_sensor_is_left_out(rows: Rows) -> None:
    posterior = GaussianProcess(rows).posterior(LOGARITHMS, np.arange(60))
    directions, remaining = posterior.directions(most=100, least=1e-12)
    linear = Solution(
        layout=Layout(sensors=9, lags_min=(), speed_lags_min=()),
        design=Design(departures=False),
        gain=np.ones(9),
        weights=posterior.linear,
        directions=directions,
        remaining=remaining,
    )
    bend = Bend(
        coordinates=np.eye(9)[:, :COORDINATES],
        points=posterior.coordinates / posterior.length,
        weights_um=posterior.variance * posterior.weights,
        variance=posterior.variance,
        linear_points=posterior.columns @ directions,
        root=posterior.root(60),
    )
    others = np.delete(posterior.columns, [1, 8], axis=1)
    covariance = posterior.without_linear + others @ others.T
    weights = np.linalg.solve(covariance, rows.values)
    np.testing.assert_allclose(bend.without(linear, (1, 8)).weights_um, posterior.variance * weights, atol=1e-8)
    np.testing.assert_allclose(np.delete(linear.coefficients((1, 8)), [1, 8], axis=0), others.T @ weights, atol=1e-8)
    assert bend.without(linear, ()) is bend
