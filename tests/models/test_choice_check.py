"""The second look at a chosen speed: semi-discretisation where the zeroth order draws too steep a flank."""

import numpy as np

from models.spindle_speed.choice import SpeedDemand
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.verification import StabilityVerification
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, SampledResponse, ToolPointResponse, mode_from_stiffness
from models.stability.semi_discretisation import semi_discretisation, spectral_radius
from models.stability.state_space import state_space

START_RAD, EXIT_RAD = engagement_rad(MillingMode.DOWN, 8.0, 16.0)
CUT = Cut(teeth=4, start_rad=START_RAD, exit_rad=EXIT_RAD, tangential_n_per_m2=8e8, radial_ratio=0.3)
MODES = ModalResponse(
    xx=(mode_from_stiffness(605.0, 0.0125, 1.7e7), mode_from_stiffness(1340.0, 0.015, 5.0e7)),
    yy=(mode_from_stiffness(646.0, 0.013, 1.9e7), mode_from_stiffness(1390.0, 0.016, 5.0e7)),
)
FREQUENCY_HZ = np.arange(300.0, 2500.0, 2.0)
SAMPLED = SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=MODES.receptance_m_per_n(FREQUENCY_HZ))


def radius(speed_rpm: float, depth_mm: float) -> float:
    method = semi_discretisation(state_space(MODES, 0.0), CUT, 80)
    return float(spectral_radius(method, speed_rpm, np.array([depth_mm]))[0])


def test_it_says_what_the_spectral_radius_says() -> None:
    check = StabilityVerification(CUT, (0.0,), largest_radius=0.999)
    said = []
    for speed_rpm in np.linspace(6050.0, 10050.0, 25).tolist():
        borne = radius(speed_rpm, 5.0) <= 0.999
        assert check.is_stable(MODES, speed_rpm, 5.0, 0.0) is borne
        said.append(borne)
    assert True in said
    assert False in said


def test_an_frf_is_looked_at_by_the_modes_that_follow_it() -> None:
    check = StabilityVerification(CUT)
    said = [check.is_stable(SAMPLED, speed_rpm, 5.0, 0.01) for speed_rpm in (6200.0, 7000.0, 8500.0, 9300.0)]
    assert said == [
        StabilityVerification(CUT).is_stable(MODES, each, 5.0, 0.01) for each in (6200.0, 7000.0, 8500.0, 9300.0)
    ]
    assert said == [False, False, True, True]


def test_all_feed_directions_must_be_borne() -> None:
    speeds = np.linspace(6000.0, 9000.0, 13).tolist()
    turned = [
        tuple(StabilityVerification(CUT, (feed,)).is_stable(MODES, each, 5.0, 0.0) for each in speeds)
        for feed in (0.0, 90.0)
    ]
    both = tuple(StabilityVerification(CUT, (0.0, 90.0)).is_stable(MODES, each, 5.0, 0.0) for each in speeds)
    assert both == tuple(x and y for x, y in zip(*turned, strict=True))
    assert turned[0] != turned[1]


def test_where_no_modes_follow_there_is_no_second_opinion() -> None:
    noise = np.random.default_rng(1).normal(size=(len(FREQUENCY_HZ), 2, 2)) * 1e-7 + 0j
    assert StabilityVerification(CUT).is_stable(
        SampledResponse(frequency_hz=FREQUENCY_HZ, receptance=noise), 7000.0, 3.0, 0.02
    )


def test_the_planner_leaves_out_what_does_not_pass() -> None:
    demand = SpeedDemand(programmed_rpm=10200.0, depth_mm=4.0, margin_fraction=0.2, tolerance_fraction=0.005)
    operation = MillingOperation(demand=demand, feed_mm_min=2040.0, teeth=4, range_rpm=(8200.0, 12000.0))
    known = EstimatedToolPoint(response=MODES, resonance_hz={"x": 605.0, "y": 646.0})

    def lobes_of(response: ToolPointResponse) -> StabilityLobes:
        return zeroth_order_lobes(response, CUT, from_rpm=8000.0, to_rpm=12200.0, points=401)

    alone = SpeedPlanner(operation, lobes_of).choice(known)
    looked_at = SpeedPlanner(operation, lobes_of, StabilityVerification(CUT)).choice(known)
    assert alone.speed_rpm == 10200.0
    assert max(radius(alone.speed_rpm * share, 4.0) for share in (0.995, 1.0, 1.005)) > 0.985
    assert looked_at.stable
    assert looked_at.speed_rpm < 10200.0
    assert max(radius(looked_at.speed_rpm * share, 4.0) for share in (0.995, 1.0, 1.005)) <= 0.985
