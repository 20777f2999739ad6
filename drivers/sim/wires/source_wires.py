"""The boxes of a simulated machine whose sensors do not hang on LATSIS lines."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

from config.schema.modbus import ModbusConfig, ModbusRequest
from config.schema.source_drivers import SourceConfig
from config.schema.sources import SourceSensorConfig
from config.schema.temperatures import SensorConfig, TemperaturesConfig
from drivers.sim.contract import SimulatedMachine
from drivers.sim.wires.modbus_box import Contents, ModbusTcpBox, Send, Table, registers_of

Temperatures = Callable[[Sequence[int]], Sequence[float]]
"""Sensor IDs -> what they measure now [degC]."""

INFRARED = ("K", 0.02)
"""Unit and scale of the infrared sensor's own numbers."""


def as_simulated(sensor: SensorConfig | SourceSensorConfig) -> SensorConfig:
    """Return the sensor of the simulated machine that stands for one of any source."""
    if isinstance(sensor, SensorConfig):
        return sensor
    device: Literal["TMP102", "MLX90615"] = "MLX90615" if (sensor.unit, sensor.scale) == INFRARED else "TMP102"
    return SensorConfig(id=sensor.id, device=device, component=sensor.component, part=sensor.part, label=sensor.label)


def temperatures_of(machine: SimulatedMachine, config: TemperaturesConfig) -> Temperatures:
    """Return what reads a machine's sensors in degC."""
    infrared = {sensor.id for sensor in map(as_simulated, config.every_sensor) if sensor.device == "MLX90615"}

    def read(sensor_ids: Sequence[int]) -> list[float]:
        codes = machine.register_codes(sensor_ids)
        return [
            code / 50 - 273.15 if sensor_id in infrared else (code - 4096 if code >= 2048 else code) / 16
            for sensor_id, code in zip(sensor_ids, codes, strict=True)
        ]

    return read


class SourceWires:
    """All boxes of one machine. They answer when they are asked; from `until_s` on no cycle begins."""

    def __init__(self, sources: Sequence[SourceConfig], read: Temperatures, *, until_s: float = math.inf) -> None:
        self._boxes = {source.name: _Box(source, read) for source in sources}
        self._until_s = until_s

    @property
    def cycles_sent(self) -> dict[str, int]:
        """Cycles whose last answer went out, by source."""
        return {name: box.cycles for name, box in self._boxes.items()}

    @property
    def idle(self) -> bool:
        """No box answers any more."""
        return all(box.stopped for box in self._boxes.values())

    async def open(self) -> None:
        """Let all boxes answer."""
        for box in self._boxes.values():
            await box.server.start()

    async def step(self, now_s: float) -> None:
        """Stop what has come to the end of its last cycle at a simulated time [s]."""
        for box in self._boxes.values():
            if (
                now_s >= self._until_s
                and not box.stopped
                and (not box.under_way or now_s >= box.given_up(self._until_s))
            ):
                box.stopped = True
                await box.server.stop()

    async def close(self) -> None:
        """Stop all boxes."""
        for box in self._boxes.values():
            await box.server.stop()


class _Box:
    """What stands at the address of one source; it counts the cycles that were read of it."""

    def __init__(self, source: SourceConfig, read: Temperatures) -> None:
        config = source.connection
        if not isinstance(config, ModbusConfig) or config.host is None:
            raise ValueError(f"source {source.name}: only Modbus over TCP can be simulated, and `host` must be given")
        self._period_s = source.cycle_period_s
        self._requests: tuple[ModbusRequest, ...] = config.requests
        self._asked = 0
        self.cycles = 0
        self.stopped = False
        self.server = ModbusTcpBox(
            self._counted(registers_with(config, read)), port=config.port, rtu=config.is_rtu, way=self._way
        )

    @property
    def under_way(self) -> bool:
        """Some requests of a cycle have been answered, and some have not."""
        return self._asked > 0

    def given_up(self, until_s: float) -> float:
        """Return when a cycle that was begun is not waited for any more [s]."""
        return until_s + self._period_s

    def _counted(self, contents: Contents) -> Contents:
        def counted(unit: int, table: Table, start: int, count: int) -> Sequence[int] | None:
            places = [
                place for place, r in enumerate(self._requests) if (r.unit_id, r.table, r.start) == (unit, table, start)
            ]
            if places:
                self._asked = places[0] + 1
            return contents(unit, table, start, count)

        return counted

    def _way(self, answer: bytes, send: Send) -> None:
        send(answer)
        if self._asked == len(self._requests):
            self._asked = 0
            self.cycles += 1


def registers_with(config: ModbusConfig, read: Temperatures) -> Contents:
    """Return the registers of boxes whose sensors measure what `read` says."""
    found = {
        (config.unit_of(sensor), sensor.table, sensor.address + word): (sensor, word)
        for sensor in config.sensors
        for word in range(sensor.width)
    }

    def contents(unit: int, table: Table, start: int, count: int) -> Sequence[int] | None:
        here = [found.get((unit, table, address)) for address in range(start, start + count)]
        sensors = [each[0] for each in here if each is not None]
        if not sensors:
            return None
        degc = dict(zip((s.id for s in sensors), read([s.id for s in sensors]), strict=True))
        return [0 if at is None else registers_of(at[0].number(degc[at[0].id]), at[0])[at[1]] for at in here]

    return contents
