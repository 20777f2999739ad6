"""Sections of the temperature sources that need little: a logger's files, the kernel's sensors, a program's lines."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field, model_validator

from config.schema.base import KeyPath, KeyProblems, Seconds
from config.schema.logger_file import LoggerFileConfig
from config.schema.sources import SourceConnection, SourceSensorConfig


class CsvSensorConfig(SourceSensorConfig):
    """One sensor in one column of a logger's files."""

    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])


class CsvConfig(SourceConnection):
    """The CSV files that a logger writes, followed as they grow."""

    driver: ClassVar[str] = "csv"

    file: LoggerFileConfig = Field(
        description="the files; with `time_columns: []` a row counts from when it is read, which is right only where "
        "the logger writes every row at once"
    )
    sensors: list[CsvSensorConfig] = Field(
        min_length=1,
        description="the sensors and their columns",
        examples=[[{"id": 411, "component": "Spindle unit"}]],
    )

    @model_validator(mode="after")
    def _columns(self) -> Self:
        found = self.file.column_problems([sensor.column for sensor in self.sensors])
        if found:
            raise KeyProblems([(("sensors", index, "column"), sentence) for index, sentence in found])
        return self

    @property
    def every_sensor(self) -> Sequence[CsvSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors


POWER_UP_MILLIDEGC = 85000
"""What a DS18B20 holds after power-up, before its first conversion: no temperature."""


class KernelSensorConfig(SourceSensorConfig):
    """One sensor in one file of the kernel."""

    path: Path = Field(
        description="file that holds its number: .../w1_bus_master1/28-.../temperature (1-Wire), "
        ".../hwmon1/temp1_input, .../iio:device0/in_temp_input; thousandths of a degree",
        examples=["/sys/bus/w1/devices/28-0316a2796fff/temperature"],
    )
    scale: float = Field(0.001, description="the number read is multiplied by this; the kernel counts thousandths")

    @property
    def is_one_wire(self) -> bool:
        """Whether it hangs on a 1-Wire bus, by its folder's name."""
        return self.path.parent.name[:3] in {"10-", "22-", "28-", "3b-", "42-"}

    def is_open(self, number: float) -> bool:
        """Return whether a number as read is no temperature; 85.000 degC is how a 1-Wire sensor powers up."""
        return (self.is_one_wire and number == POWER_UP_MILLIDEGC) or super().is_open(number)


class KernelConfig(SourceConnection):
    """Sensors that the kernel of this computer reads: 1-Wire, hwmon, IIO."""

    driver: ClassVar[str] = "kernel"

    timeout_s: Seconds = Field(5.0, description="a sensor that takes longer is not waited for")
    sensors: list[KernelSensorConfig] = Field(
        min_length=1, description="the sensors and their files", examples=[[{"id": 421, "component": "Column"}]]
    )

    @model_validator(mode="after")
    def _once(self) -> Self:
        paths = [sensor.path for sensor in self.sensors]
        problems: list[tuple[KeyPath, str]] = [
            (("sensors", index, "path"), f"two sensors read {path}")
            for index, path in enumerate(paths)
            if path in paths[:index]
        ]
        if problems:
            raise KeyProblems(problems)
        return self

    @property
    def every_sensor(self) -> Sequence[KernelSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors


class FieldSensorConfig(SourceSensorConfig):
    """One sensor in one field of what a program writes."""

    field: str = Field(
        min_length=1, description="key of its number in the JSON object; `a.b` is b within a", examples=["t1"]
    )


class ProcessConfig(SourceConnection):
    """A program that the daemon starts, and that writes a JSON object with its sensors' numbers on each line."""

    driver: ClassVar[str] = "process"

    command: list[str] = Field(
        min_length=1,
        description='program and arguments, without a shell; it writes lines such as {"t1": 21.5, "t2": 22.0}',
        examples=[["/usr/local/bin/read-my-logger", "--json"]],
    )
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")
    sensors: list[FieldSensorConfig] = Field(
        min_length=1, description="the sensors and their fields", examples=[[{"id": 431, "component": "Bed"}]]
    )

    @property
    def every_sensor(self) -> Sequence[FieldSensorConfig]:
        """The sensors, in the order of the section."""
        return self.sensors
