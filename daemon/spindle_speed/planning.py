"""Plans spindle speeds by the cutting case over temperature: slow, so the daemon runs it in a process of its own."""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from config.machine.spindle import Rotary
from config.machine.spindle_chain import read_spindle
from config.machine.stability_case import ALL_DIRECTIONS, StabilityCase, load_stability_case
from config.schema import Configuration
from config.schema.spindle_speed import SpeedOperationConfig, SpindleSpeedConfig
from daemon.snapshots import SpeedDiagram
from daemon.spindle_speed.messages import CalledOperation, PlannedSpeed, PlanRequest
from models.dynamics.assembly import SpindleAssembly
from models.errors import IdentificationError, StabilityError
from models.spindle_speed.beside_the_band import BesideTheBand
from models.spindle_speed.choice import SpeedDemand, SpeedLimits
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tool_point import EstimatedToolPoint
from models.spindle_speed.tracked_tool_point import TrackedToolPoint
from models.spindle_speed.tuning import SpeedPlan
from models.spindle_speed.verification import StabilityVerification
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import lowest_over_feed_directions, zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.response import ToolPointResponse
from models.thermomechanics.regression import ThermomechanicalModel
from models.thermomechanics.tool_point import ToolPointTracker

DIRECTIONS_DEG = tuple(22.5 * number for number in range(8))
"""Feed directions in which a speed is verified where the feed may go every way."""
SPEEDS = 401
"""Speeds among which one is chosen."""
MANY_STEPS = 16
"""The change per step is taken over one step, and over so many: speeds are chosen from a raster."""
SENSITIVITY_EVERY_S = 60.0
"""The change per step of a sensor is worked out this often."""
RESONANCES, RESONANCE_EVERY_S = 480, 180.0
"""So many resonances are kept for people to look at, this far apart [s]: a day of them."""
NAMED = 3
"""Sensors that are named in one sentence."""
DRAWN = 300
"""About so many frequencies of a response are kept for the same."""
STEPS_UNKNOWN = (
    "a signal has had no temperature for a minute, so whether one step of a sensor moves the speed is not known; the "
    "speed is frozen"
)


class OperationPlanning:
    """Everything slow about one configured operation; used by one thread at a time."""

    def __init__(
        self,
        tuning: SpindleSpeedConfig,
        operation: SpeedOperationConfig,
        model: ThermomechanicalModel,
        labels: Mapping[str, Sequence[int]],
    ) -> None:
        """Read spindles and case; raises ConfigurationError, and StabilityError where model and machine do not fit."""
        self._tuning, self._operation = tuning, operation
        self._case = load_stability_case(operation.case)
        if not operation.one_feed_direction:  # a case is written for one cut of the program
            self._case = self._case.model_copy(update={"feed_deg": ALL_DIRECTIONS})
        beyond = self._case.cut().beyond_straight
        if beyond and not tuning.verify_with_sdm:
            raise StabilityError(
                f"{operation.case}: the lobes that offer speeds know no {', '.join(beyond)}; set "
                "spindle_speed.verify_with_sdm, which does, or remove the key"
            )
        rotary: Rotary = "published" if model.rigid_rotary_inertia == "published" else "correct"
        spindles = {axis: read_spindle(path, rotary) for axis, path in operation.spindles.items()}
        for axis, spindle in spindles.items():
            if not spindle.tool:
                raise StabilityError(
                    f"{operation.spindles[axis]}: it holds no tool, and the response of the spindle alone is not the "
                    f"tool's; add `tool`, that of T{operation.tool_number}"
                )
            if model.shaft_sha256 and model.shaft_sha256 != spindle.description.shaft_sha256():
                raise StabilityError(
                    f"{operation.spindles[axis]}: the bearings of {model.model_id} were identified with another shaft "
                    "(segments, joints, materials, or bearings' groups and positions differ): describe the shaft as in "
                    "the file of the impact campaign, or identify the bearings with this one"
                )
        assemblies: dict[str, SpindleAssembly] = {axis: spindle.assembly() for axis, spindle in spindles.items()}
        near_hz = {str(axis): value for axis, value in operation.near_hz.items()}
        try:
            tracker = ToolPointTracker(model, assemblies, labels, near_hz=near_hz)
            self.estimator = TrackedToolPoint(tracker, labels)
        except (ValueError, IdentificationError) as error:
            raise StabilityError(f"{tuning.thermomechanical_model}: {error}") from error
        for axis, path in operation.spindles.items():
            if (beside_hz := tracker.axes[axis].beside_the_band()) is not None:
                low_hz, high_hz = tracker.frequency_hz[[0, -1]]
                raise StabilityError(
                    f"{path}: the largest resonance of T{operation.tool_number} lies at "
                    f"{beside_hz:.0f} Hz, and {low_hz:.0f} to {high_hz:.0f} Hz are computed: a cut would chatter where "
                    "nobody looks; leave this tool out of spindle_speed.operations"
                )
        self._beside = BesideTheBand(tracker) if tuning.verify_with_sdm else None
        self._places = [place for axis in assemblies for name in model.axes[axis].signals for place in labels[name]]

    def disbelief(self, doubted: Mapping[int, str]) -> str:
        """Return which sensors of its signals are not believed, and why, '' when all are."""
        said = [*dict.fromkeys(doubted[place] for place in self._places if place in doubted)]
        if not said:
            return ""
        more = f" and {len(said) - NAMED} more" if len(said) > NAMED else ""
        return (
            f"{', '.join(said[:NAMED])}{more}: see to it, position the work again, and when the temperatures are "
            "right, `toolpoint enable --spindle-speed`; the speed is frozen"
        )

    def unverified(self, plan: SpeedPlan) -> str:
        """Return why the command may stand where nothing was verified, '' when it cannot."""
        tuning, span_rpm = self._tuning, plan.flagged_span_rpm
        allowed_rpm = tuning.tolerance_rpm(plan.choice.speed_rpm)
        if not plan.choice.stable or not 0.0 < span_rpm <= tuning.hysteresis_rpm:
            return ""
        if span_rpm + tuning.hysteresis_rpm <= allowed_rpm:
            return ""
        return (
            f"a flagged property moves the speed by {span_rpm:.0f} 1/min, and hysteresis_rpm of "
            f"{tuning.hysteresis_rpm:g} comes to it: more than the tolerance of {allowed_rpm:.0f} within which a speed "
            "is verified; the speed is frozen: lower hysteresis_rpm, or raise tolerance_percent"
        )

    def planner(self, called: CalledOperation) -> SpeedPlanner:
        """Return what plans the speed of an operation; raises StabilityError where it cannot be planned."""
        tuning, case = self._tuning, self._case
        depth_mm = called.depth_mm or self._operation.depth_mm
        if not depth_mm:
            raise StabilityError(
                f"neither the call (D) nor depth_mm of T{called.tool_number} says how deep it cuts; say one of them"
            )
        if called.radial_mm:
            case = _with_radial(case, called.radial_mm)
        limits = SpeedLimits(
            machine_lowest_rpm=tuning.lowest_rpm,
            machine_highest_rpm=tuning.highest_rpm,
            tool_highest_rpm=self._operation.highest_rpm or tuning.highest_rpm,
            within_fraction=tuning.max_change_percent / 100.0,
        )
        range_rpm = limits.range_rpm(called.speed_rpm)
        if self._beside is not None:
            self._beside.check(case.cut().straight(), _feeds_deg(case), depth_mm, range_rpm[1])
        if tuning.hysteresis_rpm > (allowed_rpm := tuning.tolerance_rpm(range_rpm[0])):
            raise StabilityError(
                f"spindle_speed.hysteresis_rpm of {tuning.hysteresis_rpm:g} is more than tolerance_percent allows at "
                f"{range_rpm[0]:g} 1/min, which is {allowed_rpm:g}: the command may stand so far off the speed that "
                "was verified; lower it, or raise tolerance_percent"
            )
        demand = SpeedDemand(
            programmed_rpm=called.speed_rpm,
            depth_mm=depth_mm,
            margin_fraction=tuning.margin_percent / 100.0,
            tolerance_fraction=tuning.tolerance_percent / 100.0,
        )
        operation = MillingOperation(
            demand=demand,
            feed_mm_min=called.feed_mm_min,
            teeth=case.teeth,
            range_rpm=range_rpm,
            offset_hz=tuning.offset_hz,
        )
        lobes_of = partial(_lobes, cut=case.cut().straight(), operation=operation, feed_deg=case.feed_deg)
        return SpeedPlanner(operation, lobes_of, _verification(case) if tuning.verify_with_sdm else None)


def _verification(case: StabilityCase) -> StabilityVerification:
    return StabilityVerification(case.cut(), _feeds_deg(case))


def _feeds_deg(case: StabilityCase) -> tuple[float, ...]:
    return DIRECTIONS_DEG if case.feed_deg == ALL_DIRECTIONS else (float(case.feed_deg),)


def _with_radial(case: StabilityCase, radial_mm: float) -> StabilityCase:
    milling = "slot" if radial_mm >= case.diameter_mm else case.milling
    if milling == "slot" and radial_mm < case.diameter_mm:
        raise StabilityError(f"the call says E{radial_mm:g}, and the case is a slot of {case.diameter_mm:g} mm")
    return case.model_copy(update={"radial_depth_mm": min(radial_mm, case.diameter_mm), "milling": milling})


def _lobes(
    response: ToolPointResponse, *, cut: Cut, operation: MillingOperation, feed_deg: float | str
) -> StabilityLobes:
    reach = 1.0 + operation.demand.tolerance_fraction
    low, high = operation.range_rpm[0] / reach, operation.range_rpm[1] * reach
    if feed_deg == ALL_DIRECTIONS:
        return lowest_over_feed_directions(response, cut, from_rpm=low, to_rpm=high, points=SPEEDS)
    return zeroth_order_lobes(response, cut, from_rpm=low, to_rpm=high, points=SPEEDS, feed_deg=float(feed_deg))


def planned_with(configuration: Configuration, model: ThermomechanicalModel) -> dict[int, OperationPlanning]:
    """Return the planning of each operation with a model; raises ConfigurationError and StabilityError."""
    tuning = configuration.spindle_speed
    if tuning is None:
        return {}
    labels = configuration.temperatures.labels
    return {
        place: OperationPlanning(tuning, operation, model, labels) for place, operation in enumerate(tuning.operations)
    }


class _Diagrams:
    """Keeps what people look at: the resonances of a day, and once a minute response and lobes."""

    def __init__(self) -> None:
        self._resonances: deque[tuple[float, dict[str, float]]] = deque(maxlen=RESONANCES)
        self._tool_number: int | None = None
        self._latest: tuple[CalledOperation, float, SpeedDiagram] | None = None

    def note(self, tool_number: int, time_s: float, known: EstimatedToolPoint | None) -> None:
        """Keep a followed resonance of a tool, not more often than a day of them has room."""
        if tool_number != self._tool_number:
            self._tool_number = tool_number
            self._resonances.clear()
        if known is not None and (not self._resonances or time_s - self._resonances[-1][0] >= RESONANCE_EVERY_S):
            self._resonances.append((time_s, dict(known.resonance_hz)))

    def of(
        self, called: CalledOperation, planner: SpeedPlanner, known: EstimatedToolPoint, time_s: float
    ) -> SpeedDiagram | None:
        """Return the diagram of an operation; None where there are no lobes: a plan does not depend on it."""
        latest = self._latest
        if latest is None or latest[0] != called or time_s - latest[1] >= SENSITIVITY_EVERY_S:
            try:
                latest = self._latest = (called, time_s, self._made(planner, known))
            except StabilityError:
                return None
        return latest[2]

    def _made(self, planner: SpeedPlanner, known: EstimatedToolPoint) -> SpeedDiagram:
        lobes, operation = planner.lobes(known.response), planner.operation
        every_hz = known.response.frequencies_hz(operation.range_rpm[1] / 60.0 * operation.teeth)
        frequency_hz = every_hz[:: max(1, len(every_hz) // DRAWN)]
        receptance = np.abs(known.response.receptance_m_per_n(frequency_hz)) * 1e6
        times, found = zip(*self._resonances, strict=True) if self._resonances else ((), ())
        return SpeedDiagram(
            frequency_hz=tuple(frequency_hz.tolist()),
            receptance_um_per_n={axis: tuple(receptance[:, i, i].tolist()) for i, axis in enumerate(("x", "y"))},
            speed_rpm=tuple(lobes.speed_rpm.tolist()),
            limiting_depth_mm=tuple(d if np.isfinite(d) else None for d in lobes.limiting_depth_mm.tolist()),
            demanded_depth_mm=operation.demand.depth_mm,
            resonance_time_s=times,
            resonance_hz={axis: tuple(each.get(axis, np.nan) for each in found) for axis in known.resonance_hz},
        )


class SpeedPlanning:
    """Answers requests in turn: feeds the temperatures to every operation's estimator, and plans the one under way."""

    def __init__(self, operations: Mapping[int, OperationPlanning], sensor_step_k: float) -> None:
        self._operations, self._sensor_step_k = operations, sensor_step_k
        self._planner: tuple[CalledOperation, SpeedPlanner] | None = None
        self._sensitivity: tuple[CalledOperation, float, dict[str, float]] | None = None
        self._diagrams = _Diagrams()

    def answer(self, request: PlanRequest) -> PlannedSpeed | None:
        """Return the plan of the operation under way, None where there is none."""
        planned: PlannedSpeed | None = None
        for place, planning in self._operations.items():
            for time_s, degc in request.readings:
                planning.estimator.renew(time_s, np.array(degc, dtype=np.float64))
            if place == request.place and request.called is not None:
                self._diagrams.note(request.called.tool_number, request.time_s, planning.estimator.known)
                planned = self._planned(planning, request.called, request.time_s, planning.disbelief(request.doubted))
        return planned

    def _planned(
        self, planning: OperationPlanning, called: CalledOperation, time_s: float, not_believed: str
    ) -> PlannedSpeed:
        known = planning.estimator.known
        waits = not_believed or planning.estimator.waits or "no temperatures yet"
        plan, problem, changes, diagram = None, waits, dict[str, float](), None
        if known is not None:
            problem = "; ".join(filter(None, (not_believed, known.inhibit)))
            try:
                planner = self._planner_of(planning, called)
                changes = self._changes(planning, planner, called, time_s)
                if not changes and not problem:
                    problem = STEPS_UNKNOWN
                plan = None if problem else planner.plan(known)
                problem = problem if plan is None else planning.unverified(plan)
                diagram = self._diagrams.of(called, planner, known, time_s)
            except StabilityError as error:
                problem = str(error)
        return PlannedSpeed(
            called=called,
            time_s=time_s,
            plan=plan,
            problem=problem,
            resonance_hz={} if known is None else dict(known.resonance_hz),
            change_per_step_rpm=changes,
            diagram=diagram,
        )

    def _planner_of(self, planning: OperationPlanning, called: CalledOperation) -> SpeedPlanner:
        if self._planner is None or self._planner[0] != called:
            self._planner = (called, planning.planner(called))
        return self._planner[1]

    def _changes(
        self, planning: OperationPlanning, planner: SpeedPlanner, called: CalledOperation, time_s: float
    ) -> dict[str, float]:
        kept = self._sensitivity
        if kept is not None and kept[0] == called and time_s - kept[1] < SENSITIVITY_EVERY_S:
            return kept[2]
        known, changes = planning.estimator.known, dict[str, float]()
        if known is None:
            return changes
        for steps in (1, MANY_STEPS):
            moved = planning.estimator.stepped(steps * self._sensor_step_k)
            for signal, change_rpm in planner.change_per_step_rpm(known, moved).items():
                changes[signal] = max(changes.get(signal, 0.0), change_rpm / steps)
        if changes:
            self._sensitivity = (called, time_s, changes)
        return changes
