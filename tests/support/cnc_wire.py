"""The wire between a driver and the server of its dialect in random histories of a control."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any, cast

from cnc_machines import Machine
from control_rig import Bench
from memory_cnc import MemoryNc

from config.schema.cnc import CncConfig
from drivers.sim.contract import SimulatedNc
from drivers.sim.nc.nc import ModeCode
from drivers.sim.wires.focas_server import SimulatedFocasServer
from drivers.sim.wires.haas_server import SimulatedHaasServer
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.records import CncRun

PATIENCE_S = 0.3
"""Of the driver, in real time: a wire that is held back costs so much [s]."""
COUNTED = 560
"""Macro that the program raises before every positioning, where it counts them."""
TOOLS_COUNTED = 561
"""Macro in which the control counts tool changes."""
OF_THE_BUILDER = 562
"""Macro in which the machine's builder keeps the tool in the spindle."""
RUN_CODES = {CncRun.RESET: 0, CncRun.STOP: 1, CncRun.HOLD: 2, CncRun.START: 3}
STATE = ("mode", "run", "alarm", "program", "sequence_number", "clock", "power_on_count", "work_offset", "tool_number")
OPC_UA: dict[str, dict[str, Any]] = {
    "opcua": {"namespace_uri": "urn:toolpoint:cnc"},
    "opcua generic": {
        "namespace_uri": "urn:own",
        "preset": "generic",
        "nodes": {name: f"s=Own.{name}" for name in STATE} | {"macro": "s=Own.Variable[{number}]"},
    },
    "sinumerik": {"preset": "sinumerik"},
}
SERVERS: dict[str, Any] = {"focas": SimulatedFocasServer, "haas": SimulatedHaasServer}
DIALECTS = (*SERVERS, *OPC_UA)
Bytes = Callable[[bytes], Sequence[bytes | None]]


def as_it_comes(data: bytes) -> Sequence[bytes | None]:
    return [data]


class Wire:
    """A relay; `answers` and `requests` make of each piece what arrives of it, None: the connection ends."""

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._writers: set[asyncio.StreamWriter] = set()
        self.held = asyncio.Event()
        self.calm()

    def calm(self) -> None:
        self.answers = self.requests = as_it_comes
        self.held.set()

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port: int = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        self._server.close()
        self.reset()

    def reset(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            control, to_control = await asyncio.open_connection("127.0.0.1", self._target_port)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, to_control}
        pumps = [
            asyncio.create_task(self._pump(reader, to_control, answers=False)),
            asyncio.create_task(self._pump(control, writer, answers=True)),
        ]
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        for each in pumps:
            each.cancel()
        for end in (writer, to_control):
            end.transport.abort()
            self._writers.discard(end)

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, answers: bool) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(65_536):
                if answers:
                    await self.held.wait()
                for piece in (self.answers if answers else self.requests)(data):
                    if piece is None:
                        return
                    sink.write(piece)
                    await asyncio.sleep(0)


class Face:
    """Shows the NC of the present history as the simulated servers want it."""

    motor_temperature_degc = 30.0
    nc: MemoryNc

    def __init__(self) -> None:
        self.alarm, self.mode = 0, ModeCode.MEM
        self.positions_mm: dict[str, float] = {}
        self.prepared: int | None = None
        """The tool that is got ready while another one cuts, on a control that shows the latest T word."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.nc, name)

    @property
    def tool_number(self) -> int:
        return self.nc.tool_number if self.prepared is None or self.nc.program != 1000 else self.prepared

    @property
    def run(self) -> int:
        return RUN_CODES[self.nc.run]

    @property
    def external_mm(self) -> list[float]:
        return list(self.nc.guard.control.external_mm)


class Served:
    """One dialect's server and wire; histories put their NC behind them, one after the other."""

    def __init__(self, dialect: str) -> None:
        self.dialect, self.face = dialect, Face()
        self.server: Any = None

    def section(self, bench: Bench, port: int, on_expiry: str = "keep", machine: Machine | None = None) -> CncConfig:
        """Return how the daemon reaches the control through the wire."""
        siemens = self.dialect == "sinumerik"
        content: dict[str, Any] = {
            "allow_insecure_writes": True,
            "timeout_s": PATIENCE_S,
            "stale_after_s": 30.0,
            "macros": bench.configuration.cnc.macros,
            "guard": {
                "increment_mm": 0.0001,
                "on_expiry": on_expiry,
                "dialect": "sinumerik" if siemens else "fanuc",
            },
        }
        if machine is not None and "y" not in machine.places:
            content["guard"]["axes"] = {
                axis: {"letter": axis.upper(), "number": machine.places[axis] + 1} for axis in machine.offsets
            }
        if self.dialect in OPC_UA:
            content["opcua"] = OPC_UA[self.dialect] | {"endpoint": f"opc.tcp://127.0.0.1:{port}/cnc"}
        else:
            content |= {"driver": self.dialect, self.dialect: {"host": "127.0.0.1", "port": port}}
        return CncConfig.model_validate(content)

    def calm(self) -> None:
        """Leave nothing of the history before."""
        self.wire.calm()
        if self.dialect not in OPC_UA:
            self.server.responder.refused_macros.clear()

    async def start(self, bench: Bench) -> None:
        self.face.nc = bench.nc
        config = self.section(bench, 1)
        if self.dialect in OPC_UA:
            self.server = SimulatedCncServer(
                cast(SimulatedNc, self.face), config, port=0, readable=[COUNTED, TOOLS_COUNTED]
            )
        else:
            self.server = SERVERS[self.dialect](self.face, config, port=0)
        await self.server.start()
        self.wire = Wire(self.server.port)
        await self.wire.start()

    async def stop(self) -> None:
        await self.wire.stop()
        await self.server.stop()


@contextlib.asynccontextmanager
async def serving(dialect: str, directory: Path) -> AsyncIterator[Served]:
    served = Served(dialect)
    directory.mkdir(parents=True, exist_ok=True)
    await served.start(Bench(directory))
    try:
        yield served
    finally:
        await served.stop()
