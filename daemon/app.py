"""The composition root: one event loop, one task group, every part built here and handed on."""

import asyncio
import gc
import signal
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any

import structlog

from config.records.commissioning import CommissioningError, CommissioningRecord, load_commissioning
from config.schema import Configuration
from config.schema.temperatures import LineConfig
from daemon.cnc.audited_write import AuditedWriter
from daemon.cnc.limits import commissioned_factors, echo_slack_um
from daemon.cnc.link import CncLink
from daemon.cnc.macro_block import MacroBlock
from daemon.cnc.session import CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.restart import load_resume_point
from daemon.compensation.task import ControlTask
from daemon.estimation.task import Message, ThermalTask
from daemon.history.layout import MachineLayout
from daemon.history.writer import HistoryWriter
from daemon.housekeeping.backup_job import BackupJob
from daemon.housekeeping.retraining_job import RetrainingJob
from daemon.messages import SpindleSpeed
from daemon.model_release.file_access import own_account
from daemon.model_release.loading import load_released
from daemon.monitor.commands import CommandDesk
from daemon.monitor.control_socket import ControlSocket
from daemon.monitor.status import StatusBoard
from daemon.monitor.web import serve_metrics
from daemon.registry import PARTS, Parts
from daemon.supervisor import Backoff, LinkHealth, run_with_reconnect
from daemon.telemetry.latency import line_timings
from daemon.telemetry.metrics import Telemetry
from daemon.telemetry.sd_notify import ServiceManager
from drivers.clock import Clock
from drivers.contract import Cnc, LinkError

log = structlog.get_logger(__name__)


STOP_CALLS = 4
"""The control task may end this many calls to the CNC before it is cancelled."""
ALIVE_PERIOD_S = 10.0
"""The store is told this often that the daemon lives [s of the wall clock]; a restart measures its outage by it."""


class StartError(Exception):
    """The daemon cannot start; the text says why and what to do."""


def load_record(path: Path | None) -> CommissioningRecord | None:
    """Return the commissioning record, or None with the reason in the log."""
    if path is None:
        return None
    try:
        return load_commissioning(path)
    except CommissioningError as error:
        log.error("commissioning.unreadable", problem=str(error))
        return None


class Daemon:
    """One machine's daemon."""

    def __init__(
        self, configuration: Configuration, clock: Clock, parts: Parts = PARTS, *, config_path: Path | None = None
    ) -> None:
        self._configuration = configuration
        self._parts = parts
        self._clock = clock
        self._telemetry = Telemetry(line_timings(configuration), scaled=clock.speed != 1.0)
        self._service_manager = ServiceManager()
        self._history = HistoryWriter(
            configuration.history.path,
            clock=clock,
            machine=MachineLayout.from_configuration(configuration),
            on_acknowledged=self._on_acknowledged,
            on_problem=self._on_history_problem,
        )
        self._backups: BackupJob | None = None
        if configuration.history.backup is not None and config_path is not None:
            self._backups = BackupJob(configuration, config_path, configuration.history.backup, self._report)
        self._retraining: RetrainingJob | None = None
        if configuration.compensation.retraining is not None and config_path is not None:
            retraining = configuration.compensation.retraining
            self._retraining = RetrainingJob(configuration, config_path, retraining, self._report)
        self._loaded = load_released(configuration, own_account())
        model, obstacle = self._loaded.model, self._loaded.obstacle
        if obstacle:
            log.error("model.missing", problem=obstacle)
        elif self._loaded.warning:
            log.warning("model.unprotected", problem=self._loaded.warning)
        record = load_record(configuration.compensation.commissioning_file)
        axes = tuple(configuration.compensation.axes)
        self._block = MacroBlock(
            configuration.cnc.macros,
            axes,
            commissioned_factors(record, axes),
            echo_slack_um(configuration),
            configuration.cnc.guard,
        )
        self._alive_real_s = float("-inf")
        self._last_block = WriteAheadRecord.beside(configuration.history.path)
        self._resume = load_resume_point(configuration, self._history, clock, self._last_block)
        self._link = CncLink(lambda: parts.open_cnc(configuration, clock), self._open_session)
        inbox: asyncio.Queue[Message] = asyncio.Queue()
        self.control = ControlTask(
            configuration,
            clock,
            self._link,
            self._history,
            self._telemetry,
            commissioning=record,
            model_id=model.model_id if model is not None else None,
            model_obstacle=lambda: obstacle or self.thermal.obstacle(),
            resume=self._resume,
            ask_reference=inbox.put_nowait,
            on_tick=self._on_tick,
            on_sample=lambda sample: inbox.put_nowait(
                SpindleSpeed(monotonic_s=sample.time.monotonic_s, rpm=sample.spindle_speed_rpm)
            ),
        )
        self.thermal = ThermalTask(
            configuration, clock, self._history, self._telemetry, model, inbox, self.control.deliver
        )
        lines = configuration.temperatures.lines
        self._line_health = {line.name: LinkHealth(f"latsis {line.name}") for line in lines}
        self._displacement_health = LinkHealth("displacement files")
        healths = [*self._line_health.values(), self._link.health]
        if configuration.displacements is not None:
            healths.append(self._displacement_health)
        self._socket_health, self._web_health = LinkHealth("local socket"), LinkHealth("metrics")
        self._healths = healths
        self.board = StatusBoard(configuration, clock, self.thermal, self.control, self._telemetry, healths)
        self.board.model = self._loaded.picture()
        self._commands = CommandDesk(self.board, self.control, axes)

    async def run(self) -> None:
        """Run until cancelled or told to stop by a signal."""
        configuration = self._configuration
        self._history.start()
        self._report("daemon", "started")
        self._report("model", self._loaded.in_words())
        if (bearings := self.control.side.speed.worker.model) is not None:
            self._report("model", f"bearings: {bearings.in_words()}")
        scheduler = self._parts.housekeeping(self._history, configuration.history)
        try:
            async with asyncio.TaskGroup() as tasks:
                loop = asyncio.get_running_loop()
                stop = asyncio.Event()
                for number in (signal.SIGTERM, signal.SIGINT):
                    loop.add_signal_handler(number, stop.set)
                loop.add_signal_handler(signal.SIGHUP, self.reload_model)
                controlling = tasks.create_task(self.control.run())
                running = [tasks.create_task(work) for work in (self.thermal.run(), *self._links())]
                scheduler.start()
                if self._backups is not None:
                    self._backups.start()
                if self._retraining is not None:
                    self._retraining.start()
                gc.collect()
                gc.freeze()
                self._service_manager.ready("running")
                log.info("daemon.ready", machine=configuration.machine)
                await stop.wait()
                self._service_manager.stopping()
                self.control.stop()
                await asyncio.wait([controlling], timeout=STOP_CALLS * configuration.cnc.timeout_s)
                for task in (controlling, *running):
                    task.cancel()
        finally:
            if scheduler.running:
                scheduler.shutdown(wait=False)
            if self._backups is not None:
                self._backups.stop()
            if self._retraining is not None:
                self._retraining.stop()
            self._report("daemon", "stopped")
            await asyncio.to_thread(self._history.close)
            self._last_block.close()
            self.control.side.close()

    def reload_model(self) -> None:
        """Take up a model that was released meanwhile; the old one stays where the new one is refused."""
        found = load_released(self._configuration, own_account())
        if found.model is not None and self._loaded.model is None:
            words = f"{found.in_words()}; the daemon was started without a model: restart it to use this one"
        elif found.model is not None and found.sha256 == self._loaded.sha256:
            log.info("model.reload", outcome="unchanged")
            return
        elif found.model is not None:
            words = found.in_words()
            self._loaded = found
            self.board.model = found.picture()
            self.thermal.inbox.put_nowait(found.model)
        else:
            words = f"{found.in_words()}; the model in use stays"
            self.board.model = self._loaded.picture() | {"problem": found.obstacle}
        log.info("model.reload", outcome=words)
        self._report("model", words)

    # --- links ---------------------------------------------------------------------------

    def _links(self) -> Iterator[Coroutine[Any, Any, None]]:
        """Yield the work that keeps each link alive."""
        configuration, service = self._configuration, self._configuration.service
        for line in configuration.temperatures.lines:
            yield self._keep_line(line)
        yield self._keep(self._link.health, self._link.attempt)
        if configuration.displacements is not None:
            yield self._keep(self._displacement_health, self._follow_displacements)
        yield self._keep(self._socket_health, self._serve_socket)
        if service.http_port is not None:
            yield self._keep(self._web_health, self._serve_web)

    async def _serve_socket(self) -> None:
        service = self._configuration.service
        try:
            self._socket_health.up = True
            await ControlSocket(service.socket, service.socket_group, self._commands.handle).run()
        except (OSError, KeyError) as error:
            raise LinkError(f"service.socket {service.socket} cannot be served: {error}") from error

    async def _serve_web(self) -> None:
        service = self._configuration.service
        assert service.http_port is not None
        try:
            self._web_health.up = True
            await serve_metrics(self._telemetry.registry, service.http_host, service.http_port)
        except OSError as error:
            raise LinkError(f"service.http_port {service.http_port} cannot be served: {error}") from error

    async def _keep(self, health: LinkHealth, attempt: Any) -> None:
        service = self._configuration.service
        await run_with_reconnect(health, attempt, Backoff(service.retry_min_s, service.retry_max_s))

    async def _keep_line(self, line: LineConfig) -> None:
        health = self._line_health[line.name]

        async def attempt() -> None:
            source = self._parts.open_temperature_source(self._configuration, line, self._clock)
            try:
                async for cycle in source.cycles():
                    health.up = True
                    self.thermal.inbox.put_nowait(cycle)
            finally:
                health.up = False
                await source.close()

        await self._keep(health, attempt)

    async def _follow_displacements(self) -> None:
        source = self._parts.open_displacement_source(
            self._configuration, self._clock, self._history.last_displacement_utc_s()
        )
        try:
            self._displacement_health.up = True
            async for sample in source.samples():
                self._history.displacement(sample)
                self.board.displacement = sample
                self.control.displacement(sample)
        finally:
            self._displacement_health.up = False
            await source.close()

    def _open_session(self, cnc: Cnc, last: CncSession | None) -> CncSession:
        known = last.known if last is not None else self._resume.known_macros
        writer = AuditedWriter(cnc, self._block, self._clock, self._history, self._telemetry)
        return CncSession(writer, self.control.limits, known, self._last_block)

    # --- what the tasks call back --------------------------------------------------------

    def _on_tick(self) -> None:
        state = self.control.memory.state.value if self.control.memory else "waiting for the CNC"
        self._service_manager.watchdog(state)
        now = self._clock.now()
        if now.real_s - self._alive_real_s > ALIVE_PERIOD_S:
            self._alive_real_s = now.real_s
            self._history.put_state("alive_utc_s", now.utc_s)
        self._telemetry.report(now.real_s)
        self._telemetry.links((health.name, health.up) for health in self._healths)
        if self.thermal.latest is not None:
            self._telemetry.sensors_usable(self.thermal.usable)

    def _report(self, kind: str, text: str) -> None:
        self._history.event(kind, text, "daemon")

    def _on_acknowledged(self, line: str, number: int) -> None:
        self.board.acknowledged[line] = number
        self._telemetry.acknowledged(line, number)

    def _on_history_problem(self, problem: str) -> None:
        if problem:
            log.error("history.problem", problem=problem)
            self._telemetry.history_problem()
        self.board.history_problem = problem
