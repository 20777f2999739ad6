"""Synthesised accelerometer recordings of milling, stable or with chatter, with what disturbs a verdict in a shop.

Every level is an rms over that of the forced vibration. Seeds of the tuning half are even, of the judging half odd.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray
from models.stability.chatter import detect_chatter
from models.stability.spectra import machine_spectrum, standing_spectrum

MAINS_HZ = 50.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One kind of recording."""

    name: str
    chatter: bool
    rates_hz: tuple[float, ...] = (6400.0, 12800.0)
    speed_off: float = 0.0
    """The true speed is that share above or below the given one."""
    gear: float = 0.0
    mains: float = 0.0
    flip: bool = False
    sidebands: bool = True
    idle: bool = False
    """Whether the spindle was recorded turning without a cut, too."""
    late: bool = False
    teeth: tuple[int, ...] = (2, 3, 4, 6)


ROWS = (
    Row(name="stable", chatter=False),
    Row(name="stable, speed 0.5 % off", chatter=False, speed_off=0.005),
    Row(name="stable, speed 1 % off", chatter=False, speed_off=0.01),
    Row(name="stable, speed 2 % off", chatter=False, speed_off=0.02),
    Row(name="stable, sampled at 2560 Hz", chatter=False, rates_hz=(2560.0,)),
    Row(name="stable, one tooth", chatter=False, teeth=(1,)),
    Row(name="stable, gear mesh 0.3, idle recording", chatter=False, gear=0.3, idle=True),
    Row(name="stable, mains hum 0.2", chatter=False, mains=0.2),
    Row(name="stable, mains hum 0.2, idle recording", chatter=False, mains=0.2, idle=True),
    Row(name="chatter", chatter=True),
    Row(name="chatter, no sidebands", chatter=True, sidebands=False),
    Row(name="chatter, speed 1 % off", chatter=True, speed_off=0.01),
    Row(name="chatter, speed 2 % off", chatter=True, speed_off=0.02),
    Row(name="chatter, sampled at 2560 Hz", chatter=True, rates_hz=(2560.0,)),
    Row(name="chatter, one tooth", chatter=True, teeth=(1,)),
    Row(name="chatter from the middle on", chatter=True, late=True),
    Row(name="chatter, gear mesh 0.3, idle recording", chatter=True, gear=0.3, idle=True),
    Row(name="chatter, mains hum 0.2", chatter=True, mains=0.2),
    Row(name="flip chatter", chatter=True, flip=True),
    Row(name="flip chatter, odd teeth", chatter=True, flip=True, teeth=(1, 3, 5)),
)

IN_DEPTHS = (
    Row(name="stable, gear mesh 0.3", chatter=False, gear=0.3),
    Row(name="chatter, gear mesh 0.3", chatter=True, gear=0.3),
    Row(name="chatter", chatter=True),
)
"""Each as a cut at three growing depths, without a recording of the idle spindle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CutRecording:
    """A recording and what is true of it."""

    acceleration_m_s2: FloatArray
    idle_m_s2: FloatArray | None
    sample_rate_hz: float
    given_rpm: float
    true_rpm: float
    teeth: int
    chatter_hz: float | None


def recording(row: Row, seed: int) -> CutRecording:
    """Return one recording of a row."""
    draw = np.random.default_rng([seed, *row.name.removesuffix(", idle recording").encode()])
    rate_hz = float(draw.choice(row.rates_hz))
    teeth = int(draw.choice(row.teeth))
    passing_hz = float(draw.uniform(60.0, min(0.2 * rate_hz, 800.0)))
    true_rpm = passing_hz / teeth * 60.0
    given_rpm = true_rpm / (1.0 + row.speed_off * float(draw.choice([-1.0, 1.0])))
    seconds = float(draw.uniform(3.0, 6.0))
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    turn = _turn(time_s, true_rpm / 60.0, draw)
    cut = _forced(time_s, turn, teeth, rate_hz, draw)
    cut /= np.sqrt(np.mean(cut**2))
    own = _own_noise(len(time_s), rate_hz, draw)
    standing = _standing(row, true_rpm / 60.0, draw)
    signal = cut + own + standing(time_s)
    scale = float(draw.uniform(0.5, 20.0))
    chatter_hz = None
    if row.chatter:
        chatter_hz, line = _chatter(row, time_s, turn, teeth, rate_hz, draw)
        signal = signal + line
    idle = None
    if row.idle:
        rest_s = np.arange(round(3.0 * rate_hz)) / rate_hz
        runout = 0.1 * np.sin(2.0 * math.pi * _turn(rest_s, true_rpm / 60.0, draw))
        idle = runout + 0.5 * _own_noise(len(rest_s), rate_hz, draw) + float(draw.uniform(0.8, 1.2)) * standing(rest_s)
    return CutRecording(
        acceleration_m_s2=scale * signal,
        idle_m_s2=None if idle is None else scale * idle,
        sample_rate_hz=rate_hz,
        given_rpm=given_rpm,
        true_rpm=true_rpm,
        teeth=teeth,
        chatter_hz=chatter_hz,
    )


def _turn(time_s: FloatArray, turn_hz: float, draw: np.random.Generator) -> FloatArray:
    """Return the spindle's angle [turns]; its speed sways by up to 0.05 %."""
    sway_hz, share = float(draw.uniform(0.1, 1.0)), float(draw.uniform(0.0, 5e-4))
    return turn_hz * (time_s + share * np.sin(2.0 * math.pi * sway_hz * time_s) / (2.0 * math.pi * sway_hz))


def _forced(time_s: FloatArray, turn: FloatArray, teeth: int, rate_hz: float, draw: np.random.Generator) -> FloatArray:
    """Return tooth passing and runout; what the structure does to every line is drawn."""
    turn_hz = float(turn[-1] / time_s[-1])
    runout = float(draw.uniform(0.0, 0.5))
    wave = np.zeros(len(time_s))
    for order in range(1, min(int(0.45 * rate_hz / turn_hz), 12 * teeth) + 1):
        harmonic = order / teeth
        level = (1.0 if order % teeth == 0 else runout * float(draw.uniform(0.2, 1.0))) / max(harmonic, 1.0) ** 1.2
        wave += level * float(draw.lognormal(0.0, 0.5)) * np.sin(2.0 * math.pi * (order * turn + draw.uniform()))
    return wave


def _own_noise(samples: int, rate_hz: float, draw: np.random.Generator) -> FloatArray:
    """Return white noise with two broad resonances."""
    white = draw.normal(size=samples)
    frequency_hz = np.fft.rfftfreq(samples, 1.0 / rate_hz)
    gain = np.ones(len(frequency_hz))
    for _ in range(2):
        centre_hz, damping = float(draw.uniform(100.0, 0.4 * rate_hz)), float(draw.uniform(0.02, 0.08))
        ratio = frequency_hz / centre_hz
        gain += 0.5 / np.hypot(1.0 - ratio**2, 2.0 * damping * ratio)
    noise = np.fft.irfft(np.fft.rfft(white) * gain, samples)
    scaled: FloatArray = noise / noise.std() * float(draw.uniform(0.02, 0.4))
    return scaled


def _standing(row: Row, turn_hz: float, draw: np.random.Generator) -> Callable[[FloatArray], FloatArray]:
    """Return a function of time: lines of the machine itself."""
    mesh_hz = turn_hz * float(draw.uniform(2.2, 9.0)) * float(draw.choice([17.0, 23.0, 31.0])) / 19.0
    phases = draw.uniform(0.0, 2.0 * math.pi, size=4)
    shares = np.array([1.0, draw.uniform(0.0, 0.5), draw.uniform(0.0, 0.5)])

    def lines(time_s: FloatArray) -> FloatArray:
        wave = row.gear * math.sqrt(2.0) * np.sin(2.0 * math.pi * mesh_hz * time_s + phases[0])
        for order, share, phase in zip((1, 2, 3), shares, phases[1:], strict=True):
            wave = wave + row.mains * math.sqrt(2.0) * share * np.sin(2.0 * math.pi * order * MAINS_HZ * time_s + phase)
        return np.asarray(wave)

    return lines


def _chatter(
    row: Row, time_s: FloatArray, turn: FloatArray, teeth: int, rate_hz: float, draw: np.random.Generator
) -> tuple[float, FloatArray]:
    """Return the chatter frequency [Hz] and its vibration, with what the tooth passing makes of it."""
    passing_hz = float(turn[-1] / time_s[-1]) * teeth
    level = float(draw.uniform(0.5, 3.0))
    phase = float(draw.uniform(0.0, 2.0 * math.pi))
    if row.flip:
        orders = np.arange(int(0.45 * rate_hz / passing_hz))
        strongest = int(draw.integers(0, max(min(len(orders), 4), 1)))
        levels = 0.35 ** np.abs(orders - strongest)
        levels *= level / np.linalg.norm(levels)
        wave = sum(
            one * math.sqrt(2.0) * np.sin(2.0 * math.pi * (order + 0.5) * teeth * turn + phase * (order + 1))
            for order, one in zip(orders, levels, strict=True)
        )
        return (strongest + 0.5) * passing_hz, _grown(row, time_s, np.asarray(wave), draw)
    while True:
        chatter_hz = float(draw.uniform(150.0, min(0.45 * rate_hz, 2500.0)))
        away = chatter_hz / passing_hz
        from_tooth, from_turn = (abs(x - round(x)) for x in (away, away * teeth))
        if from_tooth * passing_hz > 6.0 and from_turn * passing_hz / teeth > 2.5:
            break
    wander = 2e-4 * chatter_hz * np.cumsum(draw.normal(size=len(time_s))) / math.sqrt(rate_hz) / rate_hz
    angle = 2.0 * math.pi * (chatter_hz * time_s + wander) + phase
    wave = np.sin(angle)
    if row.sidebands:
        for order in (-2, -1, 1, 2):
            side = float(draw.uniform(0.05, 0.5)) / abs(order)
            if 0.0 < chatter_hz + order * passing_hz < 0.45 * rate_hz:
                wave = wave + side * np.sin(angle + 2.0 * math.pi * order * teeth * turn + draw.uniform(0.0, 6.0))
    return chatter_hz, _grown(row, time_s, level * wave / wave.std(), draw)


def _grown(row: Row, time_s: FloatArray, wave: FloatArray, draw: np.random.Generator) -> FloatArray:
    if not row.late:
        return wave
    onset_s = float(draw.uniform(0.4, 0.6)) * float(time_s[-1])
    return wave / (1.0 + np.exp(-(time_s - onset_s) / 0.05))


def three_depths(row: Row, seed: int) -> tuple[list[FloatArray], CutRecording, list[bool]]:
    """Return a cut at three growing depths, what is true of all of them, and at which it chatters.

    What the cut makes grows with the depth; what the machine makes does not.
    """
    draw = np.random.default_rng([seed, 7])
    chatters_from = int(draw.integers(0, 3)) if row.chatter else 3
    made: list[CutRecording] = []
    standing: list[FloatArray] = []
    quiet = replace(row, chatter=False)
    for place in range(3):
        made.append(recording(row if place >= chatters_from else quiet, seed))
        still = recording(replace(quiet, gear=0.0, mains=0.0), seed)
        standing.append(recording(quiet, seed).acceleration_m_s2 - still.acceleration_m_s2)
    parts = [
        (1.0, 1.5, 2.2)[place] * (one.acceleration_m_s2 - still) + still
        for place, (one, still) in enumerate(zip(made, standing, strict=True))
    ]
    noise = np.random.default_rng([seed, 8])
    parts = [part + 0.02 * part.std() * noise.normal(size=len(part)) for part in parts]
    return parts, made[-1], [place >= chatters_from for place in range(3)]


def wrong(row: Row, seed: int) -> bool:
    """Return whether the verdict on one recording is not what is true."""
    cut = recording(row, seed)
    machine = None if cut.idle_m_s2 is None else machine_spectrum(cut.idle_m_s2, cut.sample_rate_hz)
    verdict = detect_chatter(cut.acceleration_m_s2, cut.sample_rate_hz, cut.given_rpm, cut.teeth, machine=machine)
    return verdict.chatter != row.chatter


def wrong_in_depths(row: Row, seed: int) -> tuple[int, int, int, int]:
    """Return how many of three depths are wrongly called chatter, how many missed, and how many there are of each."""
    parts, cut, truths = three_depths(row, seed)
    machine = standing_spectrum(parts, cut.sample_rate_hz)
    found = [
        detect_chatter(part, cut.sample_rate_hz, cut.given_rpm, cut.teeth, machine=machine).chatter for part in parts
    ]
    false = sum(said and not true for said, true in zip(found, truths, strict=True))
    missed = sum(true and not said for said, true in zip(found, truths, strict=True))
    return false, missed, truths.count(False), truths.count(True)
