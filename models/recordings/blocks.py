"""Runs and blocks of the rows of a recording."""

import itertools

import numpy as np
import numpy.typing as npt

from models.records import FloatArray


def block_means(time_s: FloatArray, values: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Return means over blocks of time, for down-sampling recordings to one minute.

    Block k covers ``k * period_s <= time_s < (k + 1) * period_s``. Blocks without any row do not
    appear in the result, so that gaps stay gaps.

    Result: start of each block [s], shape (n_blocks,), and the means, shape (n_blocks, ...); NaN where a block holds no
    value of a column. Raises ValueError when the period is not positive, the lengths differ or the times do not
    increase.

    `time_s`, shape (n,): times [s], increasing. `values`, shape (n,) or (n, n_columns): NaN where a value is missing;
    it is left out of its block's mean. `period_s`: length of a block [s].
    """
    if not period_s > 0:
        raise ValueError(f"period_s must be positive, got {period_s}")
    if time_s.ndim != 1 or len(values) != len(time_s):
        raise ValueError(f"{len(values)} rows of values need as many times, got shape {time_s.shape}")
    if len(time_s) == 0:
        return time_s.copy(), values.copy()
    if np.any(np.diff(time_s) <= 0):
        raise ValueError(f"times do not increase at row {int(np.argmax(np.diff(time_s) <= 0)) + 2}")
    block = np.floor(time_s / period_s)
    starts = np.flatnonzero(np.diff(block, prepend=-np.inf))
    table = values.reshape(len(values), -1)
    known = np.isfinite(table)
    count = np.add.reduceat(known.astype(np.int64), starts, axis=0)
    total = np.add.reduceat(np.where(known, table, 0.0), starts, axis=0)
    means = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return block[starts] * period_s, means.reshape(len(starts), *values.shape[1:])


def contiguous_runs(time_s: FloatArray, period_s: float) -> list[tuple[int, int]]:
    """Return the (first, past-the-last) row of each stretch without a gap.

    Result: stretches in order; together they hold every row.

    `time_s`, shape (n,): increasing times [s]. `period_s`: nominal time between rows [s]; a step over one and a half of
    it is a gap.
    """
    if len(time_s) == 0:
        return []
    breaks: npt.NDArray[np.intp] = np.flatnonzero(np.diff(time_s) > 1.5 * period_s) + 1
    bounds = [0, *breaks.tolist(), len(time_s)]
    return list(itertools.pairwise(bounds))
