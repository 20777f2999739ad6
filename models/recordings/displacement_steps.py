"""Finds where a displacement steps though nothing warms so fast: set to zero, knocked, or a probe's value repeated."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

JUMP_UM = 10.0
"""A jump is at least so large [um], ..."""
JUMP_TIMES = 12.0
"""... and so many times what nine of ten steps stay below, ..."""
LASTS = 0.7
"""... of which this share is left ..."""
LASTING_ROWS = 5
"""... in the median of so many rows after it, against as many before."""
MOST_JUMPS = 3
"""A displacement with more jumps is something else: an axis that goes to and fro, say."""
LONGEST_STEP_S = 60.0
"""Rows that lie farther apart, and than usual, tell no jump [s]."""
REPEATED_S = 300.0
"""A value that is repeated for so long as a rule [s] ..."""
REPEATED_SHARE = 0.2
"""... in all rows but this share, ..."""
FEWEST_STEPS = 5
RESOLUTIONS = 3.0
"""... and then steps by so many times the smallest difference, is that of a probe; coarse sensors step by one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Jump:
    """A displacement goes on from somewhere else."""

    row: int
    """First row after it, from 0."""
    by_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Repetition:
    """A displacement is written again and again until the next one is measured."""

    row: int
    """The first that says the same as the one before, from 0."""
    for_s: float
    """As a rule [s]."""
    step_um: float
    """As a rule [um]."""


def largest_jump(time_s: FloatArray, displacement_um: FloatArray, speed_rpm: FloatArray | None) -> Jump | None:
    """Return the largest jump of a displacement, None where there is none or more than a few.

    `time_s`, shape (n,): increasing times [s]. `displacement_um`, shape (n,): displacement [um], NaN where missing.
    `speed_rpm`, shape (n,) or None: spindle speed [1/min]; where it changes the spindle itself may jump.
    """
    rows = np.flatnonzero(np.isfinite(displacement_um))
    if len(rows) < 4 * LASTING_ROWS:
        return None
    values, step_s = displacement_um[rows], np.diff(time_s[rows])
    variation_um = np.diff(values)
    usual_um = float(np.quantile(np.abs(variation_um), 0.9))
    large = np.abs(variation_um) > max(JUMP_UM, JUMP_TIMES * usual_um)
    large &= step_s <= max(LONGEST_STEP_S, 1.5 * float(np.median(step_s)))
    found = []
    for at in np.flatnonzero(large).tolist():
        before, after = values[max(at + 1 - LASTING_ROWS, 0) : at + 1], values[at + 1 : at + 1 + LASTING_ROWS]
        by_um = float(np.median(after) - np.median(before))
        lasts = len(after) == LASTING_ROWS and by_um * np.sign(variation_um[at]) > LASTS * abs(variation_um[at])
        if lasts and not _switched(speed_rpm, int(rows[at]), int(rows[at + 1])):
            found.append(Jump(row=int(rows[at + 1]), by_um=float(variation_um[at])))
    return max(found, key=lambda jump: abs(jump.by_um)) if 0 < len(found) <= MOST_JUMPS else None


def _switched(speed_rpm: FloatArray | None, first: int, last: int) -> bool:
    """Return whether the spindle changed its speed about these rows."""
    if speed_rpm is None:
        return False
    about = speed_rpm[max(first - 2, 0) : last + 3]
    known = about[np.isfinite(about)]
    return bool(len(known) and np.ptp(known) > 0.01 * np.abs(known).max())


def repetition(time_s: FloatArray, displacement_um: FloatArray) -> Repetition | None:
    """Return how a displacement repeats the last value that was measured, None where it does not.

    `time_s`, shape (n,): increasing times [s]. `displacement_um`, shape (n,): displacement [um], NaN where missing.
    """
    rows = np.flatnonzero(np.isfinite(displacement_um))
    steps_um = np.diff(displacement_um[rows])
    at = np.flatnonzero(steps_um)
    if len(at) < FEWEST_STEPS or len(at) > REPEATED_SHARE * len(steps_um):
        return None
    for_s = float(np.median(np.diff(time_s[rows[at + 1]])))
    step_um = float(np.median(np.abs(steps_um[at])))
    smallest_um = float(np.diff(np.unique(displacement_um[rows])).min())
    if for_s < REPEATED_S or step_um < RESOLUTIONS * smallest_um:
        return None
    return Repetition(row=int(rows[np.flatnonzero(steps_um == 0.0)[0] + 1]), for_s=for_s, step_um=step_um)
