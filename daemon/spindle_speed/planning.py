"""Builds, for each configured operation, what plans its speed: spindle, bearings over temperature, cutting case."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from config.machine.spindle import Rotary
from config.machine.spindle_files import read_spindle
from config.machine.stability_case import ALL_DIRECTIONS, StabilityCase, load_stability_case
from config.problems import ConfigurationError
from config.schema import Configuration
from config.schema.spindle_speed import SpeedOperationConfig, SpindleSpeedConfig
from daemon.model_release.bearing_loading import load_released_bearings
from daemon.model_release.file_access import Account
from daemon.model_release.loading import LoadedModel
from models.dynamics.assembly import SpindleAssembly
from models.dynamics.errors import IdentificationError
from models.spindle_speed.choice import SpeedDemand, SpeedLimits
from models.spindle_speed.planner import MillingOperation, SpeedPlanner
from models.spindle_speed.tracked_tool_point import TrackedToolPoint
from models.spindle_speed.verification import StabilityVerification
from models.stability.errors import StabilityError
from models.stability.lobes import StabilityLobes
from models.stability.lobes_zoa import lowest_over_feed_directions, zeroth_order_lobes
from models.stability.milling import Cut
from models.stability.response import ToolPointResponse
from models.thermomechanics.regression import ThermomechanicalModel
from models.thermomechanics.tool_point import ToolPointTracker

DIRECTIONS_DEG = tuple(22.5 * number for number in range(8))
"""Feed directions of the second look where the case names none."""
SPEEDS = 401
"""Speeds among which one is chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalledOperation:
    """What the NC program says of the operation that it begins."""

    tool_number: int
    program: int
    speed_rpm: float
    feed_mm_min: float
    depth_mm: float
    """0: the configured one."""
    radial_mm: float
    """0: that of the case."""


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
        rotary: Rotary = "published" if model.rigid_rotary_inertia == "published" else "correct"
        assemblies: dict[str, SpindleAssembly] = {
            axis: read_spindle(path, rotary).assembly() for axis, path in operation.spindles.items()
        }
        near_hz = {str(axis): value for axis, value in operation.near_hz.items()}
        try:
            tracker = ToolPointTracker(model, assemblies, labels, near_hz=near_hz)
            self.estimator = TrackedToolPoint(tracker, labels)
        except (ValueError, IdentificationError) as error:
            raise StabilityError(f"{tuning.thermomechanical_model}: {error}") from error

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
            range_rpm=limits.range_rpm(called.speed_rpm),
            offset_hz=tuning.offset_hz,
        )
        lobes_of = partial(_lobes, cut=case.cut(), operation=operation, feed_deg=case.feed_deg)
        return SpeedPlanner(operation, lobes_of, _second_look(case) if tuning.verify_with_sdm else None)


def _second_look(case: StabilityCase) -> StabilityVerification:
    feeds_deg = DIRECTIONS_DEG if case.feed_deg == ALL_DIRECTIONS else (float(case.feed_deg),)
    return StabilityVerification(case.cut(), feeds_deg)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedPlanning:
    """The planning of the configured operations, or why there is none, and which model it follows."""

    operations: dict[int, OperationPlanning]
    """By the place of the operation in the configuration."""
    obstacle: str
    model: LoadedModel[ThermomechanicalModel] | None
    """None without a section `spindle_speed`."""


def open_planning(configuration: Configuration, account: Account) -> OpenedPlanning:
    """Return the planning of each configured operation with the released model, as this account may use it."""
    if configuration.spindle_speed is None:
        return OpenedPlanning(operations={}, obstacle="", model=None)
    loaded = load_released_bearings(configuration, account)
    if loaded.model is None:
        return OpenedPlanning(operations={}, obstacle=loaded.obstacle, model=loaded)
    try:
        return OpenedPlanning(operations=planned_with(configuration, loaded.model), obstacle="", model=loaded)
    except (ConfigurationError, StabilityError) as error:
        return OpenedPlanning(operations={}, obstacle=str(error), model=loaded)


def planned_with(configuration: Configuration, model: ThermomechanicalModel) -> dict[int, OperationPlanning]:
    """Return the planning of each operation with a model; raises ConfigurationError and StabilityError."""
    tuning = configuration.spindle_speed
    if tuning is None:
        return {}
    labels = configuration.temperatures.labels
    return {
        place: OperationPlanning(tuning, operation, model, labels) for place, operation in enumerate(tuning.operations)
    }
