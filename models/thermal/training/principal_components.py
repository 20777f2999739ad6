"""Principal components of temperatures and of their differences (Figs. 3-7 to 3-11)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray

SHARE = 0.99
"""Cumulative contribution at which the dimensions are counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrincipalComponents:
    """Eigenvectors and eigenvalues of a covariance matrix, the largest first."""

    loadings: FloatArray
    """Unit vectors, shape (n_sensors, n_components); the largest entry of each is positive."""
    variance_k2: FloatArray
    """Variance along each [K^2], shape (n_components,)."""

    @property
    def cumulative(self) -> FloatArray:
        """Cumulative contribution ratio of the first 1, 2 .. components, shape (n_components,)."""
        ratio: FloatArray = np.cumsum(self.variance_k2) / self.variance_k2.sum()
        return ratio

    def dimensions(self, share: float = SHARE) -> int:
        """Return how many components together explain at least a share (0..1) of the variance."""
        return int(np.searchsorted(self.cumulative, share * (1.0 - 1e-12))) + 1


def principal_components(values: FloatArray) -> PrincipalComponents:
    """Return the principal components of a table, by the eigenvalues of its covariance.

    Result: all of them. Raises DatasetError when there are fewer than two rows, a value is missing, or nothing varies.

    `values`, shape (n, n_sensors): temperatures or differences of temperatures [degC or K], complete.
    """
    if len(values) < 2 or not np.isfinite(values).all():
        raise DatasetError("principal components take at least two rows without missing values")
    covariance = np.atleast_2d(np.cov(values, rowvar=False))
    variance, vectors = np.linalg.eigh(covariance)
    if not variance[-1] > 0.0:
        raise DatasetError("no temperature varies, so there are no principal components")
    vectors = vectors[:, ::-1]
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return PrincipalComponents(
        loadings=vectors * np.where(largest < 0.0, -1.0, 1.0),
        variance_k2=np.maximum(variance[::-1], 0.0),
    )


def differences(runs: Sequence[FloatArray], rows: int) -> FloatArray:
    """Return the differences over a number of rows within each run, every row being the end of one.

    Result of shape (m, n_sensors): of all runs.

    `runs`: tables of shape (n, n_sensors) with the same columns. `rows`: from 1; runs that are no longer than this add
    nothing.
    """
    return np.concatenate([run[rows:] - run[:-rows] for run in runs])
