"""The control task: CNC samples and estimates in, verified macro writes out.

It alone owns the output's memory, the reference and the CNC session. Whatever others want of it waits in its inbox and
is taken in its own stack. An exception that nobody expected becomes a latched FAULT; a lost link never does.
"""

import asyncio
from collections.abc import Awaitable
from dataclasses import replace
from functools import partial
from itertools import compress

import numpy as np
import structlog

from daemon.cnc.limits import axis_sources
from daemon.cnc.session import CncSession
from daemon.compensation.alarms import GuardWatch, alarm_of
from daemon.compensation.block_writer import BlockWriter, EchoWatch
from daemon.compensation.handshake import Handshake
from daemon.compensation.inputs import error_of_tool_point_um, of_estimate
from daemon.compensation.nc_requests import RequestDesk
from daemon.compensation.operator_requests import Cadence, Requests
from daemon.compensation.parts import ControlParts, Inbox, Message
from daemon.compensation.probing import MeasuredByNc, OutputNow
from daemon.compensation.references import References
from daemon.compensation.restart import StartupRecovery, record_changes
from daemon.compensation.skill_monitor import SkillWatch
from daemon.messages import EstimateComing, ReferenceRebased, ReferenceRefused, SensorsSinceReference
from daemon.supervisor import raise_when_told_to_end
from drivers.contract import DriverError, LinkError
from models.control.compensation import begun_at, follow_inhibit, step
from models.control.state import NO_REQUEST, Inhibit, OperatorRequest, OutputInputs, OutputMemory
from models.records import (
    CompensationCommand,
    DisplacementSample,
    FloatArray,
    MachineTemperatures,
    OutputState,
    Phase,
    Reference,
    ThermalErrorEstimate,
)

log = structlog.get_logger(__name__)

SHORTEST_POLL_REAL_S = 0.008
"""The CNC is never polled more often than this, however fast a simulation runs [s of the wall clock]."""


class ControlTask:
    """Follows the CNC, decides with `models.control.compensation.step`, and writes."""

    def __init__(self, parts: ControlParts) -> None:
        configuration, history = parts.configuration, parts.history
        self._parts, self._clock, self._link = parts, parts.clock, parts.link
        self.limits, self.journal = parts.limits, parts.journal
        self.modelled = parts.interlocks.modelled
        self._sources = axis_sources(configuration)
        handshake = Handshake(configuration.cnc.macros.request, configuration.compensation.asked_for)
        told = parts.tell_thermal, self.journal, handshake, parts.um_per_unit
        self._references = References(configuration, self._clock, history, *told)
        self.skill = SkillWatch(self._sources, configuration, self.journal.notice)
        self._measured = MeasuredByNc(self.limits, history, self.journal, self.skill, self._references, self._now)
        self._desk = RequestDesk(handshake, self._references, self.journal, self._measured)
        self.guard_watch = GuardWatch(configuration.compensation.output)
        self._echo_watch = EchoWatch(parts.telemetry, self.limits.rounding_um, history.write_echoed)
        self.writer = BlockWriter(self._clock, parts.telemetry, self.journal, self._echo_watch, parts.validity_s)
        self._startup = StartupRecovery(
            parts.resume, self._references, self.journal, self.limits.axes, parts.model_id, parts.max_outage_s
        )
        self._inbox = Inbox()
        self.requests = Requests(
            parts.interlocks, self.journal, self._link, self._references, self._startup, self._inbox
        )
        self._stopping = self._unseen_reference = False
        self._estimate: ThermalErrorEstimate | None = None
        self._fresh: ThermalErrorEstimate | None = None
        self.memory: OutputMemory | None = None
        self.command: CompensationCommand | None = None

    def deliver(self, message: Message) -> None:
        """Put a message into the inbox; it is taken in the control task's own stack."""
        self._inbox.put(message)

    def request(self, request: OperatorRequest, person: str) -> str:
        """Queue what a person asks for; return why it is refused, '' when it is taken."""
        return self.requests.put(request, person)

    def stop(self) -> None:
        """End `run` between two pieces of work, so that no block stays half written."""
        self._stopping = True
        self._inbox.wake()

    @property
    def not_begun(self) -> str:
        """Why nothing has begun, or the FAULT of the previous run."""
        return f"FAULT: {self.journal.fault}" if self.journal.fault else self._startup.not_begun

    @property
    def reference(self) -> Reference | None:
        return self._references.current

    @property
    def reference_ended(self) -> str:
        """Why no reference is in force, as far as that is known."""
        return self._references.memory.ended

    @property
    def phase(self) -> Phase:
        return self._references.phase

    @property
    def session(self) -> CncSession | None:
        return self._link.session

    def applied_um(self) -> FloatArray:
        """Return the guard's echo per axis [um], NaN while it is unknown."""
        echo = None if self.session is None else self.session.echo
        return np.full(len(self.limits.axes), np.nan) if echo is None else echo.applied_um

    def thermal_error_um(self) -> FloatArray:
        """Return the estimated error per axis since the reference, tool included [um], NaN without an estimate."""
        tool, memory = self._measured.tool.number, self._references.memory
        return error_of_tool_point_um(self._sources, self._estimate, memory, tool)

    async def run(self) -> None:
        """Serve until stopped: messages and estimates as they come, polls and ticks as they fall due."""
        shortest_s, now_s = SHORTEST_POLL_REAL_S * self._clock.speed, self._clock.now().monotonic_s
        poll = Cadence(max(self._parts.configuration.cnc.poll_period_s, shortest_s), now_s)
        tick = Cadence(max(self._parts.configuration.compensation.output.tick_s, poll.period_s), now_s)
        while not self._stopping:
            await self._sleep_until(poll.next_s)
            now_s = self._clock.now().monotonic_s
            await self._guarded(self._take_messages())
            estimate, self._fresh = self._fresh, None
            lapsed = self.session is not None and (self.session.lapsed or self.writer.unwritten(self.session))
            if self._unseen_reference or self.requests or lapsed:  # echo first
                await self._guarded(self._poll())
            if estimate is not None:  # before the poll: what is new does not wait for what is only looked at
                await self._guarded(self._act(estimate))
            await self._guarded(self._serve_clients())
            if poll.due(now_s):
                await self._guarded(self._poll())
            if ticked := tick.due(now_s):
                await self._guarded(self._tick())
            if (ticked and estimate is None) or self.requests:
                await self._guarded(self._act(None))

    async def _sleep_until(self, until_s: float) -> None:
        due = any(client.due for client in self._parts.macro_clients)
        if not (self._inbox or self._fresh or self.requests or self._stopping or due):
            await self._inbox.woken((until_s - self._clock.now().monotonic_s) / self._clock.speed)

    async def _guarded(self, work: Awaitable[None]) -> None:
        """Run one piece of work; a lost link ends the session, an unknown exception is a FAULT."""
        try:
            await work
        except DriverError as error:
            self._link.lost(error if isinstance(error, LinkError) else LinkError(str(error)))
        except (Exception, asyncio.CancelledError) as error:
            raise_when_told_to_end(error)
            log.exception("control.defect")
            self.journal.raise_fault(f"unexpected {type(error).__name__} in the output task: {error}")

    async def _tick(self) -> None:
        self._parts.on_tick()

    async def _serve_clients(self) -> None:
        known = None if (tool := self._measured.tool).in_question else tool.number
        for client in self._parts.macro_clients:
            await client.serve(self.session, self.phase, self._references.sample, known)

    async def _take_messages(self) -> None:
        """Take what waits in the inbox; what follows a message that meets a defect is taken in the next turn."""
        while self._inbox:
            self._take(message := self._inbox.take())
            if isinstance(message, EstimateComing) and not self._inbox:
                await self.writer.look_ahead(self.session, self.command)

    def _take(self, message: Message) -> None:
        match message:
            case ThermalErrorEstimate() if not self._references.has_refused(message.reference_id):
                self._estimate = self._fresh = message
            case EstimateComing() | ThermalErrorEstimate():
                pass
            case MachineTemperatures():
                for client in self._parts.macro_clients:
                    client.on_temperatures(message)
            case Reference():
                if refusal := self._references.adopt(message, self.applied_um()):
                    self._desk.refused(message.reference_id, refusal)
                    self.journal.notice(refusal)
                self._unseen_reference |= not refusal
            case ReferenceRebased():
                self._references.rebase(message.reference)
            case SensorsSinceReference():
                self._references.on_sensors(message, self._measured.tool.seen_s)
            case ReferenceRefused():
                self._desk.refused(message.reference_id, message.why)
                self._references.refused(message.reference_id, message.why)
                self.journal.notice(message.why)
            case DisplacementSample():
                self.skill.displacement(message, self._estimate, self.applied_um())
            case _:
                message()

    async def _poll(self) -> None:
        session, self._unseen_reference = self.session, False
        if session is None:
            return
        asked_s, problems = self._clock.now().monotonic_s, await session.poll()
        sample = session.sample
        assert sample is not None and session.echo is not None
        self._parts.history.cnc_sample(sample)
        self._parts.on_sample(sample)
        self._echo_watch.seen(session.echo, sample.time)
        self.journal.raise_fault(*problems)
        self.guard_watch.follow(session.echo, sample)
        counted_id = None if self.memory is None or self.memory.settling else self.memory.reference_id
        await self._references.on_poll(session.cnc, sample, asked_s, problems, counted_id)
        self._measured.on_sample(sample, session.echo, self._estimate)
        await self._desk.look(session)
        if self.memory is None:
            now = self._clock.now()
            self._startup.settle_writes(self._parts.history, sample, session.echo, now)
            self.memory = self._startup.begin(session, now.monotonic_s, explained=not problems)
            self._measured.on_sample(sample, session.echo, self._estimate)
        elif self.writer.unwritten(session) or self.memory.state is OutputState.OFF:
            self.memory = begun_at(self.memory, session.echo.applied_um)
        self._references.keep()

    # --- deciding and writing ------------------------------------------------------------

    async def _act(self, estimate: ThermalErrorEstimate | None) -> None:
        if self.memory is None:
            return
        before, session = self.memory, self.session
        inputs = self._desk.judged(before, self._inputs(self.requests.take()))
        self.memory, self.command = step(before, inputs, self.limits)
        self._record(before, self.memory, inputs)
        await self.writer.write_and_settle(session, self.command, estimate, partial(self._settle, before, inputs))
        if session is not None and self.session is session and inputs.link and not self.journal.fault:
            await self._desk.answer(session, self.memory)
        self._parts.telemetry.output(self.command, inputs.applied_um)
        self._references.count_from(self.memory, self.limits.axes)
        self._references.keep()
        self._parts.on_change()
        self.requests.decided()

    def _settle(self, before: OutputMemory, inputs: OutputInputs, fault: str | None) -> None:
        """Settle what the NC program measured; where the write ended in a fault the step is made without it."""
        assert self.memory is not None
        if fault is not None and self._measured.waiting:
            inputs = replace(inputs, output_fault=fault, tool_setting=None, probe_um=None)
            after, (self.memory, self.command) = self.memory, step(before, inputs, self.limits)
            self._record(after, self.memory, inputs)
        if lost := self._measured.settle(inputs, self.memory):
            self._desk.fail(lost)

    def _record(self, before: OutputMemory, after: OutputMemory, inputs: OutputInputs) -> None:
        inhibit = partial(follow_inhibit, after, inputs, self.limits)
        echo = self.session.echo if self.session is not None else None
        alarm = alarm_of(after, self.command, echo, now_s=inputs.now_s, guard=self.guard_watch, inhibit=inhibit)
        record_changes(self.journal, before, after, alarm)
        self._startup.keep(after.wanted)

    def _now(self) -> OutputNow:
        inputs, now = self._inputs(NO_REQUEST), self._clock.now()
        return OutputNow(memory=self.memory, estimate=self._estimate, inputs=inputs, now=now)

    def _inputs(self, request: OperatorRequest) -> OutputInputs:
        session, interlocks, kept = self.session, self._parts.interlocks, self._references.memory
        now_s, tool, reference = self._clock.now().monotonic_s, self._measured.tool, kept.in_force
        return OutputInputs(
            now_s=now_s,
            phase=self.phase,
            link=session is not None and session.echo is not None and interlocks.write_inhibit(session.cnc) is None,
            applied_um=self.applied_um(),
            settled=session is None or session.echo is None or session.echo.settled,
            written_um=session.written_um if session is not None else None,
            withdrawn=session is not None and session.withdrawn,
            reference_id=reference.reference_id if reference is not None else None,
            reference_ended=kept.ended,
            kept_reference_id=self._references.kept_id,
            output_fault=self.journal.fault,
            inhibits=self._inhibits(request.enable),
            request=request,
            zero_first=self._references.zero_first,
            tool_number=tool.number,
            tools_in_question=tool.in_question,
            tool_setting=self._measured.tool_setting,
            probe_um=self._measured.probe_um,
            **of_estimate(self._sources, self._estimate, kept, tool.number, now_s),
        )

    def _inhibits(self, asked: frozenset[str]) -> tuple[Inhibit, ...]:
        wanted = compress(self.limits.axes, self.memory.wanted if self.memory is not None else ())
        inhibits = self._parts.interlocks.inhibits(self.session, asked.union(wanted))
        return (*inhibits, *filter(None, (self._startup.inhibit(), *self._measured.inhibits())))
