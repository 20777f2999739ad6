"""The CNC driver against a simulated CNC in this process: what it reads, writes and refuses."""

import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio
from scripted_machine import GROUPS, Keys, ScriptedNc, cnc_config

from config.schema.cnc_drivers import OpcUaNodesConfig
from drivers.clock import SystemClock
from drivers.contract import FatalDriverError, LinkError
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.records import CncMode, CncRun, Instant

pytestmark = [pytest.mark.wires, pytest.mark.asyncio(loop_scope="module")]


class HandClock:
    """A clock that a test moves by hand."""

    speed = 1.0

    def __init__(self) -> None:
        self.real_s = 0.0

    def now(self) -> Instant:
        return Instant(monotonic_s=self.real_s, utc_s=self.real_s, real_s=self.real_s)

    async def sleep(self, duration_s: float) -> None:
        self.real_s += duration_s


NC = ScriptedNc()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server() -> AsyncIterator[SimulatedCncServer]:
    server = SimulatedCncServer(NC, cnc_config(), port=0)
    await server.start()
    yield server
    await server.stop()


@pytest_asyncio.fixture(loop_scope="module")
async def nc(server: SimulatedCncServer) -> ScriptedNc:
    NC.reset()
    return NC


@pytest_asyncio.fixture(loop_scope="module")
async def cnc(server: SimulatedCncServer, nc: ScriptedNc) -> AsyncIterator[OpcUaCnc]:
    cnc = OpcUaCnc(cnc_config(server.endpoint), SystemClock())
    await cnc.connect()
    yield cnc
    await cnc.close()


async def test_one_read_gives_state_and_macros(cnc: OpcUaCnc, nc: ScriptedNc) -> None:
    nc.macros.values.update({501: 0.0125, 510: -0.25})
    nc.alarm = 2
    sample = await cnc.read([501, 502, 510])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, True)
    assert (sample.program, sample.sequence_number) == (1000, 20)
    assert (sample.spindle_speed_rpm, sample.motor_temperature_degc) == (5000.0, 31.5)
    assert (sample.power_on_count, sample.work_offset, sample.tool_number) == (7, 54, 3)
    assert sample.clock_s > 100.0
    assert sample.macros == {501: 0.0125, 502: None, 510: -0.25}


@pytest.mark.parametrize(
    ("mode", "run", "expected"),
    [
        (0, 0, (CncMode.MDI, CncRun.RESET)),
        (3, 1, (CncMode.EDIT, CncRun.STOP)),
        (4, 2, (CncMode.HANDLE, CncRun.HOLD)),
        (5, 4, (CncMode.JOG, CncRun.START)),
        (10, 3, (CncMode.REMOTE, CncRun.START)),
        (7, 9, (CncMode.UNKNOWN, CncRun.UNKNOWN)),
        (-1, -1, (CncMode.UNKNOWN, CncRun.UNKNOWN)),
    ],
)
async def test_codes_become_words_and_unknown_codes_stay_unknown(
    cnc: OpcUaCnc, nc: ScriptedNc, mode: int, run: int, expected: tuple[CncMode, CncRun]
) -> None:
    nc.mode, nc.run = mode, run
    sample = await cnc.read([])
    assert (sample.mode, sample.run) == expected


async def test_nothing_follows_a_refused_group(cnc: OpcUaCnc, nc: ScriptedNc) -> None:
    del nc.macros.values[502]
    with pytest.raises(FatalDriverError, match=r"#502 = -0\.002: BadNotWritable"):
        await cnc.write_macros(GROUPS)
    assert (500, 1.0) in nc.macros.written
    assert 505 not in dict(nc.macros.written)
    nc.macros.values[502] = None
    await cnc.write_macros(GROUPS)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
async def test_non_finite_values_are_refused_before_anything_is_sent(
    cnc: OpcUaCnc, nc: ScriptedNc, value: float
) -> None:
    with pytest.raises(FatalDriverError, match=r"#501; nothing was sent"):
        await cnc.write_macros([[(500, 1.0)], [(501, value)]])
    assert nc.macros.written == []


@pytest.mark.parametrize("number", [510, 521, 5201, 99])
async def test_macros_outside_the_list_are_refused_before_anything_is_sent(
    server: SimulatedCncServer, nc: ScriptedNc, number: int
) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint, writable=["100-110", "500-506"]), SystemClock())
    await cnc.connect()
    with pytest.raises(FatalDriverError, match=rf"#{number} is outside cnc\.macros\.writable"):
        await cnc.write_macros([[(500, 1.0)], [(number, 1.0)]])
    assert nc.macros.written == []
    await cnc.close()


async def test_insecure_writes_need_to_be_allowed(server: SimulatedCncServer, nc: ScriptedNc) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint, allow_insecure_writes=False), SystemClock())
    await cnc.connect()
    assert (await cnc.read([])).program == 1000
    with pytest.raises(FatalDriverError, match="allow_insecure_writes: true"):
        await cnc.write_macros(GROUPS)
    assert nc.macros.written == []
    await cnc.close()


async def test_a_clock_that_stands_still_is_a_lost_link(server: SimulatedCncServer, nc: ScriptedNc) -> None:
    clock = HandClock()
    cnc = OpcUaCnc(cnc_config(server.endpoint, stale_after_s=3.0), clock)
    await cnc.connect()
    for _ in range(10):
        await clock.sleep(2.0)
        await cnc.read([])
    nc.clock_runs = False
    await cnc.read([])
    await clock.sleep(2.9)
    await cnc.read([])
    await clock.sleep(0.2)
    with pytest.raises(LinkError, match="answers but its clock stands still"):
        await cnc.read([])
    with pytest.raises(LinkError, match="clock stands still"):
        await cnc.write_macros(GROUPS)
    await cnc.close()


async def test_the_secure_channel_is_renewed_between_reads(server: SimulatedCncServer, nc: ScriptedNc) -> None:
    clock = HandClock()
    cnc = OpcUaCnc(cnc_config(server.endpoint), clock)
    await cnc.connect()
    channel = cnc._client.uaclient.protocol._connection  # type: ignore[union-attr]
    for _ in range(3):
        token = channel.security_token.TokenId
        await clock.sleep(3600.0)
        assert (await cnc.read([501])).program == 1000
        assert channel.security_token.TokenId == token + 1
    await cnc.close()


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ({"tool_number": "s=Tool"}, r"no variable tool_number \(s=Tool\)"),
        ({"macro": "i={number}"}, r"no macro variable #500 \(i=500\)"),
        ({"mode": "Mode"}, r"cnc\.opcua\.nodes\.mode: 'Mode' is no node identifier"),
        ({"mode": "ns=2;s=Mode"}, r"'ns=2;s=Mode' is no node identifier; write s=text or i=number, without ns="),
    ],
)
async def test_wrong_node_identifiers_are_fatal_and_named(
    server: SimulatedCncServer, nodes: dict[str, str], message: str
) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint, nodes=OpcUaNodesConfig(**nodes)), SystemClock())
    with pytest.raises(FatalDriverError, match=message):
        await cnc.connect()


async def test_a_server_without_encryption_is_fatal_when_encryption_is_configured(
    server: SimulatedCncServer, tmp_path: Path
) -> None:
    cnc = OpcUaCnc(cnc_config(server.endpoint, security=Keys(tmp_path).client_config()), SystemClock())
    with pytest.raises(FatalDriverError, match=r"offers None None_, not Basic256Sha256 SignAndEncrypt"):
        await cnc.connect()
