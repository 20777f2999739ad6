"""The simulated machine mills through its warm-up, once for each way to choose the spindle speed.

What the tuner knows comes from an estimator that was fitted on impact tests of other days; whether a cut chatters is
said by the time-domain simulation with the machine's true modes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema.temperatures import SensorConfig
from config.stability_case import ALL_DIRECTIONS, StabilityCase
from daemon.rehearsal.warm_up_referee import CutState, WarmUpReferee
from daemon.stability.case_files import modal_response_of
from drivers.sim.day import Day
from drivers.sim.warming_spindle import VibrationModes, WarmingModes, WarmingSpindle, impact_response
from models.records import FloatArray, Phase
from models.stability.errors import StabilityError
from models.stability.frf_modal_fit import fit_modes
from models.stability.lobes import StabilityLobes
from models.stability.lobes_sdm import semi_discretised_lobes
from models.stability.lobes_zoa import zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.modal_regression import (
    AXES,
    INTERVAL_S,
    MEAN_S,
    ModalEstimator,
    ModalRegression,
    ModalSample,
    SignalHistory,
)
from models.stability.response import ModalResponse, Mode, ToolPointResponse
from models.stability.speed_planner import MillingOperation
from models.stability.speed_strategies import (
    ProgrammedSpeed,
    ResonanceRule,
    SpeedInForce,
    SpeedStrategy,
    TunedSpeed,
)
from models.stability.speed_tuning import SpeedTuningSettings
from models.stability.spindle_speed import SpeedDemand, SpeedLimits
from models.stability.tool_point import ToolPointEstimator

SIGNALS = ("IR", "A", "F", "Room")
"""Labels of the sensors that explain the dynamics, those of the source."""
CYCLE_S = 10.0
"""A reading of all sensors [s]."""
CUT_S, SAFE_S = 50.0, 10.0
"""A minute is a cut and a safe point [s]."""
STANDING_S = INTERVAL_S + MEAN_S
"""The machine stands so long before it mills, so that the changes of temperature are known [s]."""
CAMPAIGN_DAYS = 6
CAMPAIGN_SPEEDS_RPM = (12000.0, 6000.0, 9000.0)
CAMPAIGN_STRETCHES_MIN = (30, 20, 30, 25)
"""A stretch at each of the speeds in turn, and one standing."""
IMPACT_EVERY_MIN = 2
LINE_HZ = 1.5625
"""Between the lines of the measured responses [Hz]."""
CHOICE_POINTS = {"zoa": 601, "sdm": 121}
LEAST_GAIN_SHARE = 0.05
"""A velocity term of a mode above this share of its displacement term is no real mode's."""
USUAL_SETTINGS = SpeedTuningSettings(hysteresis_rpm=30.0, dwell_s=20.0, step_rpm=300.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUpRequest:
    """What is milled, and how the speed may be chosen."""

    demand: SpeedDemand
    limits: SpeedLimits
    minutes: int = 60
    feed_per_tooth_mm: float = 0.05
    method: str = "zoa"
    rule_axis: str | None = None
    """Followed by the source's rule; None: the axis that is softer at its resonance."""
    offset_hz: float = 20.0
    settings: SpeedTuningSettings = USUAL_SETTINGS
    machine_seed: int = 1
    day_seed: int = 1
    limit_every_min: int | None = 5
    """How often the limiting depth at the commanded speed is looked for; None: never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WarmUpMinute:
    """One cut of a minute."""

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
    """Return the warm-up without tuning, with the source's rule, and with ours; raises StabilityError."""
    if case.feed_deg == ALL_DIRECTIONS:
        raise StabilityError("the simulated cut has one direction of the feed; give feed_deg a number")
    cold = cold_modes(case, request.limits.range_rpm(request.demand.programmed_rpm))
    sensors = load_configuration(shipped_file("cfrpmt.yaml")).temperatures.sensors
    machine = WarmingModes(cold, request.machine_seed)
    labels = {name: [i for i, sensor in enumerate(sensors) if sensor.label == name] for name in SIGNALS}
    regression = ModalRegression(impact_tests(machine, sensors, labels, request.machine_seed))
    operation = operation_of(case, request)
    axis = request.rule_axis or ("x" if _softest(cold, 0) >= _softest(cold, 1) else "y")
    lobes_of = partial(lobes_over, cut=case.cut(), request=request, feed_deg=float(case.feed_deg))
    strategies: dict[str, SpeedStrategy] = {
        "programmed": ProgrammedSpeed(operation),
        "rule": ResonanceRule(operation, axis=axis, offset_hz=request.offset_hz),
        "tuned": TunedSpeed(operation, request.settings, lobes_of),
    }
    states = {
        name: mill_through(strategy, ModalEstimator(regression, labels), machine, sensors, request)
        for name, strategy in strategies.items()
    }
    return judged(states, case, request)


def operation_of(case: StabilityCase, request: WarmUpRequest) -> MillingOperation:
    """Return the programmed operation with its range of speeds; raises StabilityError."""
    speed_rpm = request.demand.programmed_rpm
    return MillingOperation(
        demand=request.demand,
        feed_mm_min=request.feed_per_tooth_mm * case.teeth * speed_rpm,
        teeth=case.teeth,
        range_rpm=request.limits.range_rpm(speed_rpm),
    )


def cold_modes(case: StabilityCase, range_rpm: tuple[float, float]) -> VibrationModes:
    """Return the modes of a case as those of the cold machine.

    Raises
    ------
    StabilityError
        When a mode is not real, or one axis acts on the other: the simulated cut knows neither.

    """
    response, _ = modal_response_of(case, *range_rpm)
    if response.xy or response.yx:
        raise StabilityError("the simulated machine has no cross receptance; leave xy and yx out")
    found: list[tuple[int, Mode]] = [(0, mode) for mode in response.xx] + [(1, mode) for mode in response.yy]
    for _, mode in found:
        gain = mode.displacement_gain_per_kg
        if gain <= 0.0 or abs(mode.velocity_gain_s_per_kg) * mode.angular_rad_s > LEAST_GAIN_SHARE * gain:
            raise StabilityError(
                f"the mode at {mode.frequency_hz:.1f} Hz is not real, and the simulated machine has real modes only; "
                "give modes with mass_kg or stiffness_n_per_m"
            )
    return VibrationModes(
        axis=tuple(axis for axis, _ in found),
        frequency_hz=np.array([mode.frequency_hz for _, mode in found]),
        damping_ratio=np.array([mode.damping_ratio for _, mode in found]),
        stiffness_n_per_m=np.array([mode.angular_rad_s**2 / mode.displacement_gain_per_kg for _, mode in found]),
    )


def impact_tests(
    machine: WarmingModes, sensors: Sequence[SensorConfig], labels: Mapping[str, Sequence[int]], machine_seed: int
) -> list[ModalSample]:
    """Return the modes fitted to impact tests over warm-up and idle on days of the machine's past."""
    top_hz = 1.4 * float(machine.cold.frequency_hz.max())
    frequency_hz = np.arange(LINE_HZ * round(0.3 * float(machine.cold.frequency_hz.min()) / LINE_HZ), top_hz, LINE_HZ)
    samples = []
    for number in range(CAMPAIGN_DAYS):
        rng = np.random.default_rng([machine_seed, number, 72])
        day = Day.draw(100_000 * (machine_seed + 1) + number, start="cold")
        spindle, history = WarmingSpindle(day, sensors, machine_seed=machine_seed), SignalHistory(labels)
        for minute, speed_rpm in enumerate(_campaign()):
            for _ in range(round(60.0 / CYCLE_S)):
                spindle.turn(CYCLE_S, speed_rpm, feeding=speed_rpm > 0.0)
                history.add(spindle.time_s, spindle.readings_degc())
            signals = history.now(spindle.time_s)
            if signals is None or minute % IMPACT_EVERY_MIN:
                continue
            true = machine.at(spindle.node_degc)
            modes = {
                name: _fitted(true, axis, frequency_hz, rng) for axis, name in enumerate(AXES) if axis in true.axis
            }
            samples.append(ModalSample(degc=signals[0], difference_k=signals[1], modes=modes))
    return samples


def _campaign() -> list[float]:
    """Return the spindle speed of every minute of a day of impact tests [1/min]."""
    minutes = [0.0] * round(STANDING_S / 60.0 + 1.0)
    for stretch, speed_rpm in zip(CAMPAIGN_STRETCHES_MIN, (*CAMPAIGN_SPEEDS_RPM, 0.0), strict=True):
        minutes += [speed_rpm] * stretch
    return minutes


def _fitted(true: VibrationModes, axis: int, frequency_hz: FloatArray, rng: np.random.Generator) -> tuple[Mode, ...]:
    measured = impact_response(true, axis, frequency_hz, rng)
    fit = fit_modes(frequency_hz, measured.astype(np.complex128), pairs=true.axis.count(axis))
    return tuple(replace(mode, velocity_gain_s_per_kg=0.0) for mode in fit.modes)


def _softest(modes: VibrationModes, axis: int) -> float:
    """Return the largest receptance at a resonance of an axis [m/N], 0 for a rigid one."""
    here = np.array(modes.axis) == axis
    return float(np.max(1.0 / (2.0 * modes.damping_ratio * modes.stiffness_n_per_m)[here], initial=0.0))


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


def mill_through(
    strategy: SpeedStrategy,
    estimator: ToolPointEstimator,
    machine: WarmingModes,
    sensors: Sequence[SensorConfig],
    request: WarmUpRequest,
) -> list[CutState]:
    """Let the machine stand, then mill minute by minute; return the state in the middle of each cut."""
    spindle = WarmingSpindle(Day.draw(request.day_seed, start="cold"), sensors, machine_seed=request.machine_seed)
    known, states = None, []
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
