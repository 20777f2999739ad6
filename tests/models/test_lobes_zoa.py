"""The zeroth-order lobes against brute force, and what they refuse."""

import math

import numpy as np
import pytest

from models.errors import StabilityError
from models.stability.collocation import radius_bounds
from models.stability.frf_modal_fit import fit_modes
from models.stability.lobes_zoa import (
    depth_at_any_speed,
    limiting_depth,
    lowest_over_feed_directions,
    zeroth_order_lobes,
)
from models.stability.milling import (
    Cut,
    MillingMode,
    engagement_rad,
    mean_directional_matrix,
)
from models.stability.response import (
    ModalResponse,
    SampledResponse,
    feed_rotation,
    mode_from_mass,
    mode_from_residue,
    mode_from_stiffness,
)

SLOT = Cut(teeth=4, start_rad=0.0, exit_rad=math.pi, tangential_n_per_m2=2.2e8, radial_ratio=0.3)
TWO = ModalResponse(
    xx=(mode_from_stiffness(664.0, 0.03, 6e6), mode_from_stiffness(1500.0, 0.02, 2e7)),
    yy=(mode_from_stiffness(601.0, 0.025, 4e6),),
    xy=(mode_from_residue(640.0, 0.03, 1e-6 - 3e-6j),),
    yx=(mode_from_residue(640.0, 0.03, 1e-6 - 3e-6j),),
)


def down(radial_depth_mm: float = 1.0) -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode.DOWN, radial_depth_mm, 10.0)
    return Cut(teeth=4, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=2.2e8, radial_ratio=0.3)


def characteristic(cut: Cut, speed_rpm: float, depth_m: float, frequency_hz: np.ndarray, feed_deg: float) -> np.ndarray:
    """det(I - 1/2 depth K (1 - exp(-j w T)) [a][H]): zero on the boundary."""
    turn = feed_rotation(feed_deg)
    receptance = turn @ TWO.receptance_m_per_n(frequency_hz) @ turn.T
    delay_s = 60.0 / (cut.teeth * speed_rpm)
    gain = 0.5 * depth_m * cut.tangential_n_per_m2 * (1.0 - np.exp(-2j * np.pi * frequency_hz * delay_s))
    return np.linalg.det(np.eye(2) - gain[:, None, None] * (mean_directional_matrix(cut) @ receptance))


@pytest.mark.parametrize("feed_deg", [0.0, 35.0])
@pytest.mark.parametrize("cut", [SLOT, down()])
def test_every_limit_solves_the_characteristic_equation(cut: Cut, feed_deg: float) -> None:
    lobes = zeroth_order_lobes(TWO, cut, from_rpm=2000.0, to_rpm=14000.0, points=61, feed_deg=feed_deg)
    assert np.all(np.isfinite(lobes.limiting_depth_mm))
    for speed, depth, chatter in zip(lobes.speed_rpm, lobes.limiting_depth_mm, lobes.chatter_hz, strict=True):
        near = np.linspace(chatter * 0.998, chatter * 1.002, 401)
        value = min(
            np.abs(characteristic(cut, speed, depth * 1e-3 * factor, near, feed_deg)).min()
            for factor in np.linspace(0.99, 1.01, 21)
        )
        assert value < 0.02, (speed, depth, chatter)


@pytest.mark.parametrize("cut", [SLOT, down()])
def test_an_frf_gives_the_lobes_of_its_modes(cut: Cut) -> None:
    lines = np.arange(384, 3201) * 12800 / 16384
    sampled = SampledResponse(frequency_hz=lines, receptance=TWO.receptance_m_per_n(lines))
    measured = zeroth_order_lobes(sampled, cut, from_rpm=5000.0, to_rpm=14000.0, points=301)
    modelled = zeroth_order_lobes(TWO, cut, from_rpm=5000.0, to_rpm=14000.0, points=301)
    assert measured.limiting_depth_mm == pytest.approx(modelled.limiting_depth_mm, rel=0.01)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, complex(0.0, -math.inf)])
@pytest.mark.parametrize("place", [(0, 0), (1, 1), (0, 1)])
def test_a_line_that_is_not_finite_is_refused_by_its_frequency(place: tuple[int, int], wrong: complex) -> None:
    """The lobes through it were lost, and 9 of 401 speeds stable to any depth."""
    lines = np.arange(100.0, 2500.0, 1.0)
    receptance = TWO.receptance_m_per_n(lines)
    receptance[550][place] = wrong
    sampled = SampledResponse(frequency_hz=lines, receptance=receptance)
    for lobes in (zeroth_order_lobes, lowest_over_feed_directions):
        with pytest.raises(StabilityError, match="no finite value at 650 Hz"):
            lobes(sampled, SLOT, from_rpm=5000.0, to_rpm=14000.0, points=401)
    with pytest.raises(StabilityError, match="no finite value at 650 Hz"):
        fit_modes(lines, receptance[:, place[0], place[1]])


def encirclements(cut: Cut, speed_rpm: float, depth_m: float) -> int:
    """Nyquist: unstable poles of the averaged loop, from the turns of the determinant along the axis."""
    frequency_hz = np.linspace(0.5, 6000.0, 120_000)
    phase = np.unwrap(np.angle(characteristic(cut, speed_rpm, depth_m, frequency_hz, 0.0)))
    return round(-(phase[-1] - phase[0]) / math.pi)


@pytest.mark.parametrize("speed_rpm", [3100.0, 5200.0, 9000.0, 9800.0, 12500.0])
@pytest.mark.parametrize("cut", [SLOT, down()])
def test_the_envelope_parts_stable_from_unstable(cut: Cut, speed_rpm: float) -> None:
    lobes = zeroth_order_lobes(TWO, cut, from_rpm=speed_rpm, to_rpm=14001.0, points=3)
    limit_m = lobes.limiting_depth_mm[0] * 1e-3
    assert encirclements(cut, speed_rpm, 0.97 * limit_m) == 0
    assert encirclements(cut, speed_rpm, 1.03 * limit_m) > 0


def test_refusals_say_what_to_do() -> None:
    lines = np.linspace(300.0, 700.0, 500)
    narrow = SampledResponse(frequency_hz=lines, receptance=TWO.receptance_m_per_n(lines))
    with pytest.raises(StabilityError, match=r"covers 300 to 700 Hz.*133.*to 933"):
        zeroth_order_lobes(narrow, SLOT, from_rpm=2000.0, to_rpm=14000.0, points=10)
    warned = zeroth_order_lobes(narrow, SLOT, from_rpm=2000.0, to_rpm=10000.0, points=10)
    assert any("begins at 300 Hz" in warning for warning in warned.warnings)
    with pytest.raises(StabilityError, match="rigid"):
        zeroth_order_lobes(ModalResponse(), SLOT, from_rpm=2000.0, to_rpm=10000.0, points=10)
    with pytest.raises(StabilityError, match="more than 20000; begin at a higher"):
        zeroth_order_lobes(TWO, SLOT, from_rpm=0.01, to_rpm=2000.0, points=10)
    with pytest.raises(StabilityError, match="no range"):
        zeroth_order_lobes(TWO, SLOT, from_rpm=9000.0, to_rpm=2000.0, points=10)
    with pytest.raises(StabilityError, match="radial depth 11 mm"):
        engagement_rad(MillingMode.UP, 11.0, 10.0)
    with pytest.raises(StabilityError, match="slot is as wide"):
        engagement_rad(MillingMode.SLOT, 5.0, 10.0)
    with pytest.raises(StabilityError, match="die away"):
        mode_from_mass(600.0, -0.01, 1.0)


def test_a_single_speed_has_the_limit_of_the_lobes_or_none() -> None:
    """Where no lobe has a speed, a spindle that is computed at each speed had no lobes at all."""
    lines_hz = np.arange(400.0, 701.0)
    one = ModalResponse(xx=(mode_from_stiffness(600.0, 0.03, 1e7),))
    sampled = SampledResponse(frequency_hz=lines_hz, receptance=one.receptance_m_per_n(lines_hz))
    cut = Cut(teeth=2, start_rad=0.0, exit_rad=math.pi, tangential_n_per_m2=6e8, radial_ratio=0.3)
    lobes = zeroth_order_lobes(sampled, cut, from_rpm=20000.0, to_rpm=20900.0, points=2)
    found = limiting_depth(sampled, cut, speed_rpm=20000.0)
    assert found == pytest.approx((lobes.limiting_depth_mm[0], lobes.chatter_hz[0]), rel=1e-3)
    depth_mm, chatter_hz = limiting_depth(sampled, cut, speed_rpm=15000.0)
    assert depth_mm == math.inf and math.isnan(chatter_hz)


@pytest.mark.parametrize(
    ("teeth", "radial_mm", "milling", "y_hz", "highest_rpm"),
    [
        (2, 1.0, "down", 3402.0, 24_000.0),
        (2, 1.0, "up", 3402.0, 150_000.0),
        (2, 0.5, "down", 3240.0, 200_000.0),
        (2, 10.0, "slot", None, 200_000.0),
        (4, 5.0, "up", 3240.0, 20_000.0),
    ],
)
def test_no_speed_chatters_at_a_depth_for_any(
    teeth: int, radial_mm: float, milling: str, y_hz: float | None, highest_rpm: float
) -> None:
    """Flip lobes of thin cuts lie at half of the zeroth order's; the semi-discretisation knows them."""
    start_rad, exit_rad = engagement_rad(MillingMode(milling), radial_mm, 10.0)
    cut = Cut(teeth=teeth, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=8e8, radial_ratio=0.3)
    along_y = () if y_hz is None else (mode_from_stiffness(y_hz, 0.01, 2.5e7),)
    modes = ModalResponse(xx=(mode_from_stiffness(3240.0, 0.01, 2.5e7),), yy=along_y)
    lines_hz = np.geomspace(2500.0, 12_000.0, 2000)
    sampled = SampledResponse(frequency_hz=lines_hz, receptance=modes.receptance_m_per_n(lines_hz))
    feeds_deg, speeds_rpm = [0.0, 45.0, 90.0, 135.0], np.geomspace(highest_rpm / 8.0, highest_rpm, 60).tolist()
    depth_mm, at_hz = depth_at_any_speed(sampled, cut, feeds_deg=feeds_deg, highest_rpm=highest_rpm)
    assert 3200.0 < at_hz < 3500.0
    for times, chatters in ((1.0, False), (4.5, True)):
        upper = radius_bounds(modes, cut, feeds_deg=feeds_deg, speeds_rpm=speeds_rpm, depth_mm=times * depth_mm)[1]
        assert bool((upper >= 1.0).any()) is chatters
