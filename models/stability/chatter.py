"""Chatter in an accelerometer signal: short-time spectra, forced lines removed, verdict and frequency.

A stable cut shakes the machine at the tooth-passing frequency and its harmonics, and at harmonics of
the spindle's own turn when the teeth run out. Chatter is a narrow line elsewhere. A frame's
strongest line elsewhere counts when it stands out from what surrounds it and is not negligible
beside the strongest forced line; a verdict needs several frames in a row.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.signal_checks import check_clipping, check_length

WINDOW_S = 0.64
"""4096 samples at 6400 Hz, as in the dissertation."""
HARMONICS_FOR_SPEED = 6
LEAST_SPACING = 2.0
"""Harmonics of the tooth passing lie at least so many times apart as is taken out around each."""
ALWAYS_RUNOUT = 2.5
"""Harmonics below this multiple of the spindle's turn are unbalance, however strong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatterSettings:
    """What counts as chatter."""

    overlap: float = 0.75
    """Share of a window that the next one repeats."""
    power_ratio: float = 0.1
    """Power of the line over that of the strongest forced line."""
    prominence: float = 30.0
    """Power density of the line over the median of its surroundings."""
    frames_in_a_row: int = 3
    lowest_hz: float = 20.0
    """What is slower is no chatter of a spindle [Hz]."""
    half_width_lines: float = 2.5
    """Forced lines are removed this many lines of the spectrum to both sides."""
    half_width_share: float = 0.0015
    """And at least this share of their frequency."""
    speed_tolerance: float = 0.005
    """The true speed is searched within this share of the given one."""
    runout_ratio: float = 4.0
    """A line on a harmonic of the spindle's turn needs this power over the strongest tooth-passing line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectrumFrame:
    """The spectrum of one window."""

    time_s: float
    """Middle of the window [s]."""
    frequency_hz: FloatArray
    """Shape (n,) [Hz]."""
    power_density: FloatArray
    """One-sided [(m/s^2)^2/Hz], shape (n,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameVerdict:
    """What one window says."""

    time_s: float
    """Middle of the window [s]."""
    chatter: bool
    frequency_hz: float
    """Of the strongest line that is not forced [Hz]."""
    power: float
    """Of that line [(m/s^2)^2]."""
    forced_power: float
    """Of the strongest forced line [(m/s^2)^2]."""
    prominence: float
    tooth_passing_hz: float
    """As found near the given speed [Hz]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatterVerdict:
    """What a recording, or a part of it, says."""

    chatter: bool
    frequency_hz: float | None
    """Of the chatter [Hz]; None without."""
    onset_s: float | None
    """Middle of the first window of the first run of frames with chatter [s]."""
    share: float
    """Of the frames that show chatter, 0 to 1."""
    power_ratio: float
    """Median over the frames that count: line over strongest forced line."""
    tooth_passing_hz: float
    frames: tuple[FrameVerdict, ...]


def window_samples(sample_rate_hz: float) -> int:
    """Return the samples of a window: the power of two nearest to `WINDOW_S`."""
    return int(2 ** round(math.log2(WINDOW_S * sample_rate_hz)))


def short_time_spectra(
    acceleration_m_s2: FloatArray, sample_rate_hz: float, overlap: float = 0.75, window: int | None = None
) -> list[SpectrumFrame]:
    """Return spectra of overlapping windows (Hann).

    Result: in the order of time. Raises StabilityError when the signal is shorter than a window.

    Parameters
    ----------
    acceleration_m_s2
        Shape (n,) [m/s^2].
    sample_rate_hz
        Samples per second [Hz].
    overlap
        Share of a window that the next one repeats, below 1.
    window
        Samples of a window; None takes `window_samples`.

    """
    length = window or window_samples(sample_rate_hz)
    check_length(len(acceleration_m_s2), sample_rate_hz, length)
    hop = max(int(length * (1.0 - overlap)), 1)
    starts = range(0, len(acceleration_m_s2) - length + 1, hop)
    return [_spectrum(acceleration_m_s2[start : start + length], start, sample_rate_hz) for start in starts]


def _spectrum(samples: FloatArray, start: int, sample_rate_hz: float) -> SpectrumFrame:
    length = len(samples)
    window = np.hanning(length + 1)[:-1]
    lines = np.fft.rfft((samples - samples.mean()) * window)
    density = 2.0 * np.abs(lines) ** 2 / (sample_rate_hz * float(np.sum(window**2)))
    return SpectrumFrame(
        time_s=(start + length / 2.0) / sample_rate_hz,
        frequency_hz=np.linspace(0.0, sample_rate_hz / 2.0, len(lines)),
        power_density=density,
    )


def judge_frame(
    frame: SpectrumFrame, speed_rpm: float, teeth: int, settings: ChatterSettings | None = None
) -> FrameVerdict:
    """Return the verdict of one window.

    Result: with the strongest line that is not forced, whether it counts or not. Raises StabilityError when the tooth
    passing is above half the sampling rate.

    Parameters
    ----------
    frame
        Its spectrum.
    speed_rpm
        Spindle speed [1/min], to within the tolerance.
    teeth
        Number of teeth.
    settings
        What counts as chatter; None: the defaults.

    """
    rules = settings or ChatterSettings()
    spacing_hz = float(frame.frequency_hz[1])
    passing_hz = _passing_hz(frame, speed_rpm * teeth / 60.0, rules)
    width_hz = np.maximum(rules.half_width_lines * spacing_hz, rules.half_width_share * frame.frequency_hz)
    if passing_hz < LEAST_SPACING * 2.0 * rules.half_width_lines * spacing_hz:
        raise StabilityError(
            f"at {speed_rpm:g} 1/min the teeth pass at {passing_hz:.3g} Hz, and lines of a spectrum are "
            f"{spacing_hz:.3g} Hz apart: between so many harmonics chatter cannot be told from the cut"
        )
    forced = _on_multiples(frame.frequency_hz, passing_hz, width_hz)
    turn_hz = passing_hz / teeth
    turning = _on_multiples(frame.frequency_hz, turn_hz, width_hz) & ~forced
    heard = frame.frequency_hz >= rules.lowest_hz
    power = np.convolve(frame.power_density, np.ones(5), mode="same") * spacing_hz
    forced_power = float(power[forced & heard].max(initial=0.0))
    runout = frame.frequency_hz < ALWAYS_RUNOUT * turn_hz
    counted = heard & ~forced & ~(turning & (runout | (power < rules.runout_ratio * forced_power)))
    density = frame.power_density
    own = np.convolve(np.where(counted, density, 0.0), np.ones(5), mode="same") * spacing_hz
    crest = np.concatenate(([False], (density[1:-1] >= density[:-2]) & (density[1:-1] >= density[2:]), [False]))
    place = int(np.argmax(np.where(counted & crest, density, 0.0)))
    prominence = _prominence(frame.power_density, place, forced)
    return FrameVerdict(
        time_s=frame.time_s,
        chatter=bool(prominence >= rules.prominence and own[place] >= rules.power_ratio * forced_power),
        frequency_hz=_peak_hz(frame, place),
        power=float(own[place]),
        forced_power=forced_power,
        prominence=prominence,
        tooth_passing_hz=passing_hz,
    )


def _on_multiples(frequency_hz: FloatArray, base_hz: float, width_hz: FloatArray) -> np.ndarray:
    orders = np.maximum(np.rint(frequency_hz / base_hz), 1.0)
    on: np.ndarray = np.abs(frequency_hz - orders * base_hz) <= width_hz
    return on


def _passing_hz(frame: SpectrumFrame, given_hz: float, rules: ChatterSettings) -> float:
    """Return the tooth-passing frequency whose harmonics stand out most, near the given one."""
    highest = float(frame.frequency_hz[-1])
    if not 0.0 < given_hz < highest:
        raise StabilityError(
            f"the teeth pass at {given_hz:g} Hz, and the recording reaches {highest:g} Hz; "
            "check speed and teeth, or sample faster"
        )
    orders = np.arange(1, min(HARMONICS_FOR_SPEED, int(highest / (given_hz * (1.0 + rules.speed_tolerance)))) + 1)
    trials = given_hz * np.linspace(1.0 - rules.speed_tolerance, 1.0 + rules.speed_tolerance, 81)
    floor = float(np.median(frame.power_density)) + 1e-300
    level = np.log(frame.power_density + floor)
    score = np.interp(trials[:, None] * orders, frame.frequency_hz, level).sum(axis=1)
    best = score >= score.max() - 1e-9
    return float(trials[best][np.argmin(np.abs(trials[best] - given_hz))])


def _prominence(density: FloatArray, place: int, forced: np.ndarray) -> float:
    around = np.arange(max(place - 18, 1), min(place + 19, len(density)))
    around = around[(np.abs(around - place) > 3) & ~forced[around]]
    floor = float(np.median(density[around])) if len(around) else float(np.median(density))
    whole = float(np.median(density))
    return float(density[place]) / max(floor, 1e-3 * whole, 1e-300)


def _peak_hz(frame: SpectrumFrame, place: int) -> float:
    """Return the frequency of a line between the lines of the spectrum, by a parabola of its logarithm [Hz]."""
    if not 0 < place < len(frame.frequency_hz) - 1:
        return float(frame.frequency_hz[place])
    left, middle, right = np.log(frame.power_density[place - 1 : place + 2] + 1e-300)
    curvature = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / curvature if curvature < 0.0 else 0.0
    return float(frame.frequency_hz[place] + np.clip(shift, -0.5, 0.5) * frame.frequency_hz[1])


def summarise(frames: Sequence[FrameVerdict], settings: ChatterSettings | None = None) -> ChatterVerdict:
    """Return the verdict of several frames in the order of time.

    Without `settings` the defaults say what counts as chatter. Raises StabilityError without a frame.
    """
    if not frames:
        raise StabilityError("no window lies wholly in this part; choose a longer part of the recording")
    rules = settings or ChatterSettings()
    needed = min(rules.frames_in_a_row, len(frames))
    run, first = 0, None
    for number, frame in enumerate(frames):
        run = run + 1 if frame.chatter else 0
        if run == needed and first is None:
            first = number - needed + 1
    shown = [frame for frame in frames if frame.chatter] if first is not None else []
    counted = shown or list(frames)
    ratios = [frame.power / frame.forced_power if frame.forced_power > 0.0 else math.inf for frame in counted]
    loudest = max(shown, key=lambda frame: frame.power) if shown else None
    return ChatterVerdict(
        chatter=first is not None,
        frequency_hz=None if loudest is None else loudest.frequency_hz,
        onset_s=None if first is None else frames[first].time_s,
        share=sum(frame.chatter for frame in frames) / len(frames),
        power_ratio=float(np.median(ratios)),
        tooth_passing_hz=float(np.median([frame.tooth_passing_hz for frame in frames])),
        frames=tuple(frames),
    )


class ChatterMonitor:
    """Judges a stream of samples, window by window, as they arrive.

    It takes what `detect_chatter` does, but for the samples.
    """

    def __init__(
        self, sample_rate_hz: float, speed_rpm: float, teeth: int, settings: ChatterSettings | None = None
    ) -> None:
        self._rate_hz, self._teeth = sample_rate_hz, teeth
        self._rules = settings or ChatterSettings()
        self._length = window_samples(sample_rate_hz)
        self._hop = max(int(self._length * (1.0 - self._rules.overlap)), 1)
        self._speed_rpm = speed_rpm
        self._held = np.zeros(0)
        self._start = 0
        self._run = 0

    @property
    def alarm(self) -> bool:
        """Whether the last frames in a row showed chatter, as many as a verdict needs."""
        return self._run >= self._rules.frames_in_a_row

    def push(self, acceleration_m_s2: FloatArray) -> list[FrameVerdict]:
        """Take samples [m/s^2], any number, and return the verdicts of the windows that they complete.

        Raises StabilityError as `judge_frame`.
        """
        self._held = np.concatenate((self._held, acceleration_m_s2))
        verdicts = []
        while len(self._held) >= self._length:
            frame = _spectrum(self._held[: self._length], self._start, self._rate_hz)
            verdict = judge_frame(frame, self._speed_rpm, self._teeth, self._rules)
            self._run = self._run + 1 if verdict.chatter else 0
            verdicts.append(verdict)
            self._held = self._held[self._hop :]
            self._start += self._hop
        return verdicts


def detect_chatter(
    acceleration_m_s2: FloatArray,
    sample_rate_hz: float,
    speed_rpm: float,
    teeth: int,
    settings: ChatterSettings | None = None,
) -> ChatterVerdict:
    """Judge a whole recording.

    Result: chatter or not, its frequency, and every frame. Raises StabilityError when the recording is too short or
    clipped, or the tooth passing beyond its reach.

    Parameters
    ----------
    acceleration_m_s2
        Shape (n,) [m/s^2].
    sample_rate_hz
        Samples per second [Hz].
    speed_rpm
        Spindle speed [1/min].
    teeth
        Number of teeth.
    settings
        What counts as chatter; None: the defaults.

    """
    check_length(len(acceleration_m_s2), sample_rate_hz, window_samples(sample_rate_hz))
    check_clipping(acceleration_m_s2)
    monitor = ChatterMonitor(sample_rate_hz, speed_rpm, teeth, settings)
    return summarise(monitor.push(acceleration_m_s2), settings)
