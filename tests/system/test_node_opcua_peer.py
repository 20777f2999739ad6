"""OPC UA against a stack that shares no line with ours: node-opcua as client and as server.

Both ways with Basic256Sha256, sign and encrypt, and a user name. The package is installed once into
a cache (environment variable TOOLPOINT_NODE_CACHE, default ~/.cache/toolpoint-tests).
"""

import asyncio
import json
import re
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from control_rig import SENSOR_IDS
from monitor_bench import PASSWORD as ACCOUNT_PASSWORD
from node_packages import NEEDS_NODE, installed
from opcua_bench import NOW, TAGS, tag_server, tell
from scripted_machine import (
    CLIENT_URI,
    GROUPS,
    NAMESPACE,
    PASSWORD,
    SERVER_URI,
    USER,
    Keys,
    ScriptedNc,
    cnc_config,
)

from config.schema.source_drivers import SourceConfig
from drivers.clock import SystemClock
from drivers.contract import DriverError, FatalDriverError, LinkError, NotSentError
from drivers.opcua.cnc import OpcUaCnc
from drivers.opcua.tags import OpcUaTagSource
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.quality import Reason
from models.records import CncMode, CncRun

PEER = Path(__file__).resolve().parent / "node_peer"
START_TIMEOUT_S = 120.0

pytestmark = [pytest.mark.wires, NEEDS_NODE]


@pytest.fixture(scope="module")
def node_environment() -> dict[str, str]:
    """Install the peer once, and return the environment in which node finds it."""
    return installed(PEER)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return Keys(tmp_path_factory.mktemp("keys"))


async def start(script: str, options: dict[str, Any], environment: dict[str, str]) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        "node",
        str(PEER / script),
        json.dumps(options),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=None,
        env=environment,
    )


async def test_node_opcua_as_client_of_the_simulated_cnc(
    node_environment: dict[str, str], keys: Keys, tmp_path: Path
) -> None:
    nc = ScriptedNc()
    server = SimulatedCncServer(nc, cnc_config(), port=0, security=keys.server_security())
    await server.start()
    options = {
        "endpoint": server.endpoint,
        "certificate": str(keys.client),
        "privateKey": str(keys.client_key),
        "applicationUri": CLIENT_URI,
        "pki": str(tmp_path / "pki"),
        "user": USER,
        "password": PASSWORD,
        "namespace": NAMESPACE,
    }
    client = await start("client.js", options, node_environment)
    output, _ = await asyncio.wait_for(client.communicate(), START_TIMEOUT_S)
    await server.stop()
    assert client.returncode == 0
    (printed,) = [line for line in output.decode().splitlines() if line.startswith("result ")]
    result = json.loads(printed.removeprefix("result "))
    assert "BadUserAccessDenied" in result.pop("wrong_password")
    assert result == {
        "application_uri": SERVER_URI,
        "program": 1000,
        "speed": 5000.0,
        "vacant": ["BadNoData", None],
        "write": "Good",
        "read_back": 0.0125,
        "write_echo": "BadUserAccessDenied",
        "write_state": "BadUserAccessDenied",
        "write_nan": "BadOutOfRange",
    }
    assert nc.macros.written == [(501, 0.0125)]


class NodeServer:
    """node-opcua serving a CNC."""

    def __init__(self, process: asyncio.subprocess.Process, endpoint: str) -> None:
        self.process = process
        self.endpoint = endpoint

    async def line(self, beginning: str) -> str:
        """The next line that begins so; node-opcua prints warnings between them, above all on a slow computer."""
        assert self.process.stdout is not None
        while raw := await asyncio.wait_for(self.process.stdout.readline(), START_TIMEOUT_S):
            if (line := raw.decode().strip()).startswith(beginning):
                return line
        raise AssertionError(f"the server ended before it printed a line that begins with {beginning!r}")

    async def written(self) -> list[float]:
        number, value = json.loads((await self.line("written ")).removeprefix("written "))
        return [number, value]


@pytest.fixture
async def node_server(
    request: pytest.FixtureRequest, node_environment: dict[str, str], keys: Keys, tmp_path: Path
) -> AsyncIterator[NodeServer]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    macros = cnc_config().macros
    echo = sorted(set(macros.block) - {number for group in GROUPS for number, _ in group})
    options = {
        "port": port,
        "certificate": str(keys.server),
        "privateKey": str(keys.server_key),
        "applicationUri": SERVER_URI,
        "pki": str(tmp_path / "pki"),
        "trusted": str(keys.client),
        "user": USER,
        "password": PASSWORD,
        "namespace": NAMESPACE,
        "macros": [number for group in GROUPS for number, _ in group],
        "echo": echo,
        "macroTypes": {},
        "state": {},
        "takes": 0,
    } | getattr(request, "param", {})
    server = NodeServer(await start("server.js", options, node_environment), "")
    server.endpoint = await server.line("opc.tcp://")
    yield server
    if server.process.returncode is None:
        server.process.kill()
    await server.process.communicate()


async def test_driver_against_node_opcua_as_server(node_server: NodeServer, keys: Keys, tmp_path: Path) -> None:
    cnc = OpcUaCnc(cnc_config(node_server.endpoint, security=keys.client_config()), SystemClock())
    await cnc.connect()
    assert cnc.identity == SERVER_URI
    sample = await cnc.read([500, 510])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, False)
    assert (sample.program, sample.spindle_speed_rpm, sample.motor_temperature_degc) == (1000, 5000.0, 31.5)
    assert sample.macros == {500: None, 510: None}
    await cnc.write_macros(GROUPS)
    assert await cnc.read_macros([500, 503, 505]) == {500: 1.0, 503: 0.0105, 505: 1.0}
    written = [await node_server.written() for group in GROUPS for _ in group]
    assert written == [[number, value] for group in GROUPS for number, value in group]
    with pytest.raises(FatalDriverError, match=r"refused macro variable #510 = 1\.0: Bad"):
        await cnc.write_macros([[(510, 1.0)]])
    await asyncio.sleep(0.01)
    assert (await cnc.read([])).clock_s > sample.clock_s
    await cnc.close()

    wrong = tmp_path / "wrong"
    wrong.write_text("wrong")
    wrong.chmod(0o600)
    security = keys.client_config(password_file=wrong)
    with pytest.raises(FatalDriverError, match="refuses the user name or password"):
        await OpcUaCnc(cnc_config(node_server.endpoint, security=security), SystemClock()).connect()

    strangers = Keys(tmp_path / "strangers")
    security = keys.client_config(certificate=strangers.client, private_key=strangers.client_key)
    with pytest.raises((FatalDriverError, LinkError), match="trust"):
        await OpcUaCnc(cnc_config(node_server.endpoint, security=security, timeout_s=5.0), SystemClock()).connect()

    with pytest.raises(FatalDriverError, match=r"offers .*Basic256Sha256 SignAndEncrypt|accepts no anonymous sessions"):
        await OpcUaCnc(cnc_config(node_server.endpoint), SystemClock()).connect()

    lost = OpcUaCnc(cnc_config(node_server.endpoint, security=keys.client_config()), SystemClock())
    await lost.connect()
    node_server.process.kill()
    await node_server.process.wait()
    with pytest.raises(LinkError):
        await lost.read([])
    await lost.close()


OTHER_TYPES: dict[str, Any] = {
    "macroTypes": {"500": "UInt16", "501": "Float", "502": "Float", "504": "Int32", "505": "Boolean", "506": "Int64"},
    "state": {
        "Mode": ["Byte", 1],
        "Alarm": ["Boolean", True],
        "Program": ["String", "O1000"],
        "SequenceNumber": ["String", "N20"],
        "WorkOffset": ["String", "G54.1 P3"],
        "ToolNumber": ["String", "T3"],
        "PowerOnCount": ["UInt64", [0, 7]],
    },
}


@pytest.mark.parametrize("node_server", [OTHER_TYPES, OTHER_TYPES | {"takes": 3}], indirect=True, ids=["all", "three"])
async def test_variables_of_other_types_are_read_and_written_in_their_own(node_server: NodeServer, keys: Keys) -> None:
    """As gateways have them, who refuse a Double for a Float with BadTypeMismatch."""
    cnc = OpcUaCnc(cnc_config(node_server.endpoint, security=keys.client_config()), SystemClock())
    await cnc.connect()
    sample = await cnc.read([])
    assert (sample.mode, sample.alarm, sample.program, sample.sequence_number) == (CncMode.MEMORY, True, 1000, 20)
    assert (sample.work_offset, sample.tool_number, sample.power_on_count) == (541_003, 3, 7)
    await cnc.write_macros(GROUPS)
    found = await cnc.read_macros([number for group in GROUPS for number, _ in group])
    assert found == pytest.approx({number: value for group in GROUPS for number, value in group}, abs=1e-9)
    for number, value, kind in ((504, 0.5, "Int32"), (501, 16_777_217.0, "Float"), (500, -1.0, "UInt16")):
        with pytest.raises(NotSentError, match=rf"#{number} cannot hold {value!r}: in the server it is of type {kind}"):
            await cnc.write_macros([[(503, 0.5)], [(number, value)]])
    assert await cnc.read_macros([503]) == {503: 0.0105}, "nothing was sent"
    await cnc.close()


def tags_of(endpoint: str, security: Any, *tags: dict[str, Any]) -> OpcUaTagSource:
    asked = tags or ({"node": "s=SpindleMotorTemperature"},)
    sensors = [{"id": number, "component": "Motor", **tag} for number, tag in enumerate(asked, start=1)]
    section = {"endpoint": endpoint, "namespace_uri": NAMESPACE, "security": security, "timeout_s": 20.0}
    content = {"name": "s", "driver": "opcua", "cycle_period_s": 0.1, "opcua": section | {"sensors": sensors}}
    return OpcUaTagSource(SourceConfig.model_validate(content), SystemClock())


@pytest.mark.parametrize("node_server", [{"sessions": 1}], indirect=True)
async def test_a_source_is_told_why_it_gets_no_session(node_server: NodeServer, keys: Keys, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong"
    wrong.write_text("wrong")
    wrong.chmod(0o600)
    strangers = Keys(tmp_path / "strangers")
    known = "the server may not trust|it must be trusted there"
    refused = [
        (None, "offers Basic256Sha256 SignAndEncrypt, not None None_; configure opcua.security"),
        (keys.client_config(password_file=wrong), "refuses the user name or password"),
        (keys.client_config(certificate=strangers.client, private_key=strangers.client_key), known),
        (keys.client_config(server_certificate=strangers.server), r"another certificate .*\(opcua\.security\.server_"),
    ]
    for security, words in refused:
        with pytest.raises(DriverError, match=rf"source s: opc\.tcp://\S+ .*({words})"):
            await anext(tags_of(node_server.endpoint, security).cycles())
    first = tags_of(node_server.endpoint, keys.client_config())
    cycles = first.cycles()
    assert (await anext(cycles)).degc.tolist() == [31.5]
    with pytest.raises(LinkError, match="BadTooManySessions"):
        await anext(tags_of(node_server.endpoint, keys.client_config()).cycles())
    await cycles.aclose()
    second = tags_of(node_server.endpoint, keys.client_config()).cycles()
    assert (await anext(second)).degc.tolist() == [31.5]
    await second.aclose()


async def test_the_numbers_of_an_array_are_read_by_their_places(node_server: NodeServer, keys: Keys) -> None:
    """As controls hold the temperatures of several inputs in one variable."""
    array = {"node": "s=Temperatures"}
    asked = [array | {"element": 1}, array | {"element": 0}, array | {"element": 2}, array]
    one = {"node": "s=SpindleMotorTemperature", "element": 0}
    cycles = tags_of(node_server.endpoint, keys.client_config(), *asked, one).cycles()
    cycle = await anext(cycles)
    assert cycle.degc[:2].tolist() == [22.5, 21.5] and list(cycle.reason[2:]) == [Reason.UNREADABLE] * 3
    assert cycle.faults == (
        "source s: sensor 3 (Motor): holds no number but '2 elements': correct `element`",
        "source s: sensor 4 (Motor): holds no number but '[21.5, 22.5]': correct `element`",
        "source s: sensor 5 (Motor): holds no array but '31.5': correct `element`",
    )
    await cycles.aclose()


@pytest.mark.parametrize("mode", ["Sign", "SignAndEncrypt"])
async def test_node_opcua_reads_the_daemons_tags(
    node_environment: dict[str, str], keys: Keys, tmp_path: Path, mode: str
) -> None:
    async with tag_server(tmp_path, keys) as bench:
        tell(bench)
        options = {
            "endpoint": bench.url,
            "certificate": str(keys.client),
            "privateKey": str(keys.client_key),
            "applicationUri": CLIENT_URI,
            "pki": str(tmp_path / "pki"),
            "user": "anna",
            "password": ACCOUNT_PASSWORD,
            "namespace": TAGS,
            "mode": mode,
        }
        client = NodeServer(await start("tags.js", options, node_environment), bench.url)
        await client.line("subscribed")
        tell(bench, first_degc=23.25)
        answer = asyncio.ensure_future(client.line("result "))
        while not answer.done():
            await bench.rig.turn()
            await asyncio.sleep(0.02)
        result = json.loads(answer.result().removeprefix("result "))
        await client.process.communicate()
    assert re.search("BadIdentityTokenRejected|anonymous", result.pop("anonymous"), re.IGNORECASE)
    assert result == {
        "names": [f"temperature.{sensor}" for sensor in SENSOR_IDS],
        "tag": [21.5, "Good", round(NOW.utc_s * 1000)],
        "held": [22.0, "UncertainLastUsableValue"],
        "unit": "°C",
        "heard": 23.25,
        "write": "BadNotWritable",
        "called": ["Good", [True, "OFF", result["called"][1][2]]],
        "arguments": ["Axes", "Zero"],
    }
