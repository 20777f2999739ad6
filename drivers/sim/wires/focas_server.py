"""The FOCAS2 face of a simulated CNC: reads show its present state, writes reach its macro variables at once.

As a control does, it refuses what it does not have by the error of the block, and a sixth session.
"""

import asyncio
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig
from drivers.focas.codec import (
    SYNC,
    Answer,
    Ask,
    Direction,
    FocasFormatError,
    Frame,
    FrameBuffer,
    Function,
    Kind,
    encode_answers,
    encode_frame,
    encode_value,
    parse_asks,
    parse_values,
)
from drivers.focas.requests import ADDITIONAL_OFFSET, MACROS_PER_BLOCK, WORK_OFFSET
from drivers.sim.contract import SimulatedNc
from drivers.sim.wires.listener import HOST, Listener
from drivers.sim.wires.system_variables import system_variable

SYSTEM = struct.pack(">hh2s2s4s4s2s", 0, 3, b"TP", b"SM", b"TOOL", b"PNT0", b"03")
MOST_SESSIONS = 5
NO_FUNCTION, WRONG_LENGTH, NO_NUMBER, WRONG_VALUE, NO_OPTION, NO_PATH = 1, 2, 3, 5, 6, 11
MOST_WRITTEN = 200
"""Macro variables that one block writes at most."""


class FocasResponder:
    """Answers one frame after the other for one NC; no I/O, so that it can be tried with any bytes."""

    def __init__(self, nc: SimulatedNc, tool_macro: int, motor_temperature_diagnosis: int | None = None) -> None:
        self.most_blocks = 100
        """A request with more is refused whole."""
        self._nc = nc
        self.tool_macro = tool_macro
        self._diagnosis = motor_temperature_diagnosis
        self.refused_functions: dict[int, int] = {}
        """Function -> the error with which it is refused: what an option or a switch of a real control does."""
        self.refused_macros: dict[int, int] = {}
        """Macro variable -> the error with which writing it is refused."""
        self._answers: Mapping[int, Callable[[Ask], Answer]] = {
            Function.SYSTEM: lambda ask: Answer(0, SYSTEM),
            Function.STATUS: self._status,
            Function.PROGRAM_NUMBER: lambda ask: Answer(0, struct.pack(">ii", nc.program, nc.program)),
            Function.SEQUENCE_NUMBER: lambda ask: Answer(0, struct.pack(">i", nc.sequence_number)),
            Function.SPINDLE_SPEED: lambda ask: Answer(0, encode_value(nc.spindle_speed_rpm)),
            Function.AXIS_POSITION: lambda ask: Answer(0, b"".join(map(encode_value, nc.positions_mm.values()))),
            Function.DIAGNOSIS_31I: self._motor_temperature,
            Function.DIAGNOSIS: self._motor_temperature,
            Function.READ_MACRO: self._read_macros,
            Function.WRITE_MACRO: self._write_macro,
            Function.WRITE_MACROS: self._write_macros,
        }

    def answer(self, body: bytes) -> bytes:
        """Return the body of the answer to a request's body; raises FocasFormatError."""
        asked = parse_asks(body)
        return encode_answers([(kind, path, ask.function, self._one(kind, path, ask)) for kind, path, ask in asked])

    def _one(self, kind: int, path: int, ask: Ask) -> Answer:
        if path != 1:
            return Answer(NO_PATH)
        if kind != 1 or ask.function not in self._answers:
            return Answer(NO_FUNCTION)
        if error := self.refused_functions.get(ask.function):
            return Answer(error)
        return self._answers[ask.function](ask)

    def _status(self, ask: Ask) -> Answer:
        nc = self._nc
        return Answer(0, struct.pack(">7h", nc.mode, nc.run, 0, 0, 0, int(nc.alarm != 0), 0))

    def _motor_temperature(self, ask: Ask) -> Answer:
        number = ask.arguments[0]
        if number != self._diagnosis:
            return Answer(NO_NUMBER)
        value = struct.pack(">i", round(self._nc.motor_temperature_degc))
        return Answer(0, struct.pack(">ihh", number, 1, 2) + value)

    def _read_macros(self, ask: Ask) -> Answer:
        first, last, *_ = ask.arguments
        if not 0 <= last - first < MACROS_PER_BLOCK:
            return Answer(WRONG_LENGTH)
        try:
            return Answer(0, b"".join(encode_value(self._macro(number)) for number in range(first, last + 1)))
        except KeyError:
            return Answer(NO_NUMBER)

    def _macro(self, number: int) -> float | None:
        nc = self._nc
        if (value := system_variable(nc, number)) is not None:
            return value
        if number == WORK_OFFSET:
            return float(nc.work_offset)
        if number == ADDITIONAL_OFFSET:
            return 0.0
        if number == self.tool_macro:
            return float(nc.tool_number)
        return nc.macros.get(number)

    def _write_macro(self, ask: Ask) -> Answer:
        first, last, *_ = ask.arguments
        if first != last or len(ask.extra) != 8:
            return Answer(WRONG_LENGTH)
        try:
            (value,) = parse_values(ask.extra, 1)
        except FocasFormatError:
            return Answer(WRONG_VALUE)
        return Answer(self._set(first, value))

    def _write_macros(self, ask: Ask) -> Answer:
        count = len(ask.extra) // 8
        if len(ask.extra) % 8 or not 0 < count <= MOST_WRITTEN:
            return Answer(WRONG_LENGTH)
        values = struct.unpack(f">{count}d", ask.extra)
        if not all(math.isfinite(value) for value in values):
            return Answer(WRONG_VALUE)
        for number, value in enumerate(values, start=ask.arguments[0]):
            if error := self._set(number, value):
                return Answer(error)
        return Answer(0)

    def _set(self, number: int, value: float | None) -> int:
        if error := self.refused_macros.get(number):
            return error
        if not (100 <= number <= 199 or 500 <= number <= 999):
            return NO_NUMBER
        try:
            if value is not None:
                encode_value(value)
            self._nc.macros.set(number, value)
        except KeyError:
            return NO_NUMBER
        except (OverflowError, ValueError):
            return WRONG_VALUE
        return 0


class SimulatedFocasServer(Listener["_Session"]):
    """A FOCAS2 server on 127.0.0.1 for one simulated NC."""

    def __init__(self, nc: SimulatedNc, config: CncConfig, *, port: int | None = None) -> None:
        """Prepare the server; `port` None takes the configured one, 0 any free one."""
        focas = config.connection_as(FocasConfig)
        super().__init__(focas.port if port is None else port)
        self.nc = nc
        self.responder = FocasResponder(nc, focas.tool_macro, focas.motor_temperature_diagnosis)

    async def _listen(self, port: int) -> asyncio.Server:
        return await asyncio.get_running_loop().create_server(lambda: _Session(self), HOST, port)


class _Session(asyncio.Protocol):
    """One connection of a client."""

    def __init__(self, server: SimulatedFocasServer) -> None:
        self._server = server
        self._buffer = FrameBuffer()
        self._transport: Any = None
        self._open = False
        self._power_on_count = server.nc.power_on_count

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport
        self._server.connections.add(self)

    def connection_lost(self, error: Exception | None) -> None:
        self._server.connections.discard(self)

    def abort(self) -> None:
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        if self._power_on_count != self._server.nc.power_on_count:
            self.abort()  # a control that was switched off knows no session of before
            return
        try:
            for frame in self._buffer.feed(data):
                self._send(self._answer(frame))
        except FocasFormatError:
            self.abort()

    def _send(self, frame: Frame) -> None:
        self._transport.write(encode_frame(frame, version=3))

    def _answer(self, frame: Frame) -> Frame:
        if frame.direction != Direction.REQUEST:
            raise FocasFormatError("a request has direction 01")
        if frame.kind == Kind.OPEN:
            others = sum(session._open for session in self._server.connections if session is not self)
            if others >= MOST_SESSIONS:
                return Frame(Kind.OPEN, Direction.REFUSED)
            self._open = True
            return Frame(Kind.OPEN, Direction.ANSWER, struct.pack(">8xH6xHHI", 1, 1, 1, 0))
        if frame.kind == Kind.CLOSE:
            self._open = False
            return Frame(Kind.CLOSE, Direction.ANSWER)
        if frame.kind == Kind.DATA and self._open:
            if len(parse_asks(frame.body)) > self._server.responder.most_blocks:
                return Frame(Kind.DATA, Direction.REFUSED)
            return Frame(Kind.DATA, Direction.ANSWER, self._server.responder.answer(frame.body))
        raise FocasFormatError(f"{SYNC.hex()}: frame {frame.kind:02X} is not known, or the session is not open")
