"""Follows one resonance of the tool point by mode continuity while the bearings change (Figs 5-18, 5-19).

The highest peak is not followed: as the spindle warms, another mode becomes the highest, and the frequency would jump.
Between two states of the bearings the way is divided until the peak moves so little that no other peak can be
taken for it. Two peaks that melt into one are one peak; a peak that vanishes is lost, and said to be.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.response_fit import IdentificationError
from models.records import FloatArray

Receptance = Callable[[Mapping[str, float]], ComplexArray]
"""Values of the twelve bearing parameters -> receptance [m/N], shape (n,)."""

SMALL_MOVE = 0.004
"""A peak that moves by less than this share of its frequency is the same one."""
CLEARANCE = 3.0
"""Nor is there doubt when every other peak is this many times further away."""
LARGEST_MOVE = 0.03
"""A peak that moves by more than this share within the smallest step is not the same one."""
MOST_DIVISIONS = 5
"""The way between two states is divided into at most 2^this steps."""


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
    """Return the resonances by ascending frequency, between the lines by a parabola through three logarithms.

    Parameters
    ----------
    frequency_hz
        Evenly spaced [Hz], shape (n,).
    receptance
        [m/N], shape (n,).

    """
    size = np.log(np.abs(receptance))
    inside = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
    found = []
    for k in inside:
        left, middle, right = size[k - 1], size[k], size[k + 1]
        shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
        frequency = frequency_hz[k] + shift * (frequency_hz[k + 1] - frequency_hz[k])
        height = middle - 0.25 * (left - right) * shift
        found.append(Peak(frequency_hz=float(frequency), magnitude_m_per_n=float(np.exp(height))))
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
    ) -> None:
        """Choose the resonance.

        Parameters
        ----------
        frequency_hz
            Evenly spaced [Hz], shape (n,).
        receptance
            Response of the structure at these frequencies.
        start
            Bearing parameters at which the resonance is chosen; after a loss it is followed anew from here.
        near_hz
            The resonance nearest to this is followed [Hz]; None: the highest.

        Raises
        ------
        IdentificationError
            When there is none.

        """
        self.frequency_hz = frequency_hz
        self._receptance = receptance
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

        Parameters
        ----------
        parameters
            The twelve parameters by name, SI units.
        response
            The receptance with them [m/N], shape (n,), where it is known already.

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
    ) -> Resonance:
        """Return a resonance that is known with some parameters as it is with others; nothing is kept."""
        response = self._receptance(parameters) if response is None else response
        return self._walk(begin, known, parameters, response, 0)

    def _walk(
        self,
        begin: Mapping[str, float],
        known: Resonance,
        end: Mapping[str, float],
        response: ComplexArray,
        division: int,
    ) -> Resonance:
        if not known.continuous:
            return known
        found = peaks(self.frequency_hz, response)
        last = division == MOST_DIVISIONS
        if peak := _same(known.frequency_hz, found, last=last):
            return Resonance(frequency_hz=peak.frequency_hz, magnitude_m_per_n=peak.magnitude_m_per_n, continuous=True)
        if last:
            return Resonance(
                frequency_hz=known.frequency_hz, magnitude_m_per_n=known.magnitude_m_per_n, continuous=False
            )
        middle = {name: 0.5 * (begin[name] + end[name]) for name in end}
        half = self._walk(begin, known, middle, self._receptance(middle), division + 1)
        return self._walk(middle, half, end, response, division + 1)


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
