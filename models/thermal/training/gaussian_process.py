"""A Gaussian process on some rows: its kernel, the evidence for its hyper-parameters with gradient, and the posterior.

Displacements y of the rows (relative to their deviation) are taken as

    y = sum_g s_g x_g w_g + h(z) + c(t) + b_run + noise,   w_g ~ N(0, 1),   h ~ GP(0, a^2 exp(-|z - z'|^2 / 2 l^2)),

with x_g the standardised columns of group g over the root of their number, z the leading principal coordinates of all
columns, c a residual that persists with time, exp(-|t - t'| / tau) within a run, and a constant of its own for each
run, because the zero of its displacements is its own. Rasmussen and Williams, Gaussian Processes for Machine Learning,
equations 2.25, 2.26, 5.8 and 5.9. All channels share the hyper-parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray

RUN_VARIANCE = 10.0
"""Of the constant of a run, relative to the variance of the displacements: it may be anything."""
COORDINATES = 16
"""So many leading principal directions of the columns are the coordinates of what bends."""
FIRST_SCALES = (1.0, 0.3, 0.1, 30.0, 0.03)
"""Where the search begins: each group, what bends, the residual, its time [min], the noise."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """What a Gaussian process is fitted on."""

    columns: FloatArray
    """Standardised, over the root of the number in the group, about their mean, shape (n, d)."""
    groups: tuple[IntArray, ...]
    """Columns of each group."""
    coordinates: FloatArray
    """Of what bends, shape (n, q)."""
    run: IntArray
    time_min: FloatArray
    values: FloatArray
    """Displacements, relative to their deviation, shape (n, n_channels)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Kernels:
    """What the covariance of rows is made of, whatever the hyper-parameters.

    All of it is symmetric: a search needs the lower triangles alone, row after row, shape (n (n + 1) / 2,) in place of
    (n, n), and takes half the time.
    """

    linear: FloatArray
    """Products of the columns of each group, shape (n_groups, n, n)."""
    apart: FloatArray
    """Squared distances of the coordinates, shape (n, n)."""
    same_run: BoolArray
    """Whether two rows are of one run, shape (n, n)."""
    elapsed_min: FloatArray
    """Time between two rows, shape (n, n)."""
    diagonal: Any
    """Index of what is on the diagonal."""

    def lower(self) -> "_Kernels":
        """Return the lower triangles."""
        below = np.tri(len(self.apart), dtype=np.bool_)
        return _Kernels(
            linear=np.stack([each[below] for each in self.linear]),
            apart=self.apart[below],
            same_run=self.same_run[below],
            elapsed_min=self.elapsed_min[below],
            diagonal=np.cumsum(np.arange(1, len(below) + 1)) - 1,
        )

    def some(self, used: IntArray) -> "_Kernels":
        """Return those of some rows; of all in their order these themselves, which may be tens of megabytes."""
        if len(used) == len(self.apart) and np.array_equal(used, np.arange(len(used))):
            return self
        both = np.ix_(used, used)
        return _Kernels(
            linear=np.stack([each[both] for each in self.linear]),
            apart=self.apart[both],
            same_run=self.same_run[both],
            elapsed_min=self.elapsed_min[both],
            diagonal=np.diag_indices(len(used)),
        )

    def of_groups(self, logarithms: FloatArray) -> FloatArray:
        """Return the covariance of the linear part, shape (n, n)."""
        variances = np.exp(2.0 * logarithms[: len(self.linear)])
        return np.asarray(np.tensordot(variances, self.linear, axes=1), dtype=np.float64)

    def of_rows(self, logarithms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariance of what bends, and of the residual that persists, each of shape (n, n)."""
        bend, length, residual, residual_min = np.exp(logarithms[len(self.linear) : -1])
        bends = self.apart * (-0.5 / np.square(length))
        np.exp(bends, out=bends)
        bends *= np.square(bend)
        persists = np.zeros_like(self.elapsed_min)
        persists[self.same_run] = np.square(residual) * np.exp(self.elapsed_min[self.same_run] * (-1.0 / residual_min))
        return bends, persists

    def covariance(self, logarithms: FloatArray, bends: FloatArray, persists: FloatArray) -> FloatArray:
        """Return the covariance of the displacements without the linear part, shape (n, n)."""
        found = RUN_VARIANCE * self.same_run + bends
        found += persists
        found[self.diagonal] += np.exp(2.0 * logarithms[-1])
        return found


def _surprise(
    logarithms: FloatArray, kernels: _Kernels, values: FloatArray, below: BoolArray
) -> tuple[float, FloatArray]:
    """Return what `GaussianProcess.surprise` says of the rows of the kernels, which are lower triangles.

    `values`, shape (m, n_channels). `below`: what of a matrix is in the lower triangle, shape (m, m).
    """
    from scipy.linalg.lapack import dpotrf, dpotri, dpotrs  # noqa: PLC0415 - never loaded by the resident daemon

    bend, residual = kernels.of_rows(logarithms)
    covariance = kernels.covariance(logarithms, bend, residual)
    covariance += kernels.of_groups(logarithms)
    matrix, (rows, channels) = np.zeros(below.shape), values.shape
    matrix[below] = covariance
    factor, failed = dpotrf(matrix.T, lower=0, clean=0, overwrite_a=1)
    if failed:
        return 1e6, np.zeros_like(logarithms)
    weights, _ = dpotrs(factor, values, lower=0)
    value = 0.5 * float((weights * values).sum()) + channels * float(np.log(np.diagonal(factor)).sum())
    inverse, _ = dpotri(factor, lower=0, overwrite_c=1)
    inverse *= channels
    inverse -= weights @ weights.T
    inverse *= 2.0  # what is below the diagonal stands for what is above it
    inverse[np.diag_indices(rows)] *= 0.5
    pull = inverse.T[below]
    count, scale = len(kernels.linear), np.exp(logarithms)
    gradient = np.empty_like(logarithms)
    gradient[:count] = scale[:count] ** 2 * (kernels.linear @ pull)
    bend *= pull
    residual *= pull
    gradient[count] = bend.sum()
    gradient[count + 1] = 0.5 * np.vdot(bend, kernels.apart) / np.square(scale[count + 1])
    gradient[count + 2] = residual.sum()
    gradient[count + 3] = 0.5 * np.vdot(residual, kernels.elapsed_min) / scale[count + 3]
    gradient[count + 4] = np.square(scale[-1]) * pull[kernels.diagonal].sum()
    return value / rows, gradient / rows


class GaussianProcess:
    """The matrices of some rows, prepared once; folds are left out by leaving rows out of them.

    `rows`: what it is fitted on.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self._kernels = _Kernels(
            linear=np.stack([rows.columns[:, group] @ rows.columns[:, group].T for group in rows.groups]),
            apart=squared_distances(rows.coordinates, rows.coordinates),
            same_run=rows.run[:, None] == rows.run,
            elapsed_min=np.abs(rows.time_min[:, None] - rows.time_min),
            diagonal=np.diag_indices(len(rows.run)),
        )
        known = self._kernels.apart[self._kernels.apart > 0.0]
        self._typical = 0.5 * float(np.log(np.median(known))) if len(known) else 0.0

    @property
    def first(self) -> FloatArray:
        """Return where the search for the hyper-parameters begins: logarithms, shape (n_groups + 5,)."""
        group, bend, residual, residual_min, noise = np.log(FIRST_SCALES)
        groups = [group] * len(self.rows.groups)
        return np.array([*groups, bend, self._typical, residual, residual_min, noise])

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Return the bounds of the search, in the order of `first`."""
        groups = [(-6.0, 4.0)] * len(self.rows.groups)
        length = (self._typical - 2.3, self._typical + 3.0)
        return [*groups, (-6.0, 3.0), length, (-7.0, 1.5), (np.log(3.0), np.log(400.0)), (-6.0, 0.0)]

    def surprise(self, logarithms: FloatArray, used: IntArray) -> tuple[float, FloatArray]:
        """Return minus the logarithm of the evidence per row, but for a constant, and its gradient (eqs. 5.8, 5.9).

        `logarithms`: of the hyper-parameters. `used`, shape (m,): rows.
        """
        below = np.tri(len(used), dtype=np.bool_)
        return _surprise(logarithms, self._kernels.some(used).lower(), self.rows.values[used], below)

    def likely(self, used: IntArray, begin: FloatArray, steps: int) -> FloatArray:
        """Return the logarithms of the hyper-parameters with the largest evidence, by L-BFGS within `bounds`.

        `used`: rows. `begin`: where the search begins. `steps`: at most so many iterations.
        """
        from scipy.optimize import minimize  # noqa: PLC0415 - never loaded by the resident daemon

        bounds = self.bounds
        start = np.clip(begin, [low for low, _ in bounds], [high for _, high in bounds])
        options = {"maxiter": steps, "maxfun": 2 * steps + 5}
        arguments = self._kernels.some(used).lower(), self.rows.values[used], np.tri(len(used), dtype=np.bool_)
        found = minimize(_surprise, start, args=arguments, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x, dtype=np.float64)

    def posterior(self, logarithms: FloatArray, used: IntArray) -> "Posterior":
        """Return what the displacements of some rows tell (eqs. 2.25, 2.26)."""
        kernels, count, both = self._kernels, len(self.rows.groups), np.ix_(used, used)
        linear = kernels.of_groups(logarithms)[both]
        without_linear = kernels.covariance(logarithms, *kernels.of_rows(logarithms))[both]
        inverse = inverse_of(np.linalg.cholesky(without_linear + linear))
        scale = np.zeros(self.rows.columns.shape[1])
        for size, group in zip(np.exp(logarithms[:count]), self.rows.groups, strict=True):
            scale[group] = size
        return Posterior(
            columns=self.rows.columns[used] * scale,
            scale=scale,
            coordinates=self.rows.coordinates[used],
            length=float(np.exp(logarithms[count + 1])),
            variance=float(np.exp(2.0 * logarithms[count])),
            without_linear=without_linear,
            inverse=inverse,
            weights=inverse @ self.rows.values[used],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Posterior:
    """What is known after training."""

    columns: FloatArray
    """Columns of the training rows in units of their prior deviation, shape (m, d)."""
    scale: FloatArray
    """Prior deviation of each standardised column, shape (d,)."""
    coordinates: FloatArray
    """Of what bends, shape (m, q)."""
    length: float
    variance: float
    """Of what bends."""
    without_linear: FloatArray
    """Covariance of the training rows without the linear part, shape (m, m)."""
    inverse: FloatArray
    """Of the whole covariance, shape (m, m)."""
    weights: FloatArray
    """Inverse times displacements, shape (m, n_channels)."""

    @property
    def linear(self) -> FloatArray:
        """Return the mean weight of each column in units of its prior deviation, shape (d, n_channels)."""
        return np.asarray(self.columns.T @ self.weights)

    def mean(self, columns: FloatArray, coordinates: FloatArray) -> FloatArray:
        """Return the mean of linear part and what bends at other rows, shape (n, n_channels)."""
        bend = self._similar(coordinates) @ self.weights
        return np.asarray((columns * self.scale) @ self.linear + self.variance * bend)

    def covariance(self, columns: FloatArray, coordinates: FloatArray) -> FloatArray:
        """Return the covariance of linear part and what bends at other rows, shape (n, n)."""
        scaled = columns * self.scale
        shared = scaled @ self.columns.T + self.variance * self._similar(coordinates)
        apart = squared_distances(coordinates, coordinates) / self.length**2
        before = scaled @ scaled.T + self.variance * np.exp(-0.5 * apart)
        return np.asarray(before - shared @ self.inverse @ shared.T)

    def directions(self, most: int, least: float) -> tuple[FloatArray, FloatArray]:
        """Return the directions of the scaled columns about which training says most, and how much of each remains.

        The posterior covariance of the weights is ``(I + X^T C^-1 X)^-1`` with C the covariance of all but the linear
        part; its eigenvectors follow from the rows.

        Result: directions, shape (d, k), and the share of the prior variance that remains of each, shape (k,).

        `most`: at most so many. `least`: eigenvalues below this are left out: training says next to nothing of them.
        """
        lower = np.linalg.cholesky(self.without_linear)
        whitened = np.linalg.solve(lower, self.columns)
        eigenvalues, vectors = np.linalg.eigh(whitened @ whitened.T)
        kept = np.argsort(eigenvalues)[::-1][:most]
        kept = kept[eigenvalues[kept] > least]
        found = whitened.T @ vectors[:, kept] / np.sqrt(eigenvalues[kept])
        return found, 1.0 / (1.0 + eigenvalues[kept])

    def root(self, most: int) -> FloatArray:
        """Return R with R R^T nearly the inverse of the whole covariance, shape (m, at most `most`).

        Directions of small variance are left out: no kernel between rows has much of these, and what it has would be
        multiplied with its rounding. So a deviation from it is never too small by more than that.
        """
        eigenvalues, vectors = np.linalg.eigh(self.inverse)
        return np.asarray(vectors[:, :most] * np.sqrt(np.maximum(eigenvalues[:most], 0.0)))

    def _similar(self, coordinates: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-0.5 * squared_distances(coordinates, self.coordinates) / self.length**2))


def squared_distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the squared distances between the rows of two tables, shape (n, m)."""
    squared = np.square(one).sum(axis=1)[:, None] + np.square(other).sum(axis=1) - 2.0 * one @ other.T
    return np.asarray(np.maximum(squared, 0.0), dtype=np.float64)


def inverse_of(lower: npt.NDArray[np.floating[Any]]) -> FloatArray:
    """Return the inverse of a matrix from its Cholesky factor, a lower triangle."""
    from scipy.linalg.lapack import dpotri  # noqa: PLC0415 - never loaded by the resident daemon

    found, failed = dpotri(np.asarray(lower, dtype=np.float64), lower=1)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the training rows cannot be inverted")
    found += np.tril(found, -1).T  # the factor has zeros above its diagonal
    return np.asarray(found, dtype=np.float64)


def principal_coordinates(columns: FloatArray, groups: Sequence[IntArray]) -> FloatArray:
    """Return the directions of the columns along which rows differ most, shape (d, at most `COORDINATES`).

    `columns`, shape (n, d): standardised, about their mean. `groups`: the columns that count.
    """
    used = np.concatenate(list(groups))
    some = columns[:, used]
    if len(some) < len(used):
        eigenvalues, vectors = np.linalg.eigh(some @ some.T)
        largest = np.argsort(eigenvalues)[::-1][:COORDINATES]
        largest = largest[eigenvalues[largest] > 1e-12 * max(float(eigenvalues.max()), 1e-300)]
        directions = some.T @ vectors[:, largest] / np.sqrt(eigenvalues[largest])
    else:
        eigenvalues, vectors = np.linalg.eigh(some.T @ some)
        directions = vectors[:, np.argsort(eigenvalues)[::-1][:COORDINATES]]
    found = np.zeros((columns.shape[1], directions.shape[1]))
    found[used] = directions
    return np.asarray(found, dtype=np.float64)
