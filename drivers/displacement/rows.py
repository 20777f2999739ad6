"""Lines of a logger's file -> rows of numbers with their times. No I/O, no clock."""

import csv
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np

from config.schema.displacements import DisplacementChannelConfig, DisplacementFileConfig, DisplacementsConfig
from config.schema.source_sections import LoggerFileConfig
from models.quality import Reason
from models.records import DisplacementSample

QUOTED_CHARACTERS = 40
"""How much of an unreadable field a problem quotes."""
LARGEST_TIME_S = 1e11
"""Milliseconds since 1970 are more; no calendar has them as seconds, and no database takes them."""
LENGTHS_AND_TEMPERATURES = ("um", "mm", "nm", "in", "degC", "degF")
_NUMBER = {
    ".": re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?"),
    ",": re.compile(r"[+-]?([0-9]+,?[0-9]*|,[0-9]+)([eE][+-]?[0-9]+)?"),
}


class UnreadableFileError(Exception):
    """The file's header does not fit the configuration; the text is fit for an operator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedNumbers:
    """Columns of a logger's files that hold something else than displacements."""

    file: LoggerFileConfig
    channels: Sequence[DisplacementChannelConfig]
    owner: str
    """Begins every sentence about the files."""
    units: Sequence[str | None] = ()
    """Unit that each column is read in, None where the configuration converts it; empty: by `scale_um`."""


Logged = DisplacementsConfig | LoggedNumbers


def unit_of_scale(um: float) -> str | None:
    """Return the unit of about so many micrometres; None where it is no usual one."""
    return {0: "um", 3: "mm"}.get(round(math.log10(abs(um))))


def logged_numbers(config: Logged) -> LoggedNumbers:
    """Return the columns of the A/D logger's files, or what was given."""
    if isinstance(config, LoggedNumbers):
        return config
    assert config.file is not None
    return LoggedNumbers(file=config.file, channels=config.channels, owner="displacement file")


def start_of(file: LoggerFileConfig) -> str | None:
    """Return the time of the first row, where rows carry none and follow each other at an interval."""
    return file.start if isinstance(file, DisplacementFileConfig) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """Where in a row to look, counted from 0."""

    time: tuple[int, ...]
    channels: tuple[int, ...]
    count: int
    """Fields that a whole row has at least."""
    titles: int | None = None
    """Fields of the header; None without one."""


class RowReader:
    """Reads the lines of one file from its first on.

    A row is refused whole when its time cannot be read or when it has other fields than the header: its last one may
    be cut, or a mark within numbers may have split them. An unreadable or overflowed field makes only its own NaN.
    """

    def __init__(self, config: Logged, file: str, report: Callable[[str], None], after_s: float = -math.inf) -> None:
        """`after_s`: time of the last row of the file before [s]."""
        config = logged_numbers(config)
        self._file_config = config.file
        self._channels = config.channels
        self._units = config.units or [unit_of_scale(channel.scale_um) for channel in config.channels]
        self._file = file
        self._report = report
        # Without a byte order mark at the beginning utf-8-sig is plain utf-8.
        self._encoding = "utf-8-sig" if config.file.encoding.startswith("utf-8") else config.file.encoding
        self._overflow = frozenset(config.file.overflow_tokens)
        self._number = _NUMBER[config.file.decimal]
        self._clock = _start_clock(config.file) or _stamp_clock(config.file, after_s)
        self._columns = None if config.file.header else self._columns_by_number()
        self._unit_row_due = False
        self.data_rows = 0

    @property
    def has_header(self) -> bool:
        """Whether the header, if the files have one, has been seen."""
        return self._columns is not None

    def read(self, line: bytes, number: int, encoding: str | None = None) -> DisplacementSample | None:
        """Return the sample of a line, counted from 1; None for others and a bad row. Raises UnreadableFileError."""
        text = line.decode(encoding or self._encoding, errors="replace").rstrip("\r\n").lstrip("\ufeff")
        if self._file_config.header and text.lstrip('"').startswith(self._file_config.header.lstrip('"')):
            try:
                self._columns = self._columns_by_header(self._fields(text), number)
            except csv.Error as error:
                raise UnreadableFileError(f"{self._file}:{number}: the header cannot be split: {error}") from error
            self._unit_row_due = self._file_config.unit_row
            return None
        columns = self._columns
        if columns is None or not text.strip():
            return None
        if self._unit_row_due:
            self._unit_row_due = False
            self._require_units(text, number, columns)
            return None
        self.data_rows += 1
        return self._row(text, number, columns)

    def _require_units(self, text: str, number: int, columns: _Columns) -> None:
        """Refuse a file whose row of units says another unit than a column is read in."""
        from config.recordings.column_units import unit_of

        fields = self._fields(text)
        for channel, index, unit in zip(self._channels, columns.channels, self._units, strict=True):
            found = unit_of(fields[index]) if unit is not None and index < len(fields) else None
            if found in LENGTHS_AND_TEMPERATURES and found != unit:
                raise UnreadableFileError(
                    f"{self._file}:{number}:{index + 1}: the row of units says {fields[index]} where {channel.name} is "
                    f"read in {unit}: correct its unit or scale in the configuration; where the row is wrong, "
                    "`unit_row: false` skips it unread"
                )

    def _row(self, text: str, number: int, columns: _Columns) -> DisplacementSample | None:
        place = f"{self._file}:{number}"
        try:
            fields = self._fields(text)
        except csv.Error as error:
            self._report(f"{place}:1: this row cannot be split into fields ({error}); it is skipped")
            return None
        if len(fields) < columns.count:
            self._report(
                f"{place}:{len(fields)}: this row has {len(fields)} fields where {columns.count} are expected; "
                "it may have been cut off and is skipped"
            )
            return None
        if columns.titles is not None and any(fields[columns.titles :]):
            self._report(
                f"{place}:{columns.titles + 1}: this row has {len(fields)} fields, the header {columns.titles}: "
                "correct `delimiter`, which is no decimal mark, or the logger's files; the row is skipped"
            )
            return None
        stamp = " ".join(fields[index] for index in columns.time)
        try:
            utc_s = self._clock(stamp, self.data_rows - 1)
        except ValueError as error:
            column = columns.time[0] + 1
            self._report(f"{place}:{column}: the time stamp {stamp!r} cannot be read ({error}); the row is skipped")
            return None
        values = [
            self._value(fields[index], f"{place}:{index + 1}", channel.name, channel.scale_um)
            for index, channel in zip(columns.channels, self._channels, strict=True)
        ]
        return DisplacementSample(
            utc_s=utc_s,
            um=np.array([um for um, _ in values], dtype=np.float64),
            reason=np.array([int(reason) for _, reason in values], dtype=np.uint8),
            source=place,
        )

    def _value(self, field: str, place: str, channel: str, scale_um: float) -> tuple[float, Reason]:
        if self._number.fullmatch(field):
            um = float(field.replace(",", ".")) * scale_um
            if math.isfinite(um):
                return um, Reason.NONE
        if field in self._overflow:
            return math.nan, Reason.OVERFLOW
        if field:
            self._report(f"{place}: {field[:QUOTED_CHARACTERS]!r} is no number for {channel}; it is left out")
        return math.nan, Reason.UNREADABLE

    def _fields(self, text: str) -> list[str]:
        delimiter = self._file_config.delimiter
        fields = text.split(delimiter) if '"' not in text else next(csv.reader([text], delimiter=delimiter))
        return [field.strip() for field in fields]

    def _columns_by_number(self) -> _Columns:
        time = (
            () if start_of(self._file_config) else tuple(int(column) - 1 for column in self._file_config.time_columns)
        )
        channels = tuple(int(channel.column) - 1 for channel in self._channels)
        return _Columns(time=time, channels=channels, count=max(*time, *channels, -1) + 1)

    def _columns_by_header(self, titles: list[str], number: int) -> _Columns:
        wanted = [] if start_of(self._file_config) else list(self._file_config.time_columns)
        time = tuple(self._find(column, titles, number) for column in wanted)
        channels = tuple(self._find(channel.column, titles, number) for channel in self._channels)
        last = max((index for index, title in enumerate(titles) if title), default=-1)
        most = max(*time, *channels, last)
        return _Columns(time=time, channels=channels, count=most + 1, titles=len(titles))

    def _find(self, column: str | int, titles: Sequence[str], number: int) -> int:
        if isinstance(column, int):
            if column <= len(titles):
                return column - 1
            raise UnreadableFileError(
                f"{self._file}:{number}: the header has {len(titles)} columns, "
                f"but the configuration reads column {column}"
            )
        found = [index for index, title in enumerate(titles) if title == column]
        if len(found) == 1:
            return found[0]
        what = "no column" if not found else f"{len(found)} columns"
        wrong = "`encoding`" if "\ufffd" in "".join(titles) else "the columns"
        raise UnreadableFileError(
            f"{self._file}:{number}: the header has {what} {column!r}; it has {', '.join(map(repr, titles))}. "
            f"Correct {wrong} in the configuration, or the logger's channel names"
        )


def _start_clock(config: LoggerFileConfig) -> Callable[[str, int], float] | None:
    """Return the time of a row by its number, for files without time columns."""
    if not isinstance(config, DisplacementFileConfig) or config.start is None or config.interval_s is None:
        return None
    start = datetime.fromisoformat(config.start)
    if start.tzinfo is None:
        start = start.replace(tzinfo=ZoneInfo(config.time_zone))
    start_s, interval_s = start.timestamp(), config.interval_s
    return lambda _, row: start_s + row * interval_s


def _stamp_clock(config: LoggerFileConfig, last_s: float) -> Callable[[str, int], float]:
    """Return the time of a row by its time stamp; NaN where rows have none, because they count from their arrival."""
    if not config.time_columns:
        return lambda _stamp, _row: math.nan
    if config.time_format == "%s":
        number = _NUMBER[config.decimal]

        def seconds(stamp: str, _: int) -> float:
            since_s = float(stamp.replace(",", ".")) if number.fullmatch(stamp) else math.inf
            if not abs(since_s) < LARGEST_TIME_S:
                raise ValueError("not a number of seconds since 1970")
            return since_s

        return seconds
    zone = ZoneInfo(config.time_zone)

    def local(stamp: str, _: int) -> float:
        nonlocal last_s
        moment = datetime.strptime(stamp, config.time_format)
        if moment.tzinfo is not None:
            return moment.timestamp()
        moment = moment.replace(tzinfo=zone)
        utc_s, second_s = moment.timestamp(), moment.replace(fold=1).timestamp()
        # An hour that comes twice when summer time ends: rows do not go back in time, and several may have one stamp.
        last_s = second_s if utc_s < last_s <= second_s else utc_s
        return last_s

    return local
