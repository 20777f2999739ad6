"""Every source of temperatures passes the same checks, each at a device on its own wire."""

from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio
from source_contract import CHECKS, NAME, SENSORS, Check, SourceBench

from config.schema.modbus import ModbusSensorConfig
from config.schema.source_drivers import SourceConfig
from drivers.clock import SystemClock
from drivers.contract import TemperatureSource
from drivers.modbus.source import ModbusSource
from drivers.sim.wires.modbus_box import ModbusPtyBox, ModbusTcpBox, registers_of

PERIOD_S = 0.02


class ModbusBench:
    """A box with one sensor per request, so that one of them can be missing."""

    def __init__(self, folder: Path, *, serial: bool) -> None:
        self._serial = serial
        self._link = folder / "box.tty"
        sensors: list[dict[str, Any]] = []
        for place, (sensor_id, about) in enumerate(SENSORS.items()):
            sensors.append({"id": sensor_id, **about, "address": 10 * place, "type": "float32"})
        sensors[1] |= {"type": "int16", "scale": 0.25, "open": [-999.0], "unit_id": 2}
        sensors[2] |= {"type": "int32", "scale": 0.5, "word_order": "little", "open": [-999.0], "table": "input"}
        self._sensors = [ModbusSensorConfig.model_validate(each) for each in sensors]
        self._words: dict[tuple[int, str, int], int] = {}
        self._box: ModbusTcpBox | ModbusPtyBox | None = None
        self._port = 0

    def contents(self, unit: int, table: str, start: int, count: int) -> Sequence[int] | None:
        words = [self._words.get((unit, table, start + i)) for i in range(count)]
        return [word for word in words if word is not None] if None not in words else None

    async def show(self, numbers: dict[int, float]) -> None:
        self._words = {}
        for sensor in self._sensors:
            if (number := numbers.get(sensor.id)) is None:
                continue
            raw = number if sensor.is_open(number) else sensor.number(number)
            for offset, word in enumerate(registers_of(raw, sensor)):
                self._words[sensor.unit_id or 1, sensor.table, sensor.address + offset] = word

    def open(self) -> TemperatureSource:
        way = {"serial_port": str(self._link)} if self._serial else {"host": "127.0.0.1", "port": self._port}
        modbus = {"timeout_s": 0.3, "sensors": [each.model_dump() for each in self._sensors], **way}
        content = {"name": NAME, "driver": "modbus", "cycle_period_s": PERIOD_S, "modbus": modbus}
        return ModbusSource(SourceConfig.model_validate(content), SystemClock())

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


@pytest_asyncio.fixture(params=["modbus-tcp", "modbus-rtu"])
async def bench(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[SourceBench]:
    made = ModbusBench(tmp_path, serial=request.param == "modbus-rtu")
    await made.bring_back()
    yield made
    await made.lose()


@pytest.mark.wires
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
async def test_every_source_does_what_the_daemon_relies_on(bench: SourceBench, check: Check) -> None:
    await check(bench)
