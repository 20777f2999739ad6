"""Moves the spindle speed with the stability pockets: reads the operation, decides, writes the pair.

Owned by the control task. What is slow happens in `SpeedWorker`; what is commanded, and when, is decided by
`models.spindle_speed.tuning.step`. The CNC takes a pair only at a safe block, for the operation that it was made for.
"""

import math
from dataclasses import replace

from config.schema import Configuration
from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.session import CncSession
from daemon.snapshots import SpindleSpeedSnapshot
from daemon.spindle_speed.calls import SpeedCalls, SpeedOperation
from daemon.spindle_speed.decision import PLANNING, OperationMemories, OperationState, SpeedDecision, SpeedSwitch
from daemon.spindle_speed.macro_block import DISABLED, MacroValues, SpeedBlock, SpeedPair
from daemon.spindle_speed.messages import PlannedSpeed
from daemon.spindle_speed.planner_process import SpeedWorker
from daemon.spindle_speed.turning import SpeedAlarms, TurningSpeed
from daemon.spindle_speed.writer import SpeedWriteError, SpeedWriter
from drivers.clock import Clock
from drivers.contract import FatalDriverError
from drivers.guard.speed_text import SpeedStatus
from models.records import CncSample, Phase
from models.spindle_speed.tuning import SpeedState

NO_LINK = "no link to the CNC"
OUR_FAULT = "spindle speed"
"""A FAULT of the spindle speed begins so."""
NO_OPERATION = "no operation has begun"
ANEW = "decided anew at the next safe block"


def speed_snapshot(
    *,
    state: str,
    reason: str,
    alarm: str,
    switched_on: bool,
    stands_off: bool,
    applied_rpm: float | None,
    nc_status: int | None,
    operation: SpeedOperation | None,
    planned: PlannedSpeed | None,
    followed: SpeedPair | None,
) -> SpindleSpeedSnapshot:
    """Return operation, plan and command, None where there is none; `followed`: the pair that the NC may take."""
    called = operation.called if operation is not None else None
    plan = planned.plan if planned is not None and planned.called == called else None
    return SpindleSpeedSnapshot(
        state=state,
        reason=reason,
        alarm=alarm,
        switched_on=switched_on,
        stands_off=stands_off,
        applied_rpm=applied_rpm,
        nc_status=nc_status,
        operation=str(operation.made_for) if operation is not None else None,
        tool_number=called.tool_number if called is not None else None,
        programmed_rpm=called.speed_rpm if called is not None else None,
        commanded_rpm=followed.speed_rpm if followed is not None else None,
        commanded_feed_mm_min=followed.feed_mm_min if followed is not None else None,
        target_rpm=plan.choice.speed_rpm if plan is not None else None,
        limiting_depth_mm=plan.choice.limiting_depth_mm if plan is not None else None,
        margin_met=plan.choice.margin_met if plan is not None else None,
        flagged_span_rpm=plan.flagged_span_rpm if plan is not None else None,
        resonance_hz=planned.resonance_hz if planned is not None else {},
        change_per_sensor_step_rpm=planned.change_per_step_rpm if planned is not None else {},
        diagram=planned.diagram if planned is not None else None,
    )


class Follower:
    """The work of `SpindleSpeedOutput` where the tuning is on."""

    def __init__(
        self,
        configuration: Configuration,
        tuning: SpindleSpeedConfig,
        clock: Clock,
        journal: Journal,
        interlocks: Interlocks,
        worker: SpeedWorker,
    ) -> None:
        self._tuning, self._clock, self._journal, self._interlocks = tuning, clock, journal, interlocks
        self.worker = worker
        self._block = SpeedBlock(tuning.macros)
        self._calls = SpeedCalls(configuration, tuning, self._block)
        self._memories = OperationMemories(journal, clock)
        self.writer = SpeedWriter(tuning, self._block, configuration.history.path, *journal.audited(self._block.ours))
        self.switch = SpeedSwitch(journal)
        self._decision = SpeedDecision(tuning, worker)
        self._turning = TurningSpeed(tuning)
        self._alarms = SpeedAlarms(journal)
        self._operation_state: OperationState | None = None
        self._next_read_s = -math.inf
        self._found: MacroValues = {}
        self._session: CncSession | None = None
        self._fault_raised = any(reason.startswith(OUR_FAULT) for reason in journal.faults)
        """A FAULT has been raised here that has not been acknowledged yet."""
        self._inhibited = NO_LINK
        """Why nothing may be decided or written, '' when it may."""
        self._unreadable: tuple[CncSession, str] | None = None

    async def follow(
        self, session: CncSession | None, phase: Phase, sample: CncSample | None, known_tool: int | None
    ) -> None:
        """Take a poll, and which tool is known to be in the spindle, None where that is not known."""
        if session is None or session.sample is None or sample is None:
            self._inhibit(NO_LINK)
            return
        if self._unreadable is not None and self._unreadable[0] is session:
            return
        now_s = self._clock.now().monotonic_s
        if now_s < self._next_read_s and session is self._session:
            return
        self._next_read_s = now_s + self._tuning.read_period_s
        found = await self._read(session)
        if found is None:
            return
        if session is not self._session:
            self._session = session
            self.writer.write_again()
        self._found = found
        clock_s = sample.clock_s + (now_s - sample.time.monotonic_s)
        self._inhibit(self._judged(session, found, clock_s, now_s))
        self._calls.known_tool = known_tool
        self._take_call(found, now_s, sample)
        operation = self._calls.under_way
        if operation is not None:
            self.worker.update(operation.called, operation.place if operation.wanted else None)
        else:
            self.worker.update(None, None)
        self._hold_against(operation, sample, phase)
        if not self._inhibited:
            await self._serve(session, operation, phase, clock_s, now_s)
        self._alarms.end(now_s)

    async def _read(self, session: CncSession) -> MacroValues | None:
        """Read the macros; where the CNC has none of them for us, say so and leave the compensation its link."""
        try:
            return await session.cnc.read_macros(self._block.numbers)
        except FatalDriverError as error:
            why = f"its macros cannot be read, so it is not tuned before the next connection: {error}"
            self._unreadable = (session, why)
            self._inhibit(why)
            return None

    def _inhibit(self, why: str) -> None:
        """Take why nothing is decided or written; record what is recorded nowhere else."""
        if why not in ("", NO_LINK) and self._journal.fault is None:
            self._alarms.there(why, self._clock.now().monotonic_s)
        self._inhibited = why

    def _judged(self, session: CncSession, found: MacroValues, clock_s: float, now_s: float) -> str:
        """Return why nothing may be written: a FAULT, an interlock, or a block that is not ours (a FAULT too)."""
        if self._journal.fault is not None:
            return f"FAULT: {self._journal.fault}"
        if (inhibit := self._interlocks.write_inhibit(session.cnc)) is not None:
            return str(inhibit)
        if self._fault_raised and not self._block.vacant(found):
            self.writer.acknowledge(found)
        self._fault_raised = False
        if mismatch := self.writer.mismatch(found, clock_s, now_s):
            return self._raise_fault(mismatch)
        return ""

    def _raise_fault(self, problem: str) -> str:
        self._fault_raised = True
        self._journal.raise_fault(f"{OUR_FAULT}: {problem}")
        return f"FAULT: {self._journal.fault}"

    def _take_call(self, found: MacroValues, now_s: float, sample: CncSample) -> None:
        """Take the operation that the NC program has begun; another one is decided on anew."""
        before = self._calls.under_way
        begun = self._calls.update(found, now_s, sample)
        if self._calls.waiting:
            self._next_read_s = now_s
        if not begun:
            return
        self._put_away(before)
        assert self._calls.under_way is not None
        self._journal.say(
            "speed", f"{self._calls.under_way.made_for} begins in O{self._calls.under_way.called.program}"
        )

    def _put_away(self, operation: SpeedOperation | None) -> None:
        if operation is not None and self._operation_state is not None:
            self._memories.keep(operation, *self._operation_state.lasting)
        self._operation_state = None

    def _begun(self, operation: SpeedOperation, now_s: float) -> OperationState:
        """Return where an operation stands that begins, or goes on after something else was in the machine."""
        lowest_rpm, highest_rpm = self._range_rpm(operation)
        memory, moved = self._memories.begin(operation, lowest_rpm, highest_rpm)
        pair = self.writer.pair
        ours = pair.made_for == operation.made_for and lowest_rpm <= pair.speed_rpm <= highest_rpm
        if ours and self.writer.valid(now_s):  # this run of the daemon began within the operation: it goes on
            kept, memory = memory, replace(memory, commanded_rpm=pair.speed_rpm, begun=True)
            origin = None if moved else kept
            return OperationState(memory=memory, decided=True, known_s=now_s, moved=True, origin=origin)
        return OperationState(memory=memory, moved=moved)

    def _hold_against(self, operation: SpeedOperation | None, sample: CncSample, phase: Phase) -> None:
        """Hold the spindle's speed against what the NC has taken."""
        state, taken_rpm = self._operation_state, None
        if operation is not None and state is not None and not (self._inhibited or self._withheld):
            taken_rpm = self._taken_rpm(state, operation)
        planned, stable_rpm = self.worker.latest, (0.0, math.inf)
        if planned is not None and planned.plan is not None and operation is not None:
            choice = planned.plan.choice
            stable_rpm = choice.pocket_rpm if choice.stable and planned.called == operation.called else stable_rpm
        self._turning.update(taken_rpm, sample, phase, stable_rpm)
        if self._turning.alarm:
            self._alarms.there(self._turning.alarm, sample.time.monotonic_s)

    def _range_rpm(self, operation: SpeedOperation) -> tuple[float, float]:
        """Return the lowest and highest speed that may be commanded for an operation [1/min]."""
        tuning, programmed_rpm = self._tuning, operation.made_for.speed_rpm
        most_rpm = tuning.max_change_percent / 100.0 * programmed_rpm
        highest_rpm = tuning.highest_of(self._calls.configured(operation))
        return max(tuning.lowest_rpm, programmed_rpm - most_rpm), min(highest_rpm, programmed_rpm + most_rpm)

    # --- deciding and writing ------------------------------------------------------------

    async def _serve(
        self, session: CncSession, operation: SpeedOperation | None, phase: Phase, clock_s: float, now_s: float
    ) -> None:
        """Decide, and write what is due; a decision that does not reach the CNC is taken back."""
        if self._withheld:
            self._put_away(operation)
            await self._write(session, DISABLED, None, clock_s, now_s)
        if operation is None or self._withheld:
            return
        if self._operation_state is None:
            self._operation_state = self._begun(operation, now_s)
        before = self._operation_state
        if (taken_rpm := self._taken_rpm(before, operation)) is not None:
            before = before.seen(taken_rpm, cuts=self._turning.cuts)
        state = before if self._calls.waiting else self._decision.decide(before, operation, now_s, phase)
        if not await self._write(session, self._decision.pair(state, operation), operation, clock_s, now_s):
            return
        self._operation_state = state
        if state is not before:
            self._report(operation, before, state, now_s)
        self._memories.keep(operation, *state.lasting)

    @property
    def _withheld(self) -> str:
        """Why the NC is to take nothing, although it may be written to; '' when it may."""
        return self.switch.inhibit or self._calls.absence

    async def _write(
        self, session: CncSession, pair: SpeedPair, operation: SpeedOperation | None, clock_s: float, now_s: float
    ) -> bool:
        """Write a pair when that is due; return whether the CNC holds it now, anything else is a FAULT."""
        if not self.writer.due(pair, now_s):
            return True
        configured = None if operation is None else self._calls.configured(operation)
        try:
            await self.writer.write(session, pair, configured, self._found, clock_s=clock_s, now_s=now_s)
        except SpeedWriteError as error:
            self._inhibit(self._raise_fault(str(error)))
            return False
        return True

    def _taken_rpm(self, state: OperationState, operation: SpeedOperation) -> float | None:
        """Return what the NC has taken for this operation [1/min]: of the block, or what is commanded as programmed."""
        applied_rpm = self._block.applied_rpm(self._found)
        if self._calls.waiting or self._block.made_for(self._found) != operation.made_for:
            return None
        of_block = self._block.status(self._found) == SpeedStatus.APPLIED
        return applied_rpm if of_block or applied_rpm == float(round(state.memory.commanded_rpm)) else None

    def _report(self, operation: SpeedOperation, before: OperationState, now: OperationState, now_s: float) -> None:
        """Record what has reached the CNC."""
        command = now.command
        from_rpm, to_rpm = before.memory.commanded_rpm, now.memory.commanded_rpm
        if command is not None and from_rpm != to_rpm:
            word = "jumps" if command.jump else "moves"
            self._journal.say("speed", f"{word} from {from_rpm:.0f} to {to_rpm:.0f} 1/min: {command.reason}")
        if now.alarm and now.alarm != PLANNING:
            unstable = "" if command is None or command.state is not SpeedState.NO_STABLE_SPEED else command.state.value
            self._alarms.there(now.alarm, now_s, unstable and f"{operation.made_for} {unstable}")

    # --- showing -------------------------------------------------------------------------

    def _state(self) -> tuple[SpeedState, str]:
        command = self._operation_state.command if self._operation_state is not None else None
        if self._inhibited:
            return SpeedState.HOLD, f"nothing is decided or written: {self._inhibited}"
        if self._withheld:
            return SpeedState.OFF, self._withheld
        if command is None:
            return SpeedState.OFF, NO_OPERATION if self._calls.under_way is None else ANEW
        return command.state, command.reason

    @property
    def followed(self) -> bool:
        """The NC may follow the pair in the block."""
        return self.writer.valid(self._clock.now().monotonic_s)

    def snapshot(self, *, stands_off: bool) -> SpindleSpeedSnapshot:
        """Return what status shows; the command only while the NC may follow it."""
        state, reason = self._state()
        alarm = self._operation_state.alarm if self._operation_state is not None else ""
        followed = not self._inhibited and self.followed
        return speed_snapshot(
            state=state.value,
            reason=reason,
            alarm=self._inhibited or self._turning.alarm or alarm or self.worker.inhibit,
            switched_on=not self.switch.inhibit,
            stands_off=stands_off,
            applied_rpm=self._block.applied_rpm(self._found),
            nc_status=self._block.status(self._found),
            operation=self._calls.under_way,
            planned=self.worker.latest,
            followed=self.writer.pair if followed else None,
        )
