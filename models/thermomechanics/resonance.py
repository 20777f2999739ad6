"""Follows one resonance of the tool point by mode continuity while the bearings change (Figs 5-18, 5-19).

The highest peak is not followed: as the spindle warms, another mode becomes the highest, and the frequency would jump.
Between two states of the bearings the way is divided into steps that change no parameter by much, and further until
no other peak can be taken for the one that is followed. Two peaks that melt into one are one peak; a peak that vanishes
is lost, and said to be.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.errors import IdentificationError
from models.records import FloatArray

Receptance = Callable[[Mapping[str, float]], ComplexArray]
"""Values of the twelve bearing parameters -> receptance [m/N], shape (n,)."""
OnTheWay = Callable[[Mapping[str, FloatArray], float, float], tuple[FloatArray, ComplexArray]]
"""Values of each parameter, shape (k,), and both ends of a band [Hz] -> frequencies in it, shape (n,), and
receptances, shape (k, n)."""

LARGEST_CHANGE = 0.05
"""A step changes no parameter by more than this share."""
NOTHING_SHARE = 0.02
"""A parameter below this share of the larger end of its way counts as about nothing."""
MOST_STEPS = 64
CLEARANCE = 3.0
"""A peak is the same one when every other is this many times further away, or when it hardly moved:"""
SMALL_MOVE = 0.002
"""Share of its frequency by which a peak hardly moves."""
LARGEST_MOVE = 0.03
"""A peak that moves by more than this share within a step is not the same one."""
MOST_DIVISIONS = 4
"""A step is halved at most this many times."""
TOGETHER = 16
"""So many steps of the way are looked at in one computation."""
REACH = CLEARANCE * LARGEST_MOVE
"""Share of its frequency around a peak within which other peaks decide whether it is the same one."""
WINDOW = 0.2
"""Share of its frequency around a peak that is looked at, so that it may move for some steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """A local maximum of a receptance's magnitude."""

    frequency_hz: float
    magnitude_m_per_n: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Resonance:
    """The resonance that is followed."""

    frequency_hz: float
    magnitude_m_per_n: float
    continuous: bool
    """False: the mode was lost on the way here, and this is where it was last."""


def peaks(frequency_hz: FloatArray, receptance: ComplexArray) -> list[Peak]:
    """Return the resonances by ascending frequency, between the lines by a parabola through 1/|H|^2.

    Of a single mode 1/|H|^2 is a parabola in the square of the frequency, so the peak does not lean towards a line.

    `frequency_hz`: evenly spaced [Hz], shape (n,). `receptance`: [m/N], shape (n,).
    """
    return peaks_of_several(frequency_hz, receptance[None])[0]


def peaks_of_several(frequency_hz: FloatArray, receptances: ComplexArray) -> list[list[Peak]]:
    """Return the `peaks` of several responses [m/N], shape (k, n), at the same frequencies [Hz], shape (n,)."""
    found: list[list[Peak]] = [[] for _ in receptances]
    if len(frequency_hz) < 3:
        return found
    inverse = 1.0 / (receptances.real**2 + receptances.imag**2)
    before, here, after = inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:]
    rows, places = np.nonzero((here < before) & (here <= after))
    left, middle, right = before[rows, places], here[rows, places], after[rows, places]
    shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
    frequency = frequency_hz[places + 1] + shift * (frequency_hz[places + 2] - frequency_hz[places + 1])
    size = np.maximum(middle - 0.25 * (left - right) * shift, 1e-3 * middle) ** -0.5
    for row, at_hz, magnitude in zip(rows.tolist(), frequency.tolist(), size.tolist(), strict=True):
        found[row].append(Peak(frequency_hz=at_hz, magnitude_m_per_n=magnitude))
    return found


def first_peak(frequency_hz: FloatArray, receptance: ComplexArray, near_hz: float | None) -> Peak:
    """Return the peak to follow: the nearest to a frequency [Hz], or the highest; raises IdentificationError."""
    found = peaks(frequency_hz, receptance)
    if not found:
        raise IdentificationError(
            f"between {frequency_hz[0]:g} and {frequency_hz[-1]:g} Hz the tool point has no resonance to follow; "
            "widen the band"
        )
    if near_hz is None:
        return max(found, key=lambda peak: peak.magnitude_m_per_n)
    return min(found, key=lambda peak: abs(peak.frequency_hz - near_hz))


class ResonanceFollower:
    """Follows one resonance of a structure from one set of bearing parameters to the next."""

    def __init__(
        self,
        frequency_hz: FloatArray,
        receptance: Receptance,
        start: Mapping[str, float],
        near_hz: float | None = None,
        *,
        on_the_way: OnTheWay | None = None,
    ) -> None:
        """Choose the resonance.

        Raises IdentificationError when there is none.

        `frequency_hz`: evenly spaced [Hz], shape (n,). `receptance`: response of the structure at these frequencies.
        `start`: bearing parameters at which the resonance is chosen; after a loss it is followed anew from here.
        `near_hz`: the resonance nearest to this is followed [Hz]; None: the highest. `on_the_way`: responses of several
        sets of parameters at once, in a band and possibly at fewer frequencies, for the steps on the way; None:
        `receptance`, one by one.
        """
        self.frequency_hz = frequency_hz
        self._receptance = receptance
        self._on_the_way = on_the_way or self._one_by_one
        self._start = dict(start)
        peak = first_peak(frequency_hz, receptance(start), near_hz)
        self._first = Resonance(
            frequency_hz=peak.frequency_hz, magnitude_m_per_n=peak.magnitude_m_per_n, continuous=True
        )
        self._at, self._resonance = self._start, self._first

    @property
    def resonance(self) -> Resonance:
        """The resonance where it was followed to."""
        return self._resonance

    def follow(self, parameters: Mapping[str, float], response: ComplexArray | None = None) -> Resonance:
        """Return the resonance with new bearing parameters, and go on from there.

        `parameters`: the twelve parameters by name, SI units. `response`: the receptance with them [m/N], shape (n,),
        where it is known already.
        """
        begin, known = (self._at, self._resonance) if self._resonance.continuous else (self._start, self._first)
        found = self.reached(begin, known, parameters, response)
        if found.continuous:
            self._at = dict(parameters)
        self._resonance = found
        return found

    def reached(
        self,
        begin: Mapping[str, float],
        known: Resonance,
        parameters: Mapping[str, float],
        response: ComplexArray | None = None,
        *,
        roughly: bool = False,
    ) -> Resonance:
        """Return a resonance that is known with some parameters as it is with others; nothing is kept.

        `roughly`: the end is looked at like the way, at what may be fewer frequencies.
        """
        names = tuple(parameters)
        steps = min(MOST_STEPS, max(1, int(np.ceil(_distance(begin, parameters) / LARGEST_CHANGE))))
        way = _way(begin, parameters, np.arange(1, steps + 1) / steps)
        count = steps if roughly else steps - 1
        before, at, done = begin, known, 0
        while done < count and at.continuous:
            chunk, (low, high) = way[done : min(done + TOGETHER, count)], _window(at)
            for row, found in zip(chunk, self._passed(names, chunk, low, high), strict=True):
                after = dict(zip(names, row.tolist(), strict=True))
                at = self._walk(before, at, after, found, 0)
                before, done = after, done + 1
                decided = low <= (1.0 - REACH) * at.frequency_hz and (1.0 + REACH) * at.frequency_hz <= high
                if not (at.continuous and decided):
                    break
        if roughly or not at.continuous:
            return at
        response = self._receptance(parameters) if response is None else response
        return self._walk(before, at, parameters, peaks(self.frequency_hz, response), 0)

    def _passed(self, names: tuple[str, ...], sets: FloatArray, low_hz: float, high_hz: float) -> list[list[Peak]]:
        """Return the peaks in a band for several sets of parameters, shape (k, m)."""
        columns = {name: sets[:, place] for place, name in enumerate(names)}
        return peaks_of_several(*self._on_the_way(columns, low_hz, high_hz))

    def _one_by_one(
        self, columns: Mapping[str, FloatArray], low_hz: float, high_hz: float
    ) -> tuple[FloatArray, ComplexArray]:
        lines = band(self.frequency_hz, low_hz, high_hz)
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        found = [self._receptance(dict(zip(columns, row, strict=True)))[lines] for row in rows]
        return self.frequency_hz[lines], np.array(found)

    def _walk(
        self,
        begin: Mapping[str, float],
        known: Resonance,
        end: Mapping[str, float],
        found: list[Peak],
        division: int,
    ) -> Resonance:
        if not known.continuous:
            return known
        last = division == MOST_DIVISIONS
        if peak := _same(known.frequency_hz, found, last=last):
            return Resonance(frequency_hz=peak.frequency_hz, magnitude_m_per_n=peak.magnitude_m_per_n, continuous=True)
        if last:
            return Resonance(
                frequency_hz=known.frequency_hz, magnitude_m_per_n=known.magnitude_m_per_n, continuous=False
            )
        halfway = _way(begin, end, np.array([0.5]))
        (passed,) = self._passed(tuple(end), halfway, *_window(known))
        middle = dict(zip(end, halfway[0].tolist(), strict=True))
        half = self._walk(begin, known, middle, passed, division + 1)
        return self._walk(middle, half, end, found, division + 1)


def band(frequency_hz: FloatArray, low_hz: float, high_hz: float) -> slice:
    """Return which of ascending frequencies [Hz], shape (n,), lie in a band, two more on both sides."""
    first, last = np.searchsorted(frequency_hz, (low_hz, high_hz))
    return slice(max(int(first) - 2, 0), int(last) + 2)


def _window(resonance: Resonance) -> tuple[float, float]:
    """Return the band [Hz] around a resonance in which it is looked for."""
    return (1.0 - WINDOW) * resonance.frequency_hz, (1.0 + WINDOW) * resonance.frequency_hz


def _logarithms(begin: Mapping[str, float], end: Mapping[str, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the parameters at both ends on scales on which equal steps change them by equal shares."""
    first = np.array([begin[name] for name in end])
    last = np.array(list(end.values()))
    floor = NOTHING_SHARE * np.maximum(np.abs(first), np.abs(last)) + 1e-300
    return np.log(first + floor), np.log(last + floor), floor


def _distance(begin: Mapping[str, float], end: Mapping[str, float]) -> float:
    first, last, _ = _logarithms(begin, end)
    return float(np.max(np.abs(last - first)))


def _way(begin: Mapping[str, float], end: Mapping[str, float], shares: FloatArray) -> FloatArray:
    """Return the parameters at shares of the way, shape (k,), in the order of `end`, shape (k, m)."""
    first, last, floor = _logarithms(begin, end)
    return np.asarray((np.exp(first + shares[:, None] * (last - first)) - floor).clip(min=0.0))


def _same(frequency_hz: float, found: list[Peak], *, last: bool) -> Peak | None:
    """Return the peak that a known one became, None where that is not certain."""
    if not found:
        return None
    away = sorted((abs(peak.frequency_hz - frequency_hz), index) for index, peak in enumerate(found))
    nearest = found[away[0][1]]
    move = away[0][0] / frequency_hz
    if move < SMALL_MOVE or (last and move < LARGEST_MOVE):
        return nearest
    clear = len(away) == 1 or away[1][0] > CLEARANCE * away[0][0]
    return nearest if clear and move < LARGEST_MOVE else None
