"""Finds temperature sensors that were exchanged in pairs from one recording on, or in one recording.

Every sensor is predicted from the others by a ridge that was fitted on the other recordings, all counted from their
means. Where two were exchanged, what they leave there is large, and small again with the two changed back, both ways:
when the recordings with the exchange are predicted from those without, and the other way round. Where others still do
not fit with all of them changed back, other pairs may explain as much, and which sensors it were is not told.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from models.recordings.dataset import Recording
from models.recordings.sensor_agreement import PENALTY_K, SAMPLE_S, Part, moving, parts_of
from models.records import FloatArray

FEWEST_SENSORS = 4
EXCHANGED_K = 0.5
"""Both of two exchanged sensors leave at least this [K] ..."""
EXCHANGED_SHARE = 0.2
"""... and this share of what they move, ..."""
CHANGED_BACK = 0.33
"""... and less than this share of it when they are changed back."""
MOST_EXCHANGES = 3
FEWEST_UNEXPLAINED = 2
"""One sensor that does not fit beside exchanged ones was exchanged with none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """Two sensors that were exchanged, or some of several."""

    first: int
    """Index of the first recording with the exchange."""
    alone: bool
    """It is the only one; else all that come after it have the exchange too."""
    sensors: tuple[int, int]
    by_k: float
    """How far the one that is told better is from what the others say [K]."""
    among: tuple[int, ...] = ()
    """Where others do not fit either: all that do not, of which nobody knows which were exchanged."""


def exchanges(recordings: Sequence[Recording]) -> list[Exchange]:
    """Return which sensors were exchanged; nothing where there are too few recordings, sensors or rows to tell.

    `recordings`: with the same columns, in order of time, without values that cannot be.
    """
    if not recordings or any(one.temperature_names != recordings[0].temperature_names for one in recordings):
        return []
    parts = parts_of([recording.downsampled(SAMPLE_S) for recording in recordings], 1)
    moved = sensors = moving(parts)
    found: list[Exchange] = []
    while len(parts) > 1 and len(sensors) >= FEWEST_SENSORS and len(found) < MOST_EXCHANGES:
        best = _best_exchange(parts, sensors)
        if best is None:
            break
        found.append(best)
        sensors = [sensor for sensor in sensors if sensor not in best.sensors]
    among = _among(parts, moved, found) if found else ()
    return [replace(found[0], among=among)] if among else found


def _among(parts: Sequence[Part], sensors: Sequence[int], found: Sequence[Exchange]) -> tuple[int, ...]:
    """Return which sensors do not fit, where some still do not with all exchanges changed back; else nothing.

    They are looked for at every recording, because what is between two changes hides some of them.
    """
    tables = [part.centred_k[:, sensors] for part in parts]
    least_k2 = (CHANGED_BACK * min(one.by_k for one in found)) ** 2
    has_first = _having(parts, found[0])
    as_they_are = _left_k2(tables, has_first)
    for one in found:
        own, other = (sensors.index(sensor) for sensor in one.sensors)
        for table in (table for table, has in zip(tables, _having(parts, one), strict=True) if has):
            table[:, [own, other]] = table[:, [other, own]]
    later = [[index >= first for index in range(len(parts))] for first, alone in _splits(len(parts)) if not alone]
    changed_back = np.max([_left_k2(tables, having) for having in (has_first, *later)], axis=0)
    if (changed_back > least_k2).sum() < FEWEST_UNEXPLAINED:
        return ()
    unexplained = np.maximum(as_they_are, changed_back) > least_k2
    named = {sensor for one in found for sensor in one.sensors}
    return tuple(sensor for at, sensor in enumerate(sensors) if unexplained[at] or sensor in named)


def _having(parts: Sequence[Part], found: Exchange) -> list[bool]:
    """Return which parts have an exchange."""
    return [part.recording == found.first or (part.recording > found.first and not found.alone) for part in parts]


def _left_k2(tables: Sequence[FloatArray], having: Sequence[bool]) -> FloatArray:
    """Return what each sensor leaves when the tables with an exchange are predicted by the others, and back [K^2]."""
    squares, rows = [table.T @ table for table in tables], [len(table) for table in tables]
    a, b = (_Side.of(squares, rows, [one is which for one in having]) for which in (False, True))
    return np.asarray((b.rows * _Left(b, a).as_it_is + a.rows * _Left(a, b).as_it_is) / (a.rows + b.rows))


def _best_exchange(parts: Sequence[Part], sensors: Sequence[int]) -> Exchange | None:
    """Return the exchange that explains most of what some sensors leave."""
    best: tuple[float, Exchange] | None = None
    tables = [part.centred_k[:, sensors] for part in parts]
    squares, rows = [table.T @ table for table in tables], [len(table) for table in tables]
    for first, alone in _splits(len(parts)):
        inside = [first <= index and (index == first or not alone) for index in range(len(parts))]
        found = _best_pair_inside(squares, rows, inside)
        if found is not None and (best is None or found[0] > best[0]):
            gain, (one, other), by_k = found
            pair = (sensors[one], sensors[other])
            best = gain, Exchange(first=parts[first].recording, alone=alone, sensors=pair, by_k=by_k)
    return None if best is None else best[1]


def exchanged_in_one(squares: Sequence[FloatArray]) -> list[tuple[tuple[int, int], float] | None]:
    """Return of several machines which two sensors are exchanged on each, against all others, and by how much [K].

    `squares`: of each machine, mean products of temperatures about the means of recordings [K^2], shape (n, n).
    """
    found: list[tuple[tuple[int, int], float] | None] = []
    for place in range(len(squares)):
        best = _best_pair_inside(squares, [1] * len(squares), [at == place for at in range(len(squares))])
        found.append(None if best is None else best[1:])
    return found


def _best_pair_inside(
    squares: Sequence[FloatArray], rows: Sequence[int], inside: Sequence[bool]
) -> tuple[float, tuple[int, int], float] | None:
    """Return what `_best_pair` does of some parts with an exchange and all others without."""
    before, after = (_Side.of(squares, rows, [one is which for one in inside]) for which in (False, True))
    return _best_pair(before, after)


def _splits(recordings: int) -> Iterator[tuple[int, bool]]:
    """Yield the first recording with an exchange, and whether it is the only one; no two say the same."""
    if recordings > 2:
        yield from ((first, True) for first in range(recordings))
    yield from ((first, False) for first in range(1, recordings) if recordings == 2 or 1 < first < recordings - 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Side:
    """The recordings without an exchange, or those with it."""

    square: FloatArray
    rows: int
    precision: FloatArray

    @classmethod
    def of(cls, squares: Sequence[FloatArray], rows: Sequence[int], chosen: Sequence[bool]) -> "_Side":
        """Return the recordings that are chosen as one."""
        square: FloatArray = np.sum([one for one, wanted in zip(squares, chosen, strict=True) if wanted], axis=0)
        count = sum(one for one, wanted in zip(rows, chosen, strict=True) if wanted)
        precision = np.asarray(np.linalg.inv(square + count * PENALTY_K**2 * np.eye(len(square))), dtype=np.float64)
        return cls(square=square, rows=count, precision=precision)


class _Left:
    """Mean squares that each sensor leaves on one side when it is predicted by the fit of the other [K^2]."""

    def __init__(self, of: _Side, by: _Side) -> None:
        self._square, self._precision = of.square, by.precision
        self._map = by.precision @ of.square
        self._scale = of.rows * np.square(np.diag(by.precision))
        self._sum = np.einsum("ij,ij->i", self._map, by.precision)
        self.as_it_is = np.asarray(self._sum / self._scale)

    def changed_back(self, one: int, others: npt.NDArray[np.intp]) -> FloatArray:
        """Return the same with one sensor and each of some others changed back, shape (len(others), n_sensors)."""
        change = self._precision[:, others] - self._precision[:, [one]]
        along = self._map[:, [one]] - self._map[:, others]
        size = self._square[one, one] + np.diag(self._square)[others] - 2.0 * self._square[one, others]
        return np.asarray((self._sum[:, None] + 2.0 * change * along + np.square(change) * size).T / self._scale)


def _best_pair(a: _Side, b: _Side) -> tuple[float, tuple[int, int], float] | None:
    """Return by how much the best two changed back lower the sum of logarithms, which, and what they leave as it is."""
    of_b, of_a = _Left(b, a), _Left(a, b)
    weight = np.array([b.rows, a.rows]) / (a.rows + b.rows)
    before_k2 = weight[0] * of_b.as_it_is + weight[1] * of_a.as_it_is
    moves_k2 = np.diag(a.square + b.square) / (a.rows + b.rows)
    suspected = before_k2 >= np.maximum(EXCHANGED_K**2, EXCHANGED_SHARE**2 * moves_k2)
    best: tuple[float, tuple[int, int], float] | None = None
    for one in np.flatnonzero(suspected).tolist():
        others = np.flatnonzero(suspected[one + 1 :]) + one + 1
        if not len(others):
            break
        forth, back = of_b.changed_back(one, others), of_a.changed_back(one, others)
        places = np.arange(len(others))
        back[:, one], back[places, others] = back[places, others].copy(), back[:, one].copy()
        after_k2 = weight[0] * forth + weight[1] * back
        gain = np.log((before_k2 + PENALTY_K**2) / (after_k2 + PENALTY_K**2)).sum(axis=1)
        share = np.maximum(after_k2[:, one] / before_k2[one], after_k2[places, others] / before_k2[others])
        gain[share > CHANGED_BACK**2] = -np.inf
        place = int(np.argmax(gain))
        if gain[place] > (0.0 if best is None else best[0]):
            other = int(others[place])
            best = float(gain[place]), (one, other), float(np.sqrt(min(before_k2[one], before_k2[other])))
    return best
