"""Reads a recording (CSV) into arrays, by a map of its columns.

Comma, semicolon or tab between fields (told by the header), UTF-8 with or without a byte-order
mark, decimal commas where the comma does not separate fields. An empty field, `nan` or `NA` is a
missing value in every column but time. Anything else that is not a number is refused, with
file, line and column. Lines `# key: value` before the header say what the recording is of.
"""

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from config.files import write_whole
from config.recordings.recording_map import ColumnError, Columns, RecordingMap, resolve_columns, usual_map
from drivers.contract import FatalDriverError
from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray

DELIMITERS = (",", ";", "\t")
MISSING = frozenset({"", "nan", "NaN", "NAN", "NA"})
MAX_FIELDS = 4096
"""A recording has hundreds of columns; more means that the file is something else."""
METADATA_MARK = "#"
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


class RecordingFileError(FatalDriverError):
    """A recording cannot be read; the text begins with file, line and column where there is one."""


class _Place:
    """Where in the file the reader is."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line = 0

    def refuse(self, sentence: str, column: str | None = None) -> RecordingFileError:
        place = f"{self.path}:{self.line}" if self.line else str(self.path)
        return RecordingFileError(f"{place}: column {column}: {sentence}" if column else f"{place}: {sentence}")


def read_header(path: Path) -> list[str]:
    """Return the names of a recording's columns; raises `RecordingFileError`."""
    place = _Place(path)
    with _opened(place) as lines:
        return _header(place, lines)[0]


def read_recording(path: Path, recording_map: RecordingMap | None = None) -> Recording:
    """Read a recording as it is, without down-sampling.

    Result: times count from the first row. Raises RecordingFileError naming file, line and column.

    Parameters
    ----------
    path
        CSV file with one header row.
    recording_map
        What the columns mean; None takes the usual names (`config.recordings.recording_map.usual_map`).

    """
    place = _Place(path)
    with _opened(place) as lines:
        header, delimiter = _header(place, lines)
        try:
            recording_map = recording_map or usual_map(header)
            columns = resolve_columns(recording_map, header)
        except ColumnError as error:
            raise place.refuse(str(error)) from error
        time_s, table = _rows(place, lines, header, delimiter, columns, _time_reader(recording_map.time_unit))
    first_temperature = 0 if columns.speed is None else 1
    inputs = [*columns.temperatures, *columns.axis_positions]
    first_displacement = first_temperature + len(inputs)
    try:
        return Recording(
            name=path.name,
            time_s=time_s,
            speed_rpm=None if columns.speed is None else table[:, 0].copy(),
            temperature_names=tuple(header[i] for i in inputs),
            axis_positions=tuple(header[i] for i in columns.axis_positions),
            temperatures_degc=table[:, first_temperature:first_displacement].copy(),
            displacement_names=tuple(header[i] for i in columns.displacements),
            displacements_um=table[:, first_displacement:].copy(),
        )
    except DatasetError as error:
        raise RecordingFileError(f"{path}: {error}") from error


class _opened:
    """The file's lines; read errors and wrong encodings become sentences."""

    def __init__(self, place: _Place) -> None:
        self._place = place

    def __enter__(self) -> Iterator[str]:
        try:
            self._file = self._place.path.open(encoding="utf-8-sig", newline="")
        except OSError as error:
            raise self._place.refuse(f"cannot be opened ({error.strerror})") from error
        return self._lines()

    def _lines(self) -> Iterator[str]:
        try:
            for line in self._file:
                self._place.line += 1
                if "\0" in line:
                    raise self._place.refuse("holds a NUL byte; the file is damaged or not text")
                yield line
        except UnicodeDecodeError as error:
            self._place.line += 1
            raise self._place.refuse(
                f"is not UTF-8 at or after this line (byte {error.object[error.start]:#04x}); save it as UTF-8"
            ) from error
        except OSError as error:
            raise self._place.refuse(f"cannot be read ({error.strerror})") from error

    def __exit__(self, *_: object) -> None:
        self._file.close()


def write_recording(path: Path, metadata: Mapping[str, object], columns: Mapping[str, tuple[FloatArray, int]]) -> None:
    """Write a recording in the form that `read_recording` reads, in one step; raises OSError.

    `columns` are values and decimals by name, in order; what is not finite becomes an empty field. A
    line break in the metadata becomes a space.
    """
    lines = [f"{METADATA_MARK} {key}: {' '.join(str(value).splitlines())}\n" for key, value in metadata.items()]
    lines.append(",".join(columns) + "\n")
    table = np.column_stack([values for values, _ in columns.values()])
    whole = ",".join(f"%.{decimals}f" for _, decimals in columns.values()) + "\n"
    for row in table:
        text = whole % tuple(row.tolist())
        lines.append(text if np.isfinite(row).all() else text.replace("-inf", "").replace("inf", "").replace("nan", ""))
    write_whole(path, "".join(lines))


def _header(place: _Place, lines: Iterator[str]) -> tuple[list[str], str]:
    line = next(lines, "")
    while line.startswith(METADATA_MARK):
        line = next(lines, "")
    if not line.strip():
        raise place.refuse("has no header row with the names of its columns")
    delimiter = max(DELIMITERS, key=line.count)
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]
    if len(names) > MAX_FIELDS:
        raise place.refuse(f"has {len(names)} columns; this is not a recording")
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise place.refuse(f"the column names {', '.join(twice)} appear twice; names must be unique")
    if all(_is_number(name) for name in names if name):
        raise place.refuse("begins with numbers; the first row must hold the names of the columns")
    return names, delimiter


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _rows(
    place: _Place,
    lines: Iterator[str],
    header: list[str],
    delimiter: str,
    columns: Columns,
    read_time: Callable[[str], float],
) -> tuple[FloatArray, FloatArray]:
    """Return times from the first row [s] and the table of speed, temperatures, displacements."""
    speed = [] if columns.speed is None else [columns.speed]
    wanted = [*speed, *columns.temperatures, *columns.axis_positions, *columns.displacements]
    times: list[float] = []
    table: list[FloatArray] = []
    reader = csv.reader(lines, delimiter=delimiter)
    while True:
        try:
            fields = next(reader, None)
        except csv.Error as error:
            raise place.refuse(f"is not CSV ({error})") from error
        if fields is None:
            break
        if not any(field.strip() for field in fields):
            continue
        if len(fields) != len(header):
            raise place.refuse(
                f"has {len(fields)} fields where the header has {len(header)}; is the row cut off or the "
                "decimal mark a comma?"
            )
        times.append(_time(place, header[columns.time], fields[columns.time], read_time))
        if len(times) > 1 and times[-1] <= times[-2]:
            raise place.refuse(
                f"{fields[columns.time].strip()!r} does not come after the row before; sort the rows, and split "
                "the file where the logger was restarted",
                header[columns.time],
            )
        table.append(_numbers(place, header, fields, wanted, delimiter))
    if not times:
        raise place.refuse("holds no rows after its header")
    time_s = np.array(times)
    return time_s - time_s[0], np.array(table)


def _time(place: _Place, column: str, text: str, read_time: Callable[[str], float]) -> float:
    if not text.strip():
        raise place.refuse("is empty; every row needs its time, so fill it in or take the row out", column)
    try:
        time_s = read_time(text.strip())
    except ValueError:
        time_s = math.nan
    if not math.isfinite(time_s):
        raise place.refuse(f"{text!r} is not a time in the unit that the map gives", column)
    return time_s


def _numbers(place: _Place, header: list[str], fields: list[str], wanted: list[int], delimiter: str) -> FloatArray:
    try:
        numbers = np.array([float(fields[i]) for i in wanted])
        if np.isfinite(numbers).all():
            return numbers
    except ValueError:
        pass
    return np.array([_number(place, header[i], fields[i].strip(), delimiter) for i in wanted])


def _number(place: _Place, column: str, text: str, delimiter: str) -> float:
    if text in MISSING:
        return math.nan
    try:
        number = float(text if delimiter == "," else text.replace(",", "."))
    except ValueError:
        raise place.refuse(
            f"{text[:40]!r} is not a number; leave the field empty where a value is missing", column
        ) from None
    if math.isinf(number):
        raise place.refuse(f"{text!r} is not a possible value; leave the field empty where it is missing", column)
    return number


def _time_reader(unit: str) -> Callable[[str], float]:
    if unit == "iso":
        return _iso_s
    factor = SECONDS[unit]
    return lambda text: float(text.replace(",", ".")) * factor


def _iso_s(text: str) -> float:
    moment = datetime.fromisoformat(text)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
