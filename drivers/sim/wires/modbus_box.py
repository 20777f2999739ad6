"""Simulated boxes that answer Modbus over TCP, without a library; `way` decides what becomes of an answer."""

import asyncio
import struct
from collections.abc import Callable, Sequence
from typing import Literal

from config.schema.modbus import ModbusSensorConfig

Table = Literal["holding", "input"]
Contents = Callable[[int, Table, int, int], Sequence[int] | None]
"""(unit, table, first register, count) -> the registers, None where the box has none."""
Send = Callable[[bytes], None]
Way = Callable[[bytes, Send], None]
"""Takes an answer and what sends bytes; sends it now, later, twice or never."""
TABLES: dict[int, Table] = {3: "holding", 4: "input"}
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
MOST_REGISTERS = 125
MBAP = struct.Struct(">HHHB")
READ = struct.Struct(">BHH")
RTU_REQUEST_BYTES = 8
LONGEST_FRAME = 260
FORMATS = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}


def answer_to(unit: int, request: bytes, contents: Contents) -> bytes:
    """Return the answer (without frame) to a request (without frame)."""
    if len(request) != READ.size or request[0] not in TABLES:
        function = request[0] if request else 0
        return bytes([function | 0x80, ILLEGAL_FUNCTION])
    function, start, count = READ.unpack(request)
    if not 1 <= count <= MOST_REGISTERS:
        return bytes([function | 0x80, ILLEGAL_VALUE])
    words = contents(unit, TABLES[function], start, count)
    if words is None:
        return bytes([function | 0x80, ILLEGAL_ADDRESS])
    return bytes([function, 2 * count]) + struct.pack(f">{count}H", *words)


def registers_of(number: float, sensor: ModbusSensorConfig) -> tuple[int, ...]:
    """Return what a sensor's registers hold for a number; raises ValueError or OverflowError when it does not fit."""
    try:
        packed = struct.pack(FORMATS[sensor.type], number if sensor.type == "float32" else round(number))
    except struct.error as error:
        raise ValueError(f"{number} does not fit {sensor.type}: {error}") from error
    words = struct.unpack(f">{sensor.width}H", packed)
    return words if sensor.word_order == "big" else words[::-1]


def crc16(data: bytes) -> bytes:
    """Return the check of an RTU frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc.to_bytes(2, "little")


def at_once(answer: bytes, send: Send) -> None:
    """Send an answer as a good wire does."""
    send(answer)


class ModbusTcpBox:
    """Answers on a TCP port."""

    def __init__(self, contents: Contents, *, port: int = 0, way: Way = at_once, rtu: bool = False) -> None:
        self._contents = contents
        self._port = port
        self.way = way
        self._rtu = rtu
        self._server: asyncio.Server | None = None
        self._served: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}
        self.requests = 0

    @property
    def port(self) -> int:
        """The port it listens on, while it does."""
        assert self._server is not None
        return int(self._server.sockets[0].getsockname()[1])

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self._port)

    async def stop(self) -> None:
        """Close all connections and listen no more."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for writer in self._served:
            writer.transport.abort()
        await asyncio.gather(*self._served.values(), return_exceptions=True)
        if server is not None:
            await server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._served[writer] = task
        try:
            while True:
                if self._rtu:
                    frame = await reader.readexactly(RTU_REQUEST_BYTES)
                    answer = rtu_answer(frame, self._contents)
                else:
                    head = await reader.readexactly(MBAP.size)
                    number, _, length, unit = MBAP.unpack(head)
                    if not 2 <= length <= LONGEST_FRAME:
                        return
                    body = answer_to(unit, await reader.readexactly(length - 1), self._contents)
                    answer = MBAP.pack(number, 0, len(body) + 1, unit) + body
                if answer:
                    self.requests += 1
                    self.way(answer, lambda data: None if writer.is_closing() else writer.write(data))
        except (asyncio.IncompleteReadError, OSError):
            return
        finally:
            del self._served[writer]
            writer.close()


def rtu_answer(frame: bytes, contents: Contents) -> bytes:
    """Return the frame that answers a request's, empty where its check does not fit."""
    if len(frame) < 4 or crc16(frame[:-2]) != frame[-2:]:
        return b""
    body = frame[:1] + answer_to(frame[0], frame[1:-2], contents)
    return body + crc16(body)
