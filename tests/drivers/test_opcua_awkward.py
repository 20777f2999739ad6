"""OPC UA servers that are right and unlike others: small limits, slow answers, folders that are not for everybody."""

import asyncio
import copy
import gc
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import pytest_asyncio
from asyncua import ua
from asyncua.common.connection import SecureConnection
from asyncua.common.utils import ServiceError
from asyncua.server.internal_session import InternalSession
from scripted_machine import NAMESPACE, ScriptedNc, cnc_config

from config.schema.source_sections import OpcUaServer
from daemon.checkup.node_map import look
from drivers.clock import SystemClock
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError
from drivers.opcua import browsing
from drivers.opcua.browsing import browse
from drivers.opcua.cnc import OpcUaCnc
from drivers.opcua.scan import analog_variables
from drivers.opcua.services import READ_RESPONSE, RESPONSE_HEADER, WRITE_RESPONSE, decode_read, decode_write
from drivers.opcua.tags import TagSession
from drivers.opcua.variables import LIMITS
from drivers.sim.wires.opcua_server import SimulatedCncServer
from drivers.sim.wires.tcp_relay import TcpRelay

Answered = Callable[[Any, Any], Any]
NAMESPACES = ua.NodeId(ua.Int32(ua.ObjectIds.Server_NamespaceArray))


def on_wires(test: Any) -> Any:
    return pytest.mark.wires(pytest.mark.asyncio(loop_scope="module")(test))


@dataclass
class Habits:
    """What this server does otherwise than the library's."""

    takes: int = 10_000
    """Nodes in one read or write."""
    tells: bool = False
    """It says so in its variables."""
    changed: Answered | None = None
    """Results of a read -> what it answers instead."""
    delay_s: float = 0.0
    refuses: str = ""
    """Children of a node of this identifier are not shown."""
    browsed: int = 0
    kept_ms: float = 0.0
    """How long the latest client wants its session kept once it is gone."""
    endpoints: Callable[[Any], Any] | None = None
    """Endpoints that it tells of -> those in its answer to a new session."""
    written: int | None = None
    """Status of every written value, of which none arrives."""


HABITS = Habits()
HELD: dict[str, Any] = {name: getattr(InternalSession, name) for name in ("read", "write", "browse", "create_session")}


async def read(session: Any, wanted: Any) -> Any:
    if not session.external:
        return await HELD["read"](session, wanted)
    await asyncio.sleep(HABITS.delay_s)
    too_many(wanted.NodesToRead)
    found = await HELD["read"](session, wanted)
    for place, each in enumerate(wanted.NodesToRead):
        if HABITS.tells and each.NodeId in LIMITS:
            found[place] = ua.DataValue(ua.Variant(HABITS.takes, ua.VariantType.UInt32))
    return found if HABITS.changed is None else HABITS.changed(wanted, found)


async def write(session: Any, wanted: Any) -> Any:
    if session.external:
        too_many(wanted.NodesToWrite)
        if HABITS.written is not None:
            return [ua.StatusCode(ua.UInt32(HABITS.written)) for _ in wanted.NodesToWrite]
    return await HELD["write"](session, wanted)


async def browse_(session: Any, wanted: Any) -> Any:
    HABITS.browsed += session.external
    if session.external and HABITS.refuses in [str(each.NodeId.Identifier) for each in wanted.NodesToBrowse]:
        raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
    return await HELD["browse"](session, wanted)


async def create(session: Any, *asked: Any, **more: Any) -> Any:
    made = await HELD["create_session"](session, *asked, **more)
    HABITS.kept_ms = asked[0].RequestedSessionTimeout
    if HABITS.endpoints is not None:
        made.ServerEndpoints = HABITS.endpoints(copy.deepcopy(made.ServerEndpoints))
    return made


def nameless(endpoints: Any) -> Any:
    for each in endpoints:
        each.Server = ua.ApplicationDescription()
    return endpoints


def too_many(nodes: list[Any]) -> None:
    if len(nodes) > HABITS.takes:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)


@pytest.fixture(autouse=True)
def habits(monkeypatch: pytest.MonkeyPatch) -> Iterator[Habits]:
    HABITS.__init__()  # type: ignore[misc]
    for name, function in (("read", read), ("write", write), ("browse", browse_), ("create_session", create)):
        monkeypatch.setattr(InternalSession, name, function)
    yield HABITS


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server() -> AsyncIterator[SimulatedCncServer]:
    server = SimulatedCncServer(ScriptedNc(), cnc_config(), port=0)
    await server.start()
    yield server
    await server.stop()


def session_at(server: SimulatedCncServer, timeout_s: float = 10.0) -> TagSession:
    place = OpcUaServer(endpoint=server.endpoint, namespace_uri="-", security=None, timeout_s=timeout_s)
    return TagSession(place, "source Gateway: server x")


@on_wires
@pytest.mark.parametrize("told", [nameless, lambda _: [], lambda _: None], ids=["nameless", "none", "null"])
async def test_a_server_that_does_not_say_at_a_session_what_it_is_is_asked(
    server: SimulatedCncServer, habits: Habits, told: Callable[[Any], Any]
) -> None:
    """As OPC UA 1.02 recommends, and as some do that are reached under another name than their own."""
    habits.endpoints = told
    cnc, session = OpcUaCnc(cnc_config(server.endpoint), SystemClock()), session_at(server)
    await cnc.connect()
    await session.connect()
    assert cnc.identity == SIMULATED_CNC_IDENTITY and NAMESPACE in session.namespaces
    await cnc.close()
    await session.close()


@on_wires
async def test_a_session_that_is_cut_off_takes_the_server_s_place_for_a_minute_only(
    server: SimulatedCncServer, habits: Habits
) -> None:
    """A server has few of them: after some interruptions nobody would get in any more."""
    for link in (OpcUaCnc(cnc_config(server.endpoint), SystemClock()), session_at(server)):
        await link.connect()
        await link.close()
        assert habits.kept_ms == 60_000


@on_wires
@pytest.mark.parametrize("takes", [1, 4])
@pytest.mark.parametrize("tells", [True, False])
async def test_a_control_that_takes_few_nodes_at_once_is_read_and_written_in_parts(
    server: SimulatedCncServer, habits: Habits, takes: int, tells: bool
) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint), SystemClock())
    habits.takes, habits.tells = takes, tells
    await cnc.connect()
    values = {number: number / 1000.0 for number in range(501, 506)}
    await cnc.write_macros([[(500, 1.0)], list(values.items())])
    sample = await cnc.read([500, *values])
    assert sample.macros == {500: 1.0} | values
    assert (sample.program, sample.tool_number, await cnc.read_macros(list(values))) == (1000, 3, values)
    habits.takes = 1
    await cnc.write_macros([list(values.items())])
    assert await cnc.read_macros(list(values)) == values, "less than before"
    await cnc.close()


@on_wires
@pytest.mark.parametrize(
    ("status", "error"),
    [("BadNotConnected", LinkError), ("BadDeviceFailure", LinkError), ("BadTypeMismatch", FatalDriverError)],
)
async def test_a_gateway_that_does_not_reach_the_control_has_refused_nothing(
    server: SimulatedCncServer, habits: Habits, status: str, error: type[Exception]
) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint), SystemClock())
    await cnc.connect()
    habits.written = getattr(ua.StatusCodes, status)
    with pytest.raises(error, match=rf"refused macro variable #500 = 1\.0: {status}"):
        await cnc.write_macros([[(500, 1.0)]])
    await cnc.close()


@on_wires
@pytest.mark.parametrize("takes", [1, 4, 30])
async def test_a_server_that_takes_few_nodes_at_once_is_looked_through_all_the_same(
    server: SimulatedCncServer, habits: Habits, takes: int
) -> None:
    whole, _ = await look(server.endpoint, None, 10.0)
    habits.takes = takes
    browsed, proposal = await look(server.endpoint, None, 10.0)
    assert {each.node for each in browsed.variables} == {each.node for each in whole.variables}
    assert proposal is not None and proposal.missing == () and proposal.values["tool_number"] == 3
    session = session_at(server)
    tags, more = await analog_variables(session)
    await session.close()
    assert {"tool_number", "program", "clock"} <= {tag.name for tag in tags} and not more


@on_wires
@pytest.mark.parametrize("told", [None, "text", 7])
async def test_a_server_without_a_list_of_namespaces_is_named(
    server: SimulatedCncServer, habits: Habits, told: Any
) -> None:
    habits.changed = lambda wanted, found: (
        [ua.DataValue(ua.Variant(told))] if wanted.NodesToRead[0].NodeId == NAMESPACES else found
    )
    session = session_at(server)
    with pytest.raises(LinkError, match="source Gateway: server x answers what cannot be read while reading"):
        await session.connect()
    await session.close()
    with pytest.raises(LinkError, match="answers what cannot be read while reading its namespaces"):
        await look(server.endpoint, None, 10.0)


@on_wires
async def test_an_answer_without_results_is_a_lost_link(server: SimulatedCncServer, habits: Habits) -> None:
    cnc, session = OpcUaCnc(cnc_config(server.endpoint), SystemClock()), session_at(server)
    await cnc.connect()
    await session.connect()
    habits.changed = lambda wanted, found: None
    with pytest.raises(LinkError, match="answered 0 values to a request for 1 macro"):
        await cnc.read_macros([500])
    with pytest.raises(LinkError, match="server x answered 0 values to a request for 1"):
        await session.values([session.client.nodes.server_state])
    habits.changed = None
    await cnc.close()
    await session.close()


def test_a_list_that_is_null_holds_nothing() -> None:
    bodies = [RESPONSE_HEADER.pack(kind, 0, 1, 0, 0, 0, bytes(3), -1) for kind in (READ_RESPONSE, WRITE_RESPONSE)]
    read, written = (body + struct.pack("<i", -1) for body in bodies)
    assert decode_read(read) == [] and decode_write(written) == []


@on_wires
async def test_a_folder_that_is_not_for_everybody_is_left_out_and_told(
    server: SimulatedCncServer, habits: Habits
) -> None:
    habits.refuses = "Mode"
    session = session_at(server)
    await session.connect()
    browsed = await browse(session)
    await session.close()
    assert {"s=Mode", "s=Program", "s=Macro.500"} <= {each.node for each in browsed.variables}
    assert not browsed.complete


@on_wires
async def test_no_more_is_asked_than_is_looked_at(
    server: SimulatedCncServer, habits: Habits, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(browsing, "MOST_NODES", 12)
    session = session_at(server)
    await session.connect()
    browsed = await browse(session)
    await session.close()
    assert 5 <= len(browsed.variables) <= 12 and not browsed.complete
    assert habits.browsed <= 12, "a control may have hundreds of thousands of nodes"


@on_wires
async def test_a_server_that_answers_within_the_time_out_is_not_given_up(
    server: SimulatedCncServer, habits: Habits
) -> None:
    session = session_at(server)
    await session.connect()
    habits.delay_s = 2.2
    index = session.namespaces.index(NAMESPACE)
    node = session.client.get_node(ua.NodeId("ToolNumber", index))
    for _ in range(2):
        (answer,) = await session.values([node])
        assert answer.Value.Value == 3
    habits.delay_s = 0.0
    await session.close()


@on_wires
async def test_a_server_that_is_gone_when_the_channel_is_to_be_renewed_leaves_nothing_in_the_log(
    server: SimulatedCncServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    opened = SecureConnection.open

    def short(connection: Any, *asked: Any) -> Any:
        result = opened(connection, *asked)
        result.SecurityToken.RevisedLifetime = 1000
        return result

    monkeypatch.setattr(SecureConnection, "open", short)
    relay = TcpRelay(port=0, target_port=int(server.endpoint.rpartition(":")[2].partition("/")[0]))
    await relay.start()
    endpoint = f"opc.tcp://127.0.0.1:{relay.port}/cnc"
    place = OpcUaServer(endpoint=endpoint, namespace_uri="-", security=None, timeout_s=10.0)
    session = TagSession(place, "server x")
    await session.connect()
    await relay.stop()
    await asyncio.sleep(1.2)
    await session.close()
    del session
    gc.collect()
    await asyncio.sleep(0)
    assert not [record for record in caplog.records if record.name == "asyncio"]
