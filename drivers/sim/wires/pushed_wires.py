"""Simulated sources that bring their numbers unasked: an MQTT broker, a logger's file, the lines of a program."""

import asyncio
import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from paho.mqtt.client import topic_matches_sub

from config.schema.displacements import DisplacementChannelConfig, DisplacementFileConfig, DisplacementsConfig
from config.schema.source_drivers import SourceConfig
from config.schema.source_sections import CsvConfig, MqttConfig, ProcessConfig
from config.schema.sources import SourceSensorConfig
from drivers.sim.wires.displacement_wire import NO_UNIT, DisplacementCsv
from drivers.sim.wires.listener import HOST, Listener

Temperatures = Callable[[Sequence[int]], Sequence[float]]
"""Sensor IDs -> what they measure now [degC]."""
FOLLOW = ("tail", "-n", "+1", "-F")
"""What stands for a program that writes lines: it shows those of a file as they come."""


CONNECT, PUBLISH, SUBSCRIBE, PING, DISCONNECT = 1, 3, 8, 12, 14
"""Kinds of packets: the upper half of their first byte."""
ACCEPTED, WRONG_VERSION = b"\x20\x02\x00\x00", b"\x20\x02\x00\x01"
LEVEL = b"\x00\x04MQTT\x04"
PONG = b"\xd0\x00"
LONGEST_PACKET = 1 << 16
LONGEST_LENGTH = 4
"""Bytes of a packet's length."""


class BrokenPacketError(ValueError):
    """A packet that this broker does not take; it ends the connection."""


class SimulatedBroker(Listener[asyncio.WriteTransport]):
    """Clients subscribe, the owner publishes with quality of service 0."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self._topics: dict[asyncio.StreamWriter, list[str]] = {}

    async def _listen(self, port: int) -> asyncio.Server:
        return await asyncio.start_server(self._serve, HOST, port)

    def publish(self, messages: Mapping[str, bytes]) -> int:
        """Send each message to who has subscribed to its topic; return to how many at least one has gone."""
        heard = 0
        for topic, payload in messages.items():
            name = topic.encode()
            body = struct.pack(">H", len(name)) + name + payload
            packet = bytes([PUBLISH << 4]) + _length(len(body)) + body
            wanting = [
                writer for writer, filters in self._topics.items() if any(topic_matches_sub(f, topic) for f in filters)
            ]
            for writer in wanting:
                writer.write(packet)
            heard += bool(wanting)
        return heard

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._topics[writer] = []
        self.connections.add(writer.transport)
        try:
            connected = False
            while True:
                first, body = await _packet(reader)
                kind = first >> 4
                if kind == CONNECT and not connected:
                    connected = body.startswith(LEVEL)
                    writer.write(ACCEPTED if connected else WRONG_VERSION)
                if not connected or kind == DISCONNECT:
                    return
                if kind == SUBSCRIBE:
                    writer.write(self._subscribed(writer, body))
                elif kind == PING:
                    writer.write(PONG)
                elif kind != CONNECT:
                    return
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError, BrokenPacketError, struct.error, UnicodeDecodeError):
            pass
        finally:
            del self._topics[writer]
            self.connections.discard(writer.transport)
            writer.close()

    def _subscribed(self, writer: asyncio.StreamWriter, body: bytes) -> bytes:
        """Note what a client wants; return the answer."""
        place, granted = 2, 0
        while place < len(body):
            (length,) = struct.unpack_from(">H", body, place)
            self._topics[writer].append(body[place + 2 : place + 2 + length].decode())
            place += 2 + length + 1
            granted += 1
        return b"\x90" + _length(2 + granted) + body[:2] + bytes(granted)


async def _packet(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    (first,) = await reader.readexactly(1)
    length = 0
    for place in range(LONGEST_LENGTH):
        (byte,) = await reader.readexactly(1)
        length |= (byte & 0x7F) << 7 * place
        if not byte & 0x80:
            break
    if length > LONGEST_PACKET:
        raise BrokenPacketError(f"a packet of {length} bytes")
    return first, await reader.readexactly(length)


def _length(length: int) -> bytes:
    """Return the length of a body as MQTT writes it: seven bits a byte, the lowest first."""
    found = bytearray()
    while length > 0x7F:
        found.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes(found + bytes([length]))


class Pushed(ABC):
    """A source that sends one reading of all its sensors in each cycle period."""

    def __init__(self, source: SourceConfig, read: Temperatures) -> None:
        self._period_s = self._next_s = source.cycle_period_s
        self._sensors = source.sensors
        self._read = read
        self.cycles = 0
        self.stopped = False

    @abstractmethod
    async def open(self) -> None:
        """Be there for whoever listens."""

    @abstractmethod
    def send(self, numbers: dict[int, float], at_s: float) -> bool:
        """Send the numbers of the sensors as they are written, of a simulated time [s]; False: nobody hears them."""

    async def step(self, now_s: float, until_s: float) -> None:
        """Send what is due at a simulated time [s]; from `until_s` on nothing is."""
        while self._next_s <= now_s and self._next_s < until_s:
            degc = self._read([sensor.id for sensor in self._sensors])
            numbers = {sensor.id: sensor.number(each) for sensor, each in zip(self._sensors, degc, strict=True)}
            self.cycles += self.send(numbers, self._next_s)
            self._next_s += self._period_s
        self.stopped = now_s >= until_s

    async def close(self) -> None:
        self.stopped = True


class MqttFace(Pushed):
    """A broker with the topics of one source; a message is a number, or a JSON object with several."""

    def __init__(self, source: SourceConfig, read: Temperatures) -> None:
        super().__init__(source, read)
        assert isinstance(source.connection, MqttConfig)
        self._inputs = source.connection.sensors
        self._broker = SimulatedBroker(source.connection.port)

    async def open(self) -> None:
        await self._broker.start()

    def send(self, numbers: dict[int, float], at_s: float) -> bool:
        """Publish the messages of all topics."""
        messages: dict[str, Any] = {}
        for each in self._inputs:
            messages[each.topic] = _placed(messages.get(each.topic), each.field, numbers[each.id])
        packets = {topic: json.dumps(content).encode() for topic, content in messages.items()}
        return self._broker.publish(packets) == len(packets)

    async def close(self) -> None:
        await super().close()
        await self._broker.stop()


class CsvFace(Pushed):
    """A logger's file, laid out as the configuration says."""

    def __init__(self, source: SourceConfig, read: Temperatures, utc_of: Callable[[float], float]) -> None:
        """Raises ValueError where such a file cannot be written, `utc_of` gives the UTC of a simulated time [s]."""
        super().__init__(source, read)
        config = source.connection
        assert isinstance(config, CsvConfig)
        names = {sensor.id: f"sensor {sensor.id}" for sensor in config.sensors}
        layout = DisplacementsConfig(
            file=DisplacementFileConfig(**config.file.model_dump()),
            channels=[DisplacementChannelConfig(name=names[each.id], column=each.column) for each in config.sensors],
        )
        self._numbers: dict[int, float] = {}
        self._file = DisplacementCsv(
            layout,
            lambda: {names[sensor_id]: number for sensor_id, number in self._numbers.items()},
            utc_of,
            start_s=source.cycle_period_s,
            period_s=source.cycle_period_s,
            unit=NO_UNIT,
        )

    async def open(self) -> None:
        self._file.begin()

    def send(self, numbers: dict[int, float], at_s: float) -> bool:
        """Append the row of this time."""
        self._numbers = numbers
        self._file.step(at_s)
        return True


class LinesFace(Pushed):
    """A file of JSON lines for the program that shows them."""

    def __init__(self, source: SourceConfig, read: Temperatures) -> None:
        super().__init__(source, read)
        assert isinstance(source.connection, ProcessConfig)
        self._inputs = source.connection.sensors
        self._path = Path(source.connection.command[-1])

    async def open(self) -> None:
        self._path.write_text("", encoding="utf-8")

    def send(self, numbers: dict[int, float], at_s: float) -> bool:
        content: Any = None
        for each in self._inputs:
            content = _placed(content, each.field, numbers[each.id])
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(content) + "\n")
        return True


def _placed(content: Any, field: str, number: float) -> Any:
    """Return a JSON value with a number put in its field: `a.b` is b within a, the empty field the value itself."""
    if not field:
        return number
    whole = content if isinstance(content, dict) else {}
    *outer, last = field.split(".")
    place = whole
    for step in outer:
        place = place.setdefault(step, {})
    place[last] = number
    return whole


def follows(path: Path) -> list[str]:
    """Return the command that stands for a program, as `LinesFace` reads it."""
    return [*FOLLOW, str(path)]


def can_be_pushed(sensors: Sequence[SourceSensorConfig]) -> bool:
    """Return whether every field of a JSON value can stand beside the others."""
    fields = [(getattr(each, "topic", ""), getattr(each, "field", "")) for each in sensors]
    return all(
        one == other or one[0] != other[0] or not (one[1] == "" or other[1].startswith(f"{one[1]}."))
        for one in fields
        for other in fields
    )
