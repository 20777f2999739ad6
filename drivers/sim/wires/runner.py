"""Runs a simulated machine with its three faces: LATSIS lines on ptys, a growing CSV, the CNC's server."""

import asyncio
import contextlib
import gc
import math
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlparse

from config.schema import Configuration
from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig, HaasConfig, MtconnectConfig, OpcUaConfig
from drivers.clock import ScaledClock
from drivers.sim.contract import NC_STATE, SimulatedMachine, SimulatedNc
from drivers.sim.faults import Fault, FaultKind, check_targets, of_kind
from drivers.sim.wires.displacement_wire import DisplacementCsv
from drivers.sim.wires.focas_server import SimulatedFocasServer
from drivers.sim.wires.haas_server import SimulatedHaasServer
from drivers.sim.wires.latsis_wire import LatsisWires
from drivers.sim.wires.mtconnect_agent import SimulatedMtconnectAgent
from drivers.sim.wires.opcua_server import ServerSecurity, SimulatedCncServer
from drivers.sim.wires.source_wires import SourceWires, temperatures_of
from drivers.sim.wires.tcp_relay import TcpRelay
from models.json_values import finite_or_none

TICK_REAL_S = 0.01
"""The machine is moved on once in this time of the wall clock [s]."""
LARGEST_STEP_S = 1.0
"""The machine is never moved on by more simulated time at once, so that no peak between is missed [s]."""
BREATH_REAL_S = 0.05
"""After so much work in one go the network gets its turn, however far behind the machine is [s]."""

Report = Callable[[dict[str, Any]], None]


class CncServer(Protocol):
    """A server on 127.0.0.1 that a driver connects to."""

    @property
    def port(self) -> int:
        """The port that is listened on (known after start)."""

    @property
    def endpoint(self) -> str:
        """Where clients find it (known after start)."""

    async def start(self) -> None: ...

    async def stop(self) -> None:
        """Close all connections and stop listening. May be called more than once."""


def configured_port(config: CncConfig) -> int:
    """Return the TCP port at which the configuration expects the control."""
    connection = config.connection
    if isinstance(connection, OpcUaConfig):
        return urlparse(connection.endpoint).port or 4840
    assert isinstance(connection, FocasConfig | HaasConfig | MtconnectConfig)
    return connection.port


def cnc_server(
    nc: SimulatedNc, config: CncConfig, *, port: int, security: ServerSecurity | None, readable: Iterable[int]
) -> CncServer:
    """Return the server of the configured driver, not started; `readable` are macros beside those of the map."""
    if config.driver == "focas":
        return SimulatedFocasServer(nc, config, port=port)
    if config.driver == "haas":
        return SimulatedHaasServer(nc, config, port=port)
    if config.driver == "mtconnect":
        return SimulatedMtconnectAgent(nc, config, port=port)
    return SimulatedCncServer(nc, config, port=port, security=security, readable=readable)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """Where the faces are, once they are there."""

    endpoint: str
    ports: dict[str, Path]
    displacements: Path | None


class Witness(Protocol):
    """Sees what a report at intervals cannot show."""

    def began(self, origin_s: float) -> None:
        """Take the clock's time at which the machine's time was 0 [s]."""

    def passed(self, line: str, start_s: float, end_s: float) -> None:
        """Take a pass over a line whose last bytes go out now; times are the machine's [s]."""


async def run_simulated_machine(
    machine: SimulatedMachine,
    configuration: Configuration,
    clock: ScaledClock,
    *,
    directory: Path,
    faults: Sequence[Fault],
    report_period_s: float,
    report: Report,
    seed: int = 0,
    security: ServerSecurity | None = None,
    ready: Callable[[Ready], None] | None = None,
    own_process: bool = False,
    first_pass_s: float | None = None,
    until_s: float = math.inf,
    witness: Witness | None = None,
) -> None:
    """Run until cancelled; the machine's time 0 is the moment when all faces are there.

    `report` is called each `report_period_s` and once more when cancelled, with `{time_s, nc: {state, macros: {number:
    value}}, truth: {axis: {uncompensated_um, compensated_um, cutting, uncompensated_max_um, compensated_max_um}},
    cycles_sent: {line: n}, cycles_disturbed, bytes_dropped, late_real_s, faults: [kinds that are on]}`; the maxima are
    of cuts so far, `late_real_s` is the longest wait for this computer. Lines are silent before `first_pass_s` and
    begin no pass from `until_s` on; after the last pass a report has `final: true`. A `witness` is told of the origin
    of the machine's time and of every pass.
    """
    check_targets(faults, configuration)
    async with _cnc_face(machine, configuration, faults, security) as (endpoint, relay):
        if own_process:
            gc.collect()
            gc.freeze()
        origin_s = clock.now().monotonic_s - machine.time_s
        origin_utc_s = clock.now().utc_s - machine.time_s
        if witness is not None:
            witness.began(origin_s)
        wires = LatsisWires(
            machine,
            configuration.temperatures,
            directory,
            first_pass_s=None if first_pass_s is None else first_pass_s - origin_s,
            until_s=until_s - origin_s,
            faults=faults,
            seed=seed,
        )
        logger = _logger(machine, configuration, origin_utc_s, faults)
        boxes = SourceWires(
            configuration.temperatures.sources or (),
            temperatures_of(machine, configuration.temperatures),
            until_s=until_s - origin_s,
            utc_of=lambda time_s: origin_utc_s + time_s,
        )
        await boxes.open()
        wires.open()
        try:
            if ready is not None:
                links = {line.name: wires.link(line.name) for line in configuration.temperatures.lines}
                ready(Ready(endpoint=endpoint, ports=links, displacements=logger.path if logger else None))
            run = _Run(machine, configuration, wires, boxes, logger, relay, faults, witness)
            await run.forever(clock, origin_s, report_period_s, report, until_s - origin_s)
        finally:
            wires.close()
            await boxes.close()


class _Run:
    """Moves the machine and its faces on, and keeps what is reported."""

    def __init__(
        self,
        machine: SimulatedMachine,
        configuration: Configuration,
        wires: LatsisWires,
        boxes: SourceWires,
        logger: DisplacementCsv | None,
        relay: TcpRelay | None,
        faults: Sequence[Fault],
        witness: Witness | None,
    ) -> None:
        self._machine = machine
        self._passed = None if witness is None else witness.passed
        self._macros = configuration.cnc.macros.block
        self._wires = wires
        self._boxes = boxes
        self._logger = logger
        self._relay = relay
        self._faults = faults
        self._freezes = of_kind(faults, FaultKind.FROZEN_CNC)
        self._kills = of_kind(faults, FaultKind.KILLED_CNC)
        self._extremes: dict[str, list[float]] = {}
        self._late_real_s = 0.0

    async def forever(
        self, clock: ScaledClock, origin_s: float, report_period_s: float, report: Report, until_s: float
    ) -> None:
        """Follow the clock; the last report is made when the task is cancelled."""
        next_report_s = self._machine.time_s
        loop = asyncio.get_running_loop()
        final = False
        turn_real_s = loop.time()
        try:
            while True:
                last_real_s, turn_real_s = turn_real_s, loop.time()
                self._late_real_s = max(self._late_real_s, turn_real_s - last_real_s)
                breath_at = turn_real_s + BREATH_REAL_S
                target_s = clock.now().monotonic_s - origin_s
                while self._machine.time_s < target_s and loop.time() < breath_at:
                    self._move(min(target_s, self._machine.time_s + LARGEST_STEP_S, self._next_start_s()))
                await self._disturb_cnc()
                await self._boxes.step(self._machine.time_s)
                if self._machine.time_s >= next_report_s:
                    report(self.snapshot())
                    next_report_s += report_period_s * (1 + (self._machine.time_s - next_report_s) // report_period_s)
                if not final and self._machine.time_s >= until_s and self._wires.idle and self._boxes.idle:
                    report(self.snapshot() | {"final": True})
                    final = True
                behind = self._machine.time_s < target_s
                await asyncio.sleep(0 if behind else TICK_REAL_S)
        except asyncio.CancelledError:
            report(self.snapshot())
            raise

    def _next_start_s(self) -> float:
        """Return when registers are read next, so that they are read at that very time."""
        start_s = self._wires.next_start_s
        return start_s if start_s > self._machine.time_s else math.inf

    def _move(self, to_s: float) -> None:
        self._machine.advance(to_s)
        self._wires.step(self._machine.time_s, self._passed)
        if self._logger is not None:
            self._logger.step(self._machine.time_s)
        for axis, truth in self._machine.truth().items():
            extremes = self._extremes.setdefault(axis, [0.0, 0.0])
            if truth.cutting:
                extremes[0] = max(extremes[0], abs(truth.uncompensated_um))
                extremes[1] = max(extremes[1], abs(truth.compensated_um))

    async def _disturb_cnc(self) -> None:
        if self._relay is None:
            return
        now_s = self._machine.time_s
        killed = any(fault.active(now_s) for fault in self._kills)
        if killed == self._relay.listening:
            await (self._relay.stop() if killed else self._relay.start())
        frozen = any(fault.active(now_s) for fault in self._freezes)
        if frozen != self._relay.frozen:
            (self._relay.freeze if frozen else self._relay.thaw)()

    def snapshot(self) -> dict[str, Any]:
        """Return the report: time, NC, truth with extremes during cuts so far, cycles sent and disturbed."""
        nc, now_s = self._machine.nc, self._machine.time_s
        truth = {}
        for axis, value in self._machine.truth().items():
            uncompensated_max_um, compensated_max_um = self._extremes.get(axis, [0.0, 0.0])
            truth[axis] = {
                "uncompensated_um": value.uncompensated_um,
                "compensated_um": value.compensated_um,
                "cutting": value.cutting,
                "uncompensated_max_um": uncompensated_max_um,
                "compensated_max_um": compensated_max_um,
            }
        return {
            "time_s": now_s,
            "nc": {attribute: finite_or_none(getattr(nc, attribute)) for attribute in NC_STATE}
            | {"macros": {str(number): finite_or_none(nc.macros.get(number)) for number in self._macros}},
            "truth": truth,
            "cycles_sent": self._wires.cycles_sent | self._boxes.cycles_sent,
            "cycles_disturbed": self._wires.cycles_disturbed,
            "bytes_dropped": self._wires.bytes_dropped,
            "late_real_s": self._late_real_s,
            "faults": [fault.kind.value for fault in self._faults if fault.active(now_s)],
        }


@contextlib.asynccontextmanager
async def _cnc_face(
    machine: SimulatedMachine, configuration: Configuration, faults: Sequence[Fault], security: ServerSecurity | None
) -> AsyncIterator[tuple[str, TcpRelay | None]]:
    """Serve the CNC on the configured port; a relay stands before it only if a fault needs one."""
    relayed = bool(of_kind(faults, FaultKind.FROZEN_CNC, FaultKind.KILLED_CNC))
    port = configured_port(configuration.cnc)
    tuning = configuration.spindle_speed
    server = cnc_server(
        machine.nc,
        configuration.cnc,
        port=0 if relayed else port,
        security=security,
        readable=() if tuning is None else tuning.macros.numbers,
    )
    relay: TcpRelay | None = None
    try:
        await server.start()
        if relayed:
            relay = TcpRelay(port=port, target_port=server.port)
            await relay.start()
        yield server.endpoint.replace(f":{server.port}", f":{relay.port if relay else server.port}"), relay
    finally:
        if relay is not None:
            await relay.stop()
        await server.stop()


def _logger(
    machine: SimulatedMachine, configuration: Configuration, origin_utc_s: float, faults: Sequence[Fault]
) -> DisplacementCsv | None:
    if configuration.displacements is None or configuration.displacements.file is None:
        return None
    return DisplacementCsv(
        configuration.displacements,
        machine.displacement_um,
        lambda time_s: origin_utc_s + time_s,
        start_s=machine.time_s,
        faults=faults,
    )
