"""Temperatures of the recent past: one-minute means now and some minutes ago, as 5-1 needs them."""

from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

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
        # of readings a minute or more apart one may come just after its moment
        rows = rows or [degc for time_s, degc in self._rows if end_s < time_s <= end_s + MEAN_S / 2.0]
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


class SignalMeans:
    """Means of labelled sensors that do not jump when a sensor leaves.

    A mean is always one over all sensors of the label that have ever had a value: one that has none now is imputed,
    from its last value on, by the mean change of those that have one. One that returns counts as it reads.
    """

    def __init__(self, places: Sequence[Sequence[int] | npt.NDArray[np.intp]]) -> None:
        """Keep the indices of each label's sensors in the machine's order."""
        self._places = [np.asarray(each, dtype=np.intp) for each in places]
        self._counted = [np.full(len(each), np.nan) for each in self._places]

    def unheard(self) -> list[int]:
        """Return how many sensors of each label have never had a value; without them a mean has another level."""
        return [int(np.isnan(counted).sum()) for counted in self._counted]

    def renew(self, degc: FloatArray) -> FloatArray:
        """Return the mean of each label at a reading of all sensors [degC], shape (labels,).

        Result: shape (labels,) [degC]; NaN where no sensor of a label has a value.

        `degc`: one value for each sensor of the machine [degC], NaN where there is none.
        """
        means = np.full(len(self._places), np.nan)
        for label, places in enumerate(self._places):
            now, before = degc[places], self._counted[label]
            read = np.isfinite(now)
            if not read.any():
                continue
            both = read & np.isfinite(before)
            change_k = float(np.mean(now[both] - before[both])) if both.any() else 0.0
            counted = np.where(read, now, before + change_k)
            self._counted[label] = counted
            means[label] = float(np.mean(counted[np.isfinite(counted)]))
        return means
