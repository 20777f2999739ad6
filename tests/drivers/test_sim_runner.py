"""The whole simulated machine with its three faces, in simulated time."""

import asyncio
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from scripted_machine import ScriptedMachine, cnc_config, configuration

from drivers.clock import ScaledClock, SystemClock
from drivers.contract import LinkError
from drivers.opcua.cnc import OpcUaCnc
from drivers.sim.faults import Fault, FaultKind
from drivers.sim.wires.runner import LARGEST_STEP_S, Ready, run_simulated_machine
from models.records import Instant

pytestmark = pytest.mark.wires


class HandClock(ScaledClock):
    """A clock that a test moves by hand."""

    def __init__(self) -> None:
        super().__init__(epoch_real_s=0.0, epoch_utc_s=1.7e9, speed=1.0)
        self.elapsed_s = 0.0
        self.looks = 0

    def now(self) -> Instant:
        self.looks += 1
        return Instant(monotonic_s=self.elapsed_s, utc_s=self.epoch_utc_s + self.elapsed_s, real_s=time.monotonic())


class Running:
    """A running simulated machine and what it has reported."""

    def __init__(
        self, directory: Path, clock: ScaledClock, *faults: Fault, report_period_s: float = 1.0, **more: Any
    ) -> None:
        self.machine = ScriptedMachine()
        self.reports: list[dict[str, Any]] = []
        self.ready: asyncio.Future[Ready] = asyncio.get_running_loop().create_future()
        self._news = asyncio.Event()
        self.clock = clock
        self.task = asyncio.create_task(
            run_simulated_machine(
                self.machine,
                configuration(directory),
                clock,
                directory=directory,
                faults=faults,
                report_period_s=report_period_s,
                report=self._take,
                ready=self._is_ready,
                **more,
            )
        )
        self.on_ready: Callable[[Ready], None] = lambda _: None

    def _is_ready(self, ready: Ready) -> None:
        self.on_ready(ready)
        self.ready.set_result(ready)

    def _take(self, report: dict[str, Any]) -> None:
        self.reports.append(json.loads(json.dumps(report)))
        self._news.set()

    async def until(self, happened: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for a report that fits."""
        async with asyncio.timeout(30):
            while not self.reports or not happened(self.reports[-1]):
                self._news.clear()
                await self._news.wait()
        return self.reports[-1]

    async def move(self, to_s: float) -> dict[str, Any]:
        """Move a hand clock on, and wait for the report of that time."""
        assert isinstance(self.clock, HandClock)
        self.clock.elapsed_s = to_s
        return await self.until(lambda report: report["time_s"] >= to_s)

    async def stop(self) -> dict[str, Any]:
        """Cancel, and return the last report."""
        self.task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await self.task
        return self.reports[-1]


@pytest.mark.parametrize("speed", [60.0, 600.0])
async def test_lines_keep_pace_with_simulated_time(tmp_path: Path, speed: float) -> None:
    running = Running(tmp_path, ScaledClock(epoch_real_s=time.monotonic(), epoch_utc_s=1.7e9, speed=speed))
    received, loop = bytearray(), asyncio.get_running_loop()
    descriptors: list[int] = []

    def open_port(ready: Ready) -> None:
        """Before the first byte is sent."""
        descriptors.append(os.open(ready.ports["spindle"], os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK))
        loop.add_reader(descriptors[0], lambda: received.extend(os.read(descriptors[0], 1 << 16)))

    running.on_ready = open_port
    report = await running.until(lambda report: report["time_s"] > speed)
    cycles = report["cycles_sent"]["spindle"]
    assert cycles == int((report["time_s"] - 30 * 10 / 9600) // 10.0) + 1
    async with asyncio.timeout(30):
        while received.count(b"01191\r\n") < cycles:
            await asyncio.sleep(0.01)
    assert bytes(received).startswith(b"04194\r\n030193\r\n02192\r\n01191\r\n" * cycles)
    loop.remove_reader(descriptors[0])
    await running.stop()
    os.close(descriptors[0])
    assert max(running.machine.steps) <= LARGEST_STEP_S + 1e-9


async def test_faces_show_one_machine(tmp_path: Path) -> None:
    running = Running(tmp_path, HandClock())
    ready = await asyncio.wait_for(running.ready, 30)
    cnc = OpcUaCnc(cnc_config(ready.endpoint), SystemClock())
    await cnc.connect()
    await cnc.write_macros([[(503, 0.25)]])
    assert running.machine.nc.macros.written == [(503, 0.25)]
    report = await running.move(130.0)
    assert report["nc"]["program"] == 1000
    assert report["nc"]["macros"]["503"] == 0.25
    assert report["nc"]["macros"]["510"] is None
    assert ready.displacements is not None
    rows = ready.displacements.read_text(encoding="utf-8-sig").splitlines()
    assert rows[0] == "Time,X1,Z"
    assert float(rows[2].split(",")[1]) >= 1.0
    await cnc.close()
    await running.stop()


async def test_frozen_and_killed_cnc(tmp_path: Path) -> None:
    running = Running(
        tmp_path,
        HandClock(),
        Fault(kind=FaultKind.FROZEN_CNC, at_s=60.0, duration_s=120.0),
        Fault(kind=FaultKind.KILLED_CNC, at_s=240.0, duration_s=60.0),
    )
    ready = await asyncio.wait_for(running.ready, 30)
    config = cnc_config(ready.endpoint, timeout_s=0.3)
    cnc = OpcUaCnc(cnc_config(ready.endpoint), SystemClock())
    await cnc.connect()
    assert (await cnc.read([])).program == 1000
    assert (await running.move(60.0))["faults"] == ["frozen_cnc"]
    with pytest.raises(LinkError, match="did not answer"):
        await OpcUaCnc(config, SystemClock()).connect()
    await running.move(180.0)
    assert (await cnc.read([])).program == 1000
    assert (await running.move(240.0))["faults"] == ["killed_cnc"]
    with pytest.raises(LinkError):
        await cnc.read([])
    await cnc.close()
    with pytest.raises(LinkError, match="was lost while connecting"):
        await OpcUaCnc(cnc_config(ready.endpoint), SystemClock()).connect()
    await running.move(300.0)
    cnc = OpcUaCnc(cnc_config(ready.endpoint), SystemClock())
    await cnc.connect()
    await cnc.close()
    await running.stop()
