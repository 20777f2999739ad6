"""Plans of the spindle speed, computed beside the loop: the loop hands readings over and takes up what is done."""

import asyncio
from collections import deque
from dataclasses import dataclass

import structlog

from config.schema import Configuration
from daemon.model_release.file_access import own_account
from daemon.spindle_speed.planning import CalledOperation, OperationPlanning, open_planning
from models.records import FloatArray
from models.spindle_speed.planner import SpeedPlan, SpeedPlanner
from models.stability.errors import StabilityError

log = structlog.get_logger(__name__)

MOST_READINGS = 60
"""Readings that may wait; older ones are left out."""
MANY_STEPS = 16
"""The change per step is looked at over one step, and over so many: speeds are chosen from a raster."""
SENSITIVITY_EVERY_S = 60.0
"""The change per step of a sensor is worked out this often."""
STEPS_UNKNOWN = (
    "a signal has had no temperature for a minute, so whether one step of a sensor moves the speed is not known; the "
    "speed is frozen"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedSpeed:
    """The latest plan of an operation, or why there is none."""

    called: CalledOperation
    time_s: float
    """Of the temperatures [s]."""
    plan: SpeedPlan | None
    problem: str
    resonance_hz: dict[str, float]
    change_per_step_rpm: dict[str, float]
    """Signal -> how far one step of its sensors moves the target [1/min]."""


class SpeedWorker:
    """Computes in one thread at a time; owned by the control task."""

    def __init__(self, configuration: Configuration) -> None:
        self._tuning = configuration.spindle_speed
        opened = open_planning(configuration, own_account())
        self._planning, self.obstacle, self.model = opened.operations, opened.obstacle, opened.model
        self._readings: deque[tuple[float, FloatArray]] = deque(maxlen=MOST_READINGS)
        self._last_s: float | None = None
        self._task: asyncio.Task[PlannedSpeed | None] | None = None
        self._planner: tuple[CalledOperation, SpeedPlanner] | None = None
        self._sensitivity: tuple[CalledOperation, float, dict[str, float]] | None = None
        self.latest: PlannedSpeed | None = None

    def take(self, time_s: float, degc: FloatArray) -> None:
        """Take a reading of all sensors [degC]."""
        if self._planning:
            self._readings.append((time_s, degc))
            self._last_s = time_s

    def look(self, called: CalledOperation | None, place: int | None) -> None:
        """Take up what is done, and begin with what waits; returns at once."""
        if self._task is not None:
            if not self._task.done():
                return
            task, self._task = self._task, None
            if (error := task.exception()) is not None:
                log.error("spindle_speed.defect", error=repr(error))
                self._planning, self.obstacle = {}, f"unexpected {type(error).__name__} in the planning: {error}"
                return
            self.latest = task.result() or self.latest
        unplanned = called is not None and place is not None and (self.latest is None or self.latest.called != called)
        if self._last_s is not None and (self._readings or unplanned):
            readings = list(self._readings)
            self._readings.clear()
            self._task = asyncio.create_task(asyncio.to_thread(self._compute, readings, self._last_s, called, place))

    async def settled(self) -> None:
        """Wait for what is being computed."""
        if self._task is not None:
            await asyncio.wait([self._task])

    def _compute(
        self, readings: list[tuple[float, FloatArray]], now_s: float, called: CalledOperation | None, place: int | None
    ) -> PlannedSpeed | None:
        """Feed every estimator, and plan the speed of the operation under way."""
        planned: PlannedSpeed | None = None
        for number, planning in self._planning.items():
            for time_s, degc in readings:
                planning.estimator.renew(time_s, degc)
            if number == place and called is not None:
                planned = self._planned(planning, called, now_s)
        return planned

    def _planned(self, planning: OperationPlanning, called: CalledOperation, time_s: float) -> PlannedSpeed:
        known = planning.estimator.known
        plan, problem, changes = None, "no temperatures yet", dict[str, float]()
        if known is not None:
            problem = known.doubt
            try:
                planner = self._planner_of(planning, called)
                changes = self._changes(planning, planner, called, time_s)
                if not changes and not problem:
                    problem = STEPS_UNKNOWN
                plan = None if problem else planner.plan(known)
            except StabilityError as error:
                problem = str(error)
        return PlannedSpeed(
            called=called,
            time_s=time_s,
            plan=plan,
            problem=problem,
            resonance_hz={} if known is None else dict(known.resonance_hz),
            change_per_step_rpm=changes,
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
        assert self._tuning is not None
        known, changes = planning.estimator.known, dict[str, float]()
        if known is None:
            return changes
        for steps in (1, MANY_STEPS):
            moved = planning.estimator.stepped(steps * self._tuning.sensor_step_k)
            for signal, change_rpm in planner.change_per_step_rpm(known, moved).items():
                changes[signal] = max(changes.get(signal, 0.0), change_rpm / steps)
        if changes:
            self._sensitivity = (called, time_s, changes)
        return changes
