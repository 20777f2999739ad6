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
