"""A measured frequency response: quantity, averaging, coherence, and what makes it unfit for identification."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from models.dynamics.beam import ComplexArray
from models.errors import RefusedInputError
from models.records import FloatArray

Quantity = Literal["receptance", "mobility", "accelerance"]
ORDER: dict[str, int] = {"receptance": 0, "mobility": 1, "accelerance": 2}
"""How often the displacement was differentiated: displacement, velocity, acceleration per force."""

USUAL_M_PER_N = (1e-11, 1e-4)
"""Median receptance of a spindle or a tool over a band with resonances; outside, the unit is another one."""
POSSIBLE_M_PER_N = (1e-30, 1e12)
POSSIBLE_HZ = (1e-6, 1e7)
"""Outside these nothing was measured, whatever the unit, and powers of the numbers would not be finite."""
FEWEST_POINTS = 20
NARROWEST_BAND = 0.1
"""Width of a band beside its middle."""


class MeasurementError(RefusedInputError, ValueError):
    """A measured response cannot be used; the text names the frequency and says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A receptance over frequency as it was measured."""

    frequency_hz: FloatArray
    """Ascending, above zero [Hz], shape (n,)."""
    receptance_m_per_n: ComplexArray
    """[m/N], shape (n,)."""
    coherence: FloatArray | None = None
    """0 to 1, shape (n,); None where it was not measured."""

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises MeasurementError."""
        if self.frequency_hz.shape != self.receptance_m_per_n.shape or self.frequency_hz.ndim != 1:
            raise MeasurementError("frequencies and receptances must be as many")
        if len(self.frequency_hz) and not (self.frequency_hz[0] > 0.0 and np.all(np.diff(self.frequency_hz) > 0.0)):
            raise MeasurementError("frequencies must lie above 0 and ascend")
        wrong = ~np.isfinite(self.receptance_m_per_n) | (self.receptance_m_per_n == 0.0)
        if wrong.any():
            raise MeasurementError(f"at {self.frequency_hz[np.argmax(wrong)]:g} Hz the response is zero or not finite")
        self._check_range()

    def _check_range(self) -> None:
        """Refuse numbers that no measurement gives; raises MeasurementError."""
        outside = (self.frequency_hz < POSSIBLE_HZ[0]) | (self.frequency_hz > POSSIBLE_HZ[1])
        if outside.any():
            raise MeasurementError(
                f"{self.frequency_hz[np.argmax(outside)]:g} Hz is no frequency at which a response is measured "
                f"({POSSIBLE_HZ[0]:g} to {POSSIBLE_HZ[1]:g} Hz)"
            )
        size = np.abs(self.receptance_m_per_n)
        far = ~((size >= POSSIBLE_M_PER_N[0]) & (size <= POSSIBLE_M_PER_N[1]))
        if far.any():
            place = int(np.argmax(far))
            raise MeasurementError(
                f"at {self.frequency_hz[place]:g} Hz the receptance is {size[place]:.3g} m/N, which nothing has "
                f"({POSSIBLE_M_PER_N[0]:g} to {POSSIBLE_M_PER_N[1]:g}); export the response again"
            )

    def between(self, from_hz: float | None, to_hz: float | None) -> "Measurement":
        """Return the part between two frequencies [Hz], both included; None: no limit."""
        kept = np.ones(len(self.frequency_hz), dtype=bool)
        kept &= self.frequency_hz >= (from_hz if from_hz is not None else 0.0)
        kept &= self.frequency_hz <= (to_hz if to_hz is not None else np.inf)
        return self._where(kept)

    def coherent(self, least: float) -> "Measurement":
        """Return the frequencies with at least a coherence; raises MeasurementError when it was not measured."""
        if self.coherence is None:
            raise MeasurementError("the coherence was not measured, so it cannot decide what is used")
        return self._where(self.coherence >= least)

    def thinned(self, lines: int) -> "Measurement":
        """Return every k-th frequency, so that about as many are left."""
        kept = np.zeros(len(self.frequency_hz), dtype=bool)
        kept[:: max(1, len(kept) // lines)] = True
        return self._where(kept)

    def _where(self, kept: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> "Measurement":
        return Measurement(
            frequency_hz=self.frequency_hz[kept],
            receptance_m_per_n=self.receptance_m_per_n[kept],
            coherence=None if self.coherence is None else self.coherence[kept],
        )


def receptance(quantity: Quantity, frequency_hz: FloatArray, values: ComplexArray) -> ComplexArray:
    """Return a mobility [m/(s N)] or an accelerance [m/(s^2 N)] as a receptance [m/N], shape (n,).

    Integrated once or twice by division by j omega; frequencies must lie above 0.
    """
    return np.asarray(values / (2j * np.pi * frequency_hz) ** ORDER[quantity], dtype=np.complex128)


def average(measurements: Sequence[Measurement]) -> Measurement:
    """Return the mean of responses measured at the same frequencies.

    The coherence is what their scatter says: the share of the mean power that the mean response holds,
    freed of the part that so few responses show by chance.

    Raises MeasurementError when there is none, or the frequencies differ.
    """
    if not measurements:
        raise MeasurementError("there is no response to average")
    first = measurements[0]
    for other in measurements[1:]:
        if not np.array_equal(other.frequency_hz, first.frequency_hz):
            raise MeasurementError("responses at different frequencies cannot be averaged; measure with one setting")
    if len(measurements) == 1:
        return first
    each = np.array([measurement.receptance_m_per_n for measurement in measurements])
    mean, power, count = each.mean(axis=0), np.mean(np.abs(each) ** 2, axis=0), len(each)
    share = (count * np.abs(mean) ** 2 / power - 1.0) / (count - 1)
    return Measurement(frequency_hz=first.frequency_hz, receptance_m_per_n=mean, coherence=np.clip(share, 0.0, 1.0))


def check_for_identification(measurement: Measurement, parameters: int, *, trust_units: bool = False) -> None:
    """Refuse a response that cannot determine as many parameters; raises MeasurementError.

    `trust_units`: its units are right, whatever the numbers look like.
    """
    frequency_hz = measurement.frequency_hz
    needed = max(FEWEST_POINTS, 2 * parameters)
    if len(frequency_hz) < needed:
        raise MeasurementError(
            f"{len(frequency_hz)} frequencies cannot determine {parameters} parameters; at least {needed} are needed"
        )
    low, high = float(frequency_hz[0]), float(frequency_hz[-1])
    band = f"{low:g} to {high:g} Hz"
    size = np.abs(measurement.receptance_m_per_n)
    middle = float(np.median(size))
    if not (trust_units or USUAL_M_PER_N[0] < middle < USUAL_M_PER_N[1]):
        raise MeasurementError(
            f"half of the receptances between {band} lie above {middle:.3g}, which is no spindle's in m/N "
            f"({USUAL_M_PER_N[0]:g} to {USUAL_M_PER_N[1]:g}); is the unit um/N, or is this an accelerance?"
        )
    if high - low < NARROWEST_BAND * 0.5 * (high + low):
        raise MeasurementError(
            f"the band from {band} is too narrow; measure over at least {NARROWEST_BAND:.0%} of its middle, "
            "better from 300 to 2500 Hz"
        )
    highest = int(np.argmax(size))
    imaginary = measurement.receptance_m_per_n.imag
    if imaginary[highest] > 0.0 and imaginary.sum() > 0.0:
        raise MeasurementError(
            f"at the highest peak, {frequency_hz[highest]:g} Hz, the imaginary part is positive, which no point does "
            "that is hit and measured at once; the sensor points against the hammer, or time runs as exp(-j w t): "
            "turn the phase by 180 degrees, or take the complex conjugate"
        )
    inside = (size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])
    if not inside.any():
        raise MeasurementError(
            f"the band from {band} is too narrow: it holds no resonance (the magnitude has no peak inside); "
            "measure where the spindle resonates"
        )
