"""Partial least squares and LASSO against scikit-learn's own estimators."""

import numpy as np
import pytest
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import Lasso

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import Inputs, build_inputs
from models.thermal.training.lags import part_of
from models.thermal.training.linear_families import LassoProblem, PartialLeastSquaresProblem, lasso_path

SENSORS = 6


@pytest.fixture(scope="module")
def inputs() -> Inputs:
    """One run of sensors that move together, at sizes that differ, of which three know something."""
    rng = np.random.default_rng(3)
    common = rng.normal(0.0, 1.0, (600, 2)).cumsum(axis=0) / 8.0
    degc = common @ rng.normal(0.0, 1.0, (2, SENSORS)) + rng.normal(0.0, 0.3, (600, SENSORS))
    degc *= np.array([1.0, 4.0, 0.5, 1.0, 2.0, 1.0])
    um = degc @ np.array([[3.0], [0.0], [-2.0], [0.0], [1.0], [0.0]]) + rng.normal(0.0, 0.5, (600, 1))
    recording = Recording(
        name="r",
        time_s=60.0 * np.arange(600.0),
        speed_rpm=None,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=20.0 + degc,
        displacement_names=("z",),
        displacements_um=um,
    )
    return part_of(build_inputs([recording], sample_s=60.0), (), ())


def rows_of(inputs: Inputs) -> tuple[FloatArray, FloatArray]:
    rows = inputs.trainable()
    return inputs.degc[rows], inputs.cleansed_um[rows]


def test_components_are_those_of_scikit_learn(inputs: Inputs) -> None:
    rows = inputs.trainable()
    problem = PartialLeastSquaresProblem(inputs, rows, inner_folds(inputs, rows)[0], None)
    x, y = rows_of(inputs)
    count = problem.hyper_parameters["components"]
    assert isinstance(count, int) and 1 < count <= SENSORS
    expected = PLSRegression(n_components=count, scale=True).fit(x, y)
    assert x @ problem.fit().coefficients - expected.predict(x) == pytest.approx(
        (x.mean(axis=0) @ problem.fit().coefficients - y.mean()) * np.ones_like(y), abs=1e-8
    )


def test_the_penalised_fit_is_that_of_scikit_learn(inputs: Inputs) -> None:
    rows = inputs.trainable()
    problem = LassoProblem(inputs, rows, inner_folds(inputs, rows)[0], None)
    x, y = rows_of(inputs)
    scaled, target = (x - x.mean(axis=0)) / x.std(axis=0), (y - y.mean())[:, 0]
    largest = np.abs(scaled.T @ target).max() / len(scaled)
    alpha = problem.hyper_parameters["relative_alpha"]
    assert isinstance(alpha, float)
    expected = Lasso(alpha=alpha * largest, fit_intercept=False, tol=1e-12, max_iter=100_000).fit(scaled, target)
    assert problem.fit().coefficients[:, 0] == pytest.approx(expected.coef_ / x.std(axis=0), abs=1e-6)
    assert problem.hyper_parameters["temperatures_used"] == np.count_nonzero(expected.coef_)


def test_every_penalty_of_the_path_is_that_of_scikit_learn(inputs: Inputs) -> None:
    x, y = rows_of(inputs)
    scaled, target = (x - x.mean(axis=0)) / x.std(axis=0), (y - y.mean())[:, 0]
    largest = np.abs(scaled.T @ target).max() / len(scaled)
    shares = (1.0, 0.5, 0.1, 0.01)
    path = lasso_path(scaled, target, shares)
    assert path.shape == (4, SENSORS)
    for share, found in zip(shares, path, strict=True):
        expected = Lasso(alpha=share * largest, fit_intercept=False, tol=1e-12, max_iter=100_000).fit(scaled, target)
        assert found == pytest.approx(expected.coef_, abs=1e-6)
    assert not path[0].any(), "the penalty that leaves no temperature"
    assert not lasso_path(scaled, np.zeros(len(target)), shares).any()
