"""An OPC UA server that sends what it likes: the driver loses the link, in bounded time and memory."""

import asyncio
import random
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import pytest
import pytest_asyncio
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua import ua_binary
from asyncua.ua.ua_binary import struct_from_binary, variant_to_binary
from asyncua.ua.uaerrors import UaError
from scripted_machine import ScriptedNc, cnc_config

from drivers.clock import SystemClock
from drivers.contract import DriverError, LinkError
from drivers.opcua.bounded import LONGEST_CHUNK, LONGEST_MESSAGE, MOST_CHUNKS, Received
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.wires.opcua_server import SimulatedCncServer


def on_wires(test: Any) -> Any:
    return pytest.mark.wires(pytest.mark.asyncio(loop_scope="module")(test))


ACKNOWLEDGE = struct.Struct("<4sIIIIII")
Changed = Callable[[bytes], bytes]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server() -> AsyncIterator[SimulatedCncServer]:
    server = SimulatedCncServer(ScriptedNc(), cnc_config(), port=0)
    await server.start()
    yield server
    await server.stop()


async def driver_at(answers: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]) -> OpcUaCnc:
    """A driver for a server of a test, which lives as long as the test."""
    listening = await asyncio.start_server(answers, "127.0.0.1", 0)
    port = listening.sockets[0].getsockname()[1]
    return OpcUaCnc(cnc_config(f"opc.tcp://127.0.0.1:{port}/cnc", timeout_s=5.0), SystemClock())


async def between(server: SimulatedCncServer, changed: Changed) -> OpcUaCnc:
    """A driver whose server's every piece is changed on its way."""
    port = int(server.endpoint.rpartition(":")[2].partition("/")[0])

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", port)

        async def on(source: asyncio.StreamReader, target: asyncio.StreamWriter, change: Changed) -> None:
            while data := await source.read(65536):
                target.write(change(data))
            target.close()

        await asyncio.gather(on(reader, back, bytes), on(there, writer, changed), return_exceptions=True)

    return await driver_at(relay)


def acknowledge(takes: int = LONGEST_CHUNK) -> bytes:
    return ACKNOWLEDGE.pack(b"ACKF", ACKNOWLEDGE.size, 0, takes, LONGEST_CHUNK, 0, 0)


async def refused(cnc: OpcUaCnc, words: str) -> None:
    with pytest.raises(LinkError, match=words):
        await cnc.connect()
    await cnc.close()


@on_wires
async def test_a_chunk_that_is_too_long_is_not_waited_for_and_a_server_is_told_how_long_it_may_be() -> None:
    said = []

    async def promise(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        said.append(ACKNOWLEDGE.unpack_from(await reader.read(4096)))
        writer.write(acknowledge() + b"OPNF" + (1 << 31).to_bytes(4, "little"))

    await refused(await driver_at(promise), "was lost while connecting")
    takes, sends, most_bytes, most_chunks = said[0][3:]
    assert takes == LONGEST_CHUNK, "else one of 65536, which some servers send, ends the connection"
    assert (sends, most_bytes, most_chunks) == (LONGEST_CHUNK, LONGEST_MESSAGE, MOST_CHUNKS)


@on_wires
async def test_a_server_of_another_kind_is_said_to_be_none() -> None:
    async def web(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(4096)
        writer.write(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n")

    await refused(await driver_at(web), "no OPC UA server answers there")


@on_wires
async def test_a_server_that_takes_next_to_nothing_is_none() -> None:
    async def tiny(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(4096)
        writer.write(acknowledge(takes=16))

    await refused(await driver_at(tiny), "was lost while connecting")


@on_wires
@pytest.mark.parametrize(("size", "most"), [(LONGEST_CHUNK - 100, LONGEST_MESSAGE), (1, MOST_CHUNKS)])
async def test_a_message_without_end_is_given_up(server: SimulatedCncServer, size: int, most: int) -> None:
    """Each answer on the channel becomes the first of parts without end."""
    sent = []

    def changed(data: bytes) -> bytes:
        if data[:3] != b"MSG":
            return data
        head, first = data[8:16], int.from_bytes(data[16:20], "little")
        chunk_size = (24 + size).to_bytes(4, "little")
        flood = [
            b"MSGC" + chunk_size + head + (first + i).to_bytes(4, "little") + data[20:24] + bytes(size)
            for i in range(most // size + 2)
        ]
        sent.append(len(flood))
        return b"".join(flood)

    await refused(await between(server, changed), "BadRequestTooLarge|was lost while connecting")
    assert len(sent) == 1


@on_wires
async def test_flipped_answers_lose_the_link_or_change_nothing_that_is_decoded(server: SimulatedCncServer) -> None:
    rng = random.Random(3)
    outcomes = []
    for _ in range(40):

        def flipped(data: bytes) -> bytes:
            altered = bytearray(data)
            for _ in range(rng.randrange(3)):
                at = rng.randrange(len(altered))
                altered[at] = rng.choice((0, 0x7F, 0x80, 0xFF, altered[at] ^ 1 << rng.randrange(8)))
            return bytes(altered)

        cnc = await between(server, flipped)
        cnc._config = cnc._config.model_copy(update={"timeout_s": 0.3})
        try:
            await cnc.connect()
            outcomes.append("connected")
        except DriverError as error:
            outcomes.append(type(error).__name__)
        finally:
            await cnc.close()
    assert "LinkError" in outcomes, outcomes


@pytest.mark.parametrize(
    "content",
    [
        b"\x80" + (2_000_000).to_bytes(4, "little"),
        b"\x8c" + (3).to_bytes(4, "little") + b"\xf0\xff\xff\xff",
        b"\x86" + (2_000_000_000).to_bytes(4, "little"),
    ],
    ids=["array of nothing", "text that goes back", "array that is not there"],
)
def test_decoding_ends_with_the_bytes(content: bytes) -> None:
    with pytest.raises(UaError):
        struct_from_binary(ua.DataValue, Received(b"\x01" + content))


@pytest.mark.parametrize("value", [0x80, 0xC0, 0xC6, 0xFF])
def test_any_byte_is_a_value_and_an_array_keeps_its_elements_without_its_shape(value: int) -> None:
    byte = variant_to_binary(ua.Variant(value, ua.VariantType.Byte))
    assert ua_binary.variant_from_binary(Received(byte)).Value == value
    matrix = ua.Variant([[1, 2], [3, value]], ua.VariantType.Int32)
    assert ua_binary.variant_from_binary(Received(variant_to_binary(matrix))).Value == [1, 2, 3, value]
    assert ua_binary.variant_from_binary(Buffer(variant_to_binary(matrix))).Value == [[1, 2], [3, value]]


def test_dimensions_are_not_multiplied() -> None:
    endless = b"\xc6" + bytes(4) + (2).to_bytes(4, "little") + b"\xff\xff\x00\x00" * 2
    assert ua_binary.variant_from_binary(Received(endless)).Value == []
