"""Chooses which rows are left out together: whole spindle cycles, whole runs or whole blocks, never single rows."""

from itertools import pairwise

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.inputs import Inputs

STANDSTILL_SHARE = 0.002
"""The spindle stands still below this share of its highest speed ..."""
STANDSTILL_RPM = 1.0
"""... or below this speed [1/min]."""
FEWEST_CYCLES = 3
"""With fewer cycles blocks are left out."""
MOST_FOLDS = 12
"""With more cycles neighbours are left out together: then they are tool changes rather than warm-up cycles, of which
those before and after tell most."""
BLOCKS = 5
"""What has neither cycles nor several runs is cut into so many blocks."""
SHORTEST_FOLD_ROWS = 5
"""A shorter stretch says nothing about a model."""
NORMAL_90 = 1.282
"""90 % point of the normal distribution."""


def spindle_starts(speed_rpm: FloatArray) -> IntArray:
    """Return the rows in which the spindle starts out of standstill; row 0 where it turns there already."""
    speed = np.abs(speed_rpm)
    on = speed > max(STANDSTILL_RPM, STANDSTILL_SHARE * float(speed.max(initial=0.0)))
    return np.flatnonzero(on & ~np.concatenate([[False], on[:-1]]))


def cycles(inputs: Inputs, rows: BoolArray) -> list[BoolArray]:
    """Return the spindle cycles within some rows: each from one start out of standstill to the next.

    Result: masks of shape (n,), in order. Rows before the first start belong to none. Raises DatasetError when the
    spindle speed was not recorded.

    `inputs`: the recordings. `rows`, shape (n,): rows that are looked at.
    """
    if inputs.speed_rpm is None:
        raise DatasetError(
            f"{inputs.recording_names[0]}: cycles begin where the spindle starts, so they need a speed column; "
            "name it in the map, or choose hours for training and test"
        )
    found = []
    for recording in range(len(inputs.recording_names)):
        chosen = np.flatnonzero(rows & (inputs.recording == recording))
        starts = spindle_starts(inputs.speed_rpm[chosen])
        for first, stop in pairwise([*starts.tolist(), len(chosen)]):
            mask = np.zeros(inputs.rows, dtype=np.bool_)
            mask[chosen[first:stop]] = True
            found.append(mask)
    return found


def inner_folds(inputs: Inputs, rows: BoolArray, fewest_runs: int = FEWEST_CYCLES) -> tuple[IntArray, str]:
    """Return what is left out in turn when something is to be chosen on some rows.

    Runs are left out one by one where there are enough; else spindle cycles; else blocks of equal length.

    Result: number of the fold of every row, shape (n,), -1 for a row that is never left out, and what the folds are:
    `run`, `cycle` or `block`.

    `rows`, shape (n,): training rows; nothing else is looked at. `fewest_runs`: with fewer runs than this they are not
    left out one by one.
    """
    fold = np.full(inputs.rows, -1, dtype=np.intp)
    runs = [run for run in np.unique(inputs.run[rows]) if (rows & (inputs.run == run)).sum() >= SHORTEST_FOLD_ROWS]
    if len(runs) >= fewest_runs:
        for number, group in enumerate(np.array_split(np.array(runs), min(len(runs), MOST_FOLDS))):
            fold[rows & np.isin(inputs.run, group)] = number
        return fold, "run"
    if inputs.speed_rpm is not None:
        found = [mask for mask in cycles(inputs, rows) if mask.sum() >= SHORTEST_FOLD_ROWS]
        if len(found) >= FEWEST_CYCLES:
            for number, group in enumerate(np.array_split(np.arange(len(found)), min(len(found), MOST_FOLDS))):
                for index in group:
                    fold[found[index]] = number
            return fold, "cycle"
    for number, block in enumerate(np.array_split(np.flatnonzero(rows), BLOCKS)):
        fold[block] = number
    return fold, "block"


def fold_segments(inputs: Inputs, rows: BoolArray) -> list[IntArray]:
    """Return the rows of a mask as stretches within one run and without a hole, for referencing each.

    Rows between in which no displacement was measured are no hole: a probe measures now and then.
    """
    chosen = np.flatnonzero(rows)
    place = np.cumsum(rows | np.isfinite(inputs.measured_um).any(axis=1))[chosen]
    breaks = np.flatnonzero((np.diff(place) > 1) | (np.diff(inputs.run[chosen]) != 0)) + 1
    return [part for part in np.split(chosen, breaks) if len(part)]


def with_unmeasured(inputs: Inputs, rows: BoolArray, fold: IntArray) -> tuple[BoolArray, IntArray]:
    """Return some rows with those between two of them in which only displacements are missing, and their folds.

    What is learned of temperatures alone needs the rows between two probes as well.

    `inputs`: the recordings. `rows`, shape (n,): training rows. `fold`, shape (n,): their folds; a row between takes
    that of the row before it.
    """
    found, folds = rows.copy(), fold.copy()
    known = ~inputs.long_missing.any(axis=1) & ~inputs.speed_missing & ~np.isfinite(inputs.measured_um).all(axis=1)
    for part in fold_segments(inputs, rows):
        between = np.arange(part[0], part[-1] + 1)
        before = part[np.searchsorted(part, between, side="right") - 1]
        found[between] |= known[between]
        folds[between] = fold[before]
    return found, folds


def few_folds_factor(folds: int) -> float:
    """Return by how much a limit is widened because it comes from few folds.

    The largest of K folds' quantiles holds on another fold with probability K / (K + 1) only. Below
    nine folds it is widened by the ratio of the 90 % points of Student's distribution with K - 1
    degrees of freedom and of the normal distribution.

    `folds`: K, at least 2.
    """
    table = {2: 3.078, 3: 1.886, 4: 1.638, 5: 1.533, 6: 1.476, 7: 1.440, 8: 1.415}
    return table.get(folds, NORMAL_90) / NORMAL_90
