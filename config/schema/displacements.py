"""Displacement files of the A/D logger."""

from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar, Literal
from zoneinfo import ZoneInfo

from pydantic import Field, model_validator

from config.schema.base import ChannelName, KeyPath, KeyProblems, Seconds, Section


class DisplacementChannelConfig(Section):
    """One displacement channel."""

    name: ChannelName = Field(description="name of the channel in history and models", examples=["Z1"])
    column: str | int = Field(description="header text of its column, or the column's number from 1", examples=[2])
    scale_um: float = Field(1.0, description="micrometres per unit of the file, with sign [um]")

    @model_validator(mode="after")
    def _sensible(self) -> "DisplacementChannelConfig":
        if self.scale_um == 0:
            raise KeyProblems([(("scale_um",), "must not be 0, or the channel is always 0")])
        if isinstance(self.column, int) and self.column < 1:
            raise KeyProblems([(("column",), "columns count from 1")])
        return self


class DisplacementFileConfig(Section):
    """The CSV files that the logger writes."""

    path: Path = Field(
        description="the file, or a pattern such as /srv/logger/*.csv (the newest is followed)",
        examples=["/srv/logger/*.csv"],
    )
    encoding: Literal["utf-8", "utf-8-sig", "cp932", "latin-1"] = Field("utf-8-sig", description="text encoding")
    delimiter: Literal[",", ";", "\t"] = Field(",", description="between fields")
    decimal: Literal[".", ","] = Field(".", description="decimal mark")
    header: str | None = Field(
        None,
        description="text that the header row starts with; rows before it are a metadata block. "
        "None: there is no header, and columns are given by number",
        examples=["time"],
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
        None,
        description="ISO 8601 time of the first row, for files without time columns; needs interval_s",
        examples=["2026-01-31T08:00:00"],
    )
    interval_s: Seconds | None = Field(
        None, description="time between rows, for files without time columns", examples=[60.0]
    )
    overflow_tokens: list[str] = Field(
        default_factory=lambda: ["+OVER", "-OVER", "OVER", "+FFFF", "-FFFF", "----"],
        description="texts that the logger writes in place of a value",
    )
    poll_period_s: Seconds = Field(5.0, description="time between looks at size and time of the file")
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")

    @model_validator(mode="after")
    def _time_source(self) -> "DisplacementFileConfig":
        if (self.start is None) != (self.interval_s is None):
            key = "start" if self.interval_s is None else "interval_s"
            raise KeyProblems([((key,), "start and interval_s go together")])
        problems: list[tuple[KeyPath, str]] = []
        if self.start is None and not self.time_columns:
            problems.append((("time_columns",), "give time_columns, or start and interval_s"))
        if self.delimiter == self.decimal:
            problems.append((("decimal",), "delimiter and decimal mark are the same character"))
        problems += [((key,), sentence) for key, sentence in self._time_problems()]
        if problems:
            raise KeyProblems(problems)
        return self

    def _time_problems(self) -> list[tuple[str, str]]:
        """Return what is wrong with zone, start and format of the time stamps."""
        problems: list[tuple[str, str]] = []
        if self.time_zone != "UTC":
            try:
                ZoneInfo(self.time_zone)
            except (KeyError, ValueError, OSError):
                sentence = f"there is no time zone {self.time_zone!r} on this computer; write one such as Asia/Tokyo"
                problems.append(("time_zone", sentence))
        if self.start is not None:
            try:
                datetime.fromisoformat(self.start)
            except ValueError:
                problems.append(("start", f"{self.start!r} is no ISO 8601 time such as 2026-01-31T08:00:00"))
        if self.time_format != "%s" and self.start is None:
            moment = datetime(2026, 1, 31, 8, 15, 30, tzinfo=UTC)
            try:
                datetime.strptime(moment.strftime(self.time_format), self.time_format)
            except ValueError as error:
                problems.append(("time_format", f"{self.time_format!r} is no strptime format: {error}"))
        return problems


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
            if channel.column in columns[:index]:
                problems.append((("channels", index, "column"), f"two channels read the column {channel.column!r}"))
            if self.file.header is None and isinstance(channel.column, str):
                sentence = "without file.header, columns must be given by number (from 1)"
                problems.append((("channels", index, "column"), sentence))
        if self.file.header is None and any(isinstance(column, str) for column in self.file.time_columns):
            problems.append((("file", "time_columns"), "without file.header, columns must be given by number (from 1)"))
        if problems:
            raise KeyProblems(problems)
        return self
