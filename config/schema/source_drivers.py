"""An entry of `temperatures.sources`: its name, its period, its driver and the section that this driver reads."""

from typing import Literal, Self

from pydantic import ConfigDict, Field, model_validator

from config.schema.base import KeyPath, KeyProblems, Name, Seconds, Section
from config.schema.cnc_drivers import drivers_of, section_of_driver
from config.schema.modbus import ModbusConfig
from config.schema.source_sections import CsvConfig, KernelConfig, MqttConfig, OpcUaTagsConfig, ProcessConfig
from config.schema.sources import SourceConnection, SourceSensorConfig


class SourceConfig(Section):
    """One source of temperatures beside the LATSIS lines."""

    model_config = ConfigDict(json_schema_extra=section_of_driver)

    name: Name = Field(description="name of the source in logs, history and commands", examples=["pt100"])
    driver: Literal["modbus", "csv", "kernel", "process", "mqtt", "opcua"] = Field(
        description="how it is read; the section of that name says where", examples=["modbus"]
    )
    cycle_period_s: Seconds = Field(10.0, description="time from one cycle of its sensors to the next")
    modbus: ModbusConfig | None = Field(
        None, description="boxes that answer Modbus TCP or RTU", examples=[{"host": "192.168.10.30"}]
    )
    csv: CsvConfig | None = Field(None, description="files of a logger, followed as they grow")
    kernel: KernelConfig | None = Field(None, description="sensors of this computer's kernel: 1-Wire, hwmon, IIO")
    process: ProcessConfig | None = Field(None, description="a program that writes JSON lines")
    mqtt: MqttConfig | None = Field(None, description="a broker to which devices publish")
    opcua: OpcUaTagsConfig | None = Field(None, description="tags of an OPC UA server")

    @model_validator(mode="after")
    def _only_the_section_of_the_driver(self) -> Self:
        problems: list[tuple[KeyPath, str]] = []
        for driver in drivers_of(type(self)):
            given = getattr(self, driver) is not None
            if driver == self.driver and not given:
                description = type(self).model_fields[driver].description
                problems.append(((driver,), f"this key is required and missing: {description}"))
            elif driver != self.driver and given:
                sentence = f"this section is for driver {driver}, but driver is {self.driver}: keep one of the two"
                problems.append(((driver,), sentence))
        if problems:
            raise KeyProblems(problems)
        return self

    @property
    def connection(self) -> SourceConnection:
        """The section of the driver."""
        section = getattr(self, self.driver)
        assert isinstance(section, SourceConnection)
        return section

    @property
    def sensors(self) -> tuple[SourceSensorConfig, ...]:
        """The sensors, in the order of the section."""
        return tuple(self.connection.every_sensor)

    @property
    def sensor_ids(self) -> tuple[int, ...]:
        """Sensor IDs in the order of its cycles."""
        return tuple(sensor.id for sensor in self.connection.every_sensor)
