"""The simulated machine mills through its warm-up, once for each way to choose the spindle speed.

What the tuner knows comes from an estimator that was fitted on impact tests of another day; whether a cut chatters is
said by the time-domain simulation with the machine's true modes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from config.machine.stability_case import ALL_DIRECTIONS, StabilityCase
from daemon.simulation.warm_up.modes import CYCLE_S, STANDING_S, CaseMachine, MillingMachine
from daemon.simulation.warm_up.spindle import SpindleMachine
from drivers.sim.spindle.milling import MillingCuts, arc_of, is_stable
from drivers.sim.spindle.warming_spindle import VibrationModes, WarmingSpindle
from models.errors import StabilityError
from models.records import FloatArray, Phase
from models.spindle_speed.choice import SpeedDemand, SpeedLimits
from models.spindle_speed.planner import MillingOperation
from models.spindle_speed.strategies import ProgrammedSpeed, ResonanceRule, SpeedInForce, SpeedStrategy, TunedSpeed
from models.spindle_speed.tuning import SpeedTuningSettings
from models.spindle_speed.verification import StabilityVerification
from models.stability.lobes import StabilityLobes
from models.stability.lobes_sdm import semi_discretised_lobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.response import ModalResponse, ToolPointResponse

CUT_S, SAFE_S = 50.0, 10.0
"""A minute is a cut and a safe point [s]."""
CHOICE_POINTS = {"zoa": 601, "sdm": 121}
USUAL_SETTINGS = SpeedTuningSettings(hysteresis_rpm=30.0, dwell_s=20.0, step_rpm=300.0)


PASSINGS = 150
STEPS_PER_PERIOD = 50
LEAST_STEPS = 120
"""Steps per tooth passing, and per period of the fastest mode, of the simulated cut."""
SLICES = 12
"""Of a helical edge."""
DEPTHS = 8
DEEPEST, SHALLOWEST = 4.0, 0.25
"""A limiting depth is looked for between these multiples of the programmed depth, in two rounds of `DEPTHS`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CutState:
    """The machine in the middle of one cut."""

    pair: SpeedInForce
    modes: VibrationModes
    """The true ones."""
    estimated_hz: dict[str, float]

    @property
    def true_hz(self) -> dict[str, float]:
        """The resonance that responds most, per axis [Hz]."""
        found = {}
        height = 1.0 / (self.modes.stiffness_n_per_m * self.modes.damping_ratio)
        for axis, name in enumerate("xy"):
            places = [place for place, of in enumerate(self.modes.axis) if of == axis]
            if places:
                place = max(places, key=lambda each: float(height[each]))
                damping = float(self.modes.damping_ratio[place])
                found[name] = float(self.modes.frequency_hz[place] * np.sqrt(max(1.0 - 2.0 * damping**2, 0.0)))
        return found


class WarmUpReferee:
    """Simulates cuts of one case side by side."""

    def __init__(self, case: StabilityCase, feed_per_tooth_mm: float) -> None:
        self._cut = cut = case.cut()
        self._teeth, self._tangential = case.teeth, cut.tangential_n_per_m2
        self._radial = cut.tangential_n_per_m2 * cut.radial_ratio
        radial_mm = case.radial_depth_mm or case.diameter_mm
        self._arc = arc_of(case.milling, radial_mm * 1e-3, case.diameter_mm * 1e-3)
        self._feed_rad = float(np.radians(float(case.feed_deg)))
        self._feed_m = feed_per_tooth_mm * 1e-3

    def stable(self, states: Sequence[CutState], depth_mm: FloatArray) -> np.ndarray:
        """Return whether each state is stable at its depth [mm], shape (n,)."""
        speed_rpm = np.array([state.pair.speed_rpm for state in states])
        same = np.ones(len(states))
        frequency_hz = np.array([state.modes.frequency_hz for state in states])
        periods = float(np.max(frequency_hz.max(axis=1) * 60.0 / (speed_rpm * self._teeth)))
        helical, rubbing = self._cut.helix_rad > 0.0, self._cut.process_damping_n_per_m
        cutting_speed_m_s = np.pi * self._cut.diameter_m * speed_rpm / 60.0
        cuts = MillingCuts(
            teeth=self._teeth,
            speed_rpm=speed_rpm,
            axial_depth_m=depth_mm * 1e-3,
            first_bearing_rad=self._arc[0] * same,
            last_bearing_rad=self._arc[1] * same,
            tangential_n_per_m2=self._tangential * same,
            radial_n_per_m2=self._radial * same,
            feed_per_tooth_m=self._feed_m * same,
            feed_direction_rad=self._feed_rad * same,
            mode_frequency_hz=frequency_hz,
            mode_damping_ratio=np.array([state.modes.damping_ratio for state in states]),
            mode_stiffness_n_per_m=np.array([state.modes.stiffness_n_per_m for state in states]),
            mode_axis=states[0].modes.axis,
            mode_lead_s=None if states[0].modes.lead_s is None else np.array([state.modes.lead_s for state in states]),
            helix_lag_rad=self._cut.lag_rad(depth_mm) if helical else None,
            slices=SLICES if helical else 1,
            pitch_rad=self._cut.pitch_rad,
            # Uneven teeth that chatter out of the cut may repeat their motion turn by turn, and would count as stable.
            keeps_contact=bool(self._cut.pitch_rad),
            damping_n_s_per_m=rubbing * depth_mm * 1e-3 / cutting_speed_m_s if rubbing else None,
        )
        return is_stable(cuts, PASSINGS, max(LEAST_STEPS, int(np.ceil(STEPS_PER_PERIOD * periods))))

    def limiting_depths_mm(self, states: Sequence[CutState], programmed_mm: float) -> FloatArray:
        """Return the depth up to which each state is stable [mm], between 0 and `DEEPEST` times the programmed one."""
        lower = np.full(len(states), SHALLOWEST * programmed_mm)
        upper = np.full(len(states), DEEPEST * programmed_mm)
        found = np.zeros(len(states))
        for _ in range(2):
            depths = np.geomspace(lower, upper, DEPTHS)
            stable = self.stable(list(states) * DEPTHS, depths.ravel()).reshape(depths.shape)
            count = np.cumprod(stable, axis=0).sum(axis=0)
            columns = np.arange(len(states))
            found = np.where(count > 0, depths[np.maximum(count - 1, 0), columns], found)
            lower = np.where(count > 0, found, 0.2 * SHALLOWEST * programmed_mm)
            upper = depths[np.minimum(count, DEPTHS - 1), columns]
            upper = np.where(upper > lower, upper, lower * 1.01)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUpRequest:
    """What is milled, and how the speed may be chosen."""

    demand: SpeedDemand
    limits: SpeedLimits
    minutes: int = 60
    feed_per_tooth_mm: float = 0.05
    dynamics: str = "spindle"
    """`spindle`: the finite elements of the simulated machine; `case`: the modes of the case, by a law."""
    method: str = "zoa"
    verify_with_sdm: bool = True
    """A chosen speed is verified beyond the lobes."""
    rule_axis: str | None = None
    """Followed by the dissertation's rule; None: the axis that is softer at its resonance."""
    offset_hz: float = 20.0
    settings: SpeedTuningSettings = USUAL_SETTINGS
    machine_seed: int = 1
    day_seed: int = 1
    limit_every_min: int | None = 5
    """How often the limiting depth at the commanded speed is looked for; None: never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUpMinute:
    time_min: float
    pair: SpeedInForce
    true_hz: dict[str, float]
    """Resonance of the machine per axis [Hz]."""
    estimated_hz: dict[str, float]
    stable: bool
    limiting_depth_mm: float | None
    """None: not looked for in this minute."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUpRun:
    """One warm-up with one way to choose the speed."""

    strategy: str
    minutes: tuple[WarmUpMinute, ...]
    cut_area_mm2: float
    """Axial times radial depth [mm2]."""

    @property
    def share_stable(self) -> float:
        """Share of the cutting time without chatter, 0 to 1."""
        return float(np.mean([minute.stable for minute in self.minutes]))

    def removed_cm3_per_min(self, *, stable_only: bool) -> float:
        """Return the material removed per minute of the warm-up [cm3/min]."""
        counted = [minute.pair.feed_mm_min * (minute.stable or not stable_only) for minute in self.minutes]
        return float(np.mean(counted)) * self.cut_area_mm2 * 1e-3 * CUT_S / (CUT_S + SAFE_S)

    @property
    def lowest_limit_mm(self) -> float:
        """The lowest limiting depth that was found at the commanded speeds [mm]; NaN where none was looked for."""
        found = [each.limiting_depth_mm for each in self.minutes if each.limiting_depth_mm is not None]
        return min(found, default=float("nan"))


def warm_up(case: StabilityCase, request: WarmUpRequest) -> tuple[WarmUpRun, ...]:
    """Return the warm-up without tuning, with the published rule, and tuned; raises StabilityError."""
    if case.feed_deg == ALL_DIRECTIONS:
        raise StabilityError("the simulated cut has one direction of the feed; give feed_deg a number")
    machine = machine_of(case, request)
    operation = operation_of(case, request)
    axis = request.rule_axis or machine.softer_axis
    cut = case.cut()
    offered = cut.straight() if request.method == "zoa" and request.verify_with_sdm else cut
    lobes_of = partial(lobes_over, cut=offered, request=request, feed_deg=float(case.feed_deg))
    check = StabilityVerification(cut, (float(case.feed_deg),)) if request.verify_with_sdm else None
    strategies: dict[str, SpeedStrategy] = {
        "programmed": ProgrammedSpeed(operation),
        "rule": ResonanceRule(operation, axis=axis, offset_hz=request.offset_hz),
        "tuned": TunedSpeed(operation, request.settings, lobes_of, check),
    }
    states = {name: mill_through(strategy, machine, request) for name, strategy in strategies.items()}
    return judged(states, case, request)


def machine_of(case: StabilityCase, request: WarmUpRequest) -> MillingMachine:
    """Return the machine that mills; raises StabilityError."""
    if request.dynamics == "case":
        range_rpm = request.limits.range_rpm(request.demand.programmed_rpm)
        return CaseMachine(case, range_rpm, request.machine_seed, request.day_seed)
    if request.method != "zoa":
        raise StabilityError(
            "the tool point of the spindle is a receptance over frequency; semi-discretisation needs the modes of the "
            "case (--dynamics case)"
        )
    return SpindleMachine(case, request.machine_seed, request.day_seed)


def operation_of(case: StabilityCase, request: WarmUpRequest) -> MillingOperation:
    """Return the programmed operation with its range of speeds; raises StabilityError."""
    speed_rpm = request.demand.programmed_rpm
    return MillingOperation(
        demand=request.demand,
        feed_mm_min=request.feed_per_tooth_mm * case.teeth * speed_rpm,
        teeth=case.teeth,
        range_rpm=request.limits.range_rpm(speed_rpm),
    )


def lobes_over(response: ToolPointResponse, *, cut: Cut, request: WarmUpRequest, feed_deg: float) -> StabilityLobes:
    """Return the lobes over the range that the speed is chosen from; raises StabilityError."""
    low, high = request.limits.range_rpm(request.demand.programmed_rpm)
    reach = 1.0 + request.demand.tolerance_fraction
    points = CHOICE_POINTS[request.method]
    if request.method == "zoa":
        return zeroth_order_lobes(
            response, cut, from_rpm=low / reach, to_rpm=high * reach, points=points, feed_deg=feed_deg
        )
    if not isinstance(response, ModalResponse):
        raise StabilityError("semi-discretisation needs modes; take the zeroth-order solution")
    return semi_discretised_lobes(
        response, cut, from_rpm=low / reach, to_rpm=high * reach, points=points, feed_deg=feed_deg
    )


def mill_through(strategy: SpeedStrategy, machine: MillingMachine, request: WarmUpRequest) -> list[CutState]:
    """Let the machine stand, then mill minute by minute; return the state in the middle of each cut."""
    spindle = WarmingSpindle(machine.day, machine.sensors, machine_seed=request.machine_seed)
    estimator, known, states = machine.estimator(), None, list[CutState]()
    for _ in range(round(STANDING_S / CYCLE_S) + 1):
        spindle.turn(CYCLE_S, 0.0, feeding=False)
        known = estimator.renew(spindle.time_s, spindle.readings_degc())
    for minute in range(request.minutes):
        pair = strategy.renew(spindle.time_s, Phase.SAFE_POINT, known)
        for cycle in range(round(CUT_S / CYCLE_S)):
            spindle.turn(CYCLE_S, pair.speed_rpm, feeding=True)
            known = estimator.renew(spindle.time_s, spindle.readings_degc())
            in_cut = strategy.renew(spindle.time_s, Phase.CUTTING, known)
            if (in_cut.speed_rpm, in_cut.feed_mm_min) != (pair.speed_rpm, pair.feed_mm_min):
                raise StabilityError(f"the speed changed within the cut of minute {minute}; please report this defect")
            if cycle == round(0.5 * CUT_S / CYCLE_S):
                estimated = {} if known is None else dict(known.resonance_hz)
                states.append(CutState(pair=pair, modes=machine.at(spindle.node_degc), estimated_hz=estimated))
        spindle.turn(SAFE_S, pair.speed_rpm, feeding=True)
        known = estimator.renew(spindle.time_s, spindle.readings_degc())
    return states


def judged(
    states: Mapping[str, Sequence[CutState]], case: StabilityCase, request: WarmUpRequest
) -> tuple[WarmUpRun, ...]:
    """Return the runs with the referee's verdict on every cut, all cuts of all runs side by side."""
    referee = WarmUpReferee(case, request.feed_per_tooth_mm)
    every = [state for run in states.values() for state in run]
    stable = iter(referee.stable(every, np.full(len(every), request.demand.depth_mm)).tolist())
    every_min = request.limit_every_min or request.minutes + 1
    sampled = [state for run in states.values() for state in run[::every_min]] if request.limit_every_min else []
    limits = iter(referee.limiting_depths_mm(sampled, request.demand.depth_mm).tolist() if sampled else [])
    runs = []
    for name, run in states.items():
        minutes = tuple(
            WarmUpMinute(
                time_min=number + 0.5 * CUT_S / 60.0,
                pair=state.pair,
                true_hz=state.true_hz,
                estimated_hz=state.estimated_hz,
                stable=next(stable),
                limiting_depth_mm=next(limits) if sampled and number % every_min == 0 else None,
            )
            for number, state in enumerate(run)
        )
        area_mm2 = request.demand.depth_mm * (case.radial_depth_mm or case.diameter_mm)
        runs.append(WarmUpRun(strategy=name, minutes=minutes, cut_area_mm2=area_mm2))
    return tuple(runs)
