"""Displacements: the files of the A/D logger, and other sources."""

from collections.abc import Collection, Sequence
from datetime import datetime
from functools import cached_property
from typing import ClassVar

from pydantic import Field, model_validator

from config.schema.base import ChannelName, KeyPath, KeyProblems, Name, Seconds, Section
from config.schema.displacement_sources import DisplacementSourceConfig, SourceChannelConfig
from config.schema.logger_file import LoggerFileConfig


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

    @model_validator(mode="after")
    def _sensible(self) -> "DisplacementChannelConfig":
        if self.scale_um == 0:
            raise KeyProblems([(("scale_um",), "must not be 0, or the channel is always 0")])
        return self


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

    @model_validator(mode="after")
    def _start_and_interval(self) -> "DisplacementFileConfig":
        if (self.start is None) != (self.interval_s is None):
            key = "start" if self.interval_s is None else "interval_s"
            raise KeyProblems([((key,), "start and interval_s go together")])
        if self.start is None and not self.time_columns:
            raise KeyProblems([(("time_columns",), "give time_columns, or start and interval_s")])
        if self.start is not None:
            try:
                datetime.fromisoformat(self.start)
            except ValueError:
                sentence = f"{self.start!r} is no ISO 8601 time such as 2026-01-31T08:00:00"
                raise KeyProblems([(("start",), sentence)]) from None
        return self


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

    @model_validator(mode="after")
    def _unique(self) -> "DisplacementsConfig":
        problems: list[tuple[KeyPath, str]] = []
        if self.file is None and not self.sources and not self.channels:
            sentence = "there is nothing to read: describe the logger's file here, or another source under `sources`"
            problems.append((("file",), sentence))
        if (self.file is None) != (not self.channels):
            key = "file" if self.file is None else "channels"
            problems.append(((key,), "file and channels go together"))
        elif self.file is not None:
            columns = [channel.column for channel in self.channels]
            problems += [(("channels", i, "column"), sentence) for i, sentence in self.file.column_problems(columns)]
        seen: set[str] = set()
        for at, channel in self.placed_channels:
            if channel.name in seen:
                problems.append(((*at, "name"), f"two channels have the same name {channel.name!r}"))
            seen.add(channel.name)
        names = [source.name for source in self.sources or ()]
        problems += [
            (("sources", i, "name"), f"two sources have the same name {name!r}")
            for i, name in enumerate(names)
            if name in names[:i]
        ]
        if problems:
            raise KeyProblems(problems)
        return self

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
