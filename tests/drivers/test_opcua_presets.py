"""Where kinds of controls keep their variables, what those mean, and what is said of what a control does not have."""

import math
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio
from asyncua import Client, ua
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scripted_machine import GROUPS, ScriptedNc, ScriptedSinumerik, cnc_config

from config.schema.cnc_drivers import OpcUaNodesConfig
from config.schema.guard import VACANT_R
from drivers.clock import SystemClock
from drivers.contract import Capability, LinkError
from drivers.opcua.cnc import OpcUaCnc
from drivers.opcua.services import Answer
from drivers.opcua.sinumerik import block_number, program_number
from drivers.opcua.variables import FANUC_NODES, NodeMap, Variables
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.records import CncMode, CncRun, CncSample

SINUMERIK: dict[str, Any] = {"preset": "sinumerik", "namespace_uri": None}


@pytest_asyncio.fixture
async def sinumerik() -> AsyncIterator[tuple[ScriptedSinumerik, SimulatedCncServer]]:
    nc = ScriptedSinumerik()
    server = SimulatedCncServer(nc, cnc_config(**SINUMERIK), port=0)
    await server.start()
    yield nc, server
    await server.stop()


async def connected(server: SimulatedCncServer, **changes: Any) -> OpcUaCnc:
    cnc = OpcUaCnc(cnc_config(server.endpoint, **changes), SystemClock())
    await cnc.connect()
    return cnc


# --- maps --------------------------------------------------------------------------------


def test_a_fraction_in_the_state_is_not_rounded_to_another_offset_or_block() -> None:
    variables, now = Variables(NodeMap(nodes=FANUC_NODES), 2), SystemClock().now()
    held = dict.fromkeys(variables._keys, 1.0)

    def sample(**changes: float) -> CncSample:
        return variables.sample(now, [], [Answer(0, value) for value in (held | changes).values()])

    assert sample(work_offset=54.0).work_offset == 54
    assert sample(work_offset=54.1).work_offset == 54_100, "an additional offset is another one than G54"
    for key in ("sequence_number", "program", "tool_number", "run", "mode", "power_on_count"):
        with pytest.raises(LinkError, match=rf"variable {key} holds 100\.7, which is no whole number"):
            sample(**{key: 100.7})


def test_what_the_guard_shows_lies_in_no_other_parameter() -> None:
    with pytest.raises(ValidationError, match=r"R505 is in the guard's memory, in the macro map"):
        cnc_config(**SINUMERIK, guard={"shown": 505})
    with pytest.raises(ValidationError, match="R590 is in the guard's memory"):
        cnc_config(**SINUMERIK, guard={"shown": 589})
    assert cnc_config(guard={"shown": 505}), "a FANUC has no such parameters"


# --- texts of a SINUMERIK ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("/_N_MPF_DIR/_N_O1000_MPF", 1000),
        ("/_N_CUS_DIR/_N_TP9010_SPF", 9010),
        ("O1000.MPF", 1000),
        ("1234", 1234),
        ("", 0),
        ("  ", 0),
    ],
)
def test_a_program_with_a_number_has_that_number(text: str, number: int) -> None:
    assert program_number(text) == number


@given(st.text(max_size=80))
def test_any_name_has_a_number_that_a_store_can_keep(text: str) -> None:
    assert 0 <= program_number(text) < 2**31 and program_number(text).is_integer()
    assert 0 <= block_number(text) < 1e9


def test_a_block_without_a_number_is_none_that_was_passed_before() -> None:
    assert [block_number(text) for text in ("N900", ":10", " n20 ", "", "G0 X1", "N", "900")] == [
        900,
        10,
        20,
        0,
        0,
        0,
        0,
    ]


# --- over the wire -----------------------------------------------------------------------


@pytest.mark.wires
async def test_a_sinumerik_is_read_as_it_is(sinumerik: tuple[ScriptedSinumerik, SimulatedCncServer]) -> None:
    nc, server = sinumerik
    cnc = await connected(server, **SINUMERIK)
    sample = await cnc.read([])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, False)
    assert (sample.program, sample.sequence_number, sample.work_offset) == (1000, 20, 54)
    assert (sample.spindle_speed_rpm, sample.power_on_count, sample.tool_number) == (5000.0, 7, 3)
    assert math.isnan(sample.motor_temperature_degc) and set(cnc.cannot) == {Capability.MOTOR_TEMPERATURE}
    assert sample.clock_s > 100.0
    for mode, run, expected in ((5, 2, (CncMode.JOG, CncRun.HOLD)), (0, 1, (CncMode.MDI, CncRun.STOP))):
        nc.mode, nc.run, nc.alarm = mode, run, 1
        sample = await cnc.read([])
        assert (sample.mode, sample.run, sample.alarm) == (*expected, True)
    nc.run = 9
    assert (await cnc.read([])).run is CncRun.UNKNOWN
    await cnc.close()


@pytest.mark.wires
async def test_r_parameters_are_read_and_written_though_nobody_can_browse_them(
    sinumerik: tuple[ScriptedSinumerik, SimulatedCncServer],
) -> None:
    nc, server = sinumerik
    cnc = await connected(server, **SINUMERIK)
    await cnc.write_macros(GROUPS)
    assert nc.macros.written == [pair for group in GROUPS for pair in group]
    nc.macros.values[501] = None
    assert await cnc.read_macros([501, 503]) == {501: None, 503: 0.0105}, "vacant is not zero"
    await cnc.close()
    async with Client(server.endpoint) as client:
        index = await client.get_namespace_index("SinumerikVarProvider")
        folder = client.get_node(ua.NodeId("CNC", index))
        seen = {str(child.nodeid.Identifier) for child in await folder.get_children()}
        assert "/Channel/State/progStatus[u1]" in seen and not any("/R[" in name for name in seen)
        vacant = await client.get_node(ua.NodeId("/Channel/Parameter/R[u1,501]", index)).read_value()
        assert vacant == VACANT_R


@pytest.mark.wires
async def test_what_a_generic_server_does_not_have_is_said_and_has_no_value() -> None:
    needed = {key: FANUC_NODES[key] for key in ("mode", "run", "alarm", "macro")}
    generic = {"preset": "generic", "nodes": OpcUaNodesConfig(**needed)}
    server = SimulatedCncServer(ScriptedNc(), cnc_config(**generic), port=0)
    await server.start()
    cnc = await connected(server, **generic)
    expected = set(Capability) - {Capability.READ_MACROS, Capability.WRITE_MACROS, Capability.AXIS_POSITION}
    assert set(cnc.cannot) == expected
    assert cnc.cannot["clock"] == "cnc.opcua.nodes.clock names no variable of the server"
    sample = await cnc.read([500])
    assert all(math.isnan(value) for value in (sample.clock_s, sample.spindle_speed_rpm, sample.motor_temperature_degc))
    assert (sample.run, sample.program, sample.power_on_count) == (CncRun.START, 0, 0)
    await cnc.close()
    await server.stop()
