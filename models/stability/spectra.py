"""Short-time spectra of an accelerometer, and what of them the machine makes without the cut."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.signal_checks import check_length

WINDOW_S = 0.64
"""4096 samples at 6400 Hz, as in the dissertation."""
OVERLAP = 0.75
"""Share of a window that the next one repeats."""
STILL_RATIO = 2.0
"""A line stands still whose power at several depths differs by no more than this."""
REACH_LINES, REACH_SHARE = 2.0, 0.0015
"""A line of the machine may lie this many lines of the spectrum, or this share of its frequency, beside itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectrumFrame:
    """The spectrum of one window."""

    time_s: float
    """Middle of the window [s]."""
    frequency_hz: FloatArray
    """Shape (n,) [Hz]."""
    power_density: FloatArray
    """One-sided [(m/s^2)^2/Hz], shape (n,)."""


def window_samples(sample_rate_hz: float) -> int:
    """Return the samples of a window: the power of two nearest to `WINDOW_S`."""
    return int(2 ** round(math.log2(WINDOW_S * sample_rate_hz)))


def short_time_spectra(acceleration_m_s2: FloatArray, sample_rate_hz: float) -> list[SpectrumFrame]:
    """Return spectra of overlapping windows (Hann).

    Result: in the order of time. Raises StabilityError when the signal is shorter than a window.

    `acceleration_m_s2`: shape (n,) [m/s^2]. `sample_rate_hz`: samples per second [Hz].
    """
    length = window_samples(sample_rate_hz)
    check_length(len(acceleration_m_s2), sample_rate_hz, length)
    hop = max(int(length * (1.0 - OVERLAP)), 1)
    starts = range(0, len(acceleration_m_s2) - length + 1, hop)
    return [spectrum(acceleration_m_s2[start : start + length], start, sample_rate_hz) for start in starts]


def spectrum(samples: FloatArray, start: int, sample_rate_hz: float) -> SpectrumFrame:
    """Return the spectrum of one window (Hann) of samples [m/s^2], shape (n,), whose first has this number."""
    length = len(samples)
    window = np.hanning(length + 1)[:-1]
    lines = np.fft.rfft((samples - samples.mean()) * window)
    density = 2.0 * np.abs(lines) ** 2 / (sample_rate_hz * float(np.sum(window**2)))
    return SpectrumFrame(
        time_s=(start + length / 2.0) / sample_rate_hz,
        frequency_hz=np.linspace(0.0, sample_rate_hz / 2.0, len(lines)),
        power_density=density,
    )


def machine_spectrum(acceleration_m_s2: FloatArray, sample_rate_hz: float) -> FloatArray:
    """Return what the machine has without the cut in question: the highest density near each frequency.

    Result: one-sided [(m/s^2)^2/Hz], on the frequencies of a window, of shape (n,). Raises StabilityError when the
    recording is shorter than a window.

    `acceleration_m_s2`: shape (n,) [m/s^2], recorded with the same sensor while the spindle turns without cutting, or
    cuts surely without chatter. `sample_rate_hz`: samples per second [Hz], those of the cut.
    """
    return _near(acceleration_m_s2, sample_rate_hz)


def standing_spectrum(parts: Sequence[FloatArray], sample_rate_hz: float) -> FloatArray:
    """Return what stands still between cuts at several depths: gear mesh and mains do, chatter and forced lines grow.

    Result: one-sided density [(m/s^2)^2/Hz] as of `machine_spectrum`, 0 where the cuts differ, shape (n,). Raises
    StabilityError with fewer than two parts, or when one is shorter than a window.

    `parts`: acceleration of each cut [m/s^2], at depths that differ by a quarter at least. `sample_rate_hz`: samples
    per second [Hz].
    """
    if len(parts) < 2:
        raise StabilityError("one depth says nothing of what stands still; give passages at two depths or more")
    near = np.array([_near(part, sample_rate_hz) for part in parts])
    still = near.max(axis=0) <= STILL_RATIO * near.min(axis=0)
    return np.where(still, near.max(axis=0), 0.0)


def _near(acceleration_m_s2: FloatArray, sample_rate_hz: float) -> FloatArray:
    """Return the mean density, at each frequency the highest of those beside it."""
    frames = short_time_spectra(acceleration_m_s2, sample_rate_hz)
    density: FloatArray = np.mean([frame.power_density for frame in frames], axis=0)
    index = np.arange(len(density))
    reach = np.maximum(REACH_LINES, REACH_SHARE * index).astype(np.intp)
    highest = density.copy()
    for shift in range(1, int(reach.max()) + 1):
        below, above = density[np.maximum(index - shift, 0)], density[np.minimum(index + shift, len(density) - 1)]
        highest = np.where(reach >= shift, np.maximum(highest, np.maximum(below, above)), highest)
    return highest
