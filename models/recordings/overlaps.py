"""Finds rows that two recordings share: a logger's files overlap where each was exported with the hours before it."""

from collections.abc import Sequence

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray

FEWEST_SHARED = 10
"""So many different rows that follow each other alike in two recordings are the same rows."""


def without_overlaps(recordings: Sequence[Recording]) -> tuple[list[Recording], tuple[str, ...]]:
    """Return recordings without rows at their beginning with which another one ends, and a warning about each.

    Rows that stand in two recordings would be tested on what was trained on them.

    Raises DatasetError where nothing else is in a recording.
    """
    tables = [np.column_stack([one.temperatures_degc, one.displacements_um]) for one in recordings]
    found, warnings = list(recordings), []
    for second, recording in enumerate(recordings):
        for first, other in enumerate(recordings):
            if first == second or (shared := _shared_rows(tables[first], tables[second])) == 0:
                continue
            if shared == recording.rows:
                raise DatasetError(
                    f"{recording.name}: all its rows are in {other.name} too; give each run once, or the model is "
                    "tested on what it was trained on"
                )
            found[second] = recording.part(shared, recording.rows)
            warnings.append(
                f"{recording.name}: its first {shared} rows are the last ones of {other.name}, and count once: the two "
                "recordings overlap"
            )
    return found, tuple(warnings)


def _shared_rows(first: FloatArray, second: FloatArray) -> int:
    """Return how many rows at the beginning of the second table are the last ones of the first, or all in it."""
    if first.shape[1] != second.shape[1] or not len(second):
        return 0
    same = (first == second[0]) | (np.isnan(first) & np.isnan(second[0]))
    for row in np.flatnonzero(same.all(axis=1)):
        count = min(len(first) - int(row), len(second))
        part = second[:count]
        if np.array_equal(first[row : row + count], part, equal_nan=True) and len(np.unique(part, axis=0)) >= (
            FEWEST_SHARED
        ):
            return count
    return 0
