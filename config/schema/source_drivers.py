"""An entry of `temperatures.sources`: its name, its period, its driver and the section that this driver reads."""

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from config.schema.base import Name, Seconds, SectionOfDriver
from config.schema.modbus import ModbusConfig
from config.schema.source_sections import CsvConfig, KernelConfig, MqttConfig, OpcUaTagsConfig, ProcessConfig
from config.schema.sources import Measured, SourceConnection, SourceSensorConfig


class SourceEntry(SectionOfDriver):
    """What every source has: of temperatures, or of displacements."""

    name: Name = Field(description="name of the source in logs, history and commands", examples=["pt100"])
    driver: Literal["modbus", "csv", "kernel", "process", "mqtt", "opcua"] = Field(
        description="how it is read; the section of that name says where", examples=["modbus"]
    )
    cycle_period_s: Seconds = Field(10.0, description="time from one reading of all that it measures to the next")

    @property
    def connection(self) -> SourceConnection:
        section = getattr(self, self.driver)
        assert isinstance(section, SourceConnection)
        return section

    @property
    def inputs(self) -> Sequence[Measured]:
        return self.connection.every_input


class SourceConfig(SourceEntry):
    """One source of temperatures beside the LATSIS lines."""

    modbus: ModbusConfig | None = Field(
        None, description="boxes that answer Modbus TCP or RTU", examples=[{"host": "192.168.10.30"}]
    )
    csv: CsvConfig | None = Field(None, description="files of a logger, followed as they grow")
    kernel: KernelConfig | None = Field(None, description="sensors of this computer's kernel: 1-Wire, hwmon, IIO")
    process: ProcessConfig | None = Field(None, description="a program that writes JSON lines")
    mqtt: MqttConfig | None = Field(None, description="a broker to which devices publish")
    opcua: OpcUaTagsConfig | None = Field(None, description="tags of an OPC UA server")

    @property
    def sensors(self) -> tuple[SourceSensorConfig, ...]:
        return tuple(self.connection.every_input)

    @property
    def sensor_ids(self) -> tuple[int, ...]:
        """Sensor IDs in the order of its cycles."""
        return tuple(sensor.id for sensor in self.sensors)
