"""The control task: CNC samples and estimates in, verified macro writes out.

It alone owns the output's memory and the CNC session. An exception that nobody expected becomes
a latched FAULT; a lost link never does.
"""

import asyncio
from collections.abc import Awaitable, Callable
from itertools import compress

import numpy as np
import structlog

from config.records.commissioning import CommissioningRecord
from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks, in_words
from daemon.cnc.limits import axis_sources, commissioned_factors, echo_slack_um, guard_programs, output_limits
from daemon.cnc.link import CncLink
from daemon.cnc.session import CncSession
from daemon.compensation.alarms import GuardWatch, alarm_of
from daemon.compensation.applied_tracker import EchoWatch
from daemon.compensation.block_writer import BlockWriter
from daemon.compensation.handshake import Handshake
from daemon.compensation.nc_requests import RequestDesk
from daemon.compensation.operator_requests import Cadence, Requests, woken
from daemon.compensation.probing import MeasuredByNc, judged_probe
from daemon.compensation.references import References
from daemon.compensation.restart import ResumePoint, StartupRecovery, record_changes, resolve_pending_writes
from daemon.compensation.skill_monitor import SkillWatch
from daemon.compensation.temperature_macro import AuxiliaryMacros, SpeedFactory
from daemon.compensation.tool import ToolInSpindle
from daemon.estimation.task import Delivery
from daemon.history.writer import HistoryWriter
from daemon.messages import ReferenceEnded, ReferenceRebased, ReferenceRequest
from daemon.state_store.store import StateStore
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import DriverError, FatalDriverError, LinkError
from models.control.axis_map import nose_errors_um
from models.control.compensation import step, why_not_ready
from models.control.state import NO_REQUEST, OperatorRequest, OutputInputs, OutputMemory
from models.records import (
    CncSample,
    CompensationCommand,
    DisplacementSample,
    FloatArray,
    MachineTemperatures,
    Phase,
    Reference,
    ThermalErrorEstimate,
)

log = structlog.get_logger(__name__)

SHORTEST_POLL_REAL_S = 0.008
"""The CNC is never polled more often than this, however fast a simulation runs [s of the wall clock]."""


class ControlTask:
    """Follows the CNC, decides with `models.control.compensation.step`, and writes."""

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
        model_obstacle: Callable[[], str],
        resume: ResumePoint,
        ask_reference: Callable[[ReferenceRequest | ReferenceEnded | Reference], None],
        on_tick: Callable[[], None],
        speed: SpeedFactory,
        on_sample: Callable[[CncSample], None] = lambda _sample: None,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._configuration = configuration
        self._clock = clock
        self._link = link
        self._history = history
        self._telemetry = telemetry
        self._echo_watch = EchoWatch(telemetry, echo_slack_um(configuration), history.write_echoed)
        self._permission = Interlocks(configuration, clock, commissioning, model_obstacle)
        self._on_tick = on_tick
        self._on_sample = on_sample
        self.on_change = on_change
        self.limits = output_limits(
            configuration, commissioned_factors(commissioning, tuple(configuration.compensation.axes))
        )
        self._sources = axis_sources(configuration)
        self._unknown = np.full(len(self.limits.axes), np.nan)
        self._tool = ToolInSpindle(self._sources, history)
        self.skill = SkillWatch(self._sources, configuration)
        self._measured = MeasuredByNc(history, self.skill)
        self._asked_by_hand = ""
        self._unseen_reference = False
        self.modelled = self._permission.modelled
        self._wake = asyncio.Event()
        self._stopping = False
        self._estimate: ThermalErrorEstimate | None = None
        self._fresh: ThermalErrorEstimate | None = None
        self.requests = Requests()
        self.memory: OutputMemory | None = None
        self.command: CompensationCommand | None = None
        self.journal = Journal(history, StateStore(history, clock), resume.faults)
        macros = configuration.cnc.macros
        handshake = Handshake(macros.request, self.limits.axes)
        self._references = References(
            configuration.compensation.reference,
            configuration.compensation.output,
            clock,
            history,
            ask_reference,
            self.journal.say,
            handshake,
            macros.safe_flag,
            guard_programs(configuration),
        )
        self._desk = RequestDesk(
            handshake, self._references, self.journal.say, self._set_tool, self._change_tool, self._take_probe
        )
        self._output = configuration.compensation.output
        self._guard_watch = GuardWatch()
        self.side = AuxiliaryMacros(configuration, telemetry, self.journal, self._permission, self._references, speed)
        self._beginning = StartupRecovery(
            resume,
            self._references,
            self._tool,
            self.journal,
            ask_reference,
            self.limits.axes,
            model_id=model_id,
            max_outage_s=configuration.compensation.reference.max_outage_s,
        )
        self.writer = BlockWriter(clock, telemetry, self.journal, self._echo_watch, validity_s=self._output.validity_s)

    def deliver(self, item: Delivery) -> None:
        """Take an estimate, a new reference, or the thermal task's refusal of one."""
        if isinstance(item, ThermalErrorEstimate):
            self._estimate = self._fresh = item
        elif isinstance(item, MachineTemperatures):
            self.side.take(item)
        elif isinstance(item, Reference):
            self._adopt_reference(item)
        elif isinstance(item, ReferenceRebased):
            self._references.rebase(item.reference)
        else:
            self._desk.refused(item.reference_id, item.why)
            self._references.refused(item.reference_id, item.why)
            self.journal.notice(item.why)
        self._wake.set()

    def request(self, request: OperatorRequest, person: str) -> str:
        """Queue what a person asks for; return why it is refused, '' when it is taken."""
        refusal = self._permission.objection(request, self.session, unknown=self._beginning.unknown)
        if refusal:
            self.journal.event("refused", f"{in_words(request)}: {refusal}", person)
            self.on_change()
            return refusal
        self.requests.put(request, person)
        self._wake.set()
        return ""

    def request_reference(self, person: str) -> str:
        """Set a reference by hand; return why it is refused, '' when it is taken."""
        sample = self.session.sample if self.session else None
        if sample is None:
            return "no link to the CNC, so program, work offset and power-on count are unknown"
        self._asked_by_hand = self._references.ask_for(f"hand: {person}", sample, positioning=False)
        self.on_change()
        return ""

    @property
    def reference_by_hand(self) -> str | None:
        """What became of the latest reference by hand: '' in force, else why not; None while nobody knows."""
        return self._references.outcomes.get(self._asked_by_hand)

    @property
    def not_begun(self) -> str:
        """Why nothing has begun, or the FAULT of the previous run."""
        return f"FAULT: {self.journal.fault}" if self.journal.fault else self._beginning.unknown

    @property
    def guard_silent_s(self) -> float:
        """Time of running program since the guard's last run [s]."""
        return self._guard_watch.silent_s

    @property
    def reference(self) -> Reference | None:
        """The reference in force."""
        return self._references.current

    @property
    def phase(self) -> Phase:
        """What the machine is doing."""
        return self._references.phase

    @property
    def session(self) -> CncSession | None:
        return self._link.session

    def applied_um(self) -> FloatArray:
        """Return the guard's echo per axis [um], NaN while it is unknown."""
        session = self.session
        if session is None or session.echo is None:
            return self._unknown
        return session.echo.applied_um

    def thermal_error_um(self) -> FloatArray:
        """Return the estimated error per axis since the reference [um], NaN without an estimate."""
        if self._estimate is None:
            return self._unknown
        return nose_errors_um(self._sources, self._estimate) + self._tool.term_um(self._estimate)

    def stop(self) -> None:
        """End `run` between two pieces of work, so that no block stays half written."""
        self._stopping = True
        self._wake.set()

    async def run(self) -> None:
        """Serve until stopped: estimates as they come, polls and ticks as they fall due."""
        shortest_s, now_s = SHORTEST_POLL_REAL_S * self._clock.speed, self._clock.now().monotonic_s
        poll = Cadence(max(self._configuration.cnc.poll_period_s, shortest_s), now_s)
        tick = Cadence(max(self._configuration.compensation.output.tick_s, poll.period_s), now_s)
        while not self._stopping:
            await self._sleep_until(poll.next_s)
            now_s = self._clock.now().monotonic_s
            estimate, self._fresh = self._fresh, None
            if self._unseen_reference or self.requests:  # both begin from where the guard stands now
                await self._guarded(self._poll())
            if estimate is not None:  # before the poll: what is new does not wait for what is only looked at
                await self._guarded(self._act(estimate))
            await self._guarded(self.side.show(self.session))
            if poll.due(now_s):
                await self._guarded(self._poll())
            if ticked := tick.due(now_s):
                self._on_tick()
            if (ticked and estimate is None) or self.requests:
                await self._guarded(self._act(None))

    async def _sleep_until(self, until_s: float) -> None:
        if not (self._fresh or self.requests or self._stopping or self.side.due):
            self._wake.clear()
            await woken(self._wake, (until_s - self._clock.now().monotonic_s) / self._clock.speed)

    async def _guarded(self, work: Awaitable[None]) -> None:
        """Run one piece of work; a lost link ends the session, an unknown exception is a FAULT."""
        try:
            await work
        except DriverError as error:
            self._link.lost(error if isinstance(error, LinkError) else LinkError(str(error)))
        except Exception as error:
            log.exception("control.defect")
            self.journal.raise_fault(f"unexpected {type(error).__name__} in the output task: {error}")

    async def _poll(self) -> None:
        session, self._unseen_reference = self.session, False
        if session is None:
            return
        problems = await session.poll()
        sample = session.sample
        assert sample is not None and session.echo is not None
        self._history.cnc_sample(sample)
        self._on_sample(sample)
        self._echo_watch.seen(session.echo, sample.time)
        if problems:
            self.journal.raise_fault(*problems)
        self._guard_watch.follow(session.echo, sample)
        self._references.follow(sample)
        self._tool.follow(sample.tool_number, self._estimate)
        await self._desk.look(session)
        if self.memory is None:
            resolve_pending_writes(self._history, sample, session.echo, self._clock.now())
            self.memory = self._beginning.begin(session, self._clock.now().monotonic_s)

    def _adopt_reference(self, reference: Reference) -> None:
        still_um = float(np.nan_to_num(np.abs(self.applied_um())).max())
        refusal = self._references.adopt(reference, still_um)
        self._unseen_reference = not refusal
        if refusal:
            self._desk.refused(reference.reference_id, refusal)
            self.journal.notice(refusal)

    def _set_tool(self, axis: str) -> str:
        """Make what is applied the baseline of the tool in the spindle; return why it is refused."""
        if self.memory is None or self.reference is None:
            return "a tool setting counts from the work's reference, and there is none: position the work first"
        if self._estimate is None or self._estimate.reference_id != self.reference.reference_id:
            return "there is no estimate since the work's reference yet; set the tool again after the next cycle"
        self._measured.tool_setting = tuple(name == axis for name in self.limits.axes)
        self._tool.begin(self._tool.number, self._estimate)
        self.journal.say("tool", f"T{self._tool.number} set on axis {axis}")
        return ""

    def _change_tool(self, tool_number: int) -> None:
        self._tool.begin(tool_number, self._estimate)
        self.journal.say("tool", f"T{tool_number} in the spindle")

    def displacement(self, sample: DisplacementSample) -> None:
        """Take a row of the A/D logger: it tells whether the estimate helps."""
        self.skill.displacement(sample, self._estimate, self.applied_um())

    def _take_probe(self, axis: str, deviation_um: float) -> str:
        """Let a probe value correct the estimate, or return why not; it reaches the history either way."""
        sample, deviations = judged_probe(
            self.memory,
            self._inputs_now(NO_REQUEST),
            self.limits,
            axis=axis,
            deviation_um=deviation_um,
            now=self._clock.now(),
        )
        return self._measured.probed(sample, deviations)

    # --- deciding and writing ------------------------------------------------------------

    async def _act(self, estimate: ThermalErrorEstimate | None) -> None:
        if self.memory is None:
            return
        before, session = self.memory, self.session
        inputs = self._inputs()
        self.memory, command = step(before, inputs, self.limits)
        self.command = command
        obstacle = why_not_ready(self.memory, inputs, self.limits)
        echo = session.echo if session is not None else None
        alarm = alarm_of(
            self.memory, echo, now_s=inputs.now_s, guard=self._guard_watch, config=self._output, obstacle=obstacle
        )
        record_changes(self.journal, self.limits.axes, before, self.memory, alarm)
        if session is not None and command.write:
            await self.writer.write_when_due(session, command, estimate)
        if lost := self._measured.settle(inputs, self.memory):
            self._desk.fail(lost)
        if session is not None and self.session is session and inputs.link and not self.journal.fault:
            await self._answer(session, self.memory)
        self._telemetry.output(command, inputs.applied_um)
        self.on_change()
        self.requests.decided()

    async def _answer(self, session: CncSession, memory: OutputMemory) -> None:
        try:
            wrong = await self._desk.answer(session, memory)
        except FatalDriverError as error:
            wrong = str(error)
        if wrong:
            self.journal.raise_fault(f"an answer to the NC program could not be written: {wrong}")

    def _inputs(self) -> OutputInputs:
        session = self.session
        request, person = self.requests.take()
        if person:
            self.journal.event("request", in_words(request), person)
        if request.acknowledge and self.journal.fault is not None and session is not None:
            self.journal.acknowledge(*session.acknowledge())
        return self._inputs_now(self._beginning.heed(request))

    def _inputs_now(self, request: OperatorRequest) -> OutputInputs:
        session, estimate = self.session, self._estimate
        now_s = self._clock.now().monotonic_s
        return OutputInputs(
            now_s=now_s,
            phase=self.phase,
            link=session is not None and session.echo is not None and not self._permission.prohibition(session.cnc),
            applied_um=self.applied_um(),
            written_um=session.written_um if session is not None else None,
            thermal_error_um=nose_errors_um(self._sources, estimate) if estimate is not None else self._unknown,
            tool_term_um=self._tool.term_um(estimate) if estimate is not None else None,
            estimate_age_s=now_s - estimate.trace.first_byte.monotonic_s if estimate is not None else np.inf,
            confidence=estimate.confidence if estimate is not None else 0.0,
            doubt=estimate.doubt if estimate is not None else "",
            in_domain=estimate.in_domain if estimate is not None else False,
            reference_id=self.reference.reference_id if self.reference is not None else None,
            estimate_reference_id=estimate.reference_id if estimate is not None else None,
            kept_reference_id=self._references.kept.reference_id if self._references.kept is not None else None,
            model_id=estimate.model_id if estimate is not None else None,
            output_fault=self.journal.fault,
            refusals=self._refusals(
                request.enable.union(compress(self.limits.axes, self.memory.wanted if self.memory else ()))
            ),
            request=request,
            zero_first=self._references.zero_first,
            tool_number=self._tool.number,
            tool_setting=self._measured.tool_setting,
            probe_um=self._measured.probe_um,
        )

    def _refusals(self, asked: frozenset[str]) -> tuple[str, ...]:
        wanted = self.memory.wanted if self.memory is not None else ()
        refusals = self._permission.refusals(self.session, asked.union(compress(self.limits.axes, wanted)))
        return tuple(why for why in (*refusals, self._beginning.obstacle(), self.skill.obstacle()) if why)
