"""Displacement files of the A/D logger."""

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from config.schema.base import Name, Seconds, Section


class DisplacementChannelConfig(Section):
    """One displacement channel."""

    name: Name = Field(description="name of the channel in history and models")
    column: str | int = Field(description="header text of its column, or the column's number from 1")
    scale_um: float = Field(1.0, description="micrometres per unit of the file, with sign [um]")


class DisplacementFileConfig(Section):
    """The CSV files that the logger writes."""

    path: Path = Field(description="the file, or a pattern such as /srv/nr500/*.csv (the newest is followed)")
    encoding: Literal["utf-8", "utf-8-sig", "cp932", "latin-1"] = Field("utf-8-sig", description="text encoding")
    delimiter: Literal[",", ";", "\t"] = Field(",", description="between fields")
    decimal: Literal[".", ","] = Field(".", description="decimal mark")
    header: str | None = Field(
        None,
        description="text that the header row starts with; rows before it are a metadata block. "
        "None: there is no header, and columns are given by number",
    )
    unit_row: bool = Field(False, description="the row after the header holds units")
    time_columns: list[str | int] = Field(
        default_factory=lambda: list[str | int]([1]), description="column, or date and time columns, of the time stamp"
    )
    time_format: str = Field(
        "%Y-%m-%dT%H:%M:%S",
        description="strptime format of the joined time columns (joined by one blank); %s: seconds since 1970",
    )
    time_zone: str = Field("UTC", description="IANA name of the zone of the logger's time stamps")
    start: str | None = Field(
        None, description="ISO 8601 time of the first row, for files without time columns; needs interval_s"
    )
    interval_s: Seconds | None = Field(None, description="time between rows, for files without time columns")
    overflow_tokens: list[str] = Field(
        default_factory=lambda: ["+OVER", "-OVER", "OVER", "+FFFF", "-FFFF", "----"],
        description="texts that the logger writes in place of a value",
    )
    poll_period_s: Seconds = Field(5.0, description="time between looks at size and time of the file")
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")

    @model_validator(mode="after")
    def _time_source(self) -> "DisplacementFileConfig":
        if (self.start is None) != (self.interval_s is None):
            raise ValueError("start and interval_s go together")
        return self


class DisplacementsConfig(Section):
    """Displacement sensors for evaluation and training; compensation never needs them."""

    file: DisplacementFileConfig = Field(description="the logger's file")
    channels: list[DisplacementChannelConfig] = Field(min_length=1, description="the channels")

    @model_validator(mode="after")
    def _unique(self) -> "DisplacementsConfig":
        names = [channel.name for channel in self.channels]
        if len(set(names)) != len(names):
            raise ValueError("two displacement channels have the same name")
        return self
