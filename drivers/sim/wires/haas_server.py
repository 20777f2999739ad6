"""The machine data collection of a simulated Haas control: two connections, every answer to both, `UNKNOWN` and `!`."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import HaasConfig
from drivers.haas.cnc import SIMULATED_SERIAL_NUMBER
from drivers.haas.codec import DECIMALS, HaasFormatError, LineBuffer, Query, Write, encode_fields, parse_request
from drivers.haas.requests import MACHINE_POSITION, METRIC, MOST_AXES, UNIT_CODE
from drivers.sim.contract import SimulatedNc
from drivers.sim.wires.listener import HOST, Listener
from drivers.sim.wires.system_variables import system_variable

MOST_CONNECTIONS = 2
MODE_WORDS = {0: "MDI", 1: "MEM", 3: "EDIT", 4: "HANDLE JOG", 5: "JOG"}
RUN_WORDS = {0: "IDLE", 1: "IDLE", 2: "FEED HOLD"}
BUSY = 3
UNKNOWN = encode_fields("UNKNOWN")
ACKNOWLEDGED = encode_fields("!")


class HaasResponder:
    """Answers one line after the other for one NC; no I/O, so that it can be tried with any bytes."""

    def __init__(self, nc: SimulatedNc, config: HaasConfig) -> None:
        self._nc = nc
        self.numbered = True
        """Whether answers name their macro variable; newer controls leave it out."""
        self.refused_macros: set[int] = set()
        """Macro variables that do not take what is written."""
        self._state: dict[int, Callable[[], float | None]] = {
            config.program_macro: lambda: nc.program,
            config.sequence_number_macro: lambda: nc.sequence_number,
            config.work_offset_macro: lambda: nc.work_offset,
            config.tool_macro: lambda: nc.tool_number,
            config.spindle_speed_macro: lambda: nc.spindle_speed_rpm,
            UNIT_CODE: lambda: METRIC,
        }
        for place in range(1, MOST_AXES + 1):
            self._state[MACHINE_POSITION + place] = self._position(place)
        self._words: Mapping[int, Callable[[], tuple[str, ...]]] = {
            Query.SERIAL_NUMBER: lambda: ("SERIAL NUMBER", SIMULATED_SERIAL_NUMBER),
            Query.SOFTWARE: lambda: ("SOFTWARE" if self.numbered else "SOFTWARE VERSION", "100.17.000.2037"),
            Query.MODEL: lambda: ("MODEL", "SIMULATED"),
            Query.MODE: lambda: ("MODE", MODE_WORDS.get(nc.mode, "REMOTE")),
            Query.PROGRAM: self._program,
        }

    def answer(self, line: str) -> bytes:
        request = parse_request(line)
        if isinstance(request, Write):
            return self._write(request)
        if request is None:
            return UNKNOWN
        query, number = request
        if query == Query.MACRO and number is not None:
            return self._macro(number)
        return encode_fields(*self._words[query]()) if query in self._words and number is None else UNKNOWN

    def _program(self) -> tuple[str, ...]:
        nc = self._nc
        if nc.run == BUSY and not nc.alarm:
            return ("STATUS", "BUSY")
        return (
            "PROGRAM",
            f"O{nc.program:05d}",
            "ALARM ON" if nc.alarm else RUN_WORDS.get(nc.run, "IDLE"),
            "PARTS",
            "0",
        )

    def _position(self, place: int) -> Callable[[], float | None]:
        return lambda: dict(enumerate(self._nc.positions_mm.values(), start=1)).get(place)

    def _macro(self, number: int) -> bytes:
        value = system_variable(self._nc, number)
        if value is None and number in self._state:
            value = self._state[number]()
        elif value is None:
            try:
                value = self._nc.macros.get(number)
            except KeyError:
                return UNKNOWN
        text = "" if value is None else f"{value:.{DECIMALS}f}"
        return encode_fields("MACRO", *([str(number)] if self.numbered else []), text)

    def _write(self, write: Write) -> bytes:
        if not (100 <= write.number <= 199 or 500 <= write.number <= 699 or 800 <= write.number <= 999):
            return UNKNOWN
        if write.number not in self.refused_macros:
            try:
                self._nc.macros.set(write.number, write.value)
            except (KeyError, ValueError):
                return UNKNOWN
        return ACKNOWLEDGED


class SimulatedHaasServer(Listener["_Connection"]):
    """Machine data collection on 127.0.0.1 for one simulated NC."""

    def __init__(self, nc: SimulatedNc, config: CncConfig, *, port: int | None = None) -> None:
        """Prepare the server; `port` None takes the configured one, 0 any free one."""
        haas = config.connection_as(HaasConfig)
        super().__init__(haas.port if port is None else port)
        self.nc = nc
        self.responder = HaasResponder(nc, haas)

    async def _listen(self, port: int) -> asyncio.Server:
        return await asyncio.get_running_loop().create_server(lambda: _Connection(self), HOST, port)

    def send(self, data: bytes) -> None:
        for connection in list(self.connections):
            connection.send(data)


class _Connection(asyncio.Protocol):
    def __init__(self, server: SimulatedHaasServer) -> None:
        self._server = server
        self._buffer = LineBuffer()
        self._transport: Any = None
        self._power_on_count = server.nc.power_on_count

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        if len(self._server.connections) >= MOST_CONNECTIONS:
            self.abort()
        else:
            self._server.connections.add(self)

    def connection_lost(self, error: Exception | None) -> None:
        self._server.connections.discard(self)

    def abort(self) -> None:
        self._transport.abort()

    def send(self, data: bytes) -> None:
        self._transport.write(data)

    def data_received(self, data: bytes) -> None:
        if self._power_on_count != self._server.nc.power_on_count:
            self.abort()  # a control that was switched off knows no connection of before
            return
        try:
            for line in self._buffer.feed(data):
                self._server.send(self._server.responder.answer(line))
        except HaasFormatError:
            self.abort()
