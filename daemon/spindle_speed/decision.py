"""Decides which speed an operation should have now, from its latest plan and what was decided for it before."""

import math
from dataclasses import dataclass, replace

from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.spindle_speed.calls import SpeedOperation
from daemon.spindle_speed.macro_block import DISABLED, SpeedPair
from daemon.spindle_speed.memory import KEPT_S
from daemon.spindle_speed.messages import PlannedSpeed
from daemon.spindle_speed.planner_process import SpeedWorker
from models.records import Phase
from models.spindle_speed.tuning import (
    SpeedState,
    SpeedTuningError,
    SpeedTuningInputs,
    SpeedTuningMemory,
    SpeedTuningSettings,
    SpindleSpeedCommand,
    step,
)

FEED_DECIMALS, FEED_DIGITS = 2, 7
"""Feeds are whole hundredths [mm/min], as the check counts them; below 10 they have this many significant digits."""


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
            return None, "no dynamics for this operation yet"
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
