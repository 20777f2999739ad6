"""Limits of healthy temperature sensors from training, and a prediction of each from all others.

With P the inverse of the damped covariance of all columns, sensor s departs from its prediction by
``(P[S, S]^-1 P[S, :] x)[0]``, S its own columns: no regression per sensor is needed. Leaving a suspect
out is a block elimination in P.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from models.model_file import ModelError, Numbers, Packed
from models.records import FloatArray
from models.thermal.features import IntArray, Layout

WATCH_LAGS_MIN = (10.0, 90.0)
"""Lags of temperatures and of spindle speed from which sensors are predicted [min]."""
FAST_MIN = 10.0
"""Departures are smoothed over this time [min] ..."""
SLOW_MIN = 240.0
"""... and count against their own mean over this time [min]: what a machine does slowly is no fault."""
THRESHOLD_FACTOR = 2.0
"""Limits are this many times the largest value on stretches that were left out in training."""
SLEW_MARGIN_K_PER_MIN = 0.3
"""Added to twice the largest slew of training [K/min]."""
FLAT_MIN = 15.0
"""A value that stays identical for so long [min] is stuck, unless training saw longer."""
FLAT_FACTOR = 1.5
"""... and then this many times the longest that training saw."""
SAME_K = 1e-6
"""Values closer than this are identical [K]."""

AT_ONCE = 32
"""So many sensors are predicted at once: with hundreds the whole precision would stand there several times over."""

Precision = npt.NDArray[np.floating[Any]]
Rows = Callable[[IntArray], FloatArray]
"""From indices of rows, shape (n,), to these rows, shape (n, d)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorWatch:
    """What healthy sensors look like, fitted in training."""

    layout: Layout
    centre: Numbers
    """Mean of each column in training, shape (d,)."""
    gain: Numbers
    """1 / standard deviation of each column, 0 where it does not move, shape (d,)."""
    precision: Packed
    """Inverse of the damped covariance of the scaled columns, shape (d, d)."""
    threshold_k: Numbers
    """Largest departure of a healthy sensor [K], shape (n_sensors,)."""
    slew_k_per_min: Numbers
    """Largest slew of a healthy sensor [K/min], shape (n_sensors,)."""
    flat_min: Numbers
    """Longest time for which a healthy sensor stays identical [min], shape (n_sensors,)."""
    speed_scale_rpm: float
    """Speed that stands for 1 in the columns [1/min]."""

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises ModelError."""
        sensors, columns = self.layout.sensors, self.layout.columns
        shapes: dict[str, tuple[int, ...]] = {
            "centre": (columns,),
            "gain": (columns,),
            "precision": (columns, columns),
            "threshold_k": (sensors,),
            "slew_k_per_min": (sensors,),
            "flat_min": (sensors,),
        }
        for key, shape in shapes.items():
            array = getattr(self, key)
            if array.shape != shape or not np.isfinite(array).all():
                raise ModelError(f"watch.{key}", f"has shape {array.shape}; {shape} of finite numbers is needed")
            if key in ("threshold_k", "slew_k_per_min", "flat_min") and np.any(array <= 0.0):
                raise ModelError(f"watch.{key}", "a limit is positive")
            array.flags.writeable = False
        if not 0.0 < self.speed_scale_rpm < np.inf:
            raise ModelError("watch.speed_scale_rpm", f"{self.speed_scale_rpm} must be positive and finite")


def without_columns(precision: Precision, columns: Sequence[int]) -> Rows:
    """Return what gives rows of the precision of all other columns; zero in those columns, and never asked for them."""
    out = np.asarray(columns, dtype=np.intp)
    inside = precision[np.ix_(out, out)].astype(np.float64)
    eliminated = np.linalg.solve(inside, precision[out]) if len(out) else np.zeros((0, len(precision)))

    def rows(wanted: IntArray) -> FloatArray:
        found = precision[wanted].astype(np.float64)
        if len(out):
            found -= precision[np.ix_(wanted, out)] @ eliminated
            found[:, out] = 0.0
        return found

    return rows


def departure_maps(
    layout: Layout, precision: Precision, gain: FloatArray, skip: Sequence[int] = (), *, lags: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Return what turns scaled columns into the departure of every sensor from its prediction by those that count.

    Result: maps [K], shape (n_sensors, d), zeros for sensors that do not count, and the standard deviation that the
    model itself expects [K], shape (n_sensors,).

    `layout`, `precision` and `gain`: see `SensorWatch`. `skip`: sensors that do not count. `lags`: whether lags do.
    """
    sensors = [s for s in range(layout.sensors) if s not in skip and gain[s] > 0.0]
    maps, expected = np.zeros((layout.sensors, layout.columns)), np.zeros(layout.sensors)
    unused = set(layout.of_sensors(skip).tolist()) | set(() if lags else range(layout.sensors, layout.columns))
    rows = without_columns(precision, sorted(unused))
    for first in range(0, len(sensors), AT_ONCE):
        some = sensors[first : first + AT_ONCE]
        own = np.stack([layout.of_sensors([s])[: None if lags else 1] for s in some])
        of_own = rows(own.ravel()).reshape(*own.shape, layout.columns)
        blocks = np.linalg.inv(np.take_along_axis(of_own, own[:, None, :], axis=2))
        maps[some] = np.einsum("sj,sjd->sd", blocks[:, 0], of_own) / gain[some, None]
        expected[some] = np.sqrt(blocks[:, 0, 0]) / gain[some]
    return maps, expected
