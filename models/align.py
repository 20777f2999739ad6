"""Means over time: of the running daemon's input, and of recordings."""

import math

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

SPARE_ROWS = 32
"""So many vectors have room before any is moved."""


class RollingMean:
    """Mean of each sensor over the last `window_s` seconds, missing values left out.

    The on-line input of a model is filtered as its training input was (one-minute means). Vectors
    may arrive slightly out of order, because lines that overlap complete in another order than
    they begin; one of before the window, as of a logger that writes its rows minutes late, is left out.

    Raises ValueError when the window is not positive.

    `window_s`: length of the window [s].
    """

    def __init__(self, window_s: float) -> None:
        if not window_s > 0:
            raise ValueError(f"window_s must be positive, got {window_s}")
        self.window_s = window_s
        self._times_s: list[float] = []
        self._rows: FloatArray = np.empty((0, 0))
        """The vectors, the oldest at `_first`; there is room for more behind the newest."""
        self._first = 0
        self._newest_s = -np.inf

    def add(self, time_s: float, values: FloatArray) -> None:
        """Take one vector into the mean.

        Raises ValueError when the time is not finite or the number of sensors changes.

        `time_s`: its time [s]. `values`, shape (n_sensors,): NaN where a sensor has no value.
        """
        if not math.isfinite(time_s):
            raise ValueError(f"time_s must be finite, got {time_s}")
        if self._times_s and values.shape != self._rows.shape[1:]:
            raise ValueError(f"{values.shape} sensors where {self._rows.shape[1:]} were before")
        if time_s <= self._newest_s - self.window_s:
            return
        self._newest_s = max(self._newest_s, time_s)
        self._forget(self._newest_s - self.window_s)
        if self._first + len(self._times_s) >= len(self._rows):
            self._make_room(values)
        self._rows[self._first + len(self._times_s)] = values
        self._times_s.append(time_s)

    def leave_out(self, sensors: npt.NDArray[np.bool_]) -> None:
        """Leave out what is in the mean of some sensors until now; `sensors`, shape (n_sensors,): which."""
        if self._times_s:
            self._rows[self._first : self._first + len(self._times_s), sensors] = np.nan

    def _forget(self, oldest_s: float) -> None:
        """Let go of what has left the window."""
        gone = 0
        while gone < len(self._times_s) and self._times_s[gone] <= oldest_s:
            gone += 1
        self._first += gone
        del self._times_s[:gone]
        if self._times_s and min(self._times_s) <= oldest_s:  # one that came late
            kept = [index for index, time_s in enumerate(self._times_s) if time_s > oldest_s]
            self._rows = self._rows[self._first :][kept]
            self._first, self._times_s = 0, [self._times_s[index] for index in kept]

    def _make_room(self, values: FloatArray) -> None:
        """Move the rows to the front of an array that holds twice as many."""
        count = len(self._times_s)
        rows = np.empty((max(SPARE_ROWS, 2 * count), len(values)))
        if count:
            rows[:count] = self._rows[self._first : self._first + count]
        self._rows, self._first = rows, 0

    def mean(self) -> FloatArray:
        """Return the mean per sensor, shape (n_sensors,); NaN where the window holds no value.

        Raises ValueError before the first vector.
        """
        if not self._times_s:
            raise ValueError("no vector has been added yet")
        return _mean_of_known(self._rows[self._first : self._first + len(self._times_s)])


def _mean_of_known(rows: FloatArray) -> FloatArray:
    whole: FloatArray = rows.sum(axis=0)
    if np.isfinite(whole).all():  # nothing is missing: the usual case
        return whole / len(rows)
    known = np.isfinite(rows)
    count = known.sum(axis=0)
    total = np.where(known, rows, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
