"""Regressions of bearing properties on temperatures from an impact campaign (sections 5.3.1 and 5.3.2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import IdentificationError
from models.records import FloatArray
from models.thermomechanics.regression import (
    AxisRegression,
    Bounds,
    FittedRange,
    PropertyRegression,
    explanatory_variables,
)

INTERVALS_MIN: tuple[float, ...] = tuple(float(minute) for minute in range(11))
"""Intervals of the difference terms that are tried [min]; 0: without such terms. Longer ones make it slow."""
LONGEST_GAP_MIN = 20.0
"""Between responses further apart nothing is interpolated [min]."""
NEAR_MIN = 1.0
"""A minute this close to a response counts in any case."""
RIDGES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
"""Penalties that are tried [K^2]; a direction in which the temperatures moved by less is hardly used."""
SQUARES_PAY = 0.8
"""The squares are kept when they bring the error on left-out stretches below this share."""
FOLDS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MinuteSeries:
    """Temperatures and bearing properties of one run, minute by minute."""

    time_min: FloatArray
    """Shape (n,)."""
    degc: FloatArray
    """One-minute means of the signals [degC], shape (n, m)."""
    past_degc: Mapping[float, FloatArray]
    """Interval [min] -> the same so long before, shape (n, m); NaN where it was not recorded."""
    values: FloatArray
    """Properties, interpolated, shape (n, p)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedProperty:
    """One regression and how it was chosen."""

    regression: PropertyRegression
    adjusted_r2: Mapping[float, float]
    """Interval [min] -> adjusted coefficient of determination with squares (13 variables, Figs 5-12, 5-13)."""
    adjusted_r2_without_squares: Mapping[float, float]
    """The same with 9 variables."""
    ridge: float
    left_out_error: float
    """Root mean square error on stretches of time that were left out, beside the property's own deviation."""


def minute_grid(time_min: FloatArray) -> FloatArray:
    """Return whole minutes between the first and the last response, without those in longer gaps [min]."""
    grid = np.arange(np.ceil(time_min[0]), np.floor(time_min[-1]) + 1.0)
    after = np.searchsorted(time_min, grid, side="left").clip(1, len(time_min) - 1)
    gap, near = (
        time_min[after] - time_min[after - 1],
        np.minimum(abs(time_min[after] - grid), abs(grid - time_min[after - 1])),
    )
    return np.asarray(grid[(gap <= LONGEST_GAP_MIN) | (near <= NEAR_MIN)], dtype=np.float64)


def minute_series(
    response_min: FloatArray,
    values: FloatArray,
    recorded_min: FloatArray,
    recorded_degc: FloatArray,
) -> MinuteSeries:
    """Interpolate properties to whole minutes and take the temperatures' means beside them.

    Raises IdentificationError when no minute is left.

    `response_min`: times of the responses [min], ascending, shape (k,). `values`: identified properties, shape (k, p).
    `recorded_min`: times of the recording [min], shape (n,). `recorded_degc`: temperatures of the signals [degC], NaN
    where unknown, shape (n, m).
    """
    grid = minute_grid(response_min)
    at = np.stack([np.interp(grid, response_min, column) for column in values.T], axis=1)
    now = _minute_means(recorded_min, recorded_degc, grid)
    past = {each: _minute_means(recorded_min, recorded_degc, grid - each) for each in INTERVALS_MIN if each}
    known = np.isfinite(now).all(axis=1)
    for table in past.values():
        known &= np.isfinite(table).all(axis=1)
    if not known.any():
        raise IdentificationError(
            f"no minute of the responses ({response_min[0]:.1f} to {response_min[-1]:.1f} min) has temperatures now "
            f"and {max(INTERVALS_MIN):g} min before; {recorded_min[0]:.1f} to {recorded_min[-1]:.1f} min are recorded: "
            "record through the whole campaign, and check that both count from the same moment"
        )
    return MinuteSeries(
        time_min=grid[known],
        degc=now[known],
        past_degc={minutes: table[known] for minutes, table in past.items()},
        values=at[known],
    )


def _minute_means(recorded_min: FloatArray, degc: FloatArray, ends_min: FloatArray) -> FloatArray:
    """Return the means over the minute that ends at each time, NaN where nothing was recorded."""
    known = np.isfinite(degc)
    sums = np.concatenate([np.zeros((1, degc.shape[1])), np.cumsum(np.where(known, degc, 0.0), axis=0)])
    counts = np.concatenate([np.zeros((1, degc.shape[1])), np.cumsum(known, axis=0)])
    first = np.searchsorted(recorded_min, ends_min - 1.0, side="right")
    stop = np.searchsorted(recorded_min, ends_min, side="right")
    number = counts[stop] - counts[first]
    return np.where(number > 0, (sums[stop] - sums[first]) / np.maximum(number, 1.0), np.nan)


def fit_axis(
    axis: str,
    signals: Sequence[str],
    names: Sequence[str],
    runs: Sequence[MinuteSeries],
    bounds: Mapping[str, Bounds],
    fixed: Mapping[str, float],
    *,
    least_squares: bool = False,
) -> tuple[AxisRegression, dict[str, FittedProperty]]:
    """Fit the regressions of one axis.

    The interval of each property is the one with the largest adjusted coefficient of determination; the penalty the
    one with the smallest error on stretches of time that were left out.

    Raises IdentificationError when there are fewer minutes than the regression needs.

    Parameters
    ----------
    axis
        x or y.
    signals
        Labels of the columns of `degc`.
    names
        Properties, the columns of `values`.
    runs
        What was measured.
    bounds
        Physical ranges by name.
    fixed
        The parameters that were not varied.
    least_squares
        No penalty, as the dissertation.

    """
    degc = np.concatenate([run.degc for run in runs])
    needed = 3 * (1 + 3 * len(signals))
    if len(degc) < needed:
        raise IdentificationError(
            f"axis {axis}: {len(degc)} minutes cannot determine {1 + 3 * len(signals)} coefficients; at least {needed} "
            "are needed: measure longer, or take fewer signals"
        )
    fitted = {name: _fit_property(name, column, runs, bounds[name], least_squares) for column, name in enumerate(names)}
    regression = AxisRegression(
        axis=axis,
        signals=tuple(signals),
        properties=tuple(each.regression for each in fitted.values()),
        fixed=dict(fixed),
        fitted_range=FittedRange(lowest_degc=degc.min(axis=0), highest_degc=degc.max(axis=0)),
    )
    return regression, fitted


def _fit_property(
    name: str, column: int, runs: Sequence[MinuteSeries], bounds: Bounds, least_squares: bool
) -> FittedProperty:
    target = np.concatenate([run.values[:, column] for run in runs])
    with_squares = {each: adjusted_r2(variables(runs, each), target) for each in INTERVALS_MIN}
    without = {
        each: adjusted_r2(variables(runs, each)[:, : 1 + (2 if each else 1) * runs[0].degc.shape[1]], target)
        for each in INTERVALS_MIN
    }
    interval = max(with_squares, key=lambda each: with_squares[each])
    table = variables(runs, interval)
    signals = runs[0].degc.shape[1]
    if least_squares:
        ridge, squares = 0.0, True
        left_out = _left_out_error(table, target, signals, ridge, squares)
    else:
        ridge, squares, left_out = _best_penalty(table, target, signals)
    coefficients = solve(table, target, signals, ridge, squares=squares)
    deviation = float(np.sqrt(np.mean((target - table @ coefficients) ** 2)))
    return FittedProperty(
        regression=PropertyRegression(
            name=name, interval_min=interval, coefficients=coefficients, bounds=bounds, deviation=deviation
        ),
        adjusted_r2=with_squares,
        adjusted_r2_without_squares=without,
        ridge=ridge,
        left_out_error=left_out / max(float(np.std(target)), 1e-300),
    )


def variables(runs: Sequence[MinuteSeries], interval_min: float) -> FloatArray:
    """Return the explanatory variables of all runs with an interval [min]; 0: without difference terms."""
    rows = []
    for run in runs:
        change = run.degc - run.past_degc[interval_min] if interval_min else run.degc[:, :0]
        rows.append(explanatory_variables(run.degc, change))
    return np.concatenate(rows)


def solve(table: FloatArray, target: FloatArray, signals: int, ridge: float, *, squares: bool = True) -> FloatArray:
    """Return the coefficients of 5-1 that minimise the squared error plus a penalty.

    The penalty acts on the temperatures' departures from the signal that moved least (usually the room's), on that
    signal itself, and on the changes: where the campaign hardly moved them, as the level of all temperatures at once,
    the regression then says nothing, in place of something arbitrary.

    `table`: explanatory variables, shape (n, 1 + 3 signals) or (n, 1 + signals). `target`: shape (n,). `signals`:
    number of temperatures. `ridge`: penalty beside the variances [K^2]; 0: least squares, as the dissertation.
    `squares`: False leaves the squares out; their coefficients are 0.
    """
    count = table.shape[1] - 1
    turn = np.eye(count)
    least = int(np.argmin(table[:, 1 : 1 + signals].std(axis=0)))
    turn[least, :signals] = -1.0
    turn[least, least] = 1.0
    columns = table[:, 1:] @ turn
    mean = columns.mean(axis=0)
    scale = np.ones(count)
    scale[2 * signals :] = np.maximum(columns[:, 2 * signals :].std(axis=0), 1e-9)
    used = np.ones(count, dtype=bool)
    used[2 * signals :] = squares
    scaled = ((columns - mean) / scale)[:, used]
    middle = float(target.mean())
    left, singular, right = np.linalg.svd(scaled, full_matrices=False)
    kept = singular > 1e-10 * singular.max(initial=0.0)
    gain = np.where(kept, singular / np.where(kept, singular**2 + ridge * len(target), 1.0), 0.0)
    slopes = np.zeros(count)
    slopes[used] = right.T @ (gain * (left.T @ (target - middle)))
    slopes = turn @ (slopes / scale)
    return np.concatenate([[middle - float(table[:, 1:].mean(axis=0) @ slopes)], slopes])


def adjusted_r2(table: FloatArray, target: FloatArray) -> float:
    """Return the adjusted coefficient of determination of least squares; 0 where the target does not move."""
    rows, count = table.shape
    total = float(np.sum((target - target.mean()) ** 2))
    if total == 0.0 or rows <= count:
        return 0.0
    found, *_ = np.linalg.lstsq(table, target, rcond=1e-12)
    left = float(np.sum((target - table @ found) ** 2))
    return float(1.0 - (left / (rows - count)) / (total / (rows - 1)))


def _best_penalty(table: FloatArray, target: FloatArray, signals: int) -> tuple[float, bool, float]:
    """Return penalty, whether the squares are kept, and the error on stretches that were left out."""
    best: dict[bool, tuple[float, float]] = {}
    for squares in (False, True):
        errors = {ridge: _left_out_error(table, target, signals, ridge, squares) for ridge in RIDGES}
        ridge = min(errors, key=lambda each: errors[each])
        best[squares] = (ridge, errors[ridge])
    squares = best[True][1] < SQUARES_PAY * best[False][1]
    return best[squares][0], squares, best[squares][1]


def _left_out_error(table: FloatArray, target: FloatArray, signals: int, ridge: float, squares: bool) -> float:
    """Return the root mean square error on contiguous stretches, each predicted from all the others."""
    error = 0.0
    for stretch in np.array_split(np.arange(len(target)), FOLDS):
        kept = np.ones(len(target), dtype=bool)
        kept[stretch] = False
        predicted = table[stretch] @ solve(table[kept], target[kept], signals, ridge, squares=squares)
        error += float(np.sum((target[stretch] - predicted) ** 2))
    return float(np.sqrt(error / len(target)))
