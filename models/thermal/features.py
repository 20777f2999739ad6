"""The features of linear models: temperatures, their first-order lags and lagged spindle speed, row by row.

A lag with time constant tau follows ``tau dx/dt = u - x``. Between two samples the input is taken
as a straight line, for which the step below is exact: the result does not depend on how often
somebody looks, and a short gap is bridged by the line between its ends.
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
    correlation_min: float | None = None
    """What models of before 2026-11-27 may hold of how their rows were weighed [min]; read, and not used."""


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


def lag_step(
    lagged: FloatArray, before: FloatArray, now: FloatArray, elapsed_min: float, time_constant_min: FloatArray | float
) -> FloatArray:
    """Return a first-order lag after one interval in which its input went straight from one value to another.

    Result: the lag at the end of the interval, in the unit of the input.

    `lagged`, `before`, `now`: lag and input at the beginning of the interval, and input at its end.
    `elapsed_min`: length of the interval [min]; 0 leaves the lag as it is. `time_constant_min`: time constant [min],
    positive; of several lags, shape (n_lags, 1).
    """
    if elapsed_min <= 0.0:
        return lagged.copy()
    decay = np.exp(-elapsed_min / time_constant_min)
    ramp = (now - before) * (time_constant_min / elapsed_min)
    return np.asarray(now - ramp + decay * (lagged - before + ramp))


def lag_table(time_min: FloatArray, values: FloatArray, time_constants_min: Sequence[float]) -> FloatArray:
    """Return the lags of a table, which begin as if the first row had lasted for ever.

    Result of shape (n_lags, n, n_columns): in the unit of the inputs.

    `time_min`, shape (n,): increasing times [min]. `values`, shape (n, n_columns): inputs; every value finite.
    `time_constants_min`, length n_lags: time constants [min].
    """
    lagged = np.empty((len(time_constants_min), *values.shape))
    if not len(values):
        return lagged
    elapsed_min = np.diff(time_min)
    for table, time_constant_min in zip(lagged, time_constants_min, strict=True):
        table[0] = values[0]
        decay = np.exp(-elapsed_min / time_constant_min)
        ramp = np.diff(values, axis=0) * (time_constant_min / elapsed_min)[:, None]
        gained = values[1:] - ramp + decay[:, None] * (ramp - values[:-1])
        for row in range(1, len(values)):
            table[row] = gained[row - 1] + decay[row - 1] * table[row - 1]
    return lagged


def speed_inputs(speed_rpm: FloatArray, scale_rpm: float) -> FloatArray:
    """Return spindle speed and its square, from which the heat of bearings and windings follows.

    Result of shape (n, 2): ``|n| / scale`` and its square, without unit.

    `speed_rpm`, shape (n,): spindle speed [1/min]. `scale_rpm`: speed that becomes 1 [1/min].
    """
    relative = np.abs(speed_rpm) / scale_rpm
    return np.column_stack([relative, np.square(relative)])


def feature_table(
    layout: Layout, time_min: FloatArray, degc: FloatArray, speed_rpm: FloatArray, scale_rpm: float
) -> FloatArray:
    """Return temperatures, their lags and lagged speed of one run, shape (n, layout.columns).

    `layout`: which columns. `time_min`, shape (n,): increasing times [min]. `degc`, shape (n, n_sensors): temperatures
    [degC], finite. `speed_rpm`, shape (n,): spindle speed [1/min], finite. `scale_rpm`: speed that becomes 1 [1/min].
    """
    lagged = lag_table(time_min, degc, layout.lags_min)
    speed = lag_table(time_min, speed_inputs(speed_rpm, scale_rpm), layout.speed_lags_min)
    return np.hstack([degc, *lagged, *speed])
