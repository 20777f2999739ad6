"""Thermal distortion in the words of ISO 230-3: by the rotating spindle, and by the environment.

A rotation runs from the last row at standstill, its reference, to the last row before the spindle stops.
Distortion is the range (largest minus smallest value) that a displacement covers, raw as it was measured.
"""

import math
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

FIRST_MIN = 60.0
"""ISO 230-3 states the distortion in the first 60 min and in the whole period."""
TURNING_RPM = 0.5
"""Slower is standstill [1/min]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Rows of a recording, from the reference on."""

    first: int
    stop: int
    """Exclusive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Distortion:
    """What one displacement does during a rotation."""

    first_60_min_um: float
    """Range in the first 60 min, or in as much as there is [um]; NaN where it was measured less than twice."""
    whole_um: float
    """Range in the whole period [um]."""
    end_um: float
    """Displacement at the end of the period since its beginning [um]."""


def rotations(speed_rpm: FloatArray) -> list[Stretch]:
    """Return every rotation of the spindle.

    Result: each with its reference as first row; a recording that begins in rotation has its first row as reference.

    `speed_rpm`, shape (n,): spindle speed [1/min]; unknown (NaN) repeats the state before, at the beginning standstill.
    """
    turning = _turning(speed_rpm)
    starts = np.flatnonzero(turning & ~np.r_[False, turning[:-1]])
    stops = np.flatnonzero(turning & ~np.r_[turning[1:], False]) + 1
    return [Stretch(first=max(int(a) - 1, 0), stop=int(b)) for a, b in zip(starts, stops, strict=True)]


def settled_stretches(time_min: FloatArray, speed_rpm: FloatArray | None, settled_min: float) -> list[Stretch]:
    """Return the stretches in which nothing but the environment moves the machine.

    Result: of at least two rows.

    `time_min`, shape (n,): time [min]. `speed_rpm`, shape (n,) or None: spindle speed [1/min]; None: the spindle stood
    all the time. `settled_min`: time after a rotation that does not count yet [min]. A recording that begins at
    standstill is taken as settled at its beginning.
    """
    if speed_rpm is None:
        return [Stretch(first=0, stop=len(time_min))] if len(time_min) > 1 else []
    turning = _turning(speed_rpm)
    last_turning = np.where(turning, time_min, -np.inf)
    settled = ~turning & (time_min - np.maximum.accumulate(last_turning) >= settled_min)
    starts = np.flatnonzero(settled & ~np.r_[False, settled[:-1]])
    stops = np.flatnonzero(settled & ~np.r_[settled[1:], False]) + 1
    return [Stretch(first=int(a), stop=int(b)) for a, b in zip(starts, stops, strict=True) if b - a > 1]


def _turning(speed_rpm: FloatArray) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    state = np.zeros(len(speed_rpm), dtype=np.bool_)
    now = False
    for row, speed in enumerate(speed_rpm.tolist()):
        if not math.isnan(speed):
            now = abs(speed) > TURNING_RPM
        state[row] = now
    return state


def value_range_um(values_um: FloatArray) -> float:
    """Return largest minus smallest value of a series [um], shape (n,); NaN of fewer than two known values."""
    known = values_um[np.isfinite(values_um)]
    return float(known.max() - known.min()) if len(known) > 1 else float("nan")


def distortion(time_min: FloatArray, error_um: FloatArray) -> Distortion:
    """Return the distortion of one displacement during a rotation.

    Result: ranges and the last value since the first.

    `time_min`, shape (n,): time of the rotation's rows [min]; the first is the reference. `error_um`, shape (n,):
    displacement [um], NaN where it was not measured.
    """
    early = time_min - time_min[0] <= FIRST_MIN + 1e-6
    known = error_um[np.isfinite(error_um)]
    return Distortion(
        first_60_min_um=value_range_um(error_um[early]),
        whole_um=value_range_um(error_um),
        end_um=float(known[-1] - known[0]) if len(known) > 1 else float("nan"),
    )


def stable_after_min(time_min: FloatArray, error_um: FloatArray, *, ahead_min: float, tolerance_um: float) -> float:
    """Return the time after which a displacement drifts less than a tolerance over the next minutes.

    Result: time since the first row [min] from which on every later change over `ahead_min` stays within the tolerance;
    NaN when the last one does not, the period is shorter than `ahead_min`, or it was measured more rarely than that.

    `time_min`, shape (n,): time [min], increasing; the first row is the start. `error_um`, shape (n,): displacement
    [um], NaN where it was not measured. `ahead_min`: how far is looked ahead [min]. `tolerance_um`: largest change
    within that time [um].
    """
    known = np.isfinite(error_um)
    time_min, error_um = time_min[known], error_um[known]
    if len(time_min) < 2 or time_min[-1] - time_min[0] < ahead_min or np.median(np.diff(time_min)) > ahead_min:
        return float("nan")
    starts = time_min[time_min <= time_min[-1] - ahead_min + 1e-9]
    change = np.interp(starts + ahead_min, time_min, error_um) - error_um[: len(starts)]
    moving = np.flatnonzero(np.abs(change) > tolerance_um)
    if not len(moving):
        return 0.0
    after = int(moving[-1]) + 1
    return float(starts[after] - time_min[0]) if after < len(starts) else float("nan")
