"""The sources of a simulated machine whose sensors do not hang on LATSIS lines."""

import math
from collections.abc import Callable, Sequence
from typing import Literal, Protocol

from config.schema.modbus import ModbusConfig, ModbusRequest
from config.schema.source_drivers import SourceConfig
from config.schema.source_sections import CsvConfig, MqttConfig, ProcessConfig
from config.schema.sources import SourceSensorConfig
from config.schema.temperatures import SensorConfig, TemperaturesConfig
from drivers.sim.contract import SimulatedMachine
from drivers.sim.wires.modbus_box import Contents, ModbusTcpBox, Send, Table, registers_of
from drivers.sim.wires.pushed_wires import CsvFace, LinesFace, MqttFace, Temperatures, can_be_pushed

UtcOf = Callable[[float], float]
"""Simulated time [s] -> UTC [s since 1970]."""

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


class Face(Protocol):
    """What stands for one source; it counts the cycles that it has brought."""

    cycles: int
    stopped: bool

    async def open(self) -> None:
        """Be there for the daemon."""

    async def step(self, now_s: float, until_s: float) -> None:
        """Do what is due at a simulated time [s]; from `until_s` on no cycle begins."""

    async def close(self) -> None:
        """Be gone. May be called more than once."""


def face_of(source: SourceConfig, read: Temperatures, utc_of: UtcOf = float) -> Face:
    """Return what stands for a source; raises ValueError for one that cannot be simulated."""
    if not can_be_pushed(source.sensors):
        raise ValueError(f"source {source.name}: one field of a message cannot be a number and hold others")
    if isinstance(source.connection, MqttConfig):
        return MqttFace(source, read)
    if isinstance(source.connection, CsvConfig):
        return CsvFace(source, read, utc_of)
    if isinstance(source.connection, ProcessConfig):
        return LinesFace(source, read)
    return _Box(source, read)


class SourceWires:
    """All sources of one machine. From `until_s` on no cycle begins."""

    def __init__(
        self, sources: Sequence[SourceConfig], read: Temperatures, *, until_s: float = math.inf, utc_of: UtcOf = float
    ) -> None:
        """Prepare; `utc_of` gives the UTC of a simulated time [s]. Raises ValueError."""
        self._faces = {source.name: face_of(source, read, utc_of) for source in sources}
        self._until_s = until_s

    @property
    def cycles_sent(self) -> dict[str, int]:
        """Cycles that went out whole, by source."""
        return {name: face.cycles for name, face in self._faces.items()}

    @property
    def idle(self) -> bool:
        return all(face.stopped for face in self._faces.values())

    async def open(self) -> None:
        for face in self._faces.values():
            await face.open()

    async def step(self, now_s: float) -> None:
        """Send what is due at a simulated time [s], and stop what has come to the end of its last cycle."""
        for face in self._faces.values():
            await face.step(now_s, self._until_s)

    async def close(self) -> None:
        for face in self._faces.values():
            await face.close()


class _Box:
    """What stands at the address of one source; it counts the cycles that were read of it."""

    def __init__(self, source: SourceConfig, read: Temperatures) -> None:
        config = source.connection
        if not isinstance(config, ModbusConfig) or config.host is None:
            raise ValueError(
                f"source {source.name}: driver {source.driver} cannot be simulated, nor Modbus without `host`"
            )
        self._period_s = source.cycle_period_s
        self._requests: tuple[ModbusRequest, ...] = config.requests
        self._asked = 0
        self.cycles = 0
        self.stopped = False
        self._server = ModbusTcpBox(
            self._counted(registers_with(config, read)), port=config.port, rtu=config.is_rtu, way=self._way
        )

    async def open(self) -> None:
        await self._server.start()

    async def step(self, now_s: float, until_s: float) -> None:
        """Stop at the end of the last cycle; one that was begun is waited for during a period."""
        under_way = self._asked > 0 and now_s < until_s + self._period_s
        if now_s >= until_s and not self.stopped and not under_way:
            self.stopped = True
            await self._server.stop()

    async def close(self) -> None:
        """Answer nobody any more."""
        await self._server.stop()

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
