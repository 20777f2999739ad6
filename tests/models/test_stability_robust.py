"""Bands of limiting depths: what one number does is known exactly; all together must hold cuts not seen before."""

import math
from dataclasses import replace

import numpy as np
import pytest

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.response import ModalResponse, mode_from_mass
from models.stability.robust_lobes import Uncertainty, depth_band

CUT = Cut(teeth=4, start_rad=0.0, exit_rad=math.pi, tangential_n_per_m2=6e8, radial_ratio=0.3)
RESPONSE = ModalResponse(xx=(mode_from_mass(900.0, 0.03, 0.1),), yy=(mode_from_mass(1100.0, 0.04, 0.12),))
NOTHING = Uncertainty(coefficients=0.0, frequency=0.0, damping=0.0, gain=0.0)


def limits(response: ModalResponse, cut: Cut) -> FloatArray:
    return zeroth_order_lobes(response, cut, from_rpm=4000.0, to_rpm=16000.0, points=60).limiting_depth_mm


def test_a_gain_that_is_off_scales_every_limit_by_its_inverse() -> None:
    """One mode alone: the limit is inversely proportional to its size, so the band is that of exp(0.1 z)."""
    one = replace(RESPONSE, yy=())
    low, high = depth_band(limits, one, CUT, replace(NOTHING, gain=0.1), draws=400)
    ratio_low, ratio_high = low / limits(one, CUT), high / limits(one, CUT)
    assert np.ptp(ratio_low) < 1e-6 and np.ptp(ratio_high) < 1e-6
    assert ratio_low[0] == pytest.approx(math.exp(-0.196), rel=0.05)
    assert ratio_high[0] == pytest.approx(math.exp(0.196), rel=0.05)


def test_a_frequency_that_is_off_moves_the_pockets_and_not_the_depth_of_the_lowest_limit() -> None:
    low, high = depth_band(limits, RESPONSE, CUT, replace(NOTHING, frequency=0.01), draws=60)
    expected = limits(RESPONSE, CUT)
    assert np.all(low <= expected * (1.0 + 1e-9)) and np.all(high >= expected * (1.0 - 1e-9))
    assert low.min() == pytest.approx(expected.min(), rel=0.1)
    assert np.max(high / low) > 1.3


def test_the_band_holds_cuts_that_it_has_not_seen() -> None:
    uncertainty = Uncertainty()
    low, high = depth_band(limits, RESPONSE, CUT, uncertainty)
    random = np.random.default_rng(77)
    inside = []
    for _ in range(150):
        moved = [
            mode_from_mass(
                mode.frequency_hz * math.exp(0.005 * random.standard_normal()),
                mode.damping_ratio * math.exp(0.1 * random.standard_normal()),
                math.exp(-0.05 * random.standard_normal()) / mode.displacement_gain_per_kg,
            )
            for mode in (RESPONSE.xx[0], RESPONSE.yy[0])
        ]
        cut = replace(
            CUT,
            tangential_n_per_m2=6e8 * math.exp(0.1 * random.standard_normal()),
            radial_ratio=0.3 * math.exp(0.1 * random.standard_normal()),
        )
        found = limits(ModalResponse(xx=(moved[0],), yy=(moved[1],)), cut)
        inside.append(np.mean((found >= low) & (found <= high)))
    assert 0.88 < np.mean(inside) < 0.99


@pytest.mark.parametrize("share", [-0.1, 0.5, math.nan])
def test_what_is_no_share_is_refused(share: float) -> None:
    with pytest.raises(StabilityError, match=r"share from 0 to 0\.5, but damping"):
        Uncertainty(damping=share)
