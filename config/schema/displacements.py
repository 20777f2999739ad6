"""Displacements: the files of the A/D logger, and other sources."""

import math
from collections.abc import Collection, Sequence
from datetime import datetime
from functools import cached_property
from typing import ClassVar, Literal

from pydantic import Field

from config.schema.base import ChannelName, KeyPath, Name, Problems, Seconds, Section, checked, repeated
from config.schema.modbus import ModbusRegister, ModbusWire
from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import (
    CsvColumn,
    CsvFiles,
    KernelFile,
    KernelFiles,
    LoggerFileConfig,
    MqttBroker,
    MqttTopic,
    OpcUaServer,
    OpcUaTag,
    Program,
    ProgramField,
)
from config.schema.sources import Measured

UM_PER = {"um": 1.0, "mm": 1000.0}


class SourceChannelConfig(Measured):
    """One displacement channel of a source: what it is called, and how its number becomes micrometres."""

    name: ChannelName = Field(description="name of the channel in history and models", examples=["Z1"])
    axis: Name | None = Field(
        None,
        description="axis whose error it measures, to compare it with the estimate; left out: the axis whose "
        "`estimate` has its name",
        examples=["z"],
    )
    unit: Literal["um", "mm"] = Field("um", description="unit of the number after scale and offset")
    scale: float = Field(1.0, description="the number read is multiplied by this, with sign")
    offset: float = Field(0.0, description="then this is added, in the unit")
    open: list[float] = Field(
        default_factory=list, description="numbers as read that say that the probe is open, absent or out of its range"
    )
    min_um: float | None = Field(
        None, description="lower values are impossible for this channel; left out: none is too low", examples=[-500.0]
    )
    max_um: float | None = Field(
        None, description="higher values are impossible for this channel; left out: none is too high", examples=[500.0]
    )

    unit_words: ClassVar[str] = "um"

    @checked
    def _readable(self) -> Problems:
        if self.scale == 0:
            yield ("scale",), "must not be 0, or the channel is always the same"
        if self.min_um is not None and self.max_um is not None and self.min_um >= self.max_um:
            yield ("min_um",), "min_um must be below max_um"

    @property
    def key(self) -> str:
        return self.name

    @property
    def in_words(self) -> str:
        """Its name, for a sentence."""
        return f"channel {self.name}"

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest possible displacement [um]."""
        return (-math.inf if self.min_um is None else self.min_um, math.inf if self.max_um is None else self.max_um)

    def is_open(self, number: float) -> bool:
        return number in self.open

    def value(self, number: float) -> float:
        """Return the displacement of a number as read [um]."""
        return (number * self.scale + self.offset) * UM_PER[self.unit]

    def number(self, value: float) -> float:
        """Return what is read at a displacement [um]; NaN at one that is none."""
        return (value / UM_PER[self.unit] - self.offset) / self.scale if math.isfinite(value) else math.nan


class ModbusChannelConfig(ModbusRegister, SourceChannelConfig):
    """One channel in one or two registers of a box."""


class ModbusChannels(ModbusWire):
    """Boxes whose registers hold displacements."""

    listed: ClassVar[str] = "channels"
    channels: list[ModbusChannelConfig] = Field(
        min_length=1, description="the channels and their registers", examples=[[{"name": "Z4", "scale": 0.1}]]
    )


class CsvChannelConfig(CsvColumn, SourceChannelConfig):
    """One channel in one column of a logger's files."""


class CsvChannels(CsvFiles):
    """The files of a logger of displacements."""

    listed: ClassVar[str] = "channels"
    channels: list[CsvChannelConfig] = Field(
        min_length=1, description="the channels and their columns", examples=[[{"name": "Z5"}]]
    )


class KernelChannelConfig(KernelFile, SourceChannelConfig):
    """One channel in one file of the kernel, such as an analog input of IIO."""


class KernelChannels(KernelFiles):
    """Analog inputs of the kernel."""

    listed: ClassVar[str] = "channels"
    channels: list[KernelChannelConfig] = Field(
        min_length=1, description="the channels and their files", examples=[[{"name": "Z6"}]]
    )


class FieldChannelConfig(ProgramField, SourceChannelConfig):
    """One channel in one field of what a program writes."""


class ProcessChannels(Program):
    """A program that writes displacements."""

    listed: ClassVar[str] = "channels"
    channels: list[FieldChannelConfig] = Field(
        min_length=1, description="the channels and their fields", examples=[[{"name": "Z7"}]]
    )


class MqttChannelConfig(MqttTopic, SourceChannelConfig):
    """One channel in the messages of one topic."""


class MqttChannels(MqttBroker):
    """A broker to which devices publish displacements."""

    listed: ClassVar[str] = "channels"
    channels: list[MqttChannelConfig] = Field(
        min_length=1, description="the channels and their topics", examples=[[{"name": "Z8"}]]
    )


class OpcUaTagChannelConfig(OpcUaTag, SourceChannelConfig):
    """One channel in one tag."""


class OpcUaTagsChannels(OpcUaServer):
    """A server whose tags hold displacements."""

    listed: ClassVar[str] = "channels"
    channels: list[OpcUaTagChannelConfig] = Field(
        min_length=1, description="the channels and their tags", examples=[[{"name": "Z9"}]]
    )


class DisplacementSourceConfig(SourceEntry):
    """One source of displacements beside the A/D logger's files."""

    modbus: ModbusChannels | None = Field(None, description="boxes that answer Modbus TCP or RTU")
    csv: CsvChannels | None = Field(None, description="files of another logger, followed as they grow")
    kernel: KernelChannels | None = Field(None, description="analog inputs of this computer's kernel: IIO, hwmon")
    process: ProcessChannels | None = Field(None, description="a program that writes JSON lines")
    mqtt: MqttChannels | None = Field(None, description="a broker to which devices publish")
    opcua: OpcUaTagsChannels | None = Field(None, description="tags of an OPC UA server")

    @property
    def channels(self) -> tuple[SourceChannelConfig, ...]:
        return tuple(self.connection.every_input)


class DisplacementChannelConfig(Section):
    """One displacement channel."""

    name: ChannelName = Field(description="name of the channel in history and models", examples=["Z1"])
    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])
    axis: Name | None = Field(
        None,
        description="axis whose error it measures; left out: the axis whose `estimate` has its name",
        examples=["z"],
    )
    scale_um: float = Field(1.0, description="micrometres per unit of the file, with sign [um]")

    @checked
    def _sensible(self) -> Problems:
        if self.scale_um == 0:
            yield ("scale_um",), "must not be 0, or the channel is always 0"


class DisplacementFileConfig(LoggerFileConfig):
    """The CSV files that the A/D logger writes."""

    driver: ClassVar[str] = "file"
    """Which driver reads them (`drivers/registry.py`)."""
    name: ClassVar[str] = "displacement files"
    """What the link is called."""

    start: str | None = Field(
        None,
        description="ISO 8601 time of the first row, for files without time columns; needs interval_s",
        examples=["2026-01-31T08:00:00"],
    )
    interval_s: Seconds | None = Field(
        None, description="time between rows, for files without time columns", examples=[60.0]
    )

    @checked
    def _start_and_interval(self) -> Problems:
        if (self.start is None) != (self.interval_s is None):
            key = "start" if self.interval_s is None else "interval_s"
            yield (key,), "start and interval_s go together"
        elif self.start is None and not self.time_columns:
            yield ("time_columns",), "give time_columns, or start and interval_s"
        elif self.start is not None:
            try:
                datetime.fromisoformat(self.start)
            except ValueError:
                sentence = f"{self.start!r} is no ISO 8601 time such as 2026-01-31T08:00:00"
                yield ("start",), sentence


class DisplacementsConfig(Section):
    """Displacement sensors for evaluation and training; compensation never needs them."""

    file: DisplacementFileConfig | None = Field(None, description="the A/D logger's file", examples=[{}])
    channels: list[DisplacementChannelConfig] = Field(
        default_factory=list[DisplacementChannelConfig], description="the channels of that file", examples=[[{}]]
    )
    sources: list[DisplacementSourceConfig] | None = Field(
        None,
        description="other sources with their own channels, beside that file or instead of it",
        examples=[[{"name": "gauges", "driver": "modbus", "modbus": {"host": "192.168.10.31"}}]],
    )

    @checked
    def _unique(self) -> Problems:
        if self.file is None and not self.sources and not self.channels:
            sentence = "there is nothing to read: describe the logger's file here, or another source under `sources`"
            yield ("file",), sentence
        if (self.file is None) != (not self.channels):
            key = "file" if self.file is None else "channels"
            yield (key,), "file and channels go together"
        elif self.file is not None:
            yield from self.file.column_problems("channels", [channel.column for channel in self.channels])
        for place, name in repeated(channel.name for channel in self.every_channel):
            yield (*self.placed_channels[place][0], "name"), f"two channels have the same name {name!r}"
        for place, name in repeated(source.name for source in self.sources or ()):
            yield ("sources", place, "name"), f"two sources have the same name {name!r}"

    @property
    def placed_channels(self) -> Sequence[tuple[KeyPath, DisplacementChannelConfig | SourceChannelConfig]]:
        """Every channel, and where it stands in this section."""
        return [
            *((("channels", i), channel) for i, channel in enumerate(self.channels)),
            *(
                (("sources", at, source.driver, "channels", i), channel)
                for at, source in enumerate(self.sources or ())
                for i, channel in enumerate(source.channels)
            ),
        ]

    @cached_property
    def every_channel(self) -> tuple[DisplacementChannelConfig | SourceChannelConfig, ...]:
        """The channels of the file and of the sources: the order of a row."""
        return tuple(channel for _, channel in self.placed_channels)

    @property
    def reads(self) -> dict[str, str]:
        """What each channel reads, with scale, sign and axis."""
        known = {"open", "min_um", "max_um"}
        channels = self.every_channel
        return {f"displacement {c.name}": c.model_dump_json(exclude=known, exclude_defaults=True) for c in channels}

    @property
    def inputs(self) -> "tuple[DisplacementFileConfig | DisplacementSourceConfig, ...]":
        """The file and the sources: each brings rows."""
        return (*(() if self.file is None else (self.file,)), *(self.sources or ()))

    def with_channels(self, names: Collection[str]) -> "tuple[DisplacementFileConfig | DisplacementSourceConfig, ...]":
        """Return those of the inputs that bring one of these channels."""
        return tuple(
            each
            for each in self.inputs
            if any(
                channel.name in names
                for channel in (each.channels if isinstance(each, DisplacementSourceConfig) else self.channels)
            )
        )

    @property
    def longest_period_s(self) -> float:
        """Time after which each of them has been looked at again [s]."""
        return max(
            each.cycle_period_s if isinstance(each, DisplacementSourceConfig) else each.poll_period_s
            for each in self.inputs
        )
