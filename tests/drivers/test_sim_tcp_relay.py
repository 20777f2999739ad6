"""The relay before the simulated CNC: forwards, freezes, dies and comes back."""

import asyncio
from collections.abc import AsyncIterator

import pytest

from drivers.sim.wires.tcp_relay import TcpRelay

pytestmark = pytest.mark.wires


@pytest.fixture
async def relay() -> AsyncIterator[TcpRelay]:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            writer.write(data)
        writer.close()

    server = await asyncio.start_server(echo, "127.0.0.1", 0)
    relay = TcpRelay(port=0, target_port=server.sockets[0].getsockname()[1])
    await relay.start()
    yield relay
    await relay.stop()
    server.close()
    await server.wait_closed()


async def connect(relay: TcpRelay) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection("127.0.0.1", relay.port)


async def test_frozen_relay_keeps_connections_open_and_silent_until_it_thaws(relay: TcpRelay) -> None:
    old = await connect(relay)
    old[1].write(b"before")
    assert await old[0].readexactly(6) == b"before"
    relay.freeze()
    new = await connect(relay)
    for _, writer in (old, new):
        writer.write(b"during")
    for reader, _ in (old, new):
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(reader.read(1), 0.1)
    relay.thaw()
    for reader, writer in (old, new):
        assert await asyncio.wait_for(reader.readexactly(6), 10) == b"during"
        writer.close()
