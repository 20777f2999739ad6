"""The SHDR adapter: what an MTConnect agent gets, its PING, and that one that talks too much is cut off alone."""

import asyncio
import contextlib
import re
from dataclasses import replace

import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc
from opcua_bench import NOW, temperatures

from config.schema.service import ShdrConfig
from daemon.monitor import shdr
from daemon.monitor.shdr import ShdrAdapter
from daemon.simulation.processes import free_port
from models.records import OutputState

LINE = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z)\|([A-Za-z0-9_]+)\|(.*)")


@contextlib.asynccontextmanager
async def adapter(directory):
    configuration = machine(directory)
    configuration = configuration.model_copy(update={"shdr": ShdrConfig(port=free_port())})
    clock = HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        serving = asyncio.Event()
        task = asyncio.create_task(ShdrAdapter(configuration, rig.snapshots).serve(serving.set))
        await asyncio.wait_for(serving.wait(), 20.0)
        try:
            yield rig, configuration.shdr.port
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def heard(reader, *keys):
    """Key -> time and text, read until all these keys have come."""
    found = {}
    while not set(keys) <= set(found):
        line = (await asyncio.wait_for(reader.readline(), 20.0)).decode().rstrip("\n")
        match = LINE.fullmatch(line)
        assert match is not None, line
        found[match[2]] = (match[1], match[3])
    return found


async def test_an_agent_gets_everything_then_what_has_changed_and_its_ping_is_answered(tmp_path, monkeypatch):
    monkeypatch.setattr(shdr, "PERIOD_S", 0.02)
    async with adapter(tmp_path) as (rig, port):
        rig.snapshots.thermal = replace(rig.snapshots.thermal, temperatures=temperatures())
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        found = await heard(reader, "compensation")
        assert found["temperature_1"] == ("2025-10-09T09:00:00.000Z", "21.500")
        assert {found[f"temperature_{sensor}"][1] for sensor in (2, 3, 11)} == {"UNAVAILABLE"}, "held or missing"
        assert found["temperature_12"] == ("2025-10-09T08:59:56.000Z", "20.000")
        assert (found["output_state"][1], found["compensation"][1]) == ("OFF", "NORMAL||||")
        assert found["z_applied_um"][1] in ("0", "UNAVAILABLE")
        rig.snapshots.thermal = replace(
            rig.snapshots.thermal, temperatures=temperatures(first_degc=21.75, utc_s=NOW.utc_s + 10.0)
        )
        assert (await heard(reader, "temperature_1")) == {"temperature_1": ("2025-10-09T09:00:10.000Z", "21.750")}
        old = temperatures(ago_s=rig.configuration.temperatures.cleansing.stale_after_s + 1.0)
        rig.snapshots.thermal = replace(rig.snapshots.thermal, temperatures=old)
        assert (await heard(reader, "temperature_1"))["temperature_1"][1] == "UNAVAILABLE", "every line is silent"
        rig.snapshots.thermal = replace(rig.snapshots.thermal, estimate=rig.estimate(1.5, 2.5))
        rig.snapshots.thermal = replace(rig.snapshots.thermal, temperatures=temperatures())
        assert (await heard(reader, "estimate_Z1_um", "confidence"))["estimate_Z1_um"][1] == "2.500"
        rig.snapshots.thermal = replace(rig.snapshots.thermal, estimate=None)
        found = await heard(reader, "estimate_Z1_um", "estimate_Y1_um", "confidence")
        assert {text for _, text in found.values()} == {"UNAVAILABLE"}, "there is no estimate any more"
        rig.snapshots.control = replace(
            rig.snapshots.control, state=OutputState.FAULT, reason="foreign | value", alarm="look\nat it"
        )
        found = await heard(reader, "output_state", "output_reason", "compensation")
        assert found["compensation"][1] == "FAULT|OUTPUT|||look at it"
        assert found["output_reason"][1] == "foreign / value"
        rig.snapshots.control = replace(rig.snapshots.control, state=OutputState.OFF)
        found = await heard(reader, "compensation")
        assert found["compensation"][1] == "WARNING|OUTPUT|||look at it", "under another code the fault stays active"
        writer.write(b"* PING\n")
        assert await asyncio.wait_for(reader.readline(), 20.0) == b"* PONG 10000\n"
        writer.close()


async def test_an_agent_that_says_too_much_is_cut_off_and_another_is_served(tmp_path, monkeypatch):
    monkeypatch.setattr(shdr, "PERIOD_S", 0.02)
    async with adapter(tmp_path) as (_, port):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"x" * 5000)
        with contextlib.suppress(ConnectionError):
            while await asyncio.wait_for(reader.read(65536), 20.0):
                pass
        writer.close()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        assert "avail" in await heard(reader, "compensation")
        writer.close()


@pytest.mark.parametrize(
    ("value", "text"),
    [(21.5, "21.500"), (-0.0042, "-0.0042"), (float("nan"), "UNAVAILABLE"), (float("inf"), "UNAVAILABLE"), (0.0, "0")],
)
def test_numbers_are_short_and_nan_never_leaves(value, text):
    assert shdr._number(value) == text
