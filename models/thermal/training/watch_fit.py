"""Fits the watch of the sensors to training rows: predictions, and limits from stretches that were left out."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray, Layout
from models.thermal.model import LinearParameters
from models.thermal.sensor_watch import (
    FAST_MIN,
    FLAT_FACTOR,
    FLAT_MIN,
    SAME_K,
    SLEW_MARGIN_K_PER_MIN,
    SLOW_MIN,
    THRESHOLD_FACTOR,
    WATCH_LAGS_MIN,
    SensorWatch,
    departure_maps,
)
from models.thermal.training.families import fold_numbers
from models.thermal.training.folds import few_folds_factor, with_unmeasured
from models.thermal.training.gaussian_process import inverse_of
from models.thermal.training.inputs import Inputs, build_inputs

PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1)
"""Damping of the covariance that is tried, relative to the variance of a column."""
RESTLESS_FLAT_MIN = 5.0
"""A sensor that never had the same value in two rows of training is stuck after this time [min] ..."""
FEWEST_FLAT_ROWS = 3
"""... and so many rows without a change."""
ROWS_AT_A_TIME, COLUMNS_AT_A_TIME = 512, 256
"""Of a large table, while something is made of it."""
SMALLEST_THRESHOLD_K = 0.1
"""No departure below this is a fault [K]: less than two steps of a TMP102."""
FEWEST_RUNS = 3
"""Two runs count as so many, because it is their cycles that are left out, which say a little more."""


def fit_watch(recordings: Sequence[Recording], sample_s: float, rows: BoolArray, fold: IntArray) -> SensorWatch:
    """Return the watch that predicts left-out folds best, with limits from them.

    Damping, and whether lagged spindle speed helps, are chosen by the mean logarithm of the largest
    left-out departure.

    `recordings`: as for `build_inputs`. `sample_s`: time between rows [s]. `rows`, shape (n,): training rows. `fold`,
    shape (n,): what is left out in turn, see `inner_folds`.
    """
    best: tuple[float, Layout, float, FloatArray] | None = None
    inputs = build_inputs(recordings, sample_s=sample_s, lags_min=WATCH_LAGS_MIN, speed_lags_min=WATCH_LAGS_MIN)
    rows, fold = with_unmeasured(inputs, rows, fold)
    whole = inputs.layout  # without the lagged speed, which comes last, the columns are the same
    for layout in dict.fromkeys((replace(whole, speed_lags_min=()), whole)):
        for penalty, largest_k in zip(PENALTIES, _left_out_departures_k(inputs, layout, rows, fold), strict=True):
            score = float(np.log(np.maximum(largest_k, 1e-3)).mean())
            if best is None or score < best[0]:
                best = (score, layout, penalty, largest_k)
    assert best is not None
    _, layout, penalty, largest_k = best
    centre, gain = _scaling(inputs.features[:, : layout.columns], rows)
    return SensorWatch(
        layout=layout,
        centre=centre,
        gain=gain,
        precision=next(_precisions(inputs.features[:, : layout.columns], rows, centre, gain, [penalty])),
        threshold_k=_few_runs_factor(inputs, rows) * _thresholds_k(largest_k),
        slew_k_per_min=2.0 * _largest_slew(inputs, rows) + SLEW_MARGIN_K_PER_MIN / max(inputs.period_min, 1.0),
        flat_min=_flat_min(_longest_flat_min(inputs, rows), inputs.period_min),
        speed_scale_rpm=inputs.speed_scale_rpm,
    )


def unnoticed_um(model: LinearParameters) -> FloatArray:
    """Return what every sensor makes when it is wrong by its limit, from which on the others tell it.

    Result: thermal error [um], shape (n_sensors, n_channels), when it has been wrong for long, so that its lags have
    followed; zero sensors without a watch.

    `model`: the model with its watch.
    """
    if model.watch is None:
        return np.zeros((0, len(model.channels)))
    change = np.zeros((len(model.watch.threshold_k), model.layout.columns))
    for sensor, limit_k in enumerate(model.watch.threshold_k):
        change[sensor, model.layout.of_sensors([sensor])] = limit_k
    return model.thermal_error_um(change, 0.0)


def _thresholds_k(largest_k: FloatArray) -> FloatArray:
    """Return the limit of every sensor from its largest left-out departure [K].

    What a few folds say about a single sensor may be luck: no limit lies below the median of all.
    """
    return np.maximum(THRESHOLD_FACTOR * np.maximum(largest_k, np.median(largest_k)), SMALLEST_THRESHOLD_K)


def _few_runs_factor(inputs: Inputs, rows: BoolArray) -> float:
    """Return by how much limits are widened because another run may differ more than few runs do among themselves.

    The parts of a single run are all there is to go by, and count as they are.
    """
    runs = len(np.unique(inputs.run[rows]))
    return few_folds_factor(max(runs, FEWEST_RUNS)) if runs > 1 else 1.0


def _scaling(features: FloatArray, rows: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean of every column, and what makes its spread 1, or 0 where it does not move."""
    centre = features.mean(axis=0, where=rows[:, None])
    square = np.zeros_like(centre)
    for part in _parts(rows):
        square += np.square(features[part] - centre).sum(axis=0)
    spread = np.sqrt(square / max(int(rows.sum()), 1))
    moves = spread > 1e-6
    return centre, np.where(moves, 1.0 / np.where(moves, spread, 1.0), 0.0)


def _parts(rows: BoolArray) -> list[IntArray]:
    """Return the rows in parts: with hundreds of sensors a table of all their lags is tens of megabytes."""
    used = np.flatnonzero(rows)
    return [used[first : first + ROWS_AT_A_TIME] for first in range(0, len(used), ROWS_AT_A_TIME)]


def _precisions(
    features: FloatArray, rows: BoolArray, centre: FloatArray, gain: FloatArray, penalties: Sequence[float]
) -> Iterator[FloatArray]:
    """Yield the precision of the scaled columns for each damping, one at a time: each is large."""
    covariance = np.zeros((len(centre), len(centre)))
    for part in _parts(rows):
        scaled = (features[part] - centre) * gain
        covariance += scaled.T @ scaled
    covariance /= max(int(rows.sum()), 1)
    diagonal = np.diag_indices_from(covariance)
    variance = covariance[diagonal]
    for penalty in penalties:
        covariance[diagonal] = variance + penalty
        yield inverse_of(np.linalg.cholesky(covariance))


def _left_out_departures_k(inputs: Inputs, layout: Layout, rows: BoolArray, fold: IntArray) -> list[FloatArray]:
    """Return the largest departure of every sensor on folds that were left out [K], one table per penalty."""
    largest = [np.zeros(layout.sensors) for _ in PENALTIES]
    features = inputs.features[:, : layout.columns]
    numbers = fold_numbers(rows, fold)
    smooth = _against_own_mean(inputs, features)
    for number in numbers:
        rest = rows & (fold != number) if len(numbers) > 1 else rows
        centre, gain = _scaling(features, rest)
        judged = smooth[rows & (fold == number)] * gain
        for index, precision in enumerate(_precisions(features, rest, centre, gain, PENALTIES)):
            maps, _ = departure_maps(layout, precision, gain)
            largest[index] = np.maximum(largest[index], np.abs(judged @ maps.T).max(axis=0))
    return largest


def _against_own_mean(inputs: Inputs, features: FloatArray) -> FloatArray:
    found = np.empty_like(features)
    for run in np.unique(inputs.run):
        rows = np.flatnonzero(inputs.run == run)
        for first in range(0, features.shape[1], COLUMNS_AT_A_TIME):
            columns = slice(first, first + COLUMNS_AT_A_TIME)
            fast = smoothed(inputs.time_min[rows], features[rows, columns], FAST_MIN)
            found[rows, columns] = fast - smoothed(inputs.time_min[rows], fast, SLOW_MIN)
    return found


def smoothed(time_min: FloatArray, values: FloatArray, constant_min: float) -> FloatArray:
    """Return the exponentially weighted mean of each column, which begins at its first value."""
    found = np.empty_like(values)
    if not len(values):
        return found
    found[0] = values[0]
    decay = np.exp(-np.diff(time_min) / constant_min)
    for row in range(1, len(values)):
        found[row] = values[row] + decay[row - 1] * (found[row - 1] - values[row])
    return found


def _largest_slew(inputs: Inputs, rows: BoolArray) -> FloatArray:
    """Return the largest change per minute of each sensor between neighbouring training rows [K/min]."""
    used = np.flatnonzero(rows)
    follows = (np.diff(inputs.run[used]) == 0) & (np.diff(inputs.time_min[used]) <= 1.5 * inputs.period_min)
    slew = np.abs(np.diff(inputs.degc[used], axis=0)) / np.maximum(np.diff(inputs.time_min[used]), 1e-9)[:, None]
    return np.asarray(slew[follows].max(axis=0, initial=0.0))


def _flat_min(longest_min: FloatArray, period_min: float) -> FloatArray:
    """Return how long each sensor may keep its value, from the longest time for which it did in training [min].

    A sensor with enough noise never to repeat itself needs less patience than one that counts in steps.
    """
    patient = np.maximum(FLAT_MIN, FLAT_FACTOR * longest_min)
    return np.where(longest_min > 0.0, patient, max(RESTLESS_FLAT_MIN, FEWEST_FLAT_ROWS * period_min))


def _longest_flat_min(inputs: Inputs, rows: BoolArray) -> FloatArray:
    """Return the longest time for which each sensor kept its value in training [min]."""
    used = np.flatnonzero(rows)
    longest, since = np.zeros(inputs.layout.sensors), inputs.time_min[used[0]] * np.ones(inputs.layout.sensors)
    for before, now in pairwise(used):
        same = np.abs(inputs.degc[now] - inputs.degc[before]) <= SAME_K
        same &= bool(inputs.run[now] == inputs.run[before])
        since = np.where(same, since, inputs.time_min[now])
        longest = np.maximum(longest, inputs.time_min[now] - since)
    return longest
