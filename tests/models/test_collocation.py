"""Collocation in the engaged arc says what the semi-discretisation says, for all feed directions at once."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from models.errors import StabilityError
from models.stability.collocation import follows, passing_maps, radius_bounds, spectral_radii
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, mode_from_residue, mode_from_stiffness
from models.stability.semi_discretisation import fine_steps, semi_discretisation, spectral_radius
from models.stability.state_space import state_space

MODES = ModalResponse(
    xx=(mode_from_stiffness(605.0, 0.0125, 1.7e7), mode_from_residue(1340.0, 0.015, 2e-7 - 9e-7j)),
    yy=(mode_from_stiffness(646.0, 0.013, 1.9e7), mode_from_stiffness(1390.0, 0.016, 5.0e7)),
)
COUPLED = replace(MODES, xy=(mode_from_stiffness(640.0, 0.02, 8e7),), yx=(mode_from_stiffness(640.0, 0.02, 9e7),))
ALL_DEG = tuple(22.5 * number for number in range(8))


def cut(mode: str, teeth: int, radial_mm: float) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode(mode), 16.0 if mode == "slot" else radial_mm, 16.0)
    return Cut(teeth=teeth, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=8e8, radial_ratio=0.3)


HALF = cut("down", 4, 8.0)


def discretised(response: ModalResponse, of: Cut, feed_deg: float, speed_rpm: float, depth_mm: float) -> float:
    structure = state_space(response, feed_deg)
    method = semi_discretisation(structure, of, fine_steps(structure, of, speed_rpm))
    return float(spectral_radius(method, speed_rpm, np.array([depth_mm]))[0])


@settings(max_examples=30, deadline=None)
@given(
    response=st.sampled_from((MODES, COUPLED, ModalResponse(yy=MODES.yy))),
    mode=st.sampled_from(("up", "down", "slot")),
    teeth=st.integers(1, 6),
    radial_mm=st.floats(0.2, 15.9),
    feed_deg=st.floats(0.0, 180.0),
    speed_rpm=st.floats(4000.0, 20_000.0),
    depth_mm=st.floats(0.01, 6.0),
)
def test_the_bounds_hold_the_spectral_radius_between_them(
    response: ModalResponse,
    mode: str,
    teeth: int,
    radial_mm: float,
    feed_deg: float,
    speed_rpm: float,
    depth_mm: float,
) -> None:
    tool = cut(mode, teeth, radial_mm)
    radius = discretised(response, tool, feed_deg, speed_rpm, depth_mm)
    assume(radius < 5.0)
    lower, upper = radius_bounds(response, tool, feeds_deg=[feed_deg], speeds_rpm=[speed_rpm], depth_mm=depth_mm)
    assert upper[0, 0] == pytest.approx(radius, rel=1e-3)
    assert lower[0, 0] == pytest.approx(radius, rel=1e-3)


@pytest.mark.parametrize(("mode", "radial_mm"), [("down", 1.6), ("down", 0.05)])
def test_radii_over_depths_are_those_of_the_discretised_cut(mode: str, radial_mm: float) -> None:
    """Immersions down to 0.3 %: there 200 steps of the semi-discretisation are off by more than they."""
    tool, depths_mm = cut(mode, 2, radial_mm), np.array([0.05, 0.5, 2.0])
    radii = spectral_radii(MODES, tool, feed_deg=30.0, speed_rpm=9000.0, depths_mm=depths_mm)
    structure = state_space(MODES, 30.0)
    expected = spectral_radius(semi_discretisation(structure, tool, 800), 9000.0, depths_mm)
    assert radii == pytest.approx(expected, abs=1e-4)


def test_depths_are_checked_and_slow_speeds_are_told() -> None:
    with pytest.raises(StabilityError, match="above 0"):
        spectral_radii(MODES, HALF, feed_deg=0.0, speed_rpm=9000.0, depths_mm=np.array([0.0]))
    assert follows(MODES, HALF, 9000.0, 2.0)
    assert not follows(MODES, HALF, 20.0, 2.0)
    assert not follows(MODES, HALF, 9000.0, 1e5)
    beyond = spectral_radii(MODES, HALF, feed_deg=0.0, speed_rpm=9000.0, depths_mm=np.array([1e300]))
    assert np.isinf(beyond).all()


@pytest.mark.parametrize("response", [MODES, COUPLED])
def test_every_direction_and_speed_is_as_if_alone(response: ModalResponse) -> None:
    speeds_rpm = np.array([6860.0, 7000.0, 7140.0])
    maps = passing_maps(response, HALF, feeds_deg=ALL_DEG, speeds_rpm=speeds_rpm, depth_mm=3.0)
    radii = np.abs(np.linalg.eigvals(maps)).max(axis=-1)
    for row, feed_deg in enumerate(ALL_DEG):
        for column, speed_rpm in enumerate(speeds_rpm.tolist()):
            assert radii[row, column] == pytest.approx(discretised(response, HALF, feed_deg, speed_rpm, 3.0), abs=1e-5)


def test_limits_end_the_squaring_early_and_change_no_verdict() -> None:
    for depth_mm in (0.5, 2.0, 5.0):
        fine = radius_bounds(MODES, HALF, feeds_deg=ALL_DEG, speeds_rpm=[7000.0], depth_mm=depth_mm)[1]
        for limit in (0.9, 0.95, 0.985, 1.0):
            asked = {"feeds_deg": ALL_DEG, "speeds_rpm": [7000.0], "depth_mm": depth_mm}
            lower, upper = radius_bounds(MODES, HALF, **asked, limits=np.array([limit]))
            assert bool(np.all(upper <= limit)) is bool(np.all(fine <= limit))
            assert bool(np.all(lower <= fine * (1.0 + 1e-9)))
            assert bool(np.all(upper >= fine * (1.0 - 1e-3)))
