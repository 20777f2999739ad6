"""Chatter in an accelerometer signal: short-time spectra, forced lines removed, verdict and frequency.

A stable cut shakes the machine at the tooth-passing frequency and its harmonics, and at harmonics of
the spindle's own turn when the teeth run out. Chatter is a narrow line elsewhere. A frame's
strongest line elsewhere counts when it stands out from what surrounds it and is not negligible
beside the strongest forced line; a verdict needs several frames in a row. Lines that the machine has without the cut
(gear mesh, mains) count by what the cut adds to them. Flip chatter, the period-doubling kind, lies half-way between
the harmonics of the tooth passing, with an even number of teeth on harmonics of the turn: it counts when these lines
carry more than the other harmonics of the turn, with two teeth, where there are no others, than runout would explain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.signal_checks import check_clipping, check_length
from models.stability.spectra import OVERLAP, SpectrumFrame, spectrum, window_samples

BoolArray = npt.NDArray[np.bool_]
HARMONICS_FOR_SPEED = 6
LEAST_SPACING = 2.0
"""Harmonics of the tooth passing lie at least so many times apart as is taken out around each."""
SPEED_REMARK = 0.005
"""A spindle speed that differs from the given one by this share is worth a sentence."""
MAINS_HZ, MAINS_ORDERS = (50.0, 60.0), 8
ALWAYS_RUNOUT = 2.5
"""Harmonics below this multiple of the spindle's turn are unbalance, however strong."""
POWER_RATIO = 0.1
"""Power of the line over that of the strongest forced line."""
PROMINENCE = 30.0
"""Power density of the line over the median of its surroundings."""
FRAMES_IN_A_ROW = 3
LOWEST_HZ = 20.0
"""What is slower is no chatter of a spindle [Hz]."""
HALF_WIDTH_LINES = 2.5
"""Forced lines are removed this many lines of the spectrum to both sides."""
HALF_WIDTH_SHARE = 0.0015
"""And at least this share of their frequency."""
SPEED_TOLERANCE = 0.03
"""The true speed is searched within this share of the given one."""
RUNOUT_RATIO = 4.0
"""A line on a harmonic of the spindle's turn needs this power over the strongest tooth-passing line."""
FLIP_RATIO = 5.0
"""Lines half-way between harmonics of the tooth passing need in the mean this power over that of the other
harmonics of the turn."""
FLIP_OF_TWO_RATIO = 0.5
"""With two teeth, where every harmonic of the turn is such a line, this power over the tooth-passing lines'."""
TURN_WIDTH_LINES = 1.25
"""Lines on harmonics of the turn are taken for runout this many lines to both sides."""
TURN_WIDTH_SHARE = 0.0008
"""And at least this share of their frequency."""
STANDING_RATIO = 4.0
"""A line that the machine has without the cut needs this power over what it has there."""
MAINS_RATIO = 0.5
"""A line on a harmonic of the mains needs this power over the strongest tooth-passing line."""


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


def judge_frame(
    frame: SpectrumFrame,
    speed_rpm: float,
    teeth: int,
    machine: FloatArray | None = None,
) -> FrameVerdict:
    """Return the verdict of one window.

    Result: with the strongest line that is not forced, whether it counts or not. Raises StabilityError when the tooth
    passing is above half the sampling rate.

    `frame`: its spectrum. `speed_rpm`: spindle speed [1/min], to within the tolerance. `teeth`: number of teeth.
    `machine`: what the machine has without this cut, from `models.stability.spectra`, shape (n,); None when that is not
    known.
    """
    spacing_hz = float(frame.frequency_hz[1])
    passing_hz = _passing_hz(frame, speed_rpm * teeth / 60.0)
    width_hz = np.maximum(HALF_WIDTH_LINES * spacing_hz, HALF_WIDTH_SHARE * frame.frequency_hz)
    if passing_hz < LEAST_SPACING * 2.0 * HALF_WIDTH_LINES * spacing_hz:
        raise StabilityError(
            f"at {speed_rpm:g} 1/min the teeth pass at {passing_hz:.3g} Hz, and lines of a spectrum are "
            f"{spacing_hz:.3g} Hz apart: between so many harmonics chatter cannot be told from the cut"
        )
    forced = _on_multiples(frame.frequency_hz, passing_hz, width_hz)
    turn_hz = passing_hz / teeth
    turn_width_hz = np.maximum(TURN_WIDTH_LINES * spacing_hz, TURN_WIDTH_SHARE * frame.frequency_hz)
    turning = _on_multiples(frame.frequency_hz, turn_hz, turn_width_hz) & ~forced
    high_enough = frame.frequency_hz >= LOWEST_HZ
    density = frame.power_density
    power = np.convolve(density, np.ones(5), mode="same") * spacing_hz
    forced_power = float(power[forced & high_enough].max(initial=0.0))
    runout = frame.frequency_hz < ALWAYS_RUNOUT * turn_hz
    of_turn = turning & (runout | (power < RUNOUT_RATIO * forced_power))
    if teeth % 2 == 0:
        of_turn &= ~_flip(frame.frequency_hz, power, passing_hz, teeth)
    counted = high_enough & ~forced & ~of_turn
    counted &= ~(_of_mains(frame.frequency_hz) & (power < MAINS_RATIO * forced_power))
    if machine is not None:
        counted &= density > STANDING_RATIO * machine
    own = np.convolve(np.where(counted, density, 0.0), np.ones(5), mode="same") * spacing_hz
    crest = np.concatenate(([False], (density[1:-1] >= density[:-2]) & (density[1:-1] >= density[2:]), [False]))
    place = int(np.argmax(np.where(counted & crest, density, 0.0)))
    prominence = _prominence(frame.power_density, place, forced)
    return FrameVerdict(
        time_s=frame.time_s,
        chatter=bool(prominence >= PROMINENCE and own[place] >= POWER_RATIO * forced_power),
        frequency_hz=_peak_hz(frame, place),
        power=float(own[place]),
        forced_power=forced_power,
        prominence=prominence,
        tooth_passing_hz=passing_hz,
    )


def _flip(frequency_hz: FloatArray, power: FloatArray, passing_hz: float, teeth: int) -> BoolArray:
    """Return which lines are flip chatter, on harmonics of the turn half-way between those of the tooth passing."""
    orders = np.arange(1, int(float(frequency_hz[-1]) * teeth / passing_hz) + 1)
    middles = np.rint(orders * passing_hz / teeth / float(frequency_hz[1])).astype(np.intp)
    near = np.clip(middles[:, None] + np.arange(-2, 3), 0, len(power) - 1)
    strongest = power[near].max(axis=1)
    half, tooth = orders % teeth == teeth // 2, orders % teeth == 0
    if teeth == 2:  # runout lies on the same lines
        needed = FLIP_OF_TWO_RATIO * float(strongest[tooth].mean())
    else:
        needed = FLIP_RATIO * float(strongest[~half & ~tooth].mean())
    flips: BoolArray = np.zeros(len(power), dtype=np.bool_)
    if half.any() and float(strongest[half].mean()) >= needed:
        flips[near[half].ravel()] = True
    return flips


def _of_mains(frequency_hz: FloatArray) -> BoolArray:
    """Return which lines of a spectrum hold a harmonic of the mains."""
    spacing_hz = float(frequency_hz[1])
    on: BoolArray = np.zeros(len(frequency_hz), dtype=np.bool_)
    for mains_hz in MAINS_HZ:
        order = np.maximum(np.rint(frequency_hz / mains_hz), 1.0)
        near = np.abs(frequency_hz - order * mains_hz) <= 0.75 * spacing_hz
        on |= near & (order <= MAINS_ORDERS)
    return on


def _on_multiples(frequency_hz: FloatArray, base_hz: float, width_hz: FloatArray) -> BoolArray:
    orders = np.maximum(np.rint(frequency_hz / base_hz), 1.0)
    on: BoolArray = np.abs(frequency_hz - orders * base_hz) <= width_hz
    return on


def _passing_hz(frame: SpectrumFrame, given_hz: float) -> float:
    """Return the tooth-passing frequency whose harmonics stand out most, near the given one."""
    highest = float(frame.frequency_hz[-1])
    if not 0.0 < given_hz * (1.0 + SPEED_TOLERANCE) < highest:
        raise StabilityError(
            f"the teeth pass at {given_hz:g} Hz, and the recording reaches {highest:g} Hz; "
            "check speed and teeth, or sample faster"
        )
    orders = np.arange(1, min(HARMONICS_FOR_SPEED, int(highest / (given_hz * (1.0 + SPEED_TOLERANCE)))) + 1)
    reach_hz = SPEED_TOLERANCE * given_hz * orders[-1]
    steps = 2 * math.ceil(reach_hz / (0.25 * float(frame.frequency_hz[1]))) + 1
    trials = given_hz * np.linspace(1.0 - SPEED_TOLERANCE, 1.0 + SPEED_TOLERANCE, steps)
    floor = float(np.median(frame.power_density)) + 1e-300
    level = np.log(frame.power_density + floor)
    score = np.interp(trials[:, None] * orders, frame.frequency_hz, level).sum(axis=1)
    best = score >= score.max() - 1e-9
    return float(trials[best][np.argmin(np.abs(trials[best] - given_hz))])


def _prominence(density: FloatArray, place: int, forced: BoolArray) -> float:
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


def summarise(frames: Sequence[FrameVerdict]) -> ChatterVerdict:
    """Return the verdict of several frames in the order of time; raises StabilityError without a frame."""
    if not frames:
        raise StabilityError("no window lies wholly in this part; choose a longer part of the recording")
    needed = min(FRAMES_IN_A_ROW, len(frames))
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


def speed_warning(verdict: ChatterVerdict, speed_rpm: float, teeth: int) -> str | None:
    """Return what the recording says against the given spindle speed [1/min] and number of teeth, None for nothing."""
    found_rpm = verdict.tooth_passing_hz * 60.0 / teeth
    off = found_rpm / speed_rpm - 1.0
    if abs(off) >= 0.95 * SPEED_TOLERANCE:
        return (
            f"the teeth seem to pass at {verdict.tooth_passing_hz:.1f} Hz ({found_rpm:.0f} 1/min), at the edge of what "
            f"is searched around {speed_rpm:g} 1/min: check speed and teeth; the verdict may be wrong"
        )
    if abs(off) > SPEED_REMARK:
        return f"the recording shows {found_rpm:.0f} 1/min, {100.0 * off:+.1f} % from the given {speed_rpm:g} 1/min"
    return None


class ChatterMonitor:
    """Judges a stream of samples, window by window, as they arrive.

    It takes what `detect_chatter` does, but for the samples.
    """

    def __init__(
        self,
        sample_rate_hz: float,
        speed_rpm: float,
        teeth: int,
        machine: FloatArray | None = None,
    ) -> None:
        self._machine = machine
        self._rate_hz, self._teeth = sample_rate_hz, teeth
        self._length = window_samples(sample_rate_hz)
        self._hop = max(int(self._length * (1.0 - OVERLAP)), 1)
        self._speed_rpm = speed_rpm
        self._held = np.zeros(0)
        self._start = 0
        self._run = 0

    @property
    def alarm(self) -> bool:
        """Whether the last frames in a row showed chatter, as many as a verdict needs."""
        return self._run >= FRAMES_IN_A_ROW

    def push(self, acceleration_m_s2: FloatArray) -> list[FrameVerdict]:
        """Take samples [m/s^2], any number, and return the verdicts of the windows that they complete.

        Raises StabilityError as `judge_frame`.
        """
        self._held = np.concatenate((self._held, acceleration_m_s2))
        verdicts = []
        while len(self._held) >= self._length:
            frame = spectrum(self._held[: self._length], self._start, self._rate_hz)
            verdict = judge_frame(frame, self._speed_rpm, self._teeth, self._machine)
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
    machine: FloatArray | None = None,
) -> ChatterVerdict:
    """Judge a whole recording.

    Result: chatter or not, its frequency, and every frame. Raises StabilityError when the recording is too short or
    clipped, or the tooth passing beyond its reach.

    `acceleration_m_s2`: shape (n,) [m/s^2]. `sample_rate_hz`: samples per second [Hz]. `speed_rpm`: spindle speed
    [1/min]. `teeth`: number of teeth. `machine`: see `judge_frame`.
    """
    check_length(len(acceleration_m_s2), sample_rate_hz, window_samples(sample_rate_hz))
    check_clipping(acceleration_m_s2)
    monitor = ChatterMonitor(sample_rate_hz, speed_rpm, teeth, machine)
    return summarise(monitor.push(acceleration_m_s2))
