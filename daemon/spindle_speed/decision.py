"""Decides which speed an operation should have now, from its latest plan and the speed it has come to."""

import math
from dataclasses import dataclass, replace

from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.cnc.events import Journal
from daemon.spindle_speed.calls import SpeedOperation
from daemon.spindle_speed.macro_block import DISABLED, SpeedPair
from daemon.spindle_speed.messages import PlannedSpeed
from daemon.spindle_speed.planner_process import SpeedWorker
from daemon.state_store.documents import OperationSpeed, SpindleSpeeds, SpindleSpeedSwitch
from drivers.clock import Clock
from models.records import Phase
from models.spindle_speed.tuning import (
    SpeedState,
    SpeedTuningError,
    SpeedTuningInputs,
    SpeedTuningMemory,
    SpeedTuningSettings,
    SpindleSpeedCommand,
    initial_memory,
    step,
)

FEED_DECIMALS, FEED_DIGITS = 2, 7
"""Feeds are whole hundredths [mm/min], as the check counts them; below 10 they have this many significant digits."""


PLANNING = "no dynamics for this operation yet"
KEPT_S = 3600.0
"""A speed this old says nothing about the spindle of now: the operation then begins anew [s]."""
MOST_OPERATIONS = 50
"""So many are kept, the latest."""
Key = tuple[float, ...]


class OperationMemories:
    """The memory of every operation of the last hour, kept over a restart; owned by the control task."""

    def __init__(self, journal: Journal, clock: Clock) -> None:
        self._journal, self._clock = journal, clock
        self._kept: dict[Key, tuple[SpeedTuningMemory, bool]] = {}
        now = clock.now()
        kept = journal.kept(SpindleSpeeds)
        for entry in () if kept is None else kept.operations:
            age_s = now.utc_s - entry.utc_s
            memory = initial_memory(entry.programmed_rpm)
            if 0.0 <= age_s <= KEPT_S:
                memory = replace(memory, commanded_rpm=entry.commanded_rpm, begun=True, last_s=now.monotonic_s - age_s)
                self._kept[entry.key] = memory, entry.moved

    def begin(self, operation: SpeedOperation, lowest_rpm: float, highest_rpm: float) -> tuple[SpeedTuningMemory, bool]:
        """Return the memory with which an operation begins, or begins again, and whether the NC has yet to take it.

        What the target has done meanwhile counts as having lasted; a speed out of the bounds of now does not count.
        """
        programmed_rpm = operation.made_for.speed_rpm
        kept, moved = self._kept.get(_key(operation), (initial_memory(programmed_rpm), False))
        if not kept.begun or self._clock.now().monotonic_s - kept.last_s > KEPT_S:
            return initial_memory(programmed_rpm), False
        if kept.commanded_rpm != programmed_rpm and not lowest_rpm <= kept.commanded_rpm <= highest_rpm:
            return initial_memory(programmed_rpm), False
        since_s = kept.off_since_s if math.isfinite(kept.off_since_s) else kept.last_s
        return replace(kept, target_rpm=math.nan, off_since_s=since_s), moved

    def keep(self, operation: SpeedOperation, memory: SpeedTuningMemory, moved: bool) -> None:
        key = _key(operation)
        before = self._kept.pop(key, None)
        self._kept[key] = memory, moved
        for old in list(self._kept)[:-MOST_OPERATIONS]:
            del self._kept[old]
        if memory.begun and (before is None or (before[0].commanded_rpm, before[1]) != (memory.commanded_rpm, moved)):
            begun = tuple(self._entry(*kept) for kept in self._kept.items() if kept[1][0].begun)
            self._journal.keep(SpindleSpeeds(operations=begun))

    def _entry(self, key: Key, kept: tuple[SpeedTuningMemory, bool]) -> OperationSpeed:
        memory, moved = kept
        now = self._clock.now()
        age_s = now.monotonic_s - memory.last_s if math.isfinite(memory.last_s) else 0.0
        return OperationSpeed(
            key=key,
            programmed_rpm=memory.programmed_rpm,
            commanded_rpm=memory.commanded_rpm,
            moved=moved,
            utc_s=now.utc_s - age_s,
        )


def _key(operation: SpeedOperation) -> Key:
    made_for = operation.made_for
    return (
        made_for.tool_number,
        made_for.speed_rpm,
        made_for.feed_mm_min,
        made_for.depth_mm,
        made_for.radial_mm,
        made_for.kind,
        -1.0 if operation.place is None else float(operation.place),
    )


class SpeedSwitch:
    """On, until a person says otherwise; owned by the control task."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        kept = journal.kept(SpindleSpeedSwitch)
        self._off_by = "" if kept is None else kept.off_by

    @property
    def inhibit(self) -> str:
        """Who has switched it off, in words; '' while it is on."""
        if not self._off_by:
            return ""
        return f"switched off by {self._off_by}; `toolpoint enable --spindle-speed` switches it on"

    def turn(self, *, on: bool, person: str) -> None:
        """Switch on or off; nothing moves by that, the NC takes what follows from it with its next call."""
        self._off_by = "" if on else person
        self._journal.keep(SpindleSpeedSwitch(off_by=self._off_by))
        self._journal.event("request", f"{'enable' if on else 'disable'} the tuning of the spindle speed", person)


@dataclass(frozen=True, slots=True, kw_only=True)
class OperationState:
    """Where the operation under way stands; taken back whole when a write fails."""

    memory: SpeedTuningMemory
    command: SpindleSpeedCommand | None = None
    decided: bool = False
    """The operation has had a decision at a safe block from present dynamics, so the block may be written for it."""
    known_s: float = -math.inf
    """Latest dynamics that could be followed [s]."""
    moved: bool = False
    """It has changed: not again before the NC has taken that, and has cut with it."""
    origin: SpeedTuningMemory | None = None
    """From what it has changed, until the NC takes that: a change that has grown old meanwhile is decided anew."""
    alarm: str = ""

    @property
    def lasting(self) -> tuple[SpeedTuningMemory, bool]:
        """The memory that counts when the operation comes again, and whether the NC has yet to cut with it."""
        return (self.memory, self.moved) if self.origin is None else (self.origin, False)

    def seen(self, taken_rpm: float, *, cuts: bool) -> "OperationState":
        """Return where the operation stands when the NC has taken this speed for it [1/min], and `cuts` with it."""
        if not self.moved:
            return self
        if taken_rpm == float(round(self.memory.commanded_rpm)):
            return replace(self, moved=not cuts, origin=None)
        if self.origin is None or taken_rpm == float(round(self.origin.commanded_rpm)):
            return self
        # the NC was quicker than a change that was decided anew: what it has taken is what counts
        return replace(self, memory=replace(self.memory, commanded_rpm=taken_rpm), origin=None)


class SpeedDecision:
    """Decides with `models.spindle_speed.tuning.step`; touches neither CNC nor store."""

    def __init__(self, tuning: SpindleSpeedConfig, worker: SpeedWorker) -> None:
        self._tuning, self._worker = tuning, worker
        self._settings = SpeedTuningSettings(
            hysteresis_rpm=tuning.hysteresis_rpm,
            dwell_s=tuning.dwell_s,
            step_rpm=tuning.step_rpm,
            filter_s=tuning.filter_s,
            keep_feed_per_tooth=tuning.keep_feed_per_tooth,
        )

    def decide(self, before: OperationState, operation: SpeedOperation, now_s: float, phase: Phase) -> OperationState:
        """Return where the operation stands with what is known now; changed only at a safe block."""
        planned, problem = self._planned(operation, now_s) if operation.wanted else (None, operation.problem)
        plan = planned.plan if planned is not None and not problem else None
        at_safe_block = phase is Phase.SAFE_POINT
        inputs = SpeedTuningInputs(
            now_s=now_s,
            phase=Phase.IDLE if before.moved and at_safe_block else phase,
            enabled=operation.wanted,
            programmed_rpm=operation.made_for.speed_rpm,
            programmed_feed_mm_min=operation.made_for.feed_mm_min,
            choice=plan.choice if plan is not None else None,
            flagged_span_rpm=plan.flagged_span_rpm if plan is not None else 0.0,
        )
        command, memory = step(before.memory, inputs, self._settings)
        moved, origin = before.moved or command.write, before.memory if command.write else before.origin
        if at_safe_block and command.due and before.origin is not None:
            command, memory = step(before.origin, replace(inputs, phase=phase), self._settings)
            moved, origin = command.write, before.origin if command.write else None
        if operation.wanted and planned is None:  # it is not known yet how far the target is off: that stays noted
            memory = replace(memory, off_since_s=before.memory.off_since_s)
        known_s = now_s if plan is not None else before.known_s
        outdated = now_s - known_s > KEPT_S
        if outdated and operation.wanted and math.isfinite(known_s):
            problem = f"{problem}; that has been so for an hour, so the programmed speed is taken"
            command = replace(command, reason="no valid dynamics for an hour; the programmed speed")
        if outgrown := phase is Phase.IDLE and command.due:
            memory, moved, origin = origin or memory, False, None
        return OperationState(
            memory=memory,
            command=command,
            decided=not (outdated or outgrown) and (before.decided or (at_safe_block and plan is not None)),
            known_s=known_s,
            moved=moved,
            origin=origin,
            alarm=(command.alarm if operation.wanted else None) or problem,
        )

    def _planned(self, operation: SpeedOperation, now_s: float) -> tuple[PlannedSpeed | None, str]:
        """Return the latest plan of this operation and what stands against following it, '' when nothing does."""
        planned = self._worker.latest
        if self._worker.inhibit:
            return None, self._worker.inhibit
        if planned is None or planned.called != operation.called:
            return None, PLANNING
        if now_s - planned.time_s > self._tuning.stale_after_s:
            return planned, f"no temperatures for {self._tuning.stale_after_s:g} s; the speed is frozen"
        if planned.problem:
            return planned, planned.problem
        try:
            self._settings.check_resolution(max(planned.change_per_step_rpm.values(), default=0.0))
        except SpeedTuningError as error:
            return planned, str(error)
        return planned, ""

    def pair(self, state: OperationState, operation: SpeedOperation) -> SpeedPair:
        """Return what the block should say; before the first safe block of an operation, nothing."""
        command = state.command
        if command is None or not state.decided or command.state is SpeedState.OFF:
            return DISABLED
        speed_rpm = float(round(command.speed_rpm))
        share = speed_rpm / command.speed_rpm if self._tuning.keep_feed_per_tooth else 1.0
        feed = share * command.feed_mm_min
        return SpeedPair(
            made_for=operation.made_for,
            speed_rpm=speed_rpm,
            feed_mm_min=round(feed, FEED_DECIMALS) if feed >= 10.0 else float(f"{feed:.{FEED_DIGITS}g}"),
            enable=True,
        )
