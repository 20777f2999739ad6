"""Random milling cases for the stability library and for the time-domain referee, from one seed.

Two modes, one along X and one along Y; one to four teeth; any engagement, immersion and feed
direction. The depth is drawn where the spectral radius is off 1 by more than `OFF_BOUNDARY`, half of
the cases stable, because within a few per cent the referee would have to run for very long.
"""

import math
from dataclasses import dataclass

import numpy as np

from drivers.sim.spindle.milling import MillingCuts, arc_of, is_stable
from models.records import FloatArray
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, mode_from_stiffness
from models.stability.semi_discretisation import default_steps, semi_discretisation, spectral_radius
from models.stability.state_space import state_space

OFF_BOUNDARY = 0.03
NEAR = 0.4
DIAMETER_MM = 10.0
DEPTHS_MM = np.geomspace(0.01, 30.0, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomCases:
    cuts: MillingCuts
    radius: FloatArray
    """Spectral radius by semi-discretisation."""
    described: tuple[str, ...]

    def agree(self, passings: int, steps_per_passing: int) -> np.ndarray:
        return is_stable(self.cuts, passings, steps_per_passing) == (self.radius < 1.0)


UNEVEN = {2: (160.0, 200.0), 3: (110.0, 135.0, 115.0), 4: (80.0, 95.0, 85.0, 100.0)}
"""Pitches of the tools that have helix and process damping, too [deg]."""
SLICES = 12


def random_cases(teeth: int, count: int, seed: int, *, beyond: bool = False) -> RandomCases:
    """Return cases; `beyond`: of tools with a helix, uneven pitches and process damping.

    These keep contact: where uneven teeth vibrate so much that one cuts nothing, the others may repeat their motion
    turn by turn, which the linear theory does not know.
    """
    own = np.random.default_rng([seed, teeth, 1])
    helix_rad = np.radians(own.uniform(15.0, 50.0, count)) * beyond
    damping_n_per_m = np.exp(own.uniform(math.log(2e3), math.log(3e4), count)) * beyond
    pitch_rad = tuple(math.radians(pitch) for pitch in UNEVEN[teeth]) if beyond else ()
    rng = np.random.default_rng([seed, teeth])
    milling = rng.choice(["up", "down", "slot"], count).tolist()
    radial_mm = np.where(np.array(milling) == "slot", 1.0, rng.uniform(0.05, 0.95, count)) * DIAMETER_MM
    speed_rpm = rng.uniform(5000.0, 40000.0, count) / teeth
    frequency_hz = rng.uniform(500.0, 1000.0, (count, 2))
    damping = rng.uniform(0.01, 0.05, (count, 2))
    stiffness = np.exp(rng.uniform(math.log(2e6), math.log(2e7), (count, 2)))
    tangential = rng.uniform(2e8, 1e9, count)
    ratio = rng.uniform(0.1, 0.5, count)
    feed_deg = rng.uniform(0.0, 360.0, count)
    depth_mm, radius = np.zeros(count), np.zeros(count)
    for i in range(count):
        start_rad, exit_rad = engagement_rad(MillingMode(milling[i]), radial_mm[i], DIAMETER_MM)
        cut = Cut(
            teeth=teeth,
            start_rad=start_rad,
            exit_rad=exit_rad,
            tangential_n_per_m2=tangential[i],
            radial_ratio=ratio[i],
            diameter_m=DIAMETER_MM * 1e-3,
            helix_rad=helix_rad[i],
            pitch_rad=pitch_rad,
            process_damping_n_per_m=damping_n_per_m[i],
        )
        along_x = mode_from_stiffness(frequency_hz[i, 0], damping[i, 0], stiffness[i, 0])
        along_y = mode_from_stiffness(frequency_hz[i, 1], damping[i, 1], stiffness[i, 1])
        structure = state_space(ModalResponse(xx=(along_x,), yy=(along_y,)), feed_deg[i])
        method = semi_discretisation(structure, cut, default_steps(structure, cut, speed_rpm[i]))
        depth_mm[i], radius[i] = drawn(rng, spectral_radius(method, speed_rpm[i], DEPTHS_MM))
    arcs = np.array(
        [arc_of(way, depth * 1e-3, DIAMETER_MM * 1e-3) for way, depth in zip(milling, radial_mm, strict=True)]
    )
    return RandomCases(
        cuts=MillingCuts(
            teeth=teeth,
            speed_rpm=speed_rpm,
            axial_depth_m=depth_mm * 1e-3,
            first_bearing_rad=arcs[:, 0],
            last_bearing_rad=arcs[:, 1],
            tangential_n_per_m2=tangential,
            radial_n_per_m2=ratio * tangential,
            feed_per_tooth_m=np.full(count, 5e-5),
            feed_direction_rad=np.radians(feed_deg),
            mode_frequency_hz=frequency_hz,
            mode_damping_ratio=damping,
            mode_stiffness_n_per_m=stiffness,
            mode_axis=(0, 1),
            helix_lag_rad=2e-3 * depth_mm * np.tan(helix_rad) / (DIAMETER_MM * 1e-3) if beyond else None,
            slices=SLICES if beyond else 1,
            pitch_rad=pitch_rad,
            keeps_contact=beyond,
            damping_n_s_per_m=damping_n_per_m * depth_mm / (math.pi * DIAMETER_MM * speed_rpm / 60.0)
            if beyond
            else None,
        ),
        radius=radius,
        described=tuple(
            f"{teeth} teeth, {milling[i]}, a_e {radial_mm[i]:.2f} mm, {speed_rpm[i]:.0f} 1/min, "
            f"{depth_mm[i]:.3f} mm: radius {radius[i]:.3f}"
            for i in range(count)
        ),
    )


def drawn(rng: np.random.Generator, radii: FloatArray) -> tuple[float, float]:
    """Return a depth and its radius: stable or not with equal chance, near the boundary where there is such a one."""
    wanted = (radii < 1.0) if rng.random() < 0.5 else (radii > 1.0)
    off = np.abs(radii - 1.0) > OFF_BOUNDARY
    for choice in (wanted & off & (np.abs(radii - 1.0) < NEAR), wanted & off, off):
        if np.any(choice):
            place = int(rng.choice(np.flatnonzero(choice)))
            return float(DEPTHS_MM[place]), float(radii[place])
    raise AssertionError("no depth is off the boundary")
