"""Zeroth-order lobes of the one-degree-of-freedom milling benchmark of Insperger and Stepan (2004).

f = 922 Hz, zeta = 0.011, m = 0.03993 kg, K_t = 6e8, K_n = 2e8 N/m^2, two teeth. The closed form
of the lowest depth, 4 k zeta (1 +- zeta) / (K_t |a_xx|), is exact for the zeroth-order solution, so
the tolerance of 1e-4 covers only how the minimum is searched; the published 0.29805 mm of the slot
has five digits.
"""

import math

import numpy as np
import pytest

from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad, mean_directional_matrix
from models.stability.response import ModalResponse, SampledResponse, ToolPointResponse, mode_from_mass

FREQUENCY_HZ, DAMPING, MASS_KG = 922.0, 0.011, 0.03993
STIFFNESS = MASS_KG * (2.0 * math.pi * FREQUENCY_HZ) ** 2
RESPONSE = ModalResponse(xx=(mode_from_mass(FREQUENCY_HZ, DAMPING, MASS_KG),))
LINES_HZ = np.arange(384, 3201) * 12800 / 16384


def cut(mode: str, radial_depth_mm: float) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode(mode), radial_depth_mm, 10.0)
    return Cut(teeth=2, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=6e8, radial_ratio=1.0 / 3.0)


def closed_form_mm(case: Cut) -> float:
    a_xx = mean_directional_matrix(case)[0, 0]
    factor = 1.0 + DAMPING if a_xx < 0.0 else 1.0 - DAMPING
    return 1e3 * 4.0 * STIFFNESS * DAMPING * factor / (case.tangential_n_per_m2 * abs(a_xx))


CASES = [("slot", 10.0), *((mode, depth) for mode in ("up", "down") for depth in (0.1, 0.5, 1.0, 2.0, 5.0, 8.0, 9.9))]


def test_slot_as_published() -> None:
    lobes = zeroth_order_lobes(RESPONSE, cut("slot", 10.0), from_rpm=5000.0, to_rpm=25000.0, points=400)
    assert lobes.minimum.depth_mm == pytest.approx(0.29805, abs=5e-6)


@pytest.mark.parametrize(("mode", "radial_depth_mm"), CASES)
@pytest.mark.parametrize(
    "response",
    [RESPONSE, SampledResponse(frequency_hz=LINES_HZ, receptance=RESPONSE.receptance_m_per_n(LINES_HZ))],
    ids=["modes", "FRF"],
)
def test_lowest_depth_is_the_closed_form(response: ToolPointResponse, mode: str, radial_depth_mm: float) -> None:
    case = cut(mode, radial_depth_mm)
    lobes = zeroth_order_lobes(response, case, from_rpm=5000.0, to_rpm=20000.0, points=400)
    assert lobes.minimum.depth_mm == pytest.approx(closed_form_mm(case), rel=1e-4)
    assert lobes.limiting_depth_mm.min() == pytest.approx(closed_form_mm(case), rel=5e-3)
    assert lobes.limiting_depth_mm.min() >= lobes.minimum.depth_mm
