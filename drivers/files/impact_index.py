"""Reads the index of an impact campaign: which response was measured when, along which axis.

`impacts.csv` in the folder of the responses has the header `file,axis,time`: a file beside it (CSV or universal
file), x or y, and the time, as in the recording of the temperatures: a number in the unit of its time column, or date
and time as ISO 8601. Everything refused is named with file, line and column.
"""

import csv
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from config.files import read_whole
from drivers.contract import FatalDriverError
from drivers.files.recording_lines import read_beginning
from drivers.files.table import columns

INDEX_FILE = "impacts.csv"
HEADER = ("file", "axis", "time")
AXES = ("x", "y")


class ImpactIndexError(FatalDriverError):
    """The index of a campaign cannot be used; the text begins with file and line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedImpact:
    """One line of the index."""

    path: Path
    axis: str
    time: float
    """In the unit of the recording's time column; seconds since 1970 for date and time."""


def read_index(folder: Path) -> tuple[IndexedImpact, ...]:
    """Return the responses of a folder, sorted by time; raises ImpactIndexError naming file, line and column."""
    path = folder / INDEX_FILE
    try:
        text = read_whole(path).decode("utf-8-sig")
    except OSError as error:
        raise ImpactIndexError(
            f"{path}: cannot be opened ({error.strerror}); a campaign's folder holds {INDEX_FILE} with the columns "
            f"{','.join(HEADER)}"
        ) from error
    except UnicodeDecodeError as error:
        raise ImpactIndexError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from error
    try:
        lines = text.splitlines()
        names, delimiter = columns(lines[0] if lines else "")
        rows = list(csv.reader(lines[1:], delimiter=delimiter))
    except csv.Error as error:
        raise ImpactIndexError(f"{path}: is not CSV ({error})") from error
    if tuple(names) != HEADER:
        raise ImpactIndexError(f"{path}:1: the header must be {','.join(HEADER)}")
    found = [
        _impact(path, number, row, delimiter) for number, row in enumerate(rows, start=2) if any(map(str.strip, row))
    ]
    if not found:
        raise ImpactIndexError(f"{path}: names no response")
    return tuple(sorted(found, key=lambda each: each.time))


def _impact(path: Path, line: int, row: list[str], delimiter: str) -> IndexedImpact:
    if len(row) != len(HEADER):
        raise ImpactIndexError(f"{path}:{line}: has {len(row)} fields where the header has {len(HEADER)}")
    name, axis, time = (field.strip() for field in row)
    if axis.lower() not in AXES:
        raise ImpactIndexError(f"{path}:{line}: column axis: {axis!r} is neither x nor y")
    measured = path.parent / name
    if not name or not measured.is_file():
        raise ImpactIndexError(f"{path}:{line}: column file: there is no file {str(measured)!r}")
    try:
        return IndexedImpact(
            path=measured, axis=axis.lower(), time=parse_time(time if delimiter == "," else time.replace(",", "."))
        )
    except ValueError:
        raise ImpactIndexError(
            f"{path}:{line}: column time: {time!r} is neither a number nor date and time as ISO 8601"
        ) from None


def parse_time(text: str) -> float:
    """Return a number, or date and time (ISO 8601, without a zone: UTC) in seconds since 1970; raises ValueError."""
    try:
        value = float(text)
    except ValueError:
        moment = datetime.fromisoformat(text)
        value = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def first_time(path: Path, column: str) -> float:
    """Return the time of a recording's first row in the unit of its column; raises a driver's error."""
    header, rows = read_beginning(path, 1)
    try:
        return parse_time(rows[0][header.index(column)].replace(",", "."))
    except (ValueError, IndexError):
        raise ImpactIndexError(f"{path}: column {column}: holds no time in the first row") from None
