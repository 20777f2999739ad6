"""An independent client of FOCAS2 (pyfocas) reads and writes the simulated control, and sees what our driver wrote."""

import asyncio
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from scripted_machine import ScriptedNc, cnc_config

from drivers.clock import SystemClock
from drivers.focas.cnc import FocasCnc
from drivers.sim.wires.focas_server import SimulatedFocasServer

FOCAS = pytest.importorskip("pyfocas.protocol.protocol", reason="pyfocas is not installed (extra dev)").FOCAS
pytestmark = pytest.mark.wires


@pytest_asyncio.fixture
async def served() -> AsyncIterator[tuple[ScriptedNc, int]]:
    nc = ScriptedNc()
    server = SimulatedFocasServer(nc, cnc_config(focas={"host": "127.0.0.1"}), port=0)
    await server.start()
    yield nc, server.port
    await server.stop()


async def test_an_independent_client_and_ours_see_the_same_control(served: tuple[ScriptedNc, int]) -> None:
    nc, port = served
    peer = FOCAS("127.0.0.1", port)
    assert await asyncio.to_thread(peer.connect)
    status = await asyncio.to_thread(peer.get_status_info)
    assert (status.aut, status.run, status.alarm) == (nc.mode, nc.run, nc.alarm)
    assert (await asyncio.to_thread(peer.get_sys_info)).series == "TOOL"
    await asyncio.to_thread(peer.write_macro_double, 502, -0.0125)
    config = cnc_config(focas={"host": "127.0.0.1", "port": port})
    ours = FocasCnc(config, SystemClock())
    await ours.connect()
    assert await ours.read_macros([502, 503]) == {502: -0.0125, 503: None}
    await ours.write_macros([[(500, 4.0)], [(501, 0.25), (502, 0.5), (503, 29_813.0)], [(505, 4.0)]])
    assert await asyncio.to_thread(peer.read_macro, 500, 503) == {500: 4.0, 501: 0.25, 502: 0.5, 503: 29_813.0}
    await ours.close()
    peer.socket.close()
