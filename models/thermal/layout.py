"""What models with lags are fitted on: temperatures, their lags, lagged spindle speed, and displacements, row by row.

Rows of several recordings stand in one table. A run is a stretch without a long gap; its lags begin
as if its first row had lasted for ever, and the zero of its displacements is its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

BRIDGE_MIN = 10.0
"""A gap is bridged by a straight line up to this length [min], or two rows; thermal errors move by 12 um in it."""


BoolArray = npt.NDArray[np.bool_]


IntArray = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where each column of a feature table comes from: temperatures, their lags in turn, then lagged speed."""

    sensors: int
    lags_min: tuple[float, ...]
    speed_lags_min: tuple[float, ...]
    """Empty without spindle speed."""

    @property
    def temperature_columns(self) -> int:
        """Number of columns that come from temperatures."""
        return self.sensors * (1 + len(self.lags_min))

    @property
    def columns(self) -> int:
        """Number of columns; speed has two per lag, speed and its square."""
        return self.temperature_columns + 2 * len(self.speed_lags_min)

    def of_sensors(self, sensors: Sequence[int]) -> IntArray:
        """Return the columns that come from the given sensors (indices from 0)."""
        first = self.sensors * np.arange(1 + len(self.lags_min))[:, None]
        return np.sort((first + np.asarray(sorted(sensors), dtype=np.intp)).ravel())


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """How the columns and rows of one ridge are made."""

    departures: bool
    """Regress on temperatures minus their lags in place of the lags: another prior, the same space."""
    correlation_min: float | None
    """Correlation time of what the model does not explain [min]: rows are then weighed by generalised
    least squares, each minus the share of its predecessor that persists. None: rows as they are."""


def design_columns(features: FloatArray, layout: Layout, design: Design) -> FloatArray:
    """Return the columns that a design regresses on, shape (n, layout.columns)."""
    if not design.departures:
        return features
    columns = features.copy()
    for first in range(layout.sensors, layout.temperature_columns, layout.sensors):
        lag = slice(first, first + layout.sensors)
        columns[:, lag] = features[:, : layout.sensors] - features[:, lag]
    return columns


def canonical(coefficients: FloatArray, layout: Layout, design: Design) -> FloatArray:
    """Return the coefficients of features from those of a design's columns, shape (layout.columns, n_channels)."""
    if not design.departures:
        return coefficients
    found = coefficients.copy()
    for first in range(layout.sensors, layout.temperature_columns, layout.sensors):
        lag = slice(first, first + layout.sensors)
        found[: layout.sensors] += coefficients[lag]
        found[lag] = -coefficients[lag]
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RidgeSolution:
    """One fitted ridge, from which sensors can be left out afterwards."""

    layout: Layout
    design: Design
    gain: FloatArray
    """1 / scale of each column; 0 for a column that does not move, shape (d,)."""
    weights: FloatArray
    """Solution in scaled columns [um], shape (d, n_channels)."""
    directions: FloatArray
    """Orthonormal principal directions of the scaled columns, shape (d, k)."""
    remaining: FloatArray
    """penalty / (eigenvalue + penalty) of each direction, shape (k,)."""

    def coefficients(self, without: Sequence[int] = ()) -> FloatArray:
        """Return the coefficients of the features, fitted without some sensors.

        Leaving columns S out of ``(G + penalty) w = b`` changes the others to
        ``w - Q[:, S] Q[S, S]^-1 w[S]`` with Q the inverse of ``G + penalty``.

        Parameters
        ----------
        without
            Indices of the sensors, from 0, with all their lags.

        Returns
        -------
        numpy.ndarray, shape (layout.columns, n_channels)
            [um per unit of the feature]; zeros for the columns left out.

        """
        weights = self.weights
        if len(without):
            out = self.layout.of_sensors(without)
            to_out = self._inverse(out)
            weights = weights - to_out @ np.linalg.solve(to_out[out], weights[out])
            weights[out] = 0.0
        return canonical(weights * self.gain[:, None], self.layout, self.design)

    def imputed(self, change: FloatArray, without: Sequence[int]) -> FloatArray:
        """Return a change of the features with what the fit without some sensors takes theirs for.

        That fit gives what this one gives when the scaled columns S left out are
        ``-Q[S, S]^-1 Q[S, R] x[R]``, R the others: the values that the penalised fit expects of them.

        Parameters
        ----------
        change : shape (layout.columns,)
            Change of the features; what it holds for the sensors left out does not count.
        without
            Indices of the sensors, from 0, with all their lags.

        Returns
        -------
        numpy.ndarray, shape (layout.columns,)
            In the units of the features; a column that did not move in training is taken not to move.

        """
        out = self.layout.of_sensors(without)
        columns = design_columns(change[None], self.layout, self.design)[0].copy()
        scaled = columns * self.gain
        scaled[out] = 0.0
        to_out = self._inverse(out)
        expected = -np.linalg.solve(to_out[out], to_out.T @ scaled)
        moves = self.gain[out] > 0.0
        columns[out] = np.where(moves, expected / np.where(moves, self.gain[out], 1.0), 0.0)
        found = change.copy()
        found[out] = design_columns(columns[None], self.layout, self.design)[0][out]
        return found

    def _inverse(self, out: IntArray) -> FloatArray:
        """Return some columns of Q, the inverse of ``G + penalty``, but for a factor; shape (d, len(out))."""
        if self.directions.shape[0] == self.directions.shape[1]:
            return np.asarray(self.directions @ (self.directions[out] * self.remaining).T)
        to_out = self.directions @ (self.directions[out] * (self.remaining - 1.0)).T
        to_out[out] += np.eye(len(out))
        return np.asarray(to_out)
