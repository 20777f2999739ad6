"""LATSIS lines on real pseudo-terminals and sockets: unplugged, plugged in again, silent, busy, forbidden."""

import asyncio
import os
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from left_behind import leaves_nothing_behind

from config.schema.temperatures import LineConfig, SensorConfig
from drivers.clock import Clock, ScaledClock, SystemClock
from drivers.contract import LinkError, TemperatureSource
from drivers.latsis import source as latsis_serial
from drivers.latsis.source import LatsisSerialSource
from models.records import TemperatureCycle

pytestmark = pytest.mark.wires
PATIENCE_S = 20.0
REPOSITORY = Path(__file__).parents[2]


class Wire:
    """A pseudo-terminal: the test holds the nodes' end, the port is a symbolic link that can be plugged again."""

    def __init__(self, port: Path) -> None:
        self.port = port
        self.master: int | None = None
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(slave))
        os.close(slave)

    def send(self, data: bytes) -> None:
        assert self.master is not None
        while data:
            data = data[os.write(self.master, data) :]

    def unplug(self) -> None:
        if self.master is not None:
            os.close(self.master)
            self.master = None


@pytest.fixture
def wires(tmp_path: Path) -> Iterator[list[Wire]]:
    wires = [Wire(tmp_path / f"port{number}") for number in range(3)]
    yield wires
    for wire in wires:
        wire.unplug()


@pytest.fixture
def wire(wires: list[Wire]) -> Wire:
    return wires[0]


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    deadline_s = time.monotonic() + PATIENCE_S
    while readers() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert readers() == []


def readers() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("latsis-")]


def source_of(
    port: Path | str, clock: Clock | None = None, *, name: str = "spindle", count: int = 5, **settings: object
) -> LatsisSerialSource:
    line = LineConfig.model_validate({"name": name, "port": str(port), "chain": [f"101-{100 + count}"], **settings})
    sensors = [SensorConfig(id=i, component="c") for i in line.sensor_ids]
    return LatsisSerialSource(line, sensors, clock or SystemClock())


def fast(speed: float) -> ScaledClock:
    return ScaledClock(epoch_real_s=time.monotonic(), epoch_utc_s=1e9, speed=speed)


def frames(count: int = 5, code: int = 0x190) -> bytes:
    return b"".join(b"%02X%03X\r\n" % (i, code) for i in range(count, 0, -1))


async def following(cycles: AsyncIterator[TemperatureCycle]) -> TemperatureCycle:
    return await asyncio.wait_for(anext(cycles), PATIENCE_S)


async def opened(wire: Wire, cycles: AsyncIterator[TemperatureCycle]) -> TemperatureCycle:
    """Start reading; send until a cycle comes, and take all that was sent.

    Opening a port flushes what came before, so the first pass may have to be sent more than once.
    """
    task = asyncio.ensure_future(following(cycles))
    code = 0x100
    while not task.done():
        code += 1
        wire.send(frames(code=code))
        await asyncio.wait({task}, timeout=0.2)
    cycle = task.result()
    while cycle.degc[0] != code * 0.0625:
        cycle = await following(cycles)
    return cycle


def contract(source: LatsisSerialSource) -> TemperatureSource:
    return source  # checked by mypy


async def test_cycles_arrive_and_are_stamped(wire: Wire) -> None:
    source = contract(source_of(wire.port))
    cycles = source.cycles()
    await opened(wire, cycles)
    for code, degc in ((0x190, 25.0), (0xE70, -25.0)):
        before_s = time.monotonic()
        wire.send(frames(code=code))
        cycle = await following(cycles)
        assert list(cycle.degc) == [degc] * 5
        assert cycle.complete
        assert before_s < cycle.trace.first_byte.real_s <= cycle.trace.last_byte.real_s <= time.monotonic()
    await source.close()


async def test_unplug_names_port_and_line_and_plugging_again_works(wire: Wire) -> None:
    for _ in range(3):
        source = source_of(wire.port)
        cycles = source.cycles()
        await opened(wire, cycles)
        wire.unplug()
        with pytest.raises(LinkError, match=f"line spindle: port {wire.port} went away"):
            while True:
                await following(cycles)
        assert readers() == []
        await source.close()
        wire.plug()


async def test_a_port_that_is_unplugged_while_it_is_opened_is_a_lost_link(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object) -> None:
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr(termios, "tcsetattr", gone)
    with pytest.raises(LinkError, match=f"line spindle: port {wire.port} cannot be opened: .*Input/output error"):
        await following(source_of(wire.port).cycles())


async def test_busy_port(wire: Wire) -> None:
    first = source_of(wire.port)
    cycles = first.cycles()
    await opened(wire, cycles)
    with pytest.raises(LinkError, match=f"port {wire.port} is in use by another program.*fuser"):
        await following(source_of(wire.port, name="saddle").cycles())
    wire.send(frames())
    assert (await following(cycles)).complete  # the first one is not disturbed
    await first.close()


FORBIDDEN = """
import os, sys
sys.path.insert(0, sys.argv[2])
from drivers.latsis.reader import SerialPort, StopSignal
if os.geteuid() == 0:  # root may open everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
SerialPort(sys.argv[1], 9600, "line spindle", StopSignal())
"""


def test_forbidden_port_names_the_group(wire: Wire) -> None:
    device = wire.port.resolve()
    device.chmod(0o000)
    command = [sys.executable, "-P", "-c", FORBIDDEN, str(device), str(REPOSITORY)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert f"LinkError: line spindle: port {device} may not be opened (permission denied)" in result.stderr
    assert "dialout" in result.stderr


async def test_silent_line_is_given_up(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latsis_serial, "MIN_DEAD_LINE_REAL_S", 0.2)
    with pytest.raises(LinkError, match=f"line spindle: port {wire.port} has been silent for .* check the cable"):
        await following(source_of(wire.port, fast(600)).cycles())


async def test_line_that_sends_nonsense_is_given_up_with_the_reason(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latsis_serial, "MIN_DEAD_LINE_REAL_S", 0.2)
    source = source_of(wire.port, fast(30))
    task = asyncio.ensure_future(following(source.cycles()))
    while not task.done():
        wire.send(b"\x80\xfe\x00\n")
        await asyncio.sleep(0.01)
    with pytest.raises(LinkError, match=r"bytes but no frame .*rejected.*check `baud` \(9600\).*profile bare"):
        await task


async def test_silence_ends_an_incomplete_pass(wire: Wire) -> None:
    for clock in (fast(60), fast(600)):
        source = source_of(wire.port, clock)
        cycles = source.cycles()
        await opened(wire, cycles)
        wire.send(b"05222\r\n04222\r\n03222\r\n")
        cycle = await following(cycles)
        while cycle.complete:
            cycle = await following(cycles)
        assert [fault for fault in cycle.faults if "not received" in fault]
        await source.close()


@pytest.mark.parametrize("speed", [60.0, 600.0])
async def test_a_fast_clock_delivers_complete_cycles(wire: Wire, speed: float) -> None:
    source = source_of(wire.port, fast(speed), count=100, profile="bare")
    received: list[TemperatureCycle] = []

    async def follow() -> None:
        async for cycle in source.cycles():
            received.append(cycle)

    task = asyncio.create_task(follow())
    while sum(cycle.complete for cycle in received) < 10 and not task.done():
        wire.send(frames(100))
        await asyncio.sleep(10.0 / speed)
    assert not task.done()
    assert [cycle.number for cycle in received] == list(range(1, len(received) + 1))
    await source.close()
    await task


async def test_three_lines_are_independent(wires: list[Wire]) -> None:
    sources = [source_of(wire.port, name=f"line{number}") for number, wire in enumerate(wires)]
    received: dict[str, int] = {}
    lost: list[str] = []

    async def follow(source: LatsisSerialSource) -> None:
        try:
            async for cycle in source.cycles():
                received[cycle.line] = received.get(cycle.line, 0) + 1
        except LinkError as error:
            lost.append(str(error))

    tasks = [asyncio.create_task(follow(source)) for source in sources]

    async def until(cycles: dict[str, int]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while any(received.get(name, 0) < count for name, count in cycles.items()):
                for wire in wires:
                    if wire.master is not None:
                        wire.send(frames())
                await asyncio.sleep(0.02)

    await until({"line0": 2, "line1": 2, "line2": 2})
    assert len(readers()) == 3
    wires[1].unplug()
    await until({"line0": received["line0"] + 5, "line2": received["line2"] + 5})
    assert len(lost) == 1
    assert "line line1" in lost[0]
    for source in sources:
        await source.close()
    await asyncio.gather(*tasks)


async def test_many_openings_leak_no_descriptor(wire: Wire) -> None:
    async def ten_times() -> None:
        for _ in range(10):
            with pytest.raises(LinkError):
                await following(source_of("/dev/none").cycles())
            source = source_of(wire.port)
            cycles = source.cycles()
            await opened(wire, cycles)
            await source.close()

    await leaves_nothing_behind(ten_times)
