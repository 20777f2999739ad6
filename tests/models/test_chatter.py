"""Chatter in made-up and in simulated signals."""

import math

import numpy as np
import pytest
from cut_recordings import IN_DEPTHS, ROWS, Row, wrong, wrong_in_depths

from drivers.sim.spindle.milling import MillingCuts, arc_of, mill
from models.errors import StabilityError
from models.records import FloatArray
from models.stability.chatter import (
    ChatterMonitor,
    detect_chatter,
    speed_warning,
    summarise,
)

RATE_HZ = 6400.0
RNG = np.random.default_rng(8)


def forced(speed_rpm: float, seconds: float, teeth: int = 4, runout: float = 0.3, noise: float = 0.3) -> FloatArray:
    """A stable cut: tooth-passing harmonics, runout at the spindle's harmonics, noise."""
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    passing, turn = speed_rpm * teeth / 60.0, speed_rpm / 60.0
    signal = noise * RNG.normal(size=len(time_s))
    for order in range(1, 6):
        signal += 2.0 / order * np.sin(2.0 * np.pi * order * passing * time_s + order)
    for order in (1, 2, 3, 5):
        signal += runout * np.sin(2.0 * np.pi * order * turn * time_s + 2.0 * order)
    return signal


def tone(frequency_hz: float, seconds: float, amplitude: float) -> FloatArray:
    return amplitude * np.sin(2.0 * np.pi * frequency_hz * np.arange(round(seconds * RATE_HZ)) / RATE_HZ)


@pytest.mark.parametrize("speed_rpm", [1500.0, 6000.0, 7000.0, 11987.0])
def test_forced_vibration_is_no_chatter(speed_rpm: float) -> None:
    verdict = detect_chatter(forced(speed_rpm, 4.0, runout=1.0), RATE_HZ, speed_rpm, 4)
    assert not verdict.chatter
    assert verdict.frequency_hz is None
    assert verdict.tooth_passing_hz == pytest.approx(speed_rpm / 15.0, rel=1e-3)


@pytest.mark.parametrize(
    ("speed_rpm", "chatter_hz"), [(6000.0, 609.0), (7000.0, 655.3), (6000.0, 1310.7), (9000.0, 618.0)]
)
@pytest.mark.parametrize("amplitude", [1.0, 5.0])
def test_a_line_elsewhere_is_chatter(speed_rpm: float, chatter_hz: float, amplitude: float) -> None:
    verdict = detect_chatter(forced(speed_rpm, 4.0) + tone(chatter_hz, 4.0, amplitude), RATE_HZ, speed_rpm, 4)
    assert verdict.chatter
    assert verdict.frequency_hz == pytest.approx(chatter_hz, abs=0.5)


def test_noise_alone_and_a_resonance_in_noise_are_no_chatter() -> None:
    noise = RNG.normal(size=int(8 * RATE_HZ))
    assert not detect_chatter(noise, RATE_HZ, 6000.0, 4).chatter
    ringing = np.zeros(len(noise))
    angular, damping = 2.0 * math.pi * 650.0 / RATE_HZ, 0.03
    for i in range(2, len(noise)):
        ringing[i] = (
            2.0 * math.exp(-damping * angular) * math.cos(angular) * ringing[i - 1]
            - math.exp(-2.0 * damping * angular) * ringing[i - 2]
            + noise[i]
        )
    assert not detect_chatter(ringing + 50.0 * forced(6000.0, 8.0, noise=0.0), RATE_HZ, 6000.0, 4).chatter


def test_onset_and_share_follow_the_signal() -> None:
    signal = forced(6000.0, 8.0)
    signal[int(4 * RATE_HZ) :] += tone(609.0, 4.0, 3.0)
    verdict = detect_chatter(signal, RATE_HZ, 6000.0, 4)
    assert verdict.onset_s == pytest.approx(4.0, abs=0.35)
    assert verdict.share == pytest.approx(0.5, abs=0.1)


def test_the_monitor_says_the_same_whatever_the_pieces() -> None:
    signal = forced(6000.0, 5.0) + tone(609.0, 5.0, 1.5)
    whole = detect_chatter(signal, RATE_HZ, 6000.0, 4)
    monitor = ChatterMonitor(RATE_HZ, 6000.0, 4)
    frames, place = [], 0
    while place < len(signal):
        size = int(RNG.integers(1, 900))
        frames += monitor.push(signal[place : place + size])
        place += size
    assert monitor.alarm
    assert summarise(frames) == whole


def test_the_simulated_cut_is_judged_as_it_is() -> None:
    first, last = arc_of("slot", 10e-3, 10e-3)
    speed_rpm, steps, seconds = 15962.8, 50, 1.2
    both = np.ones(2)
    cuts = MillingCuts(
        teeth=2,
        speed_rpm=speed_rpm * both,
        axial_depth_m=np.array([0.25e-3, 0.6e-3]),
        first_bearing_rad=first * both,
        last_bearing_rad=last * both,
        tangential_n_per_m2=6e8 * both,
        radial_n_per_m2=2e8 * both,
        feed_per_tooth_m=1e-4 * both,
        feed_direction_rad=0.0 * both,
        mode_frequency_hz=np.full((2, 1), 922.0),
        mode_damping_ratio=np.full((2, 1), 0.011),
        mode_stiffness_n_per_m=np.full((2, 1), 0.03993 * (2.0 * math.pi * 922.0) ** 2),
        mode_axis=(0,),
    )
    passing_hz = speed_rpm * 2 / 60.0
    raw = np.array([sample.acceleration_m_s2[:, 0] for sample in mill(cuts, round(seconds * passing_hz), steps)])
    times = np.arange(int(0.4 * RATE_HZ), int(seconds * RATE_HZ)) / RATE_HZ
    for series, expected in zip(raw.T, (False, True), strict=True):
        smooth = np.convolve(series, np.ones(4) / 4.0, mode="same")
        signal = np.interp(times, np.arange(1, len(raw) + 1) / (passing_hz * steps), smooth)
        verdict = detect_chatter(signal, RATE_HZ, speed_rpm, 2)
        assert verdict.chatter is expected
        if verdict.frequency_hz is not None:
            aliases = np.abs(verdict.frequency_hz - 922.0 + passing_hz * np.arange(-5, 6))
            assert aliases.min() < 40.0


def test_short_clipped_and_unreachable_recordings_are_refused() -> None:
    with pytest.raises(StabilityError, match=r"100 samples.*record longer"):
        detect_chatter(np.zeros(100), RATE_HZ, 6000.0, 4)
    for rate_hz in (1.0, 2.0):  # times that count the samples
        with pytest.raises(StabilityError, match=r"are the times of the recording in s"):
            detect_chatter(forced(6000.0, 2.0), rate_hz, 6000.0, 4)
    with pytest.raises(StabilityError, match="clipped"):
        detect_chatter(np.clip(forced(6000.0, 2.0), -2.0, 2.0), RATE_HZ, 6000.0, 4)
    with pytest.raises(StabilityError, match="check speed and teeth"):
        detect_chatter(forced(6000.0, 2.0), RATE_HZ, 60000.0, 4)
    with pytest.raises(StabilityError, match="no window"):
        summarise([])


@pytest.mark.parametrize("scale", [1e-200, 1e160, 1e307])
def test_a_scale_that_no_accelerometer_has_is_refused_without_a_warning(scale: float) -> None:
    with pytest.raises(StabilityError, match="which no accelerometer reads"):
        detect_chatter(scale * forced(6000.0, 2.0), RATE_HZ, 6000.0, 4)


@pytest.mark.parametrize("level", [0.0, 3.5])
def test_a_dead_accelerometer_is_no_verdict(level: float) -> None:
    with pytest.raises(StabilityError, match="check the sensor"):
        detect_chatter(np.full(12800, level), 6400.0, 6000.0, 2)


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_the_verdict_is_right_on_recordings_that_nothing_was_chosen_on(row: Row) -> None:
    """5 % of ten, rounded up; even seeds were chosen on. tests/benchmarks/bench_chatter.py makes the whole table."""
    assert sum(wrong(row, seed) for seed in range(1, 21, 2)) <= 1


@pytest.mark.parametrize("row", IN_DEPTHS, ids=[row.name for row in IN_DEPTHS])
def test_what_stands_still_between_depths_is_no_chatter(row: Row) -> None:
    false, missed, stable, chattering = (
        sum(each) for each in zip(*(wrong_in_depths(row, seed) for seed in range(1, 9, 2)), strict=True)
    )
    assert false <= math.ceil(0.05 * stable)
    assert missed <= math.ceil(0.05 * chattering)


def test_a_speed_that_the_recording_contradicts_is_said() -> None:
    signal = forced(6000.0, 3.0)
    assert speed_warning(detect_chatter(signal, RATE_HZ, 6010.0, 4), 6010.0, 4) is None
    off = speed_warning(detect_chatter(signal, RATE_HZ, 5880.0, 4), 5880.0, 4)
    assert off is not None and "shows 6000 1/min, +2.0 %" in off
    lost = speed_warning(detect_chatter(signal, RATE_HZ, 5810.0, 4), 5810.0, 4)
    assert lost is not None and "check speed and teeth" in lost
