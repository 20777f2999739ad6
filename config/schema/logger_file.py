"""CSV files that a logger writes and goes on writing: how they are found, split and dated."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, Self
from zoneinfo import ZoneInfo

from pydantic import Field, model_validator

from config.schema.base import KeyPath, KeyProblems, Seconds, Section


class LoggerFileConfig(Section):
    """The CSV files that a logger writes."""

    path: Path = Field(
        description="the file, or a pattern such as /srv/logger/*.csv (the newest is followed)",
        examples=["/srv/logger/*.csv"],
    )
    encoding: Literal["utf-8", "utf-8-sig", "cp932", "latin-1", "cp1252"] = Field("utf-8-sig", description="encoding")
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
    overflow_tokens: list[str] = Field(
        default_factory=lambda: ["+OVER", "-OVER", "OVER", "+FFFF", "-FFFF", "----"],
        description="texts that the logger writes in place of a value",
    )
    poll_period_s: Seconds = Field(5.0, description="time between looks at size and time of the file")
    max_line_bytes: int = Field(65536, ge=256, description="a longer line is skipped and reported")

    @model_validator(mode="after")
    def _readable(self) -> Self:
        problems: list[tuple[KeyPath, str]] = []
        if self.delimiter == self.decimal:
            problems.append((("decimal",), "delimiter and decimal mark are the same character"))
        if self.header is None and any(isinstance(column, str) for column in self.time_columns):
            problems.append((("time_columns",), "without file.header, columns must be given by number (from 1)"))
        problems += [((key,), sentence) for key, sentence in self._time_problems()]
        if problems:
            raise KeyProblems(problems)
        return self

    def _time_problems(self) -> list[tuple[str, str]]:
        """Return what is wrong with zone and format of the time stamps."""
        problems: list[tuple[str, str]] = []
        if self.time_zone != "UTC":
            try:
                ZoneInfo(self.time_zone)
            except (KeyError, ValueError, OSError):
                sentence = f"there is no time zone {self.time_zone!r} on this computer; write one such as Asia/Tokyo"
                problems.append(("time_zone", sentence))
        if self.time_format != "%s":
            moment = datetime(2026, 1, 31, 8, 15, 30, tzinfo=UTC)
            try:
                datetime.strptime(moment.strftime(self.time_format), self.time_format)
            except ValueError as error:
                problems.append(("time_format", f"{self.time_format!r} is no strptime format: {error}"))
        return problems

    def column_problems(self, columns: list[str | int]) -> list[tuple[int, str]]:
        """Return which columns of values cannot be read, by their places in the list."""
        problems: list[tuple[int, str]] = []
        for index, column in enumerate(columns):
            if column in columns[:index]:
                problems.append((index, f"reads the column {column!r}, which another one reads already"))
            if isinstance(column, int) and column < 1:
                problems.append((index, "columns count from 1"))
            if self.header is None and isinstance(column, str):
                problems.append((index, "without file.header, columns must be given by number (from 1)"))
        return problems
