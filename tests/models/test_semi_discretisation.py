"""Semi-discretisation: convergence, the case that the zeroth order solves exactly, lobes and charts."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models.errors import StabilityError
from models.stability.collocation import spectral_radii
from models.stability.lobes_sdm import semi_discretised_lobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad, tooth_passing_hz
from models.stability.response import (
    ModalResponse,
    Mode,
    mode_from_mass,
    mode_from_residue,
    mode_from_stiffness,
)
from models.stability.semi_discretisation import (
    chatter_frequency_hz,
    semi_discretisation,
    spectral_radius,
)
from models.stability.state_space import state_space

BENCHMARK = ModalResponse(xx=(mode_from_mass(922.0, 0.011, 0.03993),))
FULL = ModalResponse(
    xx=(mode_from_stiffness(664.0, 0.03, 6e6), mode_from_stiffness(1500.0, 0.02, 2e7)),
    yy=(mode_from_stiffness(601.0, 0.025, 4e6),),
    xy=(mode_from_residue(640.0, 0.03, 1e-6 - 3e-6j),),
    yx=(mode_from_residue(640.0, 0.03, 1e-6 - 3e-6j),),
)


def cut(mode: str, radial_depth_mm: float, teeth: int = 2) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode(mode), radial_depth_mm, 10.0)
    return Cut(teeth=teeth, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=6e8, radial_ratio=1.0 / 3.0)


def radius(response: ModalResponse, case: Cut, speed_rpm: float, depth_mm: float, steps: int, feed: float = 0) -> float:
    method = semi_discretisation(state_space(response, feed), case, steps)
    return float(spectral_radius(method, speed_rpm, np.array([depth_mm]))[0])


@pytest.mark.parametrize(
    ("case", "speed_rpm"),
    [(cut("slot", 10.0), 5000.0), (cut("up", 0.5), 17300.0), (cut("down", 1.0), 5000.0), (cut("up", 5.0), 17300.0)],
)
def test_two_hundred_steps_are_converged(case: Cut, speed_rpm: float) -> None:
    for depth_mm in (0.5, 3.0):
        fine = radius(BENCHMARK, case, speed_rpm, depth_mm, 400)
        assert radius(BENCHMARK, case, speed_rpm, depth_mm, 200) == pytest.approx(fine, abs=1e-3)


def test_the_error_falls_with_the_third_power_of_the_step_or_faster() -> None:
    exact = radius(BENCHMARK, cut("slot", 10.0), 9000.0, 1.0, 480)
    errors = [abs(radius(BENCHMARK, cut("slot", 10.0), 9000.0, 1.0, steps) - exact) for steps in (20, 40, 80)]
    assert errors[0] > 8.0 * errors[1] > 64.0 * errors[2] > 0.0


@pytest.mark.parametrize("feed_deg", [0.0, 20.0])
def test_four_teeth_in_a_slot_are_what_the_zeroth_order_solves_exactly(feed_deg: float) -> None:
    case = cut("slot", 10.0, teeth=4)
    lobes = zeroth_order_lobes(FULL, case, from_rpm=5000.0, to_rpm=14000.0, points=7, feed_deg=feed_deg)
    for speed, limit, chatter in zip(lobes.speed_rpm, lobes.limiting_depth_mm, lobes.chatter_hz, strict=True):
        method = semi_discretisation(state_space(FULL, feed_deg), case, 100)
        assert spectral_radius(method, speed, np.array([limit]))[0] == pytest.approx(1.0, abs=2e-3)
        assert chatter_frequency_hz(method, speed, limit)[0] == pytest.approx(chatter, rel=1e-3)


def test_low_immersion_has_flip_lobes_that_the_zeroth_order_misses() -> None:
    case = cut("down", 1.0)
    found = semi_discretised_lobes(BENCHMARK, case, from_rpm=17900.0, to_rpm=18180.0, points=8)
    averaged = zeroth_order_lobes(BENCHMARK, case, from_rpm=17900.0, to_rpm=18180.0, points=8)
    pairs = zip(found.chatter_hz, found.speed_rpm, strict=True)
    turns = [frequency / tooth_passing_hz(speed, 2) for frequency, speed in pairs]
    assert np.remainder(turns, 1.0) == pytest.approx(0.5, abs=1e-6)  # the vibration repeats every second tooth
    assert found.minimum is not None
    assert averaged.minimum is not None
    assert found.minimum.depth_mm < 0.6 * averaged.minimum.depth_mm


def test_no_island_of_instability_is_missed() -> None:
    """Random cuts of low immersion; every one is looked through at 800 depths, 0.6 % apart."""
    rng = np.random.default_rng(1)
    for _ in range(6):
        case = cut(str(rng.choice(["up", "down"])), float(rng.uniform(0.1, 2.0)))
        speed_rpm = float(rng.uniform(4000.0, 25000.0))
        found = semi_discretised_lobes(BENCHMARK, case, from_rpm=speed_rpm, to_rpm=speed_rpm + 1.0, points=2)
        depths_mm = np.geomspace(0.01 * found.max_depth_mm, found.max_depth_mm, 800)
        radii = spectral_radii(BENCHMARK, case, feed_deg=0.0, speed_rpm=speed_rpm, depths_mm=depths_mm)
        unstable = np.flatnonzero(radii >= 1.0)
        first_mm = float(depths_mm[unstable[0]]) if len(unstable) else np.inf
        assert found.limiting_depth_mm[0] <= 1.01 * first_mm


def test_transition_is_the_exponential() -> None:
    from scipy.linalg import expm

    heavy = Mode(frequency_hz=300.0, damping_ratio=1.4, displacement_gain_per_kg=2.0)
    structure = state_space(ModalResponse(xx=(*FULL.xx, heavy)))
    full = np.zeros((6, 6))
    for i, mode in enumerate(structure.modes):
        angular = mode.angular_rad_s
        full[2 * i, 2 * i + 1] = 1.0
        full[2 * i + 1, 2 * i : 2 * i + 2] = -(angular**2), -2.0 * mode.damping_ratio * angular
    moved = structure.transition(np.array([0.0, 1e-4, 7e-4]))
    scale = np.repeat([[1.0, 1.0 / (2.0 * math.pi * 700.0)]], 3, axis=0).reshape(-1)
    for time_s, found in zip((0.0, 1e-4, 7e-4), moved, strict=True):
        expected = expm(full * time_s)
        assert found * scale[:, None] / scale == pytest.approx(expected * scale[:, None] / scale, abs=1e-9)


def everything(teeth: int = 3) -> Cut:
    pitches = tuple(math.radians(angle) for angle in ((110.0, 130.0, 120.0) if teeth == 3 else (70.0, 110.0) * 2))
    return replace(
        cut("down", 3.0, teeth),
        diameter_m=0.01,
        helix_rad=math.radians(35.0),
        pitch_rad=pitches,
        process_damping_n_per_m=2e4,
    )


@pytest.mark.parametrize("teeth", [3, 4])
def test_helix_pitches_and_damping_converge(teeth: int) -> None:
    for depth_mm in (0.5, 3.0):
        fine = radius(FULL, everything(teeth), 6000.0, depth_mm, 160, 20.0)
        errors = [abs(radius(FULL, everything(teeth), 6000.0, depth_mm, steps, 20.0) - fine) for steps in (20, 40, 80)]
        assert errors[2] < 1e-4
        assert errors[0] > 4.0 * errors[1] > 16.0 * errors[2] > 0.0


def test_lobes_follow_helix_pitches_and_damping() -> None:
    """Each limit is where the radius with more steps is one; straight teeth have others."""
    tool = replace(everything().straight(), teeth=2, pitch_rad=(3.0, 2.0 * math.pi - 3.0), helix_rad=0.6)
    found = semi_discretised_lobes(BENCHMARK, tool, from_rpm=16000.0, to_rpm=17000.0, points=2)
    for speed, limit in zip(found.speed_rpm, found.limiting_depth_mm, strict=True):
        assert radius(BENCHMARK, tool, speed, limit, 80) == pytest.approx(1.0, abs=2e-3)
        assert abs(radius(BENCHMARK, tool.straight(), speed, limit, 80) - 1.0) > 0.01


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pitch_rad": (3.0, 3.0)}, "2 pitches for 3 teeth"),
        ({"pitch_rad": (1.0, 1.0, 1.0)}, "add up to 171.887 deg"),
        ({"helix_rad": 1.5}, "a helix of 85.9437 deg"),
        ({"helix_rad": math.nan}, "a helix of nan deg"),
        ({"process_damping_n_per_m": -1.0}, "process damping of -1 N/m"),
        ({"helix_rad": 0.5, "diameter_m": 0.0}, "need the diameter"),
    ],
)
def test_edges_that_are_none_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(StabilityError, match=words):
        replace(everything(), **change)


def test_refusals() -> None:
    with pytest.raises(StabilityError, match="too few"):
        semi_discretisation(state_space(BENCHMARK), cut("slot", 10.0), 3)
    with pytest.raises(StabilityError, match="above 0"):
        radius(BENCHMARK, cut("slot", 10.0), 9000.0, -1.0, 40)
    with pytest.raises(StabilityError, match="rigid"):
        state_space(ModalResponse())
