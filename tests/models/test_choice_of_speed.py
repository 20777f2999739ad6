"""Choice of the spindle speed: the dissertation's rule, pockets, limits, margin, and what one sensor step does."""

import numpy as np
import pytest

from models.errors import StabilityError
from models.spindle_speed.choice import (
    SpeedDemand,
    SpeedLimits,
    choose_speed,
    resonance_speed_rpm,
    rule_candidates_rpm,
)
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, mode_from_stiffness


def cut() -> Cut:
    start_rad, exit_rad = engagement_rad(MillingMode.DOWN, 1.0, 10.0)
    return Cut(teeth=4, start_rad=start_rad, exit_rad=exit_rad, tangential_n_per_m2=2.2e8, radial_ratio=0.3)


def lobes(resonance_hz: float = 664.0, low: float = 4000.0, high: float = 12000.0) -> StabilityLobes:
    structure = ModalResponse(
        xx=(mode_from_stiffness(resonance_hz + 90.0, 0.03, 9e6),), yy=(mode_from_stiffness(resonance_hz, 0.03, 6e6),)
    )
    return zeroth_order_lobes(structure, cut(), from_rpm=low, to_rpm=high, points=801)


@pytest.mark.parametrize(("resonance_hz", "speed_rpm"), [(601.0, 8715.0), (664.0, 9660.0), (679.0, 9885.0)])
def test_the_rule_of_the_source(resonance_hz: float, speed_rpm: float) -> None:
    assert resonance_speed_rpm(resonance_hz, 20.0, 4, 1) == pytest.approx(speed_rpm)
    assert resonance_speed_rpm(resonance_hz, 20.0, 4, 3) == pytest.approx(speed_rpm / 3.0)
    assert resonance_speed_rpm(resonance_hz, -20.0, 4, 1) > speed_rpm


def test_a_stable_programmed_speed_stays() -> None:
    diagram = lobes()
    best = float(diagram.speed_rpm[np.argmax(diagram.limiting_depth_mm)])
    choice = choose_speed(diagram, SpeedDemand(programmed_rpm=best + 0.3, depth_mm=1.0))
    assert choice.speed_rpm == best + 0.3
    assert choice.stable


def test_a_range_between_two_speeds_of_the_lobes_has_a_depth() -> None:
    """Such as that above a programmed speed that is the highest of the machine."""
    diagram = lobes()
    low_mm, high_mm = diagram.limiting_depth_mm[100:102]
    between = float(diagram.speed_rpm[100:102].mean())
    choice = choose_speed(diagram, SpeedDemand(programmed_rpm=between, depth_mm=50.0), range_rpm=(between, between))
    assert not choice.stable
    assert f"(at most {(low_mm + high_mm) / 2.0:.3g} mm anywhere)" in choice.alarm


def test_the_nearest_speed_that_bears_the_depth_with_margin_and_tolerance() -> None:
    diagram = lobes()
    worst = float(diagram.speed_rpm[np.argmin(diagram.limiting_depth_mm)])
    depth_mm = 1.5 * float(diagram.limiting_depth_mm.min())
    demand = SpeedDemand(programmed_rpm=worst, depth_mm=depth_mm, margin_fraction=0.25, tolerance_fraction=0.02)
    choice = choose_speed(diagram, demand)
    near = np.abs(diagram.speed_rpm / choice.speed_rpm - 1.0) <= 0.02
    assert choice.stable
    assert diagram.limiting_depth_mm[near].min() >= 1.25 * depth_mm
    between = np.abs(diagram.speed_rpm - worst) < abs(choice.speed_rpm - worst) - 1e-6
    for speed in diagram.speed_rpm[between][::7]:
        around = np.abs(diagram.speed_rpm / speed - 1.0) <= 0.02
        assert diagram.limiting_depth_mm[around].min() < 1.25 * depth_mm
    low, high = choice.pocket_rpm
    assert low <= choice.speed_rpm <= high
    inside = (diagram.speed_rpm >= low) & (diagram.speed_rpm <= high)
    assert diagram.limiting_depth_mm[inside].min() >= 1.25 * depth_mm


def test_no_stable_speed_gives_the_programmed_one_and_an_alarm() -> None:
    choice = choose_speed(lobes(), SpeedDemand(programmed_rpm=7000.0, depth_mm=1000.0))
    assert choice.speed_rpm == 7000.0
    assert choice.alarm is not None
    assert "no speed between 4000 and 12000 1/min is stable to 1000 mm" in choice.alarm
    assert "7000 1/min stays" in choice.alarm


def test_candidates_are_chosen_among_by_depth_then_nearness() -> None:
    diagram = lobes()
    candidates = rule_candidates_rpm((664.0,), 20.0, 4, (4000.0, 12000.0))
    choice = choose_speed(diagram, SpeedDemand(programmed_rpm=6000.0, depth_mm=1.0), candidates_rpm=candidates)
    assert choice.speed_rpm in candidates
    worst = float(diagram.speed_rpm[np.argmin(diagram.limiting_depth_mm)])
    refused = choose_speed(diagram, SpeedDemand(programmed_rpm=6000.0, depth_mm=10.0), candidates_rpm=(worst, 50_000.0))
    assert refused.alarm is not None
    assert "none of 2 speeds" in refused.alarm


def test_limits_meet() -> None:
    limits = SpeedLimits(
        machine_lowest_rpm=100.0, machine_highest_rpm=12000.0, tool_highest_rpm=9000.0, within_fraction=0.1
    )
    assert limits.range_rpm(8500.0) == pytest.approx((7650.0, 9000.0))
    with pytest.raises(StabilityError, match="leave no range"):
        limits.range_rpm(11000.0)
