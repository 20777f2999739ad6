"""An entry of `displacements.sources`: channels that come over the wires that temperatures come over."""

import math
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from config.schema.base import ChannelName, KeyPath, KeyProblems, Name
from config.schema.modbus import ModbusRegister, ModbusWire
from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import (
    CsvColumn,
    CsvFiles,
    KernelFile,
    KernelFiles,
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

    @model_validator(mode="after")
    def _readable(self) -> Self:
        problems: list[tuple[KeyPath, str]] = []
        if self.scale == 0:
            problems.append((("scale",), "must not be 0, or the channel is always the same"))
        if self.min_um is not None and self.max_um is not None and self.min_um >= self.max_um:
            problems.append((("min_um",), "min_um must be below max_um"))
        if problems:
            raise KeyProblems(problems)
        return self

    @property
    def key(self) -> str:
        """Its name."""
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
        """Return whether a number as read says that nothing is measured."""
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
        """The channels, in the order of the section."""
        return tuple(self.connection.every_input)
