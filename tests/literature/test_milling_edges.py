"""Helix, uneven pitch and process damping against what the literature says of them and can be computed otherwise.

No table of limits is known to us that gives every number a computation needs, so each published law is taken where it
makes the cut steady: there the boundary follows from the receptance alone, without steps, maps or eigenvalues.

- Helix: M. Zatarain, J. Munoa, G. Peigne, T. Insperger, Analysis of the influence of mill helix angle on chatter
  stability, CIRP Annals 55 (2006) 365-368. Flip lobes close to islands, and at depths of whole helix pitches
  (pi D / (teeth tan helix)) the cut is steady: the zeroth-order solution is exact there.
- Uneven pitch: Y. Altintas, S. Engin, E. Budak, Analytical stability prediction and design of variable pitch cutters,
  J. Manuf. Sci. Eng. 121 (1999) 173-178: with mean coefficients, det(I - b K_t [A] H(jw) sum(1 - exp(-jw T))) = 0.
  Where the edge lags by a whole turn this is exact. E. Budak, J. Manuf. Sci. Eng. 125 (2003) 29-34: pitches that grow
  by pi (spindle frequency / chatter frequency) let the phases of an even number of teeth cancel.
- Process damping: C. T. Tyler, T. L. Schmitz, Analytical process damping stability prediction, J. Manuf. Process. 15
  (2013) 69-76, F = -C b v / V. Four teeth in a slot rub evenly in all directions: C b / V is a dashpot there.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, edge_matrices, engagement_rad
from models.stability.response import ModalResponse, mode_from_mass, mode_from_stiffness
from models.stability.semi_discretisation import chatter_frequency_hz, semi_discretisation, spectral_radius
from models.stability.state_space import state_space

BENCHMARK = ModalResponse(xx=(mode_from_mass(922.0, 0.011, 0.03993),))
DIAMETER_MM = 10.0
HELIX_RAD = math.radians(30.0)
RIGHT = 2e-3
"""Of a spectral radius."""


def cut(mode: str, radial_mm: float, teeth: int = 2) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode(mode), radial_mm, DIAMETER_MM)
    return Cut(
        teeth=teeth,
        start_rad=start_rad,
        exit_rad=exit_rad,
        tangential_n_per_m2=6e8,
        radial_ratio=1.0 / 3.0,
        diameter_m=DIAMETER_MM * 1e-3,
    )


def radii(response: ModalResponse, of: Cut, speed_rpm: float, depths_mm: list[float], steps: int = 60) -> list[float]:
    method = semi_discretisation(state_space(response), of, steps)
    return [float(each) for each in spectral_radius(method, speed_rpm, np.array(depths_mm))]


def steady_limit_mm(response: ModalResponse, of: Cut, speed_rpm: float) -> float:
    lobes = zeroth_order_lobes(response, of, from_rpm=speed_rpm, to_rpm=speed_rpm + 1.0, points=2)
    return float(lobes.limiting_depth_mm[0])


@pytest.mark.parametrize(("mode", "radial_mm", "speed_rpm"), [("down", 1.0, 18128.0), ("up", 0.5, 16000.0)])
def test_at_a_depth_of_one_helix_pitch_the_mean_force_decides(mode: str, radial_mm: float, speed_rpm: float) -> None:
    straight = cut(mode, radial_mm)
    pitch_mm = math.pi * DIAMETER_MM / (straight.teeth * math.tan(HELIX_RAD))
    scale = steady_limit_mm(BENCHMARK, straight, speed_rpm) / pitch_mm
    helical = replace(straight, helix_rad=HELIX_RAD, tangential_n_per_m2=6e8 * scale)
    below, there, above = radii(BENCHMARK, helical, speed_rpm, [0.97 * pitch_mm, pitch_mm, 1.03 * pitch_mm])
    assert there == pytest.approx(1.0, abs=RIGHT)
    assert below < there - 2e-3 < there + 2e-3 < above
    edge = replace(helical, helix_rad=0.0)
    assert abs(radii(BENCHMARK, edge, speed_rpm, [pitch_mm])[0] - 1.0) > 3.0 * RIGHT  # another limit


def test_a_helix_closes_a_flip_lobe_to_an_island() -> None:
    helical = replace(cut("down", 0.5), helix_rad=HELIX_RAD)
    depths_mm = np.linspace(0.9, 4.2, 12)
    method = semi_discretisation(state_space(BENCHMARK), helical, 60)
    found = spectral_radius(method, 18128.0, depths_mm)
    unstable = depths_mm[found > 1.0]
    assert found[0] < 1.0
    assert found[-1] < 1.0
    assert unstable.size > 5
    assert chatter_frequency_hz(method, 18128.0, float(unstable[3]))[1].real < -1.0  # every second tooth
    straight = radii(BENCHMARK, cut("down", 0.5), 18128.0, [3.2])
    assert straight[0] > 1.0


@pytest.mark.parametrize("pitch_deg", [(70.0, 110.0, 70.0, 110.0), (80.0, 85.0, 95.0, 100.0)])
@pytest.mark.parametrize("speed_rpm", [4000.0, 6500.0])
def test_uneven_pitches_have_the_limit_of_their_delays(pitch_deg: tuple[float, ...], speed_rpm: float) -> None:
    uneven = replace(cut("up", 5.0, teeth=4), helix_rad=HELIX_RAD, pitch_rad=tuple(np.radians(pitch_deg).tolist()))
    depth_mm = math.pi * DIAMETER_MM / math.tan(HELIX_RAD)  # the edge lags by a whole turn
    coefficient = edge_matrices(uneven, np.zeros(1), np.array([2.0 * math.pi]))[0][0, 0, 0]
    frequency_hz = np.linspace(300.0, 3000.0, 270001)
    delays_s = np.array(pitch_deg) / 360.0 * 60.0 / speed_rpm
    regenerated = (1.0 - np.exp(-2j * np.pi * frequency_hz[:, None] * delays_s)).sum(axis=1)
    loop = coefficient * regenerated * BENCHMARK.receptance_m_per_n(frequency_hz)[:, 0, 0]
    crossings = np.flatnonzero(np.diff(np.sign(loop.imag)) != 0.0)
    first = crossings[np.argmax(loop.real[crossings])]
    at_limit = replace(uneven, tangential_n_per_m2=1.0 / (float(loop.real[first]) * depth_mm * 1e-3))
    below, there, above = radii(BENCHMARK, at_limit, speed_rpm, [0.95 * depth_mm, depth_mm, 1.05 * depth_mm])
    assert there == pytest.approx(1.0, abs=RIGHT)
    assert below < 1.0 - 2.0 * RIGHT
    assert above > 1.0 + 2.0 * RIGHT
    method = semi_discretisation(state_space(BENCHMARK), at_limit, 60)
    found_hz = chatter_frequency_hz(method, speed_rpm, depth_mm)[0]
    assert found_hz == pytest.approx(frequency_hz[first], rel=1e-3)


def test_pitches_that_let_the_phases_cancel_cut_deeper() -> None:
    """At 2000 1/min even teeth reach 0.498 mm at 611.3 Hz; the rule's pitches differ by 9.8 deg."""
    structure = ModalResponse(xx=(mode_from_stiffness(600.0, 0.03, 5e6),), yy=(mode_from_stiffness(620.0, 0.03, 5e6),))
    even = replace(cut("up", 5.0, teeth=4), radial_ratio=0.3)
    step_rad = math.pi * (2000.0 / 60.0) / 611.3
    ruled = replace(even, pitch_rad=tuple(math.pi / 2.0 + (place - 1.5) * step_rad for place in range(4)))
    assert radii(structure, even, 2000.0, [0.45])[0] < 1.0 < radii(structure, even, 2000.0, [0.55])[0]
    assert radii(structure, ruled, 2000.0, [0.8])[0] < 1.0


@pytest.mark.parametrize("speed_rpm", [1500.0, 6000.0])
def test_four_teeth_that_rub_in_a_slot_are_a_dashpot(speed_rpm: float) -> None:
    depth_mm, damping_n_per_m = 1.0, 2e4
    cutting_speed_m_s = math.pi * DIAMETER_MM * 1e-3 * speed_rpm / 60.0
    dashpot_n_s_per_m = depth_mm * 1e-3 * damping_n_per_m / cutting_speed_m_s

    def modes(dashpot: float) -> ModalResponse:
        along = [
            mode_from_stiffness(hz, ratio + dashpot * 2.0 * math.pi * hz / (2.0 * 5e6), 5e6)
            for hz, ratio in ((600.0, 0.02), (700.0, 0.03))
        ]
        return ModalResponse(xx=(along[0],), yy=(along[1],))

    bare, rubbing = modes(0.0), modes(dashpot_n_s_per_m)
    slot = cut("slot", DIAMETER_MM, teeth=4)
    at_limit = replace(
        slot,
        process_damping_n_per_m=damping_n_per_m,
        tangential_n_per_m2=6e8 * steady_limit_mm(rubbing, slot, speed_rpm) / depth_mm,
    )
    found = radii(bare, at_limit, speed_rpm, [0.95, 1.0, 1.05], steps=100)
    assert found[1] == pytest.approx(1.0, abs=RIGHT)
    assert found[0] < 1.0 - 5.0 * RIGHT
    assert found[2] > 1.0 + 5.0 * RIGHT
    assert steady_limit_mm(rubbing, slot, speed_rpm) > 1.02 * steady_limit_mm(bare, slot, speed_rpm)
