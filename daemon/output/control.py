"""The control task: CNC samples and estimates in, verified macro writes out.

It alone owns the output's memory and the CNC session. An exception that nobody expected becomes
a latched FAULT; a lost link never does.
"""

import asyncio
import uuid
from collections.abc import Awaitable, Callable

import numpy as np
import structlog

from config.commissioning import CommissioningRecord
from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.output.alarm import alarm_of
from daemon.output.cnc_link import CncLink
from daemon.output.cnc_session import CncSession
from daemon.output.echo_watch import EchoWatch
from daemon.output.limits import axis_sources, output_limits
from daemon.output.permission import Permission, in_words
from daemon.output.reference_watch import end_of_reference, phase_of, positioning_passed, power_cycled
from daemon.output.resume import ResumePoint, reference_to_state, rest_to_state, wanted_at_start, with_rest
from daemon.telemetry import Telemetry
from daemon.thermal import ReferenceRequest
from drivers.clock import Clock
from drivers.contract import DriverError, FatalDriverError, LinkError
from models.axis_map import axis_errors_um
from models.compensation import initial_memory, step, why_not_ready
from models.output import NO_REQUEST, OperatorRequest, OutputInputs, OutputMemory
from models.records import (
    CncSample,
    CompensationCommand,
    FloatArray,
    OutputState,
    Phase,
    Receipt,
    Reference,
    ThermalErrorEstimate,
    Trace,
    WriteOutcome,
)

log = structlog.get_logger(__name__)

SHORTEST_POLL_REAL_S = 0.008
"""The CNC is never polled more often than this, however fast a simulation runs [s of the wall clock]."""


class ControlTask:
    """Follows the CNC, decides with `models.compensation.step`, and writes."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        link: CncLink,
        history: HistoryWriter,
        telemetry: Telemetry,
        *,
        commissioning: CommissioningRecord | None,
        model_id: str | None,
        model_obstacle: str,
        resume: ResumePoint,
        ask_reference: Callable[[ReferenceRequest | Reference], None],
        on_tick: Callable[[], None],
    ) -> None:
        self._configuration = configuration
        self._clock = clock
        self._link = link
        self._history = history
        self._telemetry = telemetry
        self._echo_watch = EchoWatch(telemetry)
        self._permission = Permission(configuration, clock, commissioning, model_obstacle)
        self._resume = resume
        self._model_id = model_id
        self._ask_reference = ask_reference
        self._on_tick = on_tick
        self.limits = output_limits(configuration)
        self._sources = axis_sources(configuration)
        self.modelled = self._permission.modelled
        self._wake = asyncio.Event()
        self._stopping = False
        self._estimate: ThermalErrorEstimate | None = None
        self._fresh: ThermalErrorEstimate | None = None
        self._requests: list[tuple[OperatorRequest, str]] = []
        self._previous: CncSample | None = None
        self.memory: OutputMemory | None = None
        self.reference: Reference | None = None
        self.phase = Phase.CUTTING
        self.command: CompensationCommand | None = None
        self.receipt: Receipt | None = None
        self.output_fault: str | None = resume.fault
        self._needs_person = ""
        self.notices: list[str] = []
        self.alarm = ""
        self.writes = {"sent": 0, "verified": 0, "refused": 0}
        self.written_axes: set[str] = set()

    def deliver(self, item: ThermalErrorEstimate | Reference | str) -> None:
        """Take an estimate, a new reference, or the thermal task's refusal of one."""
        if isinstance(item, ThermalErrorEstimate):
            self._estimate = self._fresh = item
        elif isinstance(item, Reference):
            self._adopt_reference(item)
        else:
            self._notice(item)
        self._wake.set()

    def request(self, request: OperatorRequest, person: str) -> str:
        """Queue what a person asks for; return why it is refused, '' when it is taken."""
        refusal = self._permission.objection(
            request, self.session.cnc if self.session is not None else None, reached=self.memory is not None
        )
        if refusal:
            self._event("refused", f"{in_words(request)}: {refusal}", person)
            return refusal
        self._requests.append((request, person))
        self._wake.set()
        return ""

    def request_reference(self, person: str) -> str:
        """Set a reference by hand; return why it is refused, '' when it is taken."""
        sample = self.session.sample if self.session else None
        if sample is None:
            return "no link to the CNC, so program, work offset and power-on count are unknown"
        self._ask_for_reference(f"hand: {person}", sample)
        return ""

    # --- the loop ------------------------------------------------------------------------

    @property
    def session(self) -> CncSession | None:
        return self._link.session

    def applied_um(self) -> FloatArray:
        """Return the guard's echo per axis [um], NaN while it is unknown."""
        session = self.session
        if session is None or session.echo is None:
            return np.full(len(self.limits.axes), np.nan)
        return session.echo.applied_um

    def thermal_error_um(self) -> FloatArray:
        """Return the estimated error per axis since the reference [um], NaN without an estimate."""
        if self._estimate is None:
            return np.full(len(self.limits.axes), np.nan)
        return axis_errors_um(self._sources, self._estimate)

    def stop(self) -> None:
        """End `run` between two pieces of work, so that no block stays half written."""
        self._stopping = True
        self._wake.set()

    async def run(self) -> None:
        """Serve until stopped: estimates as they come, polls and ticks as they fall due."""
        poll_s = max(self._configuration.cnc.poll_period_s, SHORTEST_POLL_REAL_S * self._clock.speed)
        tick_s = max(self._configuration.compensation.output.tick_s, poll_s)
        next_poll_s = next_tick_s = self._clock.now().monotonic_s
        while not self._stopping:
            await self._sleep_until(next_poll_s)
            now_s = self._clock.now().monotonic_s
            estimate, self._fresh = self._fresh, None
            if now_s >= next_poll_s:
                next_poll_s = max(next_poll_s + poll_s, now_s + poll_s / 4)
                await self._guarded(self._poll())
            tick = now_s >= next_tick_s
            if tick:
                next_tick_s = max(next_tick_s + tick_s, now_s + tick_s / 4)
                self._on_tick()
            if estimate is not None or tick or self._requests:
                await self._guarded(self._act(estimate))

    async def _sleep_until(self, until_s: float) -> None:
        if self._fresh is None and not self._requests and not self._stopping:
            self._wake.clear()
            wait_s = (until_s - self._clock.now().monotonic_s) / self._clock.speed
            if wait_s > 0:
                try:
                    async with asyncio.timeout(wait_s):
                        await self._wake.wait()
                except TimeoutError:
                    return

    async def _guarded(self, work: Awaitable[None]) -> None:
        """Run one piece of work; a lost link ends the session, an unknown exception is a FAULT."""
        try:
            await work
        except DriverError as error:
            self._link.lost(error if isinstance(error, LinkError) else LinkError(str(error)))
        except Exception as error:
            log.exception("control.defect")
            self._raise_fault(f"unexpected {type(error).__name__} in the output task: {error}")

    async def _poll(self) -> None:
        session = self.session
        if session is None:
            return
        problems = await session.poll()
        sample = session.sample
        assert sample is not None and session.echo is not None
        self._history.cnc_sample(sample)
        self._echo_watch.seen(session.echo, sample.time)
        if problems:
            self._raise_fault("; ".join(problems))
        self.phase = phase_of(sample, self._configuration.compensation.output.safe_sequence_numbers)
        self._follow_program(sample)
        if self.memory is None:
            self._start_from(session)
        self._previous = sample

    def _follow_program(self, sample: CncSample) -> None:
        reference = self._configuration.compensation.reference
        if self.reference is not None:
            ended = end_of_reference(self.reference, sample)
            if not ended and power_cycled(self._previous, sample):
                ended = "the CNC's clock went back: it was switched off and on"
            if ended:
                self._notice(f"reference ended: {ended}")
                self.reference = None
                self._history.put_state("reference", None)
        if positioning_passed(self._previous, sample, reference.program, reference.sequence_numbers):
            self._ask_for_reference(f"O{sample.program} N{sample.sequence_number}", sample)

    def _ask_for_reference(self, source: str, sample: CncSample) -> None:
        self._ask_reference(
            ReferenceRequest(
                reference_id=uuid.uuid4().hex[:12],
                source=source,
                program=sample.program,
                work_offset=sample.work_offset,
                power_on_count=sample.power_on_count,
            )
        )

    def _adopt_reference(self, reference: Reference) -> None:
        self.reference = reference
        self._history.reference(reference)
        self._history.put_state("reference", reference_to_state(reference))
        self._event("reference", f"set by {reference.source}", "daemon")

    def _start_from(self, session: CncSession) -> None:
        """Begin from the CNC's echo, not from zero and not from the store."""
        assert session.echo is not None
        wanted, self._needs_person = wanted_at_start(self._resume, session.echo.applied_um)
        try:
            self.memory = initial_memory(
                now_s=self._clock.now().monotonic_s,
                applied_um=session.echo.applied_um,
                wanted=wanted,
            )
        except ValueError as error:
            self.alarm = str(error)
            return
        self._event("start", f"{self.memory.state.value}: {self.memory.reason}", "daemon")
        sample = session.sample
        reference = self._resume.reference
        if reference is not None and sample is not None and not end_of_reference(reference, sample):
            try:
                self.memory = with_rest(self.memory, self._resume.rest, self.limits.axes, reference, self._model_id)
            except ValueError as error:
                self._notice(str(error))
                return
            self.reference = reference
            self._ask_reference(reference)
            self._event("reference", f"taken up again: {reference.source}", "daemon")

    # --- deciding and writing ------------------------------------------------------------

    async def _act(self, estimate: ThermalErrorEstimate | None) -> None:
        if self.memory is None:
            return
        before = self.memory
        inputs = self._inputs()
        self.memory, command = step(before, inputs, self.limits)
        self.command = command
        obstacle = why_not_ready(self.memory, inputs, self.limits)
        self._watch(before, self.memory, inputs.now_s, obstacle)
        session = self.session
        if session is not None and command.write and self._due(session, command, estimate):
            now = self._clock.now()
            trace = estimate.trace if estimate is not None else Trace(first_byte=now, last_byte=now)
            await self._write(session, command, trace, estimate)
        self._telemetry.output(command, inputs.applied_um)

    async def _write(
        self,
        session: CncSession,
        command: CompensationCommand,
        trace: Trace,
        estimate: ThermalErrorEstimate | None,
    ) -> None:
        try:
            receipt = await session.write(
                command,
                validity_s=self._configuration.compensation.output.validity_s,
                trace=trace,
                cause="estimate" if estimate is not None else "tick",
            )
        except FatalDriverError as error:
            self.writes["refused"] += 1
            self._raise_fault(f"a write was refused: {error}")
            return
        finally:
            self.writes["sent"] += 1
        self.receipt = receipt
        if receipt.outcome is not WriteOutcome.VERIFIED:
            self._raise_fault(f"read-back differs: {receipt.detail}")
            return
        self.writes["verified"] += 1
        self.written_axes |= {axis for axis, on in zip(command.axes, command.enable, strict=True) if on}
        line = estimate.line if estimate is not None else None
        self._echo_watch.wrote(receipt.trace, command, session.echo, line)
        if line is not None:
            self._telemetry.stages(line, receipt.trace)

    def _due(self, session: CncSession, command: CompensationCommand, estimate: ThermalErrorEstimate | None) -> bool:
        last = session.last_command
        changed = (
            last is None
            or last.enable != command.enable
            or not np.array_equal(last.compensation_um, command.compensation_um)
        )
        if command.state is OutputState.OFF:
            return session.enabled or (changed and last is not None)
        if estimate is not None or changed:
            return True
        age_s = self._clock.now().monotonic_s - session.last_write_s
        return age_s > self._configuration.compensation.output.validity_s / 3

    def _inputs(self) -> OutputInputs:
        session, estimate = self.session, self._estimate
        now_s = self._clock.now().monotonic_s
        request, person = self._take_request()
        if person:
            self._event("request", in_words(request), person)
        if request.acknowledge and self.output_fault is not None and session is not None:
            self.output_fault = "; ".join(session.forgive()) or None
            self._history.put_state("fault", self.output_fault)
        if request.enable or request.disable or request.zero:
            self._needs_person = ""
        enabled = self._wanted_axes()
        return OutputInputs(
            now_s=now_s,
            phase=self.phase,
            link=session is not None and session.echo is not None and not self._permission.prohibition(session.cnc),
            applied_um=self.applied_um(),
            thermal_error_um=self.thermal_error_um(),
            estimate_age_s=now_s - estimate.trace.first_byte.monotonic_s if estimate is not None else np.inf,
            confidence=estimate.confidence if estimate is not None else 0.0,
            in_domain=estimate.in_domain if estimate is not None else False,
            reference_id=self.reference.reference_id if self.reference is not None else None,
            estimate_reference_id=estimate.reference_id if estimate is not None else None,
            model_id=estimate.model_id if estimate is not None else None,
            output_fault=self.output_fault,
            refusals=self._refusals(enabled | request.enable),
            request=request,
        )

    def _wanted_axes(self) -> frozenset[str]:
        if self.memory is None:
            return frozenset()
        return frozenset(axis for axis, on in zip(self.limits.axes, self.memory.wanted, strict=True) if on)

    def _take_request(self) -> tuple[OperatorRequest, str]:
        return self._requests.pop(0) if self._requests else (NO_REQUEST, "")

    def _refusals(self, axes: frozenset[str]) -> tuple[str, ...]:
        session = self.session
        refusals = self._permission.refusals(session.cnc if session is not None else None, axes)
        return (*refusals, self._needs_person) if self._needs_person else refusals

    def _watch(self, before: OutputMemory, after: OutputMemory, now_s: float, obstacle: str) -> None:
        if after.state is not before.state:
            self._event("state", f"{before.state.value} -> {after.state.value}: {after.reason}", "daemon")
        if after.wanted != before.wanted or after.state is not before.state:
            self._history.put_state("wanted", dict(zip(self.limits.axes, after.wanted, strict=True)))
        counts_anew = after.baseline_um is not before.baseline_um or after.offset_um is not before.offset_um
        if after.reference_id is not None and counts_anew:
            self._history.put_state("rest", rest_to_state(after, self.limits.axes))
        echo = self.session.echo if self.session is not None else None
        alarm_after_s = self._configuration.compensation.output.alarm_after_s
        self.alarm = alarm_of(after, echo, now_s=now_s, alarm_after_s=alarm_after_s, obstacle=obstacle)

    def _raise_fault(self, reason: str) -> None:
        if self.output_fault is None:
            self._event("fault", reason, "daemon")
            self._history.put_state("fault", reason)
        self.output_fault = reason

    def _notice(self, text: str) -> None:
        self.notices = [*self.notices[-19:], text]
        self._event("notice", text, "daemon")

    def _event(self, kind: str, text: str, person: str) -> None:
        log.info(f"output.{kind}", text=text, person=person)
        self._history.event(kind, text, person)
