"""The rows of a CSV file that a person exported."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from drivers.files.recording_lines import LONGEST_LINE
from drivers.files.table import columns, number
from models.errors import StabilityError


@contextmanager
def csv_rows(path: Path, what: str) -> Iterator["csv.DictReader[str]"]:
    """Open a file whose header names its columns; raises StabilityError when it cannot be read as text."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = iter(partial(file.readline, LONGEST_LINE), "")
            names, delimiter = columns(next(lines, ""))
            yield csv.DictReader(lines, names, delimiter=delimiter)
    except OSError as error:
        raise StabilityError(f"{path}: cannot be opened ({error.strerror})") from error
    except csv.Error as error:
        raise StabilityError(f"{path}: is not CSV ({error})") from error
    except UnicodeDecodeError as error:
        raise StabilityError(f"{path}: is not UTF-8 text; export the {what} as CSV") from error


def field(reader: "csv.DictReader[str]", row: dict[str, str | None], name: str) -> float:
    """Return the number of a row in a column; raises ValueError."""
    return number(row[name] or "", reader.reader.dialect.delimiter)


def line_of(reader: "csv.DictReader[str]") -> int:
    """Return the line of the row that was read last; the reader has not seen the header."""
    return reader.line_num + 1
