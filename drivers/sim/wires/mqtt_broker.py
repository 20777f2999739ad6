"""An MQTT 3.1.1 broker on 127.0.0.1 that passes on what the simulated machine publishes; nobody else may publish."""

import asyncio
import struct
from collections.abc import Mapping

from paho.mqtt.client import topic_matches_sub

from drivers.sim.wires.listener import HOST, Listener

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
    """Return first byte and body of the next packet."""
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
