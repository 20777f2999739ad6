"""Every source of temperatures or displacements passes the same checks, each at a device on its own wire."""

import asyncio
import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
import pytest_asyncio
from asyncua import Server, ua
from modbus_pty import ModbusPtyBox
from source_contract import (
    CHECKS,
    DISPLACEMENTS,
    NAME,
    PATIENCE_S,
    TEMPERATURES,
    WIRE_CHECKS,
    Check,
    Measuring,
    SourceBench,
)

from config.schema.base import drivers_of
from config.schema.displacements import DisplacementSourceConfig, ModbusChannelConfig
from config.schema.modbus import ModbusRegister, ModbusSensorConfig
from config.schema.source_drivers import SourceConfig, SourceEntry
from daemon.simulation.processes import free_port
from drivers import pushing
from drivers.clock import SystemClock
from drivers.displacement.logger import LoggerSource
from drivers.kernel import KernelSource
from drivers.modbus.source import ModbusSource
from drivers.mqtt import MqttSource
from drivers.opcua.tags import OpcUaTagSource
from drivers.process import ProcessSource
from drivers.readings import RowSource
from drivers.sim.wires.modbus_box import ModbusTcpBox, registers_of
from drivers.sim.wires.tcp_relay import TcpRelay

PERIOD_S = 0.02


class ModbusBench:
    """A box with one sensor per request, so that one of them can be missing."""

    def __init__(self, folder: Path, measuring: Measuring, *, serial: bool) -> None:
        self.measuring = measuring
        self._serial = serial
        self._link = folder / "box.tty"
        inputs = [measuring.described(place, address=10 * place, type="float32") for place in range(3)]
        inputs[1] |= {"type": "int16", "scale": 0.25, "unit_id": 2}
        inputs[2] |= {"type": "int32", "scale": 0.5, "word_order": "little", "table": "input"}
        kind = ModbusSensorConfig if measuring is TEMPERATURES else ModbusChannelConfig
        self._inputs: list[ModbusRegister] = [kind.model_validate(each) for each in inputs]
        self._words: dict[tuple[int, str, int], int] = {}
        self._box: ModbusTcpBox | ModbusPtyBox | None = None
        self._port = 0

    def contents(self, unit: int, table: str, start: int, count: int) -> Sequence[int] | None:
        words = [self._words.get((unit, table, start + i)) for i in range(count)]
        return [word for word in words if word is not None] if None not in words else None

    async def show(self, *numbers: float | None) -> None:
        self._words = {}
        for each, number in zip(self._inputs, numbers, strict=True):
            if number is None:
                continue
            raw = number if each.is_open(number) else each.number(number)
            for offset, word in enumerate(registers_of(raw, each)):
                self._words[each.unit_id or 1, each.table, each.address + offset] = word

    def open(self) -> RowSource:
        way = {"serial_port": str(self._link)} if self._serial else {"host": "127.0.0.1", "port": self._port}
        section = {"timeout_s": 0.3, self.measuring.listed: [each.model_dump() for each in self._inputs], **way}
        content = {"name": NAME, "driver": "modbus", "cycle_period_s": PERIOD_S, "modbus": section}
        return ModbusSource(self.measuring.config.model_validate(content), SystemClock())

    async def bring_back(self) -> None:
        if self._serial:
            self._box = ModbusPtyBox(self.contents, self._link)
            self._box.start()
        else:
            self._box = ModbusTcpBox(self.contents, port=self._port)
            await self._box.start()
            self._port = self._box.port

    async def lose(self) -> None:
        box, self._box = self._box, None
        if isinstance(box, ModbusPtyBox):
            box.stop()
        elif box is not None:
            await box.stop()


class Writing:
    """What the benches share whose device writes again and again: the numbers, and the task that writes them."""

    def __init__(self, measuring: Measuring) -> None:
        self.measuring = measuring
        self._numbers: tuple[float | None, ...] = (None, None, None)
        self._task: asyncio.Task[None] | None = None

    async def show(self, *numbers: float | None) -> None:
        self._numbers = numbers

    def write(self) -> None:
        raise NotImplementedError

    async def _write_on(self) -> None:
        while True:
            self.write()
            await asyncio.sleep(PERIOD_S)

    async def bring_back(self) -> None:
        self._task = asyncio.create_task(self._write_on())

    async def lose(self) -> None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})


def configured(
    measuring: Measuring, driver: str, section: dict[str, Any], inputs: list[dict[str, Any]], **about: Any
) -> SourceEntry:
    section = {**section, measuring.listed: inputs}
    content = {"name": NAME, "driver": driver, "cycle_period_s": PERIOD_S, driver: section}
    return measuring.config.model_validate_json(json.dumps(content | about))


class CsvBench(Writing):
    """A logger that appends a row with a time stamp, in Japanese text with a decimal comma."""

    def __init__(self, folder: Path, measuring: Measuring) -> None:
        super().__init__(measuring)
        self._path = folder / "\u6e29\u5ea6.csv"
        inputs = [measuring.described(i, column=f"T{i} \u2103") for i in range(3)]
        file = {
            "path": str(self._path),
            "encoding": "cp932",
            "delimiter": ";",
            "decimal": ",",
            "header": "\u6642\u523b",
        }
        file |= {"time_format": "%s", "poll_period_s": PERIOD_S / 2}
        self._config = configured(measuring, "csv", {"file": file}, inputs)

    def write(self) -> None:
        new = not self._path.exists()
        cells = ["" if number is None else str(number).replace(".", ",") for number in self._numbers]
        with self._path.open("a", encoding="cp932") as file:
            if new:
                file.write("maker;someone\n" + ";".join(["\u6642\u523b", *(f"T{i} \u2103" for i in range(3))]) + "\n")
            file.write(";".join([f"{time.time():.3f}".replace(".", ","), *cells]) + "\n")

    def open(self) -> RowSource:
        return LoggerSource(self._config, SystemClock())

    async def lose(self) -> None:
        await super().lose()
        self._path.unlink(missing_ok=True)


class KernelBench:
    """Files as those of the kernel."""

    def __init__(self, folder: Path, measuring: Measuring) -> None:
        self.measuring = measuring
        self._folder = folder
        self._paths = [folder / f"hwmon{i}" / "temp1_input" for i in range(3)]
        inputs = [measuring.described(i, path=str(self._paths[i]), open=[-999000], scale=0.001) for i in range(3)]
        self._config = configured(measuring, "kernel", {}, inputs)

    async def show(self, *numbers: float | None) -> None:
        for path, number in zip(self._paths, numbers, strict=True):
            path.parent.mkdir(exist_ok=True)
            if number is not None:
                fresh = path.with_suffix(".new")
                fresh.write_text(f"{number * 1000:.0f}\n")
                fresh.replace(path)
            else:
                path.unlink(missing_ok=True)

    def open(self) -> RowSource:
        return KernelSource(self._config, SystemClock())

    async def bring_back(self) -> None:
        pass

    async def lose(self) -> None:
        for path in self._paths:
            path.unlink(missing_ok=True)


class ProcessBench:
    """A program that writes what stands in a file, and ends when there is none."""

    PROGRAM = """
import pathlib, sys, time
path = pathlib.Path(sys.argv[1])
while path.exists():
    print(path.read_text(), flush=True)
    time.sleep(float(sys.argv[2]))
print("the device went away", file=sys.stderr)
"""

    def __init__(self, folder: Path, measuring: Measuring) -> None:
        self.measuring = measuring
        self._path = folder / "numbers"
        inputs = [measuring.described(i, field=f"device.t{i}") for i in range(3)]
        command = [sys.executable, "-I", "-S", "-c", self.PROGRAM, str(self._path), str(PERIOD_S)]
        self._config = configured(measuring, "process", {"command": command}, inputs)

    async def show(self, *numbers: float | None) -> None:
        fresh = self._path.with_suffix(".new")
        given = {f"t{i}": number for i, number in enumerate(numbers) if number is not None}
        fresh.write_text(json.dumps({"device": given}))
        fresh.replace(self._path)

    def open(self) -> RowSource:
        return ProcessSource(self._config, SystemClock())

    async def bring_back(self) -> None:
        pass

    async def lose(self) -> None:
        self._path.unlink(missing_ok=True)


class MqttBench(Writing):
    """Debian's broker, and a device that publishes each sensor to a topic of its own."""

    def __init__(self, folder: Path, measuring: Measuring) -> None:
        super().__init__(measuring)
        self._broker = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
        if self._broker is None:
            pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
        self._port = free_port()
        self._file = folder / "mosquitto.conf"
        self._file.write_text(f"listener {self._port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
        inputs = [measuring.described(i, topic=f"machine/{i}", field="v" if i else "") for i in range(3)]
        section = {"host": "127.0.0.1", "port": self._port, "timeout_s": 2.0}
        self._config = configured(measuring, "mqtt", section, inputs, cycle_period_s=0.1)
        self._process: subprocess.Popen[bytes] | None = None

    def open(self) -> RowSource:
        return MqttSource(self._config, SystemClock())

    async def _write_on(self) -> None:
        with contextlib.suppress(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", self._port) as client:
                while True:
                    for place, number in enumerate(self._numbers):
                        if number is not None:
                            payload = json.dumps({"v": number, "unit": "C"}) if place else str(number)
                            await client.publish(f"machine/{place}", payload)
                    await asyncio.sleep(PERIOD_S)

    async def bring_back(self) -> None:
        assert self._broker is not None
        command = [self._broker, "-c", str(self._file)]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        async with asyncio.timeout(PATIENCE_S):
            while not await listens(self._port):
                await asyncio.sleep(0.02)
        await super().bring_back()

    async def lose(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
        await super().lose()


async def listens(port: int) -> bool:
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        return False
    writer.close()
    return True


class OpcUaBench:
    """A gateway with three tags; it goes away by the wire before it."""

    URI = "urn:gateway"

    def __init__(self, folder: Path, measuring: Measuring) -> None:
        self.measuring = measuring
        self._port, self._server, self._relay = free_port(), None, None
        inputs = [measuring.described(i, node=f"s=T{i}") for i in range(3)]
        section = {"endpoint": f"opc.tcp://127.0.0.1:{self._port}/g", "namespace_uri": self.URI, "timeout_s": 5.0}
        self._config = configured(measuring, "opcua", section, inputs)

    def open(self) -> RowSource:
        return OpcUaTagSource(self._config, SystemClock())

    async def show(self, *numbers: float | None) -> None:
        for node, number in zip(self._nodes, numbers, strict=True):
            status = ua.StatusCode(ua.UInt32(ua.StatusCodes.BadSensorFailure if number is None else 0))
            value = ua.Variant(20.0 if number is None else number, ua.VariantType.Double)
            await self._server.write_attribute_value(node.nodeid, ua.DataValue(value, status))

    async def bring_back(self) -> None:
        if self._server is None:
            self._server = Server()
            await self._server.init()
            inner = free_port()
            self._server.set_endpoint(f"opc.tcp://127.0.0.1:{inner}/g")
            self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
            index = await self._server.register_namespace(self.URI)
            objects = self._server.nodes.objects
            self._nodes = [await objects.add_variable(ua.NodeId(f"T{i}", index), f"T{i}", 20.0) for i in range(3)]
            await self._server.start()
            self._relay = TcpRelay(port=self._port, target_port=inner)
        await self._relay.start()

    async def lose(self) -> None:
        await self._relay.stop()

    async def end(self) -> None:
        await self._server.stop()


BENCHES: dict[str, Callable[[Path, Measuring], SourceBench]] = {
    "modbus-tcp": lambda folder, measuring: ModbusBench(folder, measuring, serial=False),
    "modbus-rtu": lambda folder, measuring: ModbusBench(folder, measuring, serial=True),
    "csv": CsvBench,
    "kernel": KernelBench,
    "process": ProcessBench,
    "mqtt": MqttBench,
    "opcua": OpcUaBench,
}


@pytest.fixture
def measuring() -> Measuring:
    return TEMPERATURES


@pytest_asyncio.fixture(params=list(BENCHES))
async def bench(
    request: pytest.FixtureRequest, measuring: Measuring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[SourceBench]:
    # Silence alone tells that a logger is gone; the others say so, and a computer that is busy is silent too.
    monkeypatch.setattr(pushing, "MIN_SILENT_REAL_S", 4.0 if request.param == "csv" else PATIENCE_S)
    made = BENCHES[request.param](tmp_path, measuring)
    await made.bring_back()
    yield made
    await made.lose()
    if isinstance(made, OpcUaBench):
        await made.end()


@pytest.mark.wires
@pytest.mark.parametrize("measuring", [TEMPERATURES, DISPLACEMENTS], ids=["temperatures", "displacements"])
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
async def test_every_source_does_what_the_daemon_relies_on(bench: SourceBench, check: Check) -> None:
    await check(bench)


@pytest.mark.wires
@pytest.mark.parametrize("check", WIRE_CHECKS, ids=lambda check: check.__name__)
async def test_every_wire_is_opened_lost_and_closed_alike(bench: SourceBench, check: Check) -> None:
    await check(bench)


def test_every_driver_of_the_schema_is_on_a_bench() -> None:
    assert set(drivers_of(SourceConfig)) == {name.partition("-")[0] for name in BENCHES}
    assert set(drivers_of(DisplacementSourceConfig)) == set(drivers_of(SourceConfig))
