"""From temperatures to a commanded speed: bounds, hysteresis, nothing within a cut, nothing on bad data."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.records import Phase
from models.spindle_speed.choice import SpeedDemand, deepest_speed, least_depth_mm
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.strategies import TunedSpeed
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.tuning import SpeedTuningSettings
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut, MillingMode, engagement_rad
from models.stability.response import ModalResponse, ToolPointResponse, mode_from_stiffness

START_RAD, EXIT_RAD = engagement_rad(MillingMode.DOWN, 5.0, 10.0)
CUT = Cut(teeth=4, start_rad=START_RAD, exit_rad=EXIT_RAD, tangential_n_per_m2=8e8, radial_ratio=0.3)
RANGE_RPM = (7400.0, 11000.0)
OPERATION = MillingOperation(
    demand=SpeedDemand(programmed_rpm=9200.0, depth_mm=4.0, tolerance_fraction=0.01),
    feed_mm_min=1840.0,
    teeth=4,
    range_rpm=RANGE_RPM,
)
SETTINGS = SpeedTuningSettings(hysteresis_rpm=40.0, dwell_s=20.0, step_rpm=150.0)


def known_at(x_hz: float, y_hz: float, **changes: object) -> EstimatedToolPoint:
    response = ModalResponse(xx=(mode_from_stiffness(x_hz, 0.02, 6e6),), yy=(mode_from_stiffness(y_hz, 0.02, 7e6),))
    return replace(EstimatedToolPoint(response=response, resonance_hz={"x": x_hz, "y": y_hz}), **changes)


def lobes_of(response: ToolPointResponse) -> StabilityLobes:
    return zeroth_order_lobes(response, CUT, from_rpm=7300.0, to_rpm=11200.0, points=131)


def test_a_plan_moves_with_the_resonances() -> None:
    planner = SpeedPlanner(OPERATION, lobes_of)
    cold, warm = (planner.plan(known_at(620.0 * factor, 680.0 * factor)) for factor in (1.0, 1.07))
    assert cold.choice.stable
    assert warm.choice.stable
    assert warm.choice.speed_rpm > cold.choice.speed_rpm
    assert cold.flagged_span_rpm == 0.0


def test_flagged_properties_widen_the_span_until_it_blocks() -> None:
    planner = SpeedPlanner(OPERATION, lobes_of)
    near = (known_at(620.0, 680.0), known_at(621.0, 681.0))
    far = (known_at(600.0, 660.0), known_at(660.0, 720.0))
    assert planner.plan(known_at(620.0, 680.0, flagged_ends=near)).flagged_span_rpm <= SETTINGS.hysteresis_rpm
    span_rpm = planner.plan(known_at(620.0, 680.0, flagged_ends=far)).flagged_span_rpm
    assert span_rpm > SETTINGS.hysteresis_rpm
    assert planner.plan(known_at(620.0, 680.0, flagged_ends=(None,))).flagged_span_rpm == math.inf
    tuned = TunedSpeed(OPERATION, SETTINGS, lobes_of)
    blocked = tuned.renew(0.0, Phase.SAFE_POINT, known_at(620.0, 680.0, flagged_ends=far))
    assert (blocked.speed_rpm, blocked.feed_mm_min, blocked.state) == (9200.0, 1840.0, "HOLD")
    assert "flagged property" in str(blocked.alarm)


def test_an_offset_leaves_the_speeds_of_the_rule_only() -> None:
    ruled = SpeedPlanner(replace(OPERATION, offset_hz=20.0), lobes_of).plan(known_at(640.0, 690.0)).choice
    assert ruled.speed_rpm in (pytest.approx(60.0 * 620.0 / 4.0), pytest.approx(60.0 * 670.0 / 4.0))
    below = SpeedPlanner(replace(OPERATION, offset_hz=-15.0), lobes_of).plan(known_at(640.0, 690.0)).choice
    assert below.speed_rpm == pytest.approx(60.0 * 655.0 / 4.0)


def test_without_the_margin_the_deepest_speed_is_taken_and_without_the_depth_none() -> None:
    lobes = lobes_of(known_at(620.0, 680.0).response)
    best = deepest_speed(lobes, replace(OPERATION.demand, depth_mm=0.01), RANGE_RPM)
    assert best is not None
    deepest_mm = least_depth_mm(lobes, best.speed_rpm, OPERATION.demand.tolerance_fraction)
    assert deepest_mm < 0.95 * best.limiting_depth_mm
    tight = replace(OPERATION, demand=replace(OPERATION.demand, depth_mm=0.95 * deepest_mm))
    choice = SpeedPlanner(tight, lobes_of).plan(known_at(620.0, 680.0)).choice
    assert choice.stable
    assert not choice.margin_met
    assert choice.limiting_depth_mm >= 0.95 * deepest_mm
    assert choice.pocket_rpm[0] <= choice.speed_rpm <= choice.pocket_rpm[1]
    ends_mm = [least_depth_mm(lobes, end, OPERATION.demand.tolerance_fraction) for end in choice.pocket_rpm]
    assert min(ends_mm) >= tight.demand.depth_mm, "a spindle that cuts within the tolerance of an end is stable too"
    beyond = replace(OPERATION, demand=replace(OPERATION.demand, depth_mm=1.05 * deepest_mm))
    none = SpeedPlanner(beyond, lobes_of).plan(known_at(620.0, 680.0)).choice
    assert not none.stable
    assert none.speed_rpm == 9200.0


EVENTS = st.lists(
    st.tuples(
        st.floats(0.5, 60.0),
        st.sampled_from([Phase.CUTTING, Phase.SAFE_POINT, Phase.IDLE]),
        st.one_of(st.none(), st.tuples(st.floats(580.0, 720.0), st.floats(620.0, 760.0))),
        st.sampled_from(["", "", "", "the mode is lost"]),
        st.sampled_from([(), (), (None,), (known_at(600.0, 650.0), known_at(700.0, 750.0))]),
    ),
    min_size=1,
    max_size=12,
)


@settings(max_examples=60, deadline=None)
@given(EVENTS)
def test_whatever_the_estimator_says(events: list) -> None:
    tuned, planner = TunedSpeed(OPERATION, SETTINGS, lobes_of), SpeedPlanner(OPERATION, lobes_of)
    now_s, before, begun = 0.0, OPERATION.demand.programmed_rpm, False
    for elapsed_s, phase, resonances, inhibit, ends in events:
        now_s += elapsed_s
        known = None if resonances is None else known_at(*resonances, inhibit=inhibit, flagged_ends=ends)
        pair = tuned.renew(now_s, phase, known)
        assert RANGE_RPM[0] <= pair.speed_rpm <= RANGE_RPM[1]
        assert pair.feed_mm_min == pytest.approx(1840.0 * pair.speed_rpm / 9200.0)
        usable = known is not None and not known.inhibit
        plan = planner.plan(known) if known is not None and usable else None
        blocked = plan is not None and plan.flagged_span_rpm > SETTINGS.hysteresis_rpm
        if phase is not Phase.SAFE_POINT or plan is None or blocked:
            assert pair.speed_rpm == before
        elif begun and plan.choice.stable:
            near = abs(plan.choice.speed_rpm - before) <= SETTINGS.hysteresis_rpm
            assert pair.speed_rpm == before or not near
        if pair.speed_rpm != before and plan is not None:
            assert abs(pair.speed_rpm - plan.choice.speed_rpm) <= abs(before - plan.choice.speed_rpm) + 1e-9
        begun = begun or (phase is Phase.SAFE_POINT and plan is not None and not blocked)
        before = pair.speed_rpm
    assert np.isfinite(before)
