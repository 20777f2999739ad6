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
from scripted_machine import GROUPS, NAMESPACE, ScriptedNc, ScriptedSinumerik, cnc_config

from config.schema.cnc_drivers import OpcUaConfig, OpcUaNodesConfig
from config.schema.guard import VACANT_R
from drivers.clock import SystemClock
from drivers.contract import Capability, LinkError
from drivers.opcua.cnc import OpcUaCnc, node_map
from drivers.opcua.services import Answer
from drivers.opcua.sinumerik import FIRST_NAMED, block_number, offset_number, program_number
from drivers.opcua.variables import FANUC_NODES, NodeMap, Variables
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.records import CncMode, CncRun, CncSample

SINUMERIK: dict[str, Any] = {"preset": "sinumerik", "namespace_uri": None}
ENDPOINT = "opc.tcp://192.168.10.20:4840"


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


def test_an_identifier_of_the_configuration_comes_before_that_of_the_preset() -> None:
    nodes = OpcUaNodesConfig(tool_number="i=7", motor_temperature="none")
    found = node_map(cnc_config(nodes=nodes)).nodes
    assert found["tool_number"] == "i=7" and "motor_temperature" not in found
    assert {key: found[key] for key in found if key != "tool_number"} == {
        key: FANUC_NODES[key] for key in FANUC_NODES if key not in ("tool_number", "motor_temperature")
    }
    siemens = node_map(cnc_config(nodes=OpcUaNodesConfig(macro="s=/Channel/Parameter/R[u2,{number}]"), **SINUMERIK))
    assert siemens.nodes["macro"].format(number=5) == "s=/Channel/Parameter/R[u2,5]"
    assert siemens.nodes["clock"] == "s=/Channel/Parameter/R[u1,580]"


def test_generic_takes_nothing_for_granted() -> None:
    with pytest.raises(ValidationError) as refused:
        OpcUaConfig(endpoint=ENDPOINT, namespace_uri=NAMESPACE, preset="generic")
    assert all(key in str(refused.value.errors()[0]["ctx"]["error"].problems) for key in ("mode", "run", "alarm"))
    nodes = OpcUaNodesConfig(mode="i=1", run="i=2", alarm="i=3", macro="i={number}")
    assert node_map(cnc_config(nodes=nodes, preset="generic")).nodes == nodes.model_dump(exclude_none=True)


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


def test_a_name_with_other_braces_is_a_name() -> None:
    variables = Variables(NodeMap(nodes={"macro": "s=/{unit}/R[{number}]"}), 2)
    assert variables._macro_node_id(500).Identifier == "/{unit}/R[500]"


def test_only_a_sinumerik_has_a_namespace_of_its_own() -> None:
    assert OpcUaConfig(endpoint=ENDPOINT, preset="sinumerik").namespace == "SinumerikVarProvider"
    with pytest.raises(ValidationError, match="this key is required and missing: namespace"):
        OpcUaConfig(endpoint=ENDPOINT)


@pytest.mark.parametrize("key", ["mode", "run", "alarm", "macro"])
def test_what_no_control_can_be_without_cannot_be_left_out(key: str) -> None:
    with pytest.raises(ValidationError, match="no control can be compensated without it"):
        OpcUaNodesConfig(**{key: "none"})


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


def test_other_programs_are_told_apart_by_their_whole_path() -> None:
    names = [
        *("/_N_MPF_DIR/_N_HOUSING_MPF", "/_N_MPF_DIR/_N_HOUSING2_MPF", "/_N_WKS_DIR/_N_A_WPD/_N_O1000_MPF"),
        *("/_N_WKS_DIR/_N_B_WPD/_N_O1000_MPF", "/_N_MPF_DIR/_N_MPF1000_MPF", "/_N_MPF_DIR/_N_O01000_MPF", "O0.MPF"),
    ]
    numbers = [program_number(name) for name in names]
    assert len(set(numbers)) == len(names) and min(numbers) >= FIRST_NAMED
    assert numbers == [program_number(name.lower()) for name in names]


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


def test_an_offset_is_what_the_g_code_says() -> None:
    assert [offset_number(text) for text in ("G54", "G500", "g505")] == [54, 500, 505]
    for text in ("", "54", "G", "G54X"):
        with pytest.raises(ValueError, match="work offset"):
            offset_number(text)


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
async def test_a_text_that_means_nothing_is_a_lost_link_that_names_it(
    sinumerik: tuple[ScriptedSinumerik, SimulatedCncServer],
) -> None:
    nc, server = sinumerik
    cnc = await connected(server, **SINUMERIK)
    nc.work_offset = "54X"  # type: ignore[assignment]
    with pytest.raises(
        LinkError, match=r"variable work_offset \(s=/Channel/SelectedFunctions/ncFkt\[u1,8\]\) is 'G54X'"
    ):
        await cnc.read([])
    await cnc.close()


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
