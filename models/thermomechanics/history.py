"""Temperatures of the recent past: one-minute means now and some minutes ago, as 5-1 needs them."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from models.records import FloatArray

MEAN_S = 60.0
"""The input is averaged over this time, as the input of the fit was [s]."""


class TemperatureHistory:
    """A sliding window of temperatures."""

    def __init__(self, intervals_min: Sequence[float]) -> None:
        """Keep as much as the longest interval [min] needs."""
        self.intervals_min = tuple(intervals_min)
        self._kept_s = 60.0 * max(self.intervals_min, default=0.0) + 2.0 * MEAN_S
        self._rows: deque[tuple[float, FloatArray]] = deque()

    def add(self, time_s: float, degc: FloatArray) -> None:
        """Add temperatures [degC], NaN where unknown, shape (m,), at a time [s]; one that is not later is ignored."""
        if self._rows and time_s <= self._rows[-1][0]:
            return
        self._rows.append((time_s, degc))
        while self._rows[0][0] < time_s - self._kept_s:
            self._rows.popleft()

    def mean_degc(self, ago_min: float = 0.0) -> FloatArray | None:
        """Return the means over the minute that ended some minutes ago [degC], NaN where a signal had no value.

        None where no temperatures of that minute are kept.
        """
        if not self._rows:
            return None
        end_s = self._rows[-1][0] - 60.0 * ago_min
        rows = [degc for time_s, degc in self._rows if end_s - MEAN_S < time_s <= end_s + 1e-6]
        if not rows:
            return None
        table = np.array(rows)
        known = np.isfinite(table)
        count = known.sum(axis=0)
        total = np.where(known, table, 0.0).sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def covered_min(self) -> float:
        """Time between the oldest and the newest kept temperatures [min]."""
        return (self._rows[-1][0] - self._rows[0][0]) / 60.0 if self._rows else 0.0
