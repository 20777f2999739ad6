"""Moves the spindle speed with the stability pockets: looks at the operation, decides, writes the pair.

Owned by the control task, which alone talks to the CNC. What is slow happens in `SpeedWorker`; what is
commanded, and when, is decided by `models.stability.speed_tuning.step`. The CNC takes a pair only when its
speed program runs, at a safe block, and only for the operation that it was made for.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

from config.guard.speed_text import SpeedStatus
from config.schema import Configuration
from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.output.cnc_session import CncSession
from daemon.output.journal import Journal
from daemon.output.permission import Permission
from daemon.output.speed_block import DISABLED, Found, SpeedBlock, SpeedPair
from daemon.output.speed_call import SpeedCalls, SpeedOperation
from daemon.output.speed_memory import OperationMemories
from daemon.output.speed_worker import PlannedSpeed, SpeedWorker
from daemon.output.speed_writer import SpeedWriteError, SpeedWriter
from drivers.clock import Clock
from drivers.contract import FatalDriverError
from models.records import CncSample, MachineTemperatures, Phase
from models.stability.errors import StabilityError
from models.stability.speed_tuning import (
    SpeedState,
    SpeedTuningInputs,
    SpeedTuningMemory,
    SpeedTuningSettings,
    SpindleSpeedCommand,
    step,
)

NO_LINK = "no link to the CNC"
OUR_FAULT = "spindle speed"
"""A FAULT of the spindle speed begins so."""
NO_OPERATION = "no operation has begun"
FEED_DECIMALS = 3
"""Feeds are written to this many decimals [mm/min]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Standing:
    """Where the operation under way stands; taken back whole when a write fails."""

    memory: SpeedTuningMemory
    command: SpindleSpeedCommand | None = None
    decided: bool = False
    """The operation has had a decision at a safe block, so that the block may speak for it."""
    moved: bool = False
    """It has changed: not again before the NC has taken that, and has cut with it."""
    alarm: str = ""


class SpindleSpeedOutput:
    """Follows one CNC's operations; does nothing without the section `spindle_speed`."""

    def __init__(self, configuration: Configuration, clock: Clock, journal: Journal, permission: Permission) -> None:
        self._clock, self._journal, self._permission = clock, journal, permission
        self.worker = SpeedWorker(configuration)
        tuning = configuration.spindle_speed
        self._follower: _Follower | None = None
        if tuning is not None:
            self._follower = _Follower(configuration, tuning, clock, journal, permission, self.worker)

    def take(self, temperatures: MachineTemperatures) -> None:
        """Take a cycle of the sensors."""
        time = temperatures.trace.cleansed or temperatures.trace.last_byte
        self.worker.take(time.monotonic_s, temperatures.degc)

    async def follow(self, session: CncSession | None, phase: Phase, sample: CncSample | None) -> None:
        """Look at the operation when it is time, decide, and write what is due.

        `sample` is the latest poll, with the part program's block while a program of the guard runs.
        """
        if self._follower is not None:
            await self._follower.follow(session, phase, sample)

    def close(self) -> None:
        """Release what is open."""
        if self._follower is not None:
            self._follower.writer.close()

    def picture(self) -> dict[str, Any] | None:
        """Return what status shows; None where the tuning is off."""
        return None if self._follower is None else self._follower.picture()


class _Follower:
    """The work of `SpindleSpeedOutput` where the tuning is on."""

    def __init__(
        self,
        configuration: Configuration,
        tuning: SpindleSpeedConfig,
        clock: Clock,
        journal: Journal,
        permission: Permission,
        worker: SpeedWorker,
    ) -> None:
        self._tuning, self._clock, self._journal, self._permission = tuning, clock, journal, permission
        self._worker = worker
        self._block = SpeedBlock(tuning.macros)
        self._calls = SpeedCalls(configuration, tuning, self._block)
        self._memories = OperationMemories(journal, clock)
        self.writer = SpeedWriter(tuning, self._block, configuration.history.path)
        self._standing: _Standing | None = None
        self._next_look_s = -math.inf
        self._found: Found = {}
        self._session: CncSession | None = None
        self._accused = (journal.fault or "").startswith(OUR_FAULT)
        """A FAULT has been raised here that nobody has acknowledged yet."""
        self._obstacle = NO_LINK
        """Why nothing may be decided or written, '' when it may."""
        self._unreadable: tuple[CncSession, str] | None = None
        self._settings = SpeedTuningSettings(
            hysteresis_rpm=tuning.hysteresis_rpm,
            dwell_s=tuning.dwell_s,
            step_rpm=tuning.step_rpm,
            filter_s=tuning.filter_s,
            keep_feed_per_tooth=tuning.keep_feed_per_tooth,
        )

    async def follow(self, session: CncSession | None, phase: Phase, sample: CncSample | None) -> None:
        if session is None or session.sample is None or sample is None:
            self._hinder(NO_LINK)
            return
        if self._unreadable is not None and self._unreadable[0] is session:
            return
        now_s = self._clock.now().monotonic_s
        if now_s < self._next_look_s and session is self._session:
            return
        self._next_look_s = now_s + self._tuning.read_period_s
        found = await self._read(session)
        if found is None:
            return
        if session is not self._session:
            self._session = session
            self.writer.doubt()
        self._found = found
        clock_s = sample.clock_s + (now_s - sample.time.monotonic_s)
        self._hinder(self._judged(session, found, clock_s, now_s))
        self._take_call(found, now_s, sample)
        operation = self._calls.under_way
        if operation is not None:
            self._worker.look(operation.called, operation.place if operation.wanted else None)
        else:
            self._worker.look(None, None)
        if operation is not None and not self._obstacle:
            await self._serve(session, operation, phase, clock_s, now_s)

    async def _read(self, session: CncSession) -> Found | None:
        """Read the macros; where the CNC has none of them for us, say so and leave the compensation its link."""
        try:
            return await session.cnc.read_macros(self._block.numbers)
        except FatalDriverError as error:
            why = f"its macros cannot be read, so it is not tuned before the next connection: {error}"
            self._unreadable = (session, why)
            self._hinder(why)
            return None

    def _hinder(self, obstacle: str) -> None:
        """Take what stands against deciding and writing; say once what is said nowhere else."""
        elsewhere = obstacle in ("", NO_LINK) or self._journal.fault is not None
        if not elsewhere and obstacle != self._obstacle:
            self._journal.say("alarm", f"spindle speed: {obstacle}")
        self._obstacle = obstacle

    def _judged(self, session: CncSession, found: Found, clock_s: float, now_s: float) -> str:
        """Return what stands against writing: a FAULT, a prohibition, or a block that is not ours (a FAULT too)."""
        if self._journal.fault is not None:
            return f"FAULT: {self._journal.fault}"
        if prohibition := self._permission.prohibition(session.cnc):
            return prohibition
        if self._accused and not self._block.vacant(found):
            self.writer.forgive(found)
        self._accused = False
        if objection := self.writer.objection(found, clock_s, now_s):
            return self._accuse(objection)
        return ""

    def _accuse(self, problem: str) -> str:
        self._accused = True
        self._journal.raise_fault(f"{OUR_FAULT}: {problem}")
        return f"FAULT: {self._journal.fault}"

    def _take_call(self, found: Found, now_s: float, sample: CncSample) -> None:
        """Take the operation that the NC program has begun; another one is decided on anew."""
        before = self._calls.under_way
        begun = self._calls.look(found, now_s, sample)
        if self._calls.waiting:
            self._next_look_s = now_s
        if not begun:
            return
        if before is not None and self._standing is not None:
            self._memories.keep(before, self._standing.memory, moved=self._standing.moved)
        operation = self._calls.under_way
        assert operation is not None
        lowest_rpm, highest_rpm = self._range_rpm(operation)
        memory, moved = self._memories.begin(operation, lowest_rpm, highest_rpm)
        pair = self.writer.pair
        ours = pair.made_for == operation.made_for and lowest_rpm <= pair.speed_rpm <= highest_rpm
        if ours := ours and self.writer.valid(now_s):  # this run began within the operation: it goes on
            memory, moved = replace(memory, commanded_rpm=pair.speed_rpm, begun=True), True
        self._standing = _Standing(memory=memory, decided=ours, moved=moved)
        self._journal.say("speed", f"{operation.made_for} begins in O{operation.called.program}")

    def _range_rpm(self, operation: SpeedOperation) -> tuple[float, float]:
        """Return the lowest and highest speed that may be commanded for an operation [1/min]."""
        tuning, programmed_rpm = self._tuning, operation.made_for.speed_rpm
        most_rpm = tuning.within_percent / 100.0 * programmed_rpm
        highest_rpm = tuning.highest_of(self._calls.configured(operation))
        return max(tuning.lowest_rpm, programmed_rpm - most_rpm), min(highest_rpm, programmed_rpm + most_rpm)

    # --- deciding and writing ------------------------------------------------------------

    async def _serve(
        self, session: CncSession, operation: SpeedOperation, phase: Phase, clock_s: float, now_s: float
    ) -> None:
        """Decide, and write what is due; a decision that does not reach the CNC is taken back."""
        assert self._standing is not None
        before = self._standing
        if before.moved and phase is Phase.CUTTING and self._taken(before, operation):
            before = replace(before, moved=False)
        standing = before if self._calls.waiting else self._decided(before, operation, now_s, phase)
        pair = self._wanted_pair(standing, operation)
        if self.writer.due(pair, now_s):
            configured = self._calls.configured(operation)
            try:
                await self.writer.write(session, pair, configured, self._found, clock_s=clock_s, now_s=now_s)
            except SpeedWriteError as error:
                self._hinder(self._accuse(str(error)))
                return
        self._standing = standing
        if standing is not before:
            self._report(before, standing)
        self._memories.keep(operation, standing.memory, moved=standing.moved)

    def _taken(self, standing: _Standing, operation: SpeedOperation) -> bool:
        """Whether the NC has taken for this operation what is commanded."""
        applied_rpm = self._block.applied_rpm(self._found)
        return (
            not self._calls.waiting
            and self._block.made_for(self._found) == operation.made_for
            and self._block.status(self._found) == SpeedStatus.APPLIED
            and applied_rpm == float(round(standing.memory.commanded_rpm))
        )

    def _decided(self, before: _Standing, operation: SpeedOperation, now_s: float, phase: Phase) -> _Standing:
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
        if operation.wanted and planned is None:  # nobody has looked yet how far the wish is off: that stays noted
            memory = replace(memory, off_since_s=before.memory.off_since_s)
        return _Standing(
            memory=memory,
            command=command,
            decided=before.decided or at_safe_block,
            moved=before.moved or command.write,
            alarm=(command.alarm if operation.wanted else None) or problem,
        )

    def _planned(self, operation: SpeedOperation, now_s: float) -> tuple[PlannedSpeed | None, str]:
        """Return the latest plan of this operation and what stands against following it, '' when nothing does."""
        planned = self._worker.latest
        if self._worker.obstacle:
            return None, self._worker.obstacle
        if planned is None or planned.called != operation.called:
            return None, "no dynamics for this operation yet"
        if now_s - planned.time_s > self._tuning.stale_after_s:
            return planned, f"the latest temperatures are {now_s - planned.time_s:.0f} s old; the speed is frozen"
        if planned.problem:
            return planned, planned.problem
        try:
            self._settings.check_resolution(max(planned.change_per_step_rpm.values(), default=0.0))
        except StabilityError as error:
            return planned, str(error)
        return planned, ""

    def _wanted_pair(self, standing: _Standing, operation: SpeedOperation) -> SpeedPair:
        """Return what the block should say; before the first safe block of an operation, nothing."""
        command = standing.command
        if command is None or not standing.decided or command.state is SpeedState.OFF:
            return DISABLED
        speed_rpm = float(round(command.speed_rpm))
        share = speed_rpm / command.speed_rpm if self._tuning.keep_feed_per_tooth else 1.0
        return SpeedPair(
            made_for=operation.made_for,
            speed_rpm=speed_rpm,
            feed_mm_min=round(share * command.feed_mm_min, FEED_DECIMALS),
            enable=True,
        )

    def _report(self, before: _Standing, now: _Standing) -> None:
        """Record what has reached the CNC."""
        command = now.command
        if command is not None and command.write:
            word = "jumps" if command.jump else "moves"
            self._journal.say(
                "speed",
                f"{word} from {before.memory.commanded_rpm:.0f} to {command.speed_rpm:.0f} 1/min: {command.reason}",
            )
        if now.alarm and now.alarm != before.alarm:
            self._journal.say("alarm", f"spindle speed: {now.alarm}")

    # --- showing -------------------------------------------------------------------------

    def _state(self) -> tuple[SpeedState, str]:
        command = self._standing.command if self._standing is not None else None
        if self._obstacle:
            return SpeedState.HOLD, f"nothing is decided or written: {self._obstacle}"
        if command is None:
            return SpeedState.OFF, NO_OPERATION
        return command.state, command.reason

    def picture(self) -> dict[str, Any]:
        """Return what status shows; the command only while the NC may follow it."""
        state, reason = self._state()
        operation, planned, pair = self._calls.under_way, self._worker.latest, self.writer.pair
        called = operation.called if operation is not None else None
        plan = planned.plan if planned is not None and planned.called == called else None
        followed = not self._obstacle and self.writer.valid(self._clock.now().monotonic_s)
        alarm = self._standing.alarm if self._standing is not None else ""
        return {
            "state": state.value,
            "reason": reason,
            "alarm": self._obstacle or alarm or self._worker.obstacle,
            "operation": str(operation.made_for) if operation is not None else None,
            "tool_number": called.tool_number if called is not None else None,
            "programmed_rpm": called.speed_rpm if called is not None else None,
            "commanded_rpm": pair.speed_rpm if followed else None,
            "commanded_feed_mm_min": pair.feed_mm_min if followed else None,
            "applied_rpm": self._block.applied_rpm(self._found),
            "nc_status": self._block.status(self._found),
            "wished_rpm": plan.choice.speed_rpm if plan is not None else None,
            "limiting_depth_mm": plan.choice.limiting_depth_mm if plan is not None else None,
            "margin_met": plan.choice.margin_met if plan is not None else None,
            "flagged_span_rpm": plan.flagged_span_rpm if plan is not None else None,
            "resonance_hz": planned.resonance_hz if planned is not None else {},
            "change_per_sensor_step_rpm": planned.change_per_step_rpm if planned is not None else {},
        }
