"""Displacement files of the A/D logger."""

from datetime import datetime
from typing import ClassVar

from pydantic import Field, model_validator

from config.schema.base import ChannelName, KeyPath, KeyProblems, Seconds, Section
from config.schema.logger_file import LoggerFileConfig


class DisplacementChannelConfig(Section):
    """One displacement channel."""

    name: ChannelName = Field(description="name of the channel in history and models", examples=["Z1"])
    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])
    scale_um: float = Field(1.0, description="micrometres per unit of the file, with sign [um]")

    @model_validator(mode="after")
    def _sensible(self) -> "DisplacementChannelConfig":
        if self.scale_um == 0:
            raise KeyProblems([(("scale_um",), "must not be 0, or the channel is always 0")])
        return self


class DisplacementFileConfig(LoggerFileConfig):
    """The CSV files that the A/D logger writes."""

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

    driver: ClassVar[str] = "file"
    """Which driver reads them (`drivers/registry.py`)."""

    file: DisplacementFileConfig = Field(description="the logger's file")
    channels: list[DisplacementChannelConfig] = Field(min_length=1, description="the channels")

    @model_validator(mode="after")
    def _unique(self) -> "DisplacementsConfig":
        problems: list[tuple[KeyPath, str]] = []
        names = [channel.name for channel in self.channels]
        columns = [channel.column for channel in self.channels]
        for index, channel in enumerate(self.channels):
            if channel.name in names[:index]:
                problems.append((("channels", index, "name"), f"two channels have the same name {channel.name!r}"))
        problems += [(("channels", i, "column"), sentence) for i, sentence in self.file.column_problems(columns)]
        if problems:
            raise KeyProblems(problems)
        return self
