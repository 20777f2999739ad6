"""What slopes add to estimate and compensation where an axis stood when something was measured on it."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema import Configuration
from drivers.guard.sloped_axes import SlopedAxis, added_um, place_of, sloped_axes
from models.records import CncSample, FloatArray

STOOD_MM = 1.0
"""An axis that has moved by more between the polls around a value was on its way, and the value says nothing [mm]."""
KEPT = 600
"""Polls that are kept: loggers' rows come later than they were measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class There:
    """What a slope adds where its axis stood."""

    place: int
    """Values of one place count from one zero."""
    estimated_um: float
    applied_um: float


class SlopedSkill:
    """Knows where axes with a slope stood; owned by the control task. `say` tells a person, once per cause."""

    def __init__(self, configuration: Configuration, axes: Sequence[str], say: Callable[[str], None]) -> None:
        self._sloped = sloped_axes(configuration)
        self._place = {name: axes.index(one.slope) for name, one in self._sloped.items()}
        self._stale_after_s = configuration.cnc.stale_after_s
        self._say = say
        self._told: set[str] = set()
        self._utc_s: list[float] = []
        self._mm: dict[str, list[float]] = {name: [] for name in self._sloped}

    def take(self, sample: CncSample) -> None:
        """Take where the axes stood at a poll; a clock that was set back begins anew."""
        if self._utc_s and sample.time.utc_s < self._utc_s[-1]:
            for kept in (self._utc_s, *self._mm.values()):
                kept.clear()
        self._utc_s.append(sample.time.utc_s)
        for name, known in self._mm.items():
            known.append(sample.positions_mm.get(self._sloped[name].position or "", np.nan))
            del known[:-KEPT]
        del self._utc_s[:-KEPT]

    def there(self, axis: str, utc_s: float, estimated_um: FloatArray, applied_um: FloatArray) -> There | None:
        """Return what the slope of an axis adds at a time [um], None where nobody knows."""
        if (one := self._sloped.get(axis)) is None:
            return There(place=0, estimated_um=0.0, applied_um=0.0)
        per_m = float(np.nan_to_num(estimated_um[self._place[axis]]))
        applied_per_m = float(applied_um[self._place[axis]])
        mm, moved = self._stood_mm(axis, utc_s)
        along_m = float(one.along_m(mm))
        found = There(
            place=place_of(mm),
            estimated_um=float(added_um(per_m, along_m)),
            applied_um=float(added_um(applied_per_m, along_m if one.follows else np.nan)),
        )
        if np.isfinite([found.estimated_um, found.applied_um]).all() and not moved:
            return found
        if not moved and np.isfinite(applied_per_m):
            self._tell(one, one.why_unknown(applied_per_m))
        return None

    def _stood_mm(self, axis: str, utc_s: float) -> tuple[float, bool]:
        """Return where an axis stood [mm], NaN where nobody says, and whether it was on its way, or was not polled."""
        after = bisect_right(self._utc_s, utc_s)
        near = self._mm[axis][max(after - 2, 0) : after + 1]
        if after == 0 or len(near) < 2 or utc_s - self._utc_s[after - 1] > self._stale_after_s:
            return np.nan, True
        if not np.isfinite(near).all():
            return np.nan, False
        return near[-1], max(near) - min(near) > STOOD_MM

    def _tell(self, one: SlopedAxis, why: str) -> None:
        if why not in self._told:
            self._told.add(why)
            self._say(f"what is measured on axis {one.axis} is not judged: {why}")
