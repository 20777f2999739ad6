"""Lobes of a stability case, by either method."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from config.machine.stability_case import ALL_DIRECTIONS, StabilityCase
from daemon.workbench.stability.case_files import RotatingSpindle, modal_response_of, response_of
from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.choice import SpeedDemand, SpeedLimits, choose_speed, limiting_depth_mm
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.tuning import SpeedChoice
from models.spindle_speed.verification import StabilityVerification
from models.stability.collocation import follows, spectral_radii
from models.stability.lobes import LobeMinimum, StabilityLobes, check_range
from models.stability.lobes_sdm import limiting_depth, semi_discretised_lobes, semi_discretised_over_feed_directions
from models.stability.lobes_zoa import limiting_depth as zoa_limiting_depth
from models.stability.lobes_zoa import lowest_over_feed_directions, zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.response import ModalResponse, ToolPointResponse
from models.stability.robust_lobes import Uncertainty, depth_band
from models.stability.semi_discretisation import (
    FEWEST_PER_CYCLE,
    fine_steps,
    periods_per_passing,
    semi_discretisation,
    spectral_radius,
)
from models.stability.state_space import state_space

POINTS = {"zoa": 400, "sdm": 100}
DRAWS = {"zoa": 60, "sdm": 20}
"""Cuts from which a band is made; 20 of the slow kind reach from the lowest to the highest."""
TURNING_POINTS = 60
"""Speeds at which a spindle that turns is computed."""
FEEDS_DEG = tuple(22.5 * number for number in range(8))
UNVERIFIED = "the speed is that of the zeroth order, which knows no flip lobes, and not verified: {}; try --method sdm"
CHOICE_POINTS = {"zoa": 601, "sdm": 121}
"""Speeds among which one is chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LobesRequest:
    method: str
    """`zoa` or `sdm`."""
    from_rpm: float
    to_rpm: float
    points: int | None = None
    max_depth_mm: float | None = None
    steps: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthBand:
    """Limiting depths between which the middle 95 of 100 lie, at the speeds of the lobes; inf: none."""

    low_mm: FloatArray
    high_mm: FloatArray


def find_lobes(case: StabilityCase, request: LobesRequest) -> StabilityLobes:
    """Return the lobes of a case; raises MeasurementFileError and StabilityError."""
    if case.rotating:
        return _turning_lobes(case, request)
    if request.method == "zoa":
        return _lobes(response_of(case), case.cut(), case, request)
    modes, warnings = modal_response_of(case, request.from_rpm, request.to_rpm)
    return _lobes(modes, case.cut(), case, request).with_warnings(warnings)


def find_band(case: StabilityCase, request: LobesRequest) -> DepthBand:
    """Return the limiting depths at the speeds of `find_lobes` as a band; raises as it does."""
    if case.rotating:
        raise StabilityError(
            "a band needs modes or FRFs; leave out --band for a spindle that is computed at each speed"
        )
    modes, _ = modal_response_of(case, request.from_rpm, request.to_rpm)

    def limits(drawn: ModalResponse, cut: Cut) -> FloatArray:
        return _lobes(drawn, cut, case, request).limiting_depth_mm

    low, high = depth_band(
        limits, modes, case.cut(), Uncertainty(**case.uncertainty.model_dump()), DRAWS[request.method]
    )
    return DepthBand(low_mm=low, high_mm=high)


def _turning_lobes(case: StabilityCase, request: LobesRequest) -> StabilityLobes:
    """Return lobes in which every speed has dynamics of its own; the minimum is that of the sampled speeds."""
    spindle, cut = RotatingSpindle(case, request.to_rpm), case.cut()
    check_range(request.from_rpm, request.to_rpm, request.points or TURNING_POINTS)
    speeds_rpm = np.linspace(request.from_rpm, request.to_rpm, request.points or TURNING_POINTS)
    feeds_deg = FEEDS_DEG if case.feed_deg == ALL_DIRECTIONS else (float(case.feed_deg),)
    found = np.array([_turning_limits(spindle, cut, request, speed, feeds_deg) for speed in speeds_rpm.tolist()])
    lowest, columns = np.argmin(found[:, :, 0], axis=1), np.arange(len(speeds_rpm))
    depths_mm, chatter_hz = found[columns, lowest].T
    place = int(np.argmin(depths_mm))
    minimum, warnings = None, spindle.warnings
    if not np.isfinite(depths_mm[place]):
        warnings += ("no lobe has any of these speeds: nothing limits the depth, as far as was looked",)
    else:
        minimum = LobeMinimum(
            speed_rpm=float(speeds_rpm[place]), depth_mm=float(depths_mm[place]), chatter_hz=float(chatter_hz[place])
        )
    return StabilityLobes(
        speed_rpm=speeds_rpm,
        limiting_depth_mm=depths_mm,
        chatter_hz=chatter_hz,
        minimum=minimum,
        feed_deg=feeds_deg[int(lowest[place])],
        warnings=warnings,
        max_depth_mm=request.max_depth_mm or np.inf,
    )


def _turning_limits(
    spindle: RotatingSpindle, cut: Cut, request: LobesRequest, speed_rpm: float, feeds_deg: tuple[float, ...]
) -> list[tuple[float, float]]:
    """Return limiting depth [mm] and chatter frequency [Hz] at one speed for each direction of the feed."""
    if request.method == "zoa":
        samples = spindle.at(speed_rpm)
        return [zoa_limiting_depth(samples, cut, speed_rpm=speed_rpm, feed_deg=feed_deg) for feed_deg in feeds_deg]
    modes = spindle.modes_at(speed_rpm)
    return [
        limiting_depth(
            modes, cut, speed_rpm=speed_rpm, feed_deg=feed_deg, max_depth_mm=request.max_depth_mm, steps=request.steps
        )
        for feed_deg in feeds_deg
    ]


def _lobes(response: ToolPointResponse, cut: Cut, case: StabilityCase, request: LobesRequest) -> StabilityLobes:
    points, span = request.points or POINTS[request.method], (request.from_rpm, request.to_rpm)
    everywhere = case.feed_deg == ALL_DIRECTIONS
    feed_deg = 0.0 if everywhere else float(case.feed_deg)
    if not isinstance(response, ModalResponse) or request.method == "zoa":
        if everywhere:
            return lowest_over_feed_directions(response, cut, from_rpm=span[0], to_rpm=span[1], points=points)
        return zeroth_order_lobes(response, cut, from_rpm=span[0], to_rpm=span[1], points=points, feed_deg=feed_deg)
    depth, steps = request.max_depth_mm, request.steps
    if everywhere:
        return semi_discretised_over_feed_directions(
            response, cut, from_rpm=span[0], to_rpm=span[1], points=points, max_depth_mm=depth, steps=steps
        )
    return semi_discretised_lobes(
        response,
        cut,
        from_rpm=span[0],
        to_rpm=span[1],
        points=points,
        feed_deg=feed_deg,
        max_depth_mm=depth,
        steps=steps,
    )


def radii_at(case: StabilityCase, points: tuple[tuple[float, float], ...], steps: int | None) -> dict[str, Any]:
    """Return the spectral radius at speeds [1/min] and depths [mm]; raises MeasurementFileError, StabilityError."""
    if case.feed_deg == ALL_DIRECTIONS:
        raise StabilityError("a spectral radius needs one direction of the feed; give feed_deg a number")
    speeds = [speed for speed, _ in points]
    spindle = RotatingSpindle(case, max(speeds)) if case.rotating else None
    modes, warnings = (None, spindle.warnings) if spindle else modal_response_of(case, min(speeds), max(speeds))
    cut, feed_deg = case.cut(), float(case.feed_deg)
    found = []
    for speed, depth in points:
        modes = spindle.modes_at(speed) if spindle else modes
        assert modes is not None
        radius = _radius(modes, cut, feed_deg, speed, depth, steps)
        if not np.isfinite(radius):
            raise StabilityError(
                f"at {speed:g} 1/min and {depth:g} mm the vibration grows beyond all numbers: this is far above any "
                "limiting depth; check the depth, which is in mm"
            )
        found.append(
            {"speed_rpm": speed, "depth_mm": depth, "spectral_radius": float(radius), "stable": bool(radius < 1.0)}
        )
    return {"method": "sdm", "points": found, "warnings": list(warnings)}


def _radius(modes: ModalResponse, cut: Cut, feed_deg: float, speed: float, depth: float, steps: int | None) -> float:
    """Return the spectral radius at a speed [1/min] and depth [mm]: by collocation, or with so many steps."""
    depths = np.array([depth])
    if steps is None and follows(modes, cut, speed, depth):
        return float(spectral_radii(modes, cut, feed_deg=feed_deg, speed_rpm=speed, depths_mm=depths)[0])
    structure = state_space(modes, feed_deg)
    taken = steps or fine_steps(structure, cut, speed)
    if (periods := periods_per_passing(structure, cut, speed)) * FEWEST_PER_CYCLE > taken:
        raise StabilityError(
            f"--steps {taken} do not follow {periods:.4g} vibrations from tooth to tooth at {speed:g} 1/min; take "
            "more, or leave --steps out"
        )
    return float(spectral_radius(semi_discretisation(structure, cut, taken), speed, depths)[0])


def choose_for_case(
    case: StabilityCase, demand: SpeedDemand, limits: SpeedLimits, method: str
) -> tuple[SpeedChoice, tuple[str, ...]]:
    """Return the speed for a case and warnings; raises MeasurementFileError and StabilityError."""
    low, high = limits.range_rpm(demand.programmed_rpm)
    reach = 1.0 + demand.tolerance_fraction
    wide = LobesRequest(method=method, from_rpm=low / reach, to_rpm=high * reach, points=CHOICE_POINTS[method])
    found = find_lobes(case, wide)
    choice, doubts = verified_choice(case, found, demand, method, (low, high))
    return choice, (*found.warnings, *doubts)


def verified_choice(
    case: StabilityCase,
    lobes: StabilityLobes,
    demand: SpeedDemand,
    method: str,
    range_rpm: tuple[float, float] | None = None,
) -> tuple[SpeedChoice, tuple[str, ...]]:
    """Return the speed that lobes offer within a range [1/min], and what is doubtful about it.

    The zeroth order knows no flip lobes, so its speeds are verified as the daemon verifies them.
    """
    by_lobes = choose_speed(lobes, demand, range_rpm=range_rpm)
    if method != "zoa" or not by_lobes.stable:
        return by_lobes, ()
    if case.rotating:
        return by_lobes, (UNVERIFIED.format("its dynamics change with the speed"),)
    feeds_deg = FEEDS_DEG if case.feed_deg == ALL_DIRECTIONS else (float(case.feed_deg),)
    operation = MillingOperation(
        demand=demand,
        feed_mm_min=math.nan,
        teeth=case.teeth,
        range_rpm=range_rpm or (float(lobes.speed_rpm[0]), float(lobes.speed_rpm[-1])),
    )
    planner = SpeedPlanner(operation, lambda _: lobes, StabilityVerification(case.cut(), feeds_deg))
    try:
        choice = planner.choice(EstimatedToolPoint(response=response_of(case), resonance_hz={}))
    except StabilityError as error:
        return by_lobes, (UNVERIFIED.format(error),)
    if choice.margin_met:
        return choice, ()
    programmed_rpm = demand.programmed_rpm
    alarm = (
        f"no speed that is verified bears {demand.depth_mm:g} mm with a margin of {demand.margin_fraction:.0%}; "
        f"{choice.speed_rpm:.0f} 1/min bears the depth alone; the programmed {programmed_rpm:g} 1/min stays: cut less "
        "deep or widen the limits"
    )
    limiting_mm = limiting_depth_mm(lobes, programmed_rpm)
    pocket_rpm = (programmed_rpm, programmed_rpm)
    return replace(
        choice, speed_rpm=programmed_rpm, limiting_depth_mm=limiting_mm, pocket_rpm=pocket_rpm, alarm=alarm
    ), ()
