"""Semi-discretisation against the time-domain simulation, which share no formula.

`tests/benchmarks/bench_stability.py` runs 500 cases; here are fewer, for shorter.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from milling_cases import random_cases

from drivers.sim.spindle.milling import MillingCuts, arc_of, is_stable, mill
from models.stability.milling import Cut
from models.stability.response import ModalResponse, mode_from_stiffness
from models.stability.semi_discretisation import chatter_frequency_hz, semi_discretisation, spectral_radius
from models.stability.state_space import state_space


@pytest.mark.slow
def test_stable_and_unstable_agree_off_the_boundary() -> None:
    agreed, disagreed, stable = 0, [], 0
    for teeth in (2, 3):
        cases = random_cases(teeth, 12, seed=11)
        same = cases.agree(passings=90, steps_per_passing=160)
        agreed += int(same.sum())
        stable += int((cases.radius < 1.0).sum())
        disagreed += [cases.described[i] for i in np.flatnonzero(~same)]
    assert 6 <= stable <= 18
    assert agreed == 24, disagreed


@pytest.mark.slow
def test_helix_pitches_and_damping_agree_off_the_boundary() -> None:
    cases = random_cases(3, 5, seed=5, beyond=True)
    same = cases.agree(passings=90, steps_per_passing=160)
    assert 1 <= int((cases.radius < 1.0).sum()) <= 4
    assert same.all(), [cases.described[i] for i in np.flatnonzero(~same)]


def benchmark_cut(depth_mm: float, speed_rpm: float, milling: str, radial_mm: float) -> MillingCuts:
    first, last = arc_of(milling, radial_mm * 1e-3, 10e-3)
    return MillingCuts(
        teeth=2,
        speed_rpm=np.array([speed_rpm]),
        axial_depth_m=np.array([depth_mm * 1e-3]),
        first_bearing_rad=np.array([first]),
        last_bearing_rad=np.array([last]),
        tangential_n_per_m2=np.array([6e8]),
        radial_n_per_m2=np.array([2e8]),
        feed_per_tooth_m=np.array([1e-4]),
        feed_direction_rad=np.array([0.0]),
        mode_frequency_hz=np.array([[922.0]]),
        mode_damping_ratio=np.array([[0.011]]),
        mode_stiffness_n_per_m=np.array([[0.03993 * (2.0 * math.pi * 922.0) ** 2]]),
        mode_axis=(0,),
    )


BENCHMARK = ModalResponse(xx=(mode_from_stiffness(922.0, 0.011, 0.03993 * (2.0 * math.pi * 922.0) ** 2),))


def down(radial_mm: float) -> Cut:
    start = math.acos(2.0 * radial_mm / 10.0 - 1.0)
    return Cut(teeth=2, start_rad=start, exit_rad=math.pi, tangential_n_per_m2=6e8, radial_ratio=1.0 / 3.0)


def beside(single: list[MillingCuts]) -> MillingCuts:
    """Return cuts that are simulated together."""
    names = [name for name in MillingCuts.__slots__ if isinstance(getattr(single[0], name), np.ndarray)]
    return replace(single[0], **{name: np.concatenate([getattr(cut, name) for cut in single]) for name in names})


def test_a_stable_cut_fades_with_the_spectral_radius() -> None:
    points = [(18128.0, 0.6), (18500.0, 0.65)]
    both = beside([benchmark_cut(depth_mm, speed_rpm, "down", 1.0) for speed_rpm, depth_mm in points])
    changes, before = [], np.zeros((2, 2))
    for number, sample in enumerate(mill(both, 100, 200), start=1):
        if number % 200 == 0:
            changes.append(np.linalg.norm(sample.displacement_m - before, axis=1))
            before = sample.displacement_m
    faded = np.linalg.norm(changes[80:100], axis=0) / np.linalg.norm(changes[40:60], axis=0)
    method = semi_discretisation(state_space(BENCHMARK), down(1.0), 200)
    for (speed_rpm, depth_mm), rate in zip(points, faded ** (1.0 / 40.0), strict=True):
        radius = spectral_radius(method, speed_rpm, np.array([depth_mm]))[0]
        assert radius < 0.99
        assert rate == pytest.approx(radius, abs=0.003)


def test_a_flip_lobe_vibrates_at_half_the_tooth_passing_frequency() -> None:
    method = semi_discretisation(state_space(BENCHMARK), down(1.0), 80)
    frequency_hz, multiplier = chatter_frequency_hz(method, 18128.0, 0.75)
    passing_hz = 18128.0 * 2 / 60.0
    assert multiplier.imag == 0.0
    assert multiplier.real < -1.0
    assert frequency_hz == pytest.approx(1.5 * passing_hz)
    samples = [s.displacement_m[0, 0] for s in mill(benchmark_cut(1.0, 18128.0, "down", 1.0), 160, 120)]
    tail = np.array(samples[-64 * 120 :])
    spectrum = np.abs(np.fft.rfft(tail - tail.mean()))
    lines_hz = np.fft.rfftfreq(len(tail), 1.0 / (passing_hz * 120))
    off_harmonics = np.abs(lines_hz / passing_hz - np.rint(lines_hz / passing_hz)) > 0.1
    assert lines_hz[off_harmonics][np.argmax(spectrum[off_harmonics])] == pytest.approx(1.5 * passing_hz, rel=0.02)


@pytest.mark.slow
def test_more_depth_than_the_limit_leaves_the_material() -> None:
    cuts = benchmark_cut(1.0, 15962.8, "slot", 10.0)
    forces = np.array([sample.force_n[0] for sample in mill(cuts, 100, 160)])[-1600:]
    assert np.mean(np.all(forces == 0.0, axis=1)) > 0.05
    both = beside([cuts, benchmark_cut(0.25, 15962.8, "slot", 10.0)])
    assert is_stable(both, 100, 160).tolist() == [False, True]
