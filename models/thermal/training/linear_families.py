"""Families of models on temperatures alone that scikit-learn fits: partial least squares, LASSO."""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.model import HyperParameters
from models.thermal.training.families import (
    Fit,
    chosen,
    require_enough,
)
from models.thermal.training.inputs import Inputs

MOST_COMPONENTS = 20
"""Partial least squares tries so many components."""
RELATIVE_ALPHAS: tuple[float, ...] = tuple(10.0 ** (-quarter / 4.0) for quarter in range(1, 18))
"""LASSO penalties that are tried, relative to the one that leaves no temperature."""


class _CentredRows:
    """Temperatures and displacements of training rows about the mean of each run."""

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray) -> None:
        require_enough(inputs, rows)
        self.inputs, self.rows, self.fold = inputs, rows, fold
        self.sensors, self.channels = inputs.layout.sensors, len(inputs.channels)

    def centred(self, left_out: frozenset[int], without: Sequence[int]) -> tuple[FloatArray, FloatArray, list[int]]:
        """Return x, y and the sensors that x has."""
        rows = self.rows & ~np.isin(self.fold, list(left_out))
        x, y = self.inputs.degc[rows].copy(), self.inputs.cleansed_um[rows].copy()
        run = self.inputs.run[rows]
        for number in np.unique(run):
            x[run == number] -= x[run == number].mean(axis=0)
            y[run == number] -= y[run == number].mean(axis=0)
        kept = [s for s in range(self.sensors) if s not in without and x[:, s].std() > 1e-9]
        return x[:, kept], y, kept

    def wide(self, coefficients: FloatArray, kept: Sequence[int]) -> FloatArray:
        """Return coefficients for all sensors from those that were kept."""
        found = np.zeros((self.sensors, self.channels))
        found[kept] = coefficients
        return found


class PartialLeastSquaresProblem:
    """Partial least squares on temperatures (scikit-learn), components chosen by leaving folds out."""

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None) -> None:
        self._rows = _CentredRows(inputs, rows, fold)
        most = max(1, min(MOST_COMPONENTS, inputs.layout.sensors, int(rows.sum()) // 2))

        def candidates(number: int) -> list[Fit]:
            """Return one fit per number of components without the fold."""
            return self._fits(frozenset({number}), (), range(1, most + 1))

        self._components = 1 + chosen(inputs, rows, fold, probe_min, candidates)
        self.hyper_parameters: HyperParameters = {"components": self._components}

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return self._fits(left_out, (), [self._components])[0]

    def _fits(self, left_out: frozenset[int], without: tuple[int, ...], components: Sequence[int]) -> list[Fit]:
        from sklearn.cross_decomposition import PLSRegression  # noqa: PLC0415

        x, y, kept = self._rows.centred(left_out, without)
        most = min(max(components), x.shape[1], len(x) - 1)
        scale = x.std(axis=0)
        model = PLSRegression(n_components=most, scale=False).fit(x / scale, y)
        found = []
        for count in components:
            used = slice(0, min(count, most))
            weights = model.x_rotations_[:, used] @ model.y_loadings_[:, used].T
            found.append(
                Fit(
                    coefficients=self._rows.wide(weights / scale[:, None], kept),
                    drift_um_per_min=np.zeros(self._rows.channels),
                    refit=lambda more: self._fits(left_out, tuple({*without, *more}), [self._components])[0],
                )
            )
        return found


class LassoProblem:
    """LASSO on temperatures (scikit-learn), one relative penalty for all channels, chosen by leaving folds out."""

    def __init__(self, inputs: Inputs, rows: BoolArray, fold: IntArray, probe_min: float | None) -> None:
        self._rows = _CentredRows(inputs, rows, fold)

        def candidates(number: int) -> list[Fit]:
            """Return one fit per penalty without the fold."""
            return self._fits(frozenset({number}), (), RELATIVE_ALPHAS)

        self._alpha = RELATIVE_ALPHAS[chosen(inputs, rows, fold, probe_min, candidates)]
        used = int((np.abs(self.fit().coefficients).max(axis=1) > 0.0).sum())
        self.hyper_parameters: HyperParameters = {"relative_alpha": self._alpha, "temperatures_used": used}

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""
        return self._fits(left_out, (), [self._alpha])[0]

    def _fits(self, left_out: frozenset[int], without: tuple[int, ...], alphas: Sequence[float]) -> list[Fit]:
        x, y, kept = self._rows.centred(left_out, without)
        scale = x.std(axis=0)
        paths = np.stack([lasso_path(x / scale, target, alphas) for target in y.T], axis=-1)
        return [
            Fit(
                coefficients=self._rows.wide(path / scale[:, None], kept),
                drift_um_per_min=np.zeros(self._rows.channels),
                refit=lambda more: self._fits(left_out, tuple({*without, *more}), [self._alpha])[0],
            )
            for path in paths
        ]


def lasso_path(x: FloatArray, y: FloatArray, relative_alphas: Sequence[float]) -> FloatArray:
    """Return the LASSO solutions for penalties relative to the one that leaves nothing.

    Result of shape (len(relative_alphas), d): found by least angle regression, along which every solution between two
    knots is a line.

    `x`, shape (n, d): centred and scaled columns. `y`, shape (n,): centred target [um]. `relative_alphas`: decreasing,
    from 1.
    """
    from sklearn.linear_model import lars_path_gram  # noqa: PLC0415

    largest = float(np.abs(x.T @ y).max(initial=0.0)) / len(x)
    if largest <= 0.0:
        return np.zeros((len(relative_alphas), x.shape[1]))
    knots, _, path = lars_path_gram(
        Xy=x.T @ y,
        Gram=x.T @ x,
        n_samples=len(x),
        method="lasso",
        alpha_min=0.5 * min(relative_alphas) * largest,
        max_iter=20 * x.shape[1] + 100,
    )
    wanted = np.asarray(relative_alphas) * largest
    return np.column_stack([np.interp(wanted, knots[::-1], row[::-1]) for row in path])
