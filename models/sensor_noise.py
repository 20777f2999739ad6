"""How far a sensor's readings scatter: what is noise of one sensor would be a jump of another."""

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

IndexArray = npt.NDArray[np.intp]
APART_S = 10.0
"""Readings that are nearer in time say nothing more [s]."""
SHARE = 0.35
"""The bend that this share stays below tells the scatter: most others may be wrong."""
GAIN, FEWEST = 0.05, 9
"""By so much a bend changes what the others before it tell, the first ones by more, and so many it takes."""
STILL_K = 0.1
"""The limits of the configuration are for sensors that scatter no more (standard deviation) [K]."""
STILL_BEND_K = 0.454 * np.sqrt(6.0) * STILL_K
"""That bend of normal noise of this size."""
WIDEST = 2.5
"""Limits are widened by at most so much: a sensor that scatters by more is none."""


class SensorNoise:
    """Of each sensor of one machine: by how much its limits are wider; owned by the thermal task.

    A bend is how far a reading lies off the line through the two before it: what warms evenly has none.
    """

    def __init__(self, count: int) -> None:
        self._before, self._last = np.full(count, np.nan), np.full(count, np.nan)
        self._at_s = np.full(count, -np.inf)
        self._bend_k, self._count = np.full(count, STILL_BEND_K), np.zeros(count)

    def wider(self, indices: IndexArray, degc: FloatArray, now_s: float) -> FloatArray:
        """Take a cycle's readings of sensors (indices) [degC], NaN where none; return by how much theirs are wider."""
        apart = (now_s - self._at_s[indices] >= APART_S - 1e-6) | (self._count[indices] < FEWEST)
        due = np.isfinite(degc) & apart
        if due.any():
            places, read = indices[due], degc[due]
            bends_k = np.abs(read - 2.0 * self._last[places] + self._before[places])
            self._before[places], self._last[places], self._at_s[places] = self._last[places], read, now_s
            known = np.isfinite(bends_k)
            self._learn(places[known], bends_k[known])
        told = self._count[indices] >= FEWEST
        return np.asarray(np.where(told, np.clip(self._bend_k[indices] / STILL_BEND_K, 1.0, WIDEST), 1.0))

    def _learn(self, places: IndexArray, bends_k: FloatArray) -> None:
        """Take what bends tell: the share of them that stays below goes to `SHARE`."""
        self._count[places] += 1.0
        above = bends_k > self._bend_k[places]
        gain = np.maximum(GAIN, 1.0 / self._count[places])
        told_k = self._bend_k[places] * np.exp(gain * (above - (1.0 - SHARE)))
        self._bend_k[places] = np.clip(told_k, STILL_BEND_K / 2.0, STILL_BEND_K * WIDEST * 1.2)
