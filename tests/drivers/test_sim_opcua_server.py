"""The simulated CNC's OPC UA server, seen by a plain OPC UA client."""

import asyncio
import math
from collections.abc import AsyncIterator

import psutil
import pytest
import pytest_asyncio
from asyncua import Client, ua
from scripted_machine import NAMESPACE, ScriptedNc, cnc_config

from drivers.sim.wires.opcua_server import SimulatedCncServer

pytestmark = [pytest.mark.wires, pytest.mark.asyncio(loop_scope="module")]

NC = ScriptedNc()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server() -> AsyncIterator[SimulatedCncServer]:
    server = SimulatedCncServer(NC, cnc_config(), port=0)
    await server.start()
    yield server
    await server.stop()


@pytest_asyncio.fixture(loop_scope="module")
async def client(server: SimulatedCncServer) -> AsyncIterator[Client]:
    NC.reset()
    async with Client(server.endpoint, timeout=10) as client:
        yield client


async def variable(client: Client, text: str) -> ua.NodeId:
    return ua.NodeId.from_string(f"ns={await client.get_namespace_index(NAMESPACE)};{text}")


async def write(client: Client, text: str, value: ua.Variant) -> str:
    item = ua.WriteValue(
        NodeId=await variable(client, text), AttributeId=ua.AttributeIds.Value, Value=ua.DataValue(value)
    )
    [status] = await client.uaclient.write(ua.WriteParameters(NodesToWrite=[item]))
    return str(status.name)


async def test_listens_on_loopback_only(server: SimulatedCncServer) -> None:
    listening = [c.laddr.ip for c in psutil.Process().net_connections("tcp") if c.laddr.port == server.port]
    assert set(listening) == {"127.0.0.1"}


async def test_writes_reach_the_nc_at_once_and_in_order(client: Client) -> None:
    numbers = [505, 500, 100, 503, 501]
    items = [
        ua.WriteValue(
            NodeId=await variable(client, f"s=Macro.{number}"),
            AttributeId=ua.AttributeIds.Value,
            Value=ua.DataValue(ua.Variant(float(number), ua.VariantType.Double)),
        )
        for number in numbers
    ]
    statuses = await client.uaclient.write(ua.WriteParameters(NodesToWrite=items))
    assert all(status.is_good() for status in statuses)
    assert NC.macros.written == [(number, float(number)) for number in numbers]


@pytest.mark.parametrize("text", ["s=Mode", "s=Clock", "s=Macro.510", "s=Macro.515"])
async def test_state_and_echo_are_not_writable(client: Client, text: str) -> None:
    kind = ua.VariantType.Int32 if text == "s=Mode" else ua.VariantType.Double
    assert await write(client, text, ua.Variant(1 if text == "s=Mode" else 1.0, kind)) == "BadUserAccessDenied"
    assert NC.macros.written == []


@pytest.mark.parametrize(
    ("value", "status"),
    [
        (ua.Variant("1.0", ua.VariantType.String), "BadTypeMismatch"),
        (ua.Variant(1, ua.VariantType.Int32), "BadTypeMismatch"),
        (ua.Variant([1.0, 2.0], ua.VariantType.Double), "BadTypeMismatch"),
        (ua.Variant(math.nan, ua.VariantType.Double), "BadOutOfRange"),
        (ua.Variant(math.inf, ua.VariantType.Double), "BadOutOfRange"),
    ],
)
async def test_values_that_are_no_numbers_are_refused(client: Client, value: ua.Variant, status: str) -> None:
    assert await write(client, "s=Macro.501", value) == status
    assert NC.macros.written == []


async def test_stop_ends_connections_and_leaves_no_task_and_can_be_repeated() -> None:
    before = asyncio.all_tasks()
    server = SimulatedCncServer(ScriptedNc(), cnc_config(), port=0)
    await server.start()
    client = Client(server.endpoint, timeout=10)
    await client.connect()
    await server.stop()
    await server.stop()
    async with asyncio.timeout(10):
        while client.state.value == "connected":
            await asyncio.sleep(0.01)
    await client.disconnect()
    assert asyncio.all_tasks() <= before
