"""Moves the spindle speed with the stability pockets: looks at the operation, decides, writes the pair.

Owned by the control task, which alone talks to the CNC. What is slow happens in `SpeedWorker`; what is
commanded, and when, is decided by `models.stability.speed_tuning.step`. The CNC takes a pair only when its
speed program runs, at a safe block.
"""

import math
from typing import Any

from config.schema import Configuration
from daemon.output.cnc_session import CncSession
from daemon.output.journal import Journal
from daemon.output.permission import Permission
from daemon.output.speed_block import DISABLED, Found, SpeedBlock, SpeedPair
from daemon.output.speed_worker import PlannedSpeed, SpeedWorker
from daemon.stability.tool_points import CalledOperation
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, DriverError, FatalDriverError
from models.records import CncSample, MachineTemperatures, Phase, WriteOutcome
from models.stability.errors import StabilityError
from models.stability.speed_tuning import (
    SpeedState,
    SpeedTuningInputs,
    SpeedTuningMemory,
    SpeedTuningSettings,
    SpindleSpeedCommand,
    initial_memory,
    not_written,
    step,
)

SPEED_CAUSE = "spindle speed"
"""Cause of these writes in the audit."""
ONLY_SIMULATED = (
    "this version moves the spindle speed of the simulated control only: the block does not yet name the tool, "
    "depth and width that a pair was made for; leave spindle_speed out on a real control"
)
RENEW_SHARE = 1.0 / 3.0
"""The pair is written again after this share of its validity."""


class SpindleSpeedOutput:
    """Follows one CNC's operations; does nothing without the section `spindle_speed`."""

    def __init__(self, configuration: Configuration, clock: Clock, journal: Journal, permission: Permission) -> None:
        tuning = configuration.spindle_speed
        self._tuning, self._clock, self._journal, self._permission = tuning, clock, journal, permission
        self.worker = SpeedWorker(configuration)
        self._called: CalledOperation | None = None
        self._memory: SpeedTuningMemory | None = None
        self._command: SpindleSpeedCommand | None = None
        self._decided = False
        """The operation has had a decision at a safe block."""
        self._moved = False
        """It has changed in this safe block: not again before the next."""
        self._written: dict[int, float] = {}
        self._pair = DISABLED
        self._next_look_s = self._written_s = -math.inf
        self._found: Found = {}
        self._session: CncSession | None = None
        self.alarm = ""
        if tuning is not None:
            self._block = SpeedBlock(tuning.macros)
            self._settings = SpeedTuningSettings(
                hysteresis_rpm=tuning.hysteresis_rpm,
                dwell_s=tuning.dwell_s,
                step_rpm=tuning.step_rpm,
                filter_s=tuning.filter_s,
                keep_feed_per_tooth=tuning.keep_feed_per_tooth,
            )

    def take(self, temperatures: MachineTemperatures) -> None:
        """Take a cycle of the sensors."""
        time = temperatures.trace.cleansed or temperatures.trace.last_byte
        self.worker.take(time.monotonic_s, temperatures.degc)

    async def follow(self, session: CncSession | None, phase: Phase) -> None:
        """Look at the operation when it is time, decide, and write what is due."""
        if phase is not Phase.SAFE_POINT:
            self._moved = False
        if self._tuning is None or session is None or session.sample is None:
            return
        if session.cnc.identity != SIMULATED_CNC_IDENTITY:
            self._refuse(ONLY_SIMULATED)
            return
        now_s = self._clock.now().monotonic_s
        if now_s < self._next_look_s and session is self._session:
            return
        self._next_look_s = now_s + self._tuning.read_period_s
        found = await session.cnc.read_macros(self._block.numbers)
        if session is not self._session:
            self._begin(session)
        elif problem := self._block.foreign(self._written, found):
            self._written = {}
            self._journal.raise_fault(f"spindle speed: {problem}")
            return
        self._found = found
        self._take_call(found, session.sample)
        place = self._place()
        self.worker.look(self._called, place)
        if self._called is None:
            return
        self._decide(self._called, now_s, phase, wanted=self._block.wanted(found) and place is not None)
        await self._write_when_due(session, found, now_s)

    def _refuse(self, why: str) -> None:
        if self.alarm != why:
            self._journal.event("refused", f"spindle speed: {why}", "daemon")
        self.alarm = why

    def _begin(self, session: CncSession) -> None:
        """Begin with a new session: what the CNC holds is not known to be ours, so it is written anew."""
        self._session, self._written, self._pair, self._written_s = session, {}, DISABLED, -math.inf

    def _take_call(self, found: Found, sample: CncSample) -> None:
        """Take the operation that the NC program has begun; another one is decided on anew."""
        called = self._block.called(found, sample)
        if called == self._called:
            return
        self._called, self._decided = called, False
        if called is not None:
            self._memory = initial_memory(called.speed_rpm)
            self._journal.say("speed", f"T{called.tool_number} S{called.speed_rpm:g} F{called.feed_mm_min:g} begins")

    def _place(self) -> int | None:
        """Return which configured operation this is; None for one that is not configured."""
        assert self._tuning is not None
        if self._called is None:
            return None
        operation = self._tuning.operation_of(self._called.tool_number, self._called.program)
        return None if operation is None else self._tuning.operations.index(operation)

    # --- deciding ------------------------------------------------------------------------

    def _decide(self, called: CalledOperation, now_s: float, phase: Phase, *, wanted: bool) -> None:
        assert self._memory is not None
        planned, problem = self._planned(called, now_s)
        plan = planned.plan if planned is not None and not problem else None
        at_safe_block = phase is Phase.SAFE_POINT
        inputs = SpeedTuningInputs(
            now_s=now_s,
            phase=Phase.IDLE if self._moved and at_safe_block else phase,
            enabled=wanted,
            programmed_rpm=called.speed_rpm,
            programmed_feed_mm_min=called.feed_mm_min,
            choice=plan.choice if plan is not None else None,
            flagged_span_rpm=plan.flagged_span_rpm if plan is not None else 0.0,
        )
        before = self._memory
        self._command, self._memory = step(before, inputs, self._settings)
        self._decided = self._decided or at_safe_block
        if self._command.write:
            self._moved = True
            word = "jumps" if self._command.jump else "moves"
            self._journal.say(
                "speed", f"{word} from {before.commanded_rpm:.0f} to {self._command.speed_rpm:.0f} 1/min: "
                f"{self._command.reason}"
            )  # fmt: skip
        alarm = (self._command.alarm or problem) if wanted else ""
        if alarm and alarm != self.alarm:
            self._journal.say("alarm", f"spindle speed: {alarm}")
        self.alarm = alarm

    def _planned(self, called: CalledOperation, now_s: float) -> tuple[PlannedSpeed | None, str]:
        """Return the latest plan of this operation and what stands against following it, '' when nothing does."""
        assert self._tuning is not None
        planned = self.worker.latest
        if self.worker.obstacle:
            return None, self.worker.obstacle
        if planned is None or planned.called != called:
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

    # --- writing -------------------------------------------------------------------------

    def _wanted_pair(self) -> SpeedPair:
        """Return what the block should say; before the first safe block of an operation, nothing."""
        command, called = self._command, self._called
        if command is None or called is None or not self._decided or command.state is SpeedState.OFF:
            return DISABLED
        speed_rpm = float(round(command.speed_rpm))
        feed_mm_min = round(command.feed_mm_min, 1)
        return SpeedPair(for_rpm=called.speed_rpm, speed_rpm=speed_rpm, feed_mm_min=feed_mm_min, enable=True)

    async def _write_when_due(self, session: CncSession, found: Found, now_s: float) -> None:
        assert self._tuning is not None and session.sample is not None
        pair = self._wanted_pair()
        stale = pair.enable and now_s - self._written_s > RENEW_SHARE * self._tuning.validity_s
        if self._written and pair == self._pair and not stale:
            return
        if self._journal.fault is not None or self._permission.prohibition(session.cnc):
            return
        try:
            self._check_bounds(pair)
            clock_s = session.sample.clock_s + (now_s - session.sample.time.monotonic_s)
            groups = self._block.encode(
                pair, after=self._block.sequence(found), valid_until_s=clock_s + self._tuning.validity_s
            )
            receipt = await session.write_apart(groups, cause=SPEED_CAUSE)
        except FatalDriverError as error:
            self._journal.raise_fault(f"a write of the spindle speed was refused: {error}")
            return
        except DriverError:
            self._session = None
            if self._memory is not None:
                self._memory = not_written(self._memory, self._pair.speed_rpm or self._memory.programmed_rpm)
            raise
        if receipt.outcome is not WriteOutcome.VERIFIED:
            self._journal.raise_fault(f"read-back of the spindle speed differs: {receipt.detail}")
            return
        self._pair, self._written_s = pair, now_s
        self._written = {number: value for group in groups for number, value in group}

    def _check_bounds(self, pair: SpeedPair) -> None:
        """Refuse a speed outside the machine's and the change that is allowed; raises FatalDriverError."""
        tuning = self._tuning
        assert tuning is not None
        if not pair.enable or pair.speed_rpm == pair.for_rpm:
            return
        change = abs(pair.speed_rpm - pair.for_rpm)
        inside = tuning.lowest_rpm - 0.5 <= pair.speed_rpm <= tuning.highest_rpm + 0.5
        if not (inside and change <= tuning.within_percent / 100.0 * pair.for_rpm + 0.5 and pair.feed_mm_min > 0.0):
            raise FatalDriverError(f"S{pair.speed_rpm:g} for S{pair.for_rpm:g} is out of bounds; nothing was sent")

    # --- showing -------------------------------------------------------------------------

    def picture(self) -> dict[str, Any] | None:
        """Return what status shows; None where the tuning is off."""
        if self._tuning is None:
            return None
        command, called, planned = self._command, self._called, self.worker.latest
        plan = planned.plan if planned is not None and planned.called == called else None
        return {
            "state": command.state.value if command is not None and called is not None else SpeedState.OFF.value,
            "reason": command.reason if command is not None and called is not None else "no operation has begun",
            "alarm": self.alarm or self.worker.obstacle,
            "tool_number": called.tool_number if called is not None else None,
            "programmed_rpm": called.speed_rpm if called is not None else None,
            "commanded_rpm": self._pair.speed_rpm if self._pair.enable else None,
            "commanded_feed_mm_min": self._pair.feed_mm_min if self._pair.enable else None,
            "applied_rpm": self._block.applied_rpm(self._found),
            "nc_status": self._block.status(self._found),
            "wished_rpm": plan.choice.speed_rpm if plan is not None else None,
            "limiting_depth_mm": plan.choice.limiting_depth_mm if plan is not None else None,
            "margin_met": plan.choice.margin_met if plan is not None else None,
            "flagged_span_rpm": plan.flagged_span_rpm if plan is not None else None,
            "resonance_hz": planned.resonance_hz if planned is not None else {},
            "change_per_sensor_step_rpm": planned.change_per_step_rpm if planned is not None else {},
        }
