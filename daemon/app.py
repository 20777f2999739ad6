"""The composition root: one event loop, one task group, every part built here and handed on."""

import asyncio
import gc
import signal
from collections.abc import Callable, Coroutine, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import structlog

from config.records.commissioning import CommissioningError, CommissioningRecord, load_commissioning
from config.schema import Configuration
from daemon.cnc.audited_write import AuditedWriter
from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks
from daemon.cnc.limits import CommissionedFactors, also_polled, output_limits
from daemon.cnc.macro_block import MacroBlock
from daemon.cnc.session import CncLink, CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.parts import ControlParts
from daemon.compensation.restart import load_resume_point
from daemon.compensation.snapshot import control_snapshot, output_actions
from daemon.compensation.task import ControlTask
from daemon.compensation.temperature_macro import TemperatureMacro
from daemon.estimation.inputs import Message, ThermalInbox, poll_of
from daemon.estimation.task import ThermalTask, thermal_snapshot
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.housekeeping.jobs import job_snapshots, scheduled_jobs
from daemon.links import DisplacementLog, Links, Serve
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import LoadedModel, load_released
from daemon.model_release.reload import ModelReload
from daemon.monitor.commands import CommandDesk
from daemon.monitor.control_socket import ControlSocket
from daemon.monitor.status import StatusBoard
from daemon.registry import PARTS, Parts
from daemon.snapshots import HistorySnapshot, SnapshotBoard
from daemon.spindle_speed.output import SpindleSpeedOutput, open_planner
from daemon.state_store.documents import DaemonAlive
from daemon.state_store.store import StateStore
from daemon.telemetry.latency import line_timings
from daemon.telemetry.metrics import Telemetry, keep_one_heap
from daemon.telemetry.sd_notify import ServiceManager
from drivers.clock import Clock
from drivers.contract import Cnc
from models.control.state import OutputLimits
from models.records import DisplacementSample
from models.thermal.family import ThermalModel

if TYPE_CHECKING:
    from config.schema.sinks import SinkConfig
    from daemon.monitor.opcua.serving import OpcUaService
    from daemon.monitor.shdr import ShdrAdapter
    from daemon.spindle_speed.messages import OpenedModel

log = structlog.get_logger(__name__)
STOP_CALLS = 4
"""The control task may end this many calls to the CNC before it is cancelled."""
ALIVE_PERIOD_S = 10.0
"""How often the store records that the daemon runs [s of the wall clock]; a restart measures its outage by it."""


def load_record(configuration: Configuration) -> tuple[CommissioningRecord | None, str]:
    """Return the commissioning record, or None and why it is refused, '' where none is named."""
    path = configuration.compensation.commissioning_file
    if path is None:
        return None, ""
    try:
        return load_commissioning(path, configuration.signatures.public_keys), ""
    except CommissioningError as error:
        log.error("commissioning.unreadable", problem=str(error))
        return None, str(error)


def load_model(configuration: Configuration) -> LoadedModel[ThermalModel]:
    """Return the released model, or why there is none; what stands against it is in the log."""
    loaded = load_released(configuration, own_account())
    if loaded.inhibit:
        log.error("model.missing", problem=loaded.inhibit)
    elif loaded.warning:
        log.warning("model.unprotected", problem=loaded.warning)
    return loaded


def _load_monitor() -> Callable[..., Serve]:
    from daemon.monitoring import monitor_service  # noqa: PLC0415 (loaded only where it is configured)

    return monitor_service


def _load_opcua_service() -> "type[OpcUaService]":
    from daemon.monitor.opcua.serving import OpcUaService  # noqa: PLC0415 (loaded only where it is configured)

    return OpcUaService


def _load_shdr_adapter() -> "type[ShdrAdapter]":
    from daemon.monitor.shdr import ShdrAdapter  # noqa: PLC0415 (loaded only where it is configured)

    return ShdrAdapter


def _outlets(
    links: Links, configuration: Configuration, board: SnapshotBoard, desk: CommandDesk, history: HistoryWriter
) -> Iterator[Coroutine[Any, Any, None]]:
    """Yield the work of what is served to other systems; the libraries of each are loaded where it is configured."""

    async def serve_tags(came_up: Callable[[], None]) -> None:
        service = await asyncio.to_thread(_load_opcua_service)
        await service(configuration, board, desk, history).serve(came_up)

    async def serve_shdr(came_up: Callable[[], None]) -> None:
        await _load_shdr_adapter()(configuration, board).serve(came_up)

    async def watch_sink(sink: "SinkConfig", came_up: Callable[[], None]) -> None:
        from daemon.sinks.watching import watch  # noqa: PLC0415 (loaded only where it is configured)

        await watch(sink, configuration.history.path, came_up)

    for sink in configuration.sinks or ():
        yield links.own(f"sink {sink.name}", sink.place, partial(watch_sink, sink))
    if (tags := configuration.opcua_server) is not None:
        yield links.own("opcua_server", f"{tags.host}:{tags.port}", serve_tags)
    if (shdr := configuration.shdr) is not None:
        yield links.own("shdr", f"{shdr.host}:{shdr.port}", serve_shdr)


def _collect_what_comes_now() -> None:
    """Leave what the start has loaded out of every later collection; until now there was none."""
    gc.collect()
    gc.freeze()
    gc.enable()


class Daemon:
    def __init__(
        self, configuration: Configuration, clock: Clock, parts: Parts = PARTS, *, config_path: Path | None = None
    ) -> None:
        self._configuration = configuration
        self._parts = parts
        self._clock = clock
        self._telemetry = Telemetry(line_timings(configuration), scaled=clock.speed != 1.0)
        self._service_manager = ServiceManager()
        self.acknowledged: dict[str, int] = {}
        """Line -> number of its last committed cycle."""
        self._history = HistoryWriter(
            configuration.history.path,
            clock=clock,
            machine=MachineLayout.from_configuration(configuration),
            on_acknowledged=self._on_acknowledged,
            on_problem=self._on_history_problem,
            sinks=[sink.name for sink in configuration.sinks or () if sink.alarms is None],
        )
        self._history.hold()
        self._jobs = scheduled_jobs(configuration, config_path, self._report)
        self._loaded = load_model(configuration)
        model = self._loaded.model
        inhibit = self._loaded.inhibit
        record, refused = load_record(configuration)
        axes = tuple(configuration.compensation.axes)
        factors = CommissionedFactors(record, axes)
        self._block = MacroBlock(
            configuration.cnc.macros,
            axes,
            factors,
            guard=configuration.cnc.guard,
            also_polled=also_polled(configuration),
            pivots_mm=configuration.compensation.pivots_mm,
        )
        self._store = StateStore(self._history, clock)
        self._alive_real_s = float("-inf")
        self._last_block = WriteAheadRecord.beside(configuration.history.path)
        self._resume = load_resume_point(configuration, self._history, clock, self._last_block)
        self._monitor: Serve | None = None
        self._planner = open_planner(parts.speed_planner, configuration, self._on_bearings)
        self._link = CncLink(lambda: parts.open_cnc(configuration, clock), self._open_session)
        inbox = self._inbox = ThermalInbox()
        limits = output_limits(configuration, factors)
        interlocks = Interlocks(configuration, clock, record, lambda: inhibit or self.thermal.inhibit(), refused)
        self.control = self._control_task(interlocks, limits, None if model is None else model.model_id, inbox)
        self.thermal = ThermalTask(
            configuration,
            clock,
            self._history,
            self._telemetry,
            model,
            inbox,
            self.control.deliver,
            self._publish_thermal,
        )
        self.snapshots = SnapshotBoard(control=control_snapshot(self.control), thermal=thermal_snapshot(self.thermal))
        self.snapshots.spindle_speed = self.spindle_speed.snapshot()
        self.snapshots.model = self._loaded.snapshot()
        self._models = ModelReload(
            self._loaded,
            lambda: parts.load_model(configuration),
            take=inbox.put_nowait,
            report=self._report,
            publish=partial(setattr, self.snapshots, "model"),
        )
        self._links = Links(configuration, clock, parts, self._link, self._publish_links)
        publish = partial(setattr, self.snapshots, "displacements")
        self._displacements = DisplacementLog(clock, self._on_displacement, self._report, publish)
        status = StatusBoard(configuration, clock, self.snapshots, self._telemetry.picture)
        actions = output_actions(self.control, self._switch_spindle_speed)
        self._commands = CommandDesk(status, self.snapshots, actions, configuration.compensation.axes)

    def _control_task(
        self, interlocks: Interlocks, limits: OutputLimits, model_id: str | None, inbox: "asyncio.Queue[Message]"
    ) -> ControlTask:
        """Return the control task with the macros that it serves beside the block; `inbox` is the thermal task's."""
        configuration, journal = self._configuration, Journal(self._history, self._store, self._resume.faults)
        temperature = TemperatureMacro(configuration, self._telemetry, journal, interlocks)
        given = journal, interlocks, self._planner, inbox.put_nowait
        self.spindle_speed = SpindleSpeedOutput(configuration, self._clock, *given)
        return ControlTask(
            ControlParts(
                configuration=configuration,
                clock=self._clock,
                link=self._link,
                history=self._history,
                telemetry=self._telemetry,
                journal=journal,
                interlocks=interlocks,
                limits=limits,
                resume=self._resume,
                um_per_unit=self._block.um_per_unit,
                model_id=model_id,
                tell_thermal=inbox.put_nowait,
                on_tick=self._on_tick,
                on_sample=lambda sample: inbox.put_nowait(poll_of(sample, self._link.cnc)),
                on_change=self._publish_output,
                macro_clients=(temperature, self.spindle_speed),
            )
        )

    async def run(self) -> None:
        """Run until cancelled or told to stop by a signal."""
        keep_one_heap()
        self._history.start()
        try:
            with self._parts.hold_cnc(self._configuration.cnc):
                await self._run()
        finally:
            await asyncio.to_thread(self._history.close)
            self._last_block.follow(self._history, begun=self.control.memory is not None)
            self._last_block.close()

    async def _run(self) -> None:
        self._report("daemon", "started")
        self._publish_links()
        self._report("model", self._loaded.in_words())
        scheduler = self._parts.housekeeping(self._history, self._configuration.history, self._jobs)
        try:
            async with asyncio.TaskGroup() as tasks:
                loop = asyncio.get_running_loop()
                stop = asyncio.Event()
                for number in (signal.SIGTERM, signal.SIGINT):
                    loop.add_signal_handler(number, stop.set)
                loop.add_signal_handler(signal.SIGHUP, self._models.request)
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
                controlling = tasks.create_task(self.control.run())
                running = [tasks.create_task(work) for work in self._work()]
                scheduler.start()
                self._service_manager.ready("running")
                log.info("daemon.ready", machine=self._configuration.machine)
                _collect_what_comes_now()
                await stop.wait()
                self._service_manager.stopping()
                self.control.stop()
                await asyncio.wait([controlling], timeout=STOP_CALLS * self._configuration.cnc.timeout_s)
                for task in (controlling, *running):
                    task.cancel()
        finally:
            if scheduler.running:
                scheduler.shutdown(wait=False)
            self._displacements.flush()
            self._report("daemon", "stopped")
            self.spindle_speed.close()

    def _work(self) -> Iterator[Coroutine[Any, Any, None]]:
        """Yield the work of every task but the control task."""
        links, service = self._links, self._configuration.service
        yield self.thermal.run()
        yield self._models.run()
        yield from links.temperatures(self._inbox.put_cycle)
        yield links.cnc()
        if self._planner is not None:
            yield links.planner(self._planner.attempt)
        yield from links.displacements(self._history.last_displacement_utc_s, self._displacements)
        control_socket = ControlSocket(service.socket, service.socket_group, self._commands.handle)
        yield links.own("service.socket", service.socket, control_socket.run)
        if service.http_port is not None:
            yield links.own("service.http_port", service.http_port, self._serve_monitor)
        yield from _outlets(links, self._configuration, self.snapshots, self._commands, self._history)

    async def _serve_monitor(self, came_up: Callable[[], None]) -> None:
        """Serve the monitor; its libraries, a quarter of the start, are loaded while the daemon already runs."""
        if self._monitor is None:
            monitor_service = await asyncio.to_thread(_load_monitor)
            given = self._configuration, self._clock, self.snapshots, self._commands, self._telemetry, self._history
            self._monitor = monitor_service(*given)
            gc.freeze()
        await self._monitor(came_up)

    def _open_session(self, cnc: Cnc, last: CncSession | None) -> CncSession:
        known = last.known if last is not None else self._resume.known_macros
        writer = AuditedWriter(cnc, self._block, self._clock, self._history, self._telemetry)
        resumed = last is None or last.sample is None
        return CncSession(writer, self.control.limits, known, self._last_block, resumed=resumed)

    # --- what the tasks call back --------------------------------------------------------

    def _on_tick(self) -> None:
        state = self.control.memory.state.value if self.control.memory else "waiting for the CNC"
        self._service_manager.watchdog(state)
        now = self._clock.now()
        if now.real_s - self._alive_real_s > ALIVE_PERIOD_S:
            self._alive_real_s = now.real_s
            self._store.put(DaemonAlive(utc_s=now.utc_s))
        self._telemetry.report(now.real_s)
        if self.thermal.latest is not None:
            self._telemetry.sensors_usable(self.thermal.latest.degc)
        self._publish_output()
        self.snapshots.jobs = job_snapshots(self._history, self._jobs)
        self.snapshots.history = HistorySnapshot(acknowledged=dict(self.acknowledged), problem=self._history.problem)
        self._last_block.follow(self._history, begun=self.control.memory is not None)

    def _publish_links(self) -> None:
        self.snapshots.links = self._links.snapshots()
        self._telemetry.links((health.name, health.up) for health in self._links.shown)

    def _publish_output(self) -> None:
        self.snapshots.control = control_snapshot(self.control)
        self.snapshots.spindle_speed = self.spindle_speed.snapshot()

    def _switch_spindle_speed(self, on: bool, person: str) -> str:
        refusal = self.spindle_speed.turn(on=on, person=person)
        self._publish_output()
        return refusal

    def _publish_thermal(self) -> None:
        self.snapshots.thermal = thermal_snapshot(self.thermal)

    def _on_displacement(self, sample: DisplacementSample) -> None:
        self._history.displacement(sample)
        self.control.deliver(sample)

    def _report(self, kind: str, text: str) -> None:
        self._history.event(kind, text, "daemon")

    def _on_bearings(self, opened: "OpenedModel") -> None:
        """Note what speeds are planned with; it is told once, and when the files have changed at another start."""
        if opened.inhibit:
            self._links.planner_health.went_down(opened.inhibit, self._clock.now().utc_s)
        else:
            self._links.planner_health.came_up()
        self.snapshots.bearing_model = opened.model
        if opened.words:
            self._report("model", f"bearings: {opened.words}")

    def _on_acknowledged(self, line: str, number: int) -> None:
        self.acknowledged[line] = number
        self._telemetry.acknowledged(line, number)

    def _on_history_problem(self, problem: str) -> None:
        if problem:
            log.error("history.problem", problem=problem)
            self._telemetry.history_problem()
        else:
            log.info("history.works_again")
