"""Reads a recording (CSV) into arrays, by a map of its columns.

Comma, semicolon or tab between fields (told by the header), UTF-8 with or without a byte-order
mark or what the map says, decimal commas where the comma does not separate fields or the map says so.
An empty field, `nan` or `NA` is a missing value in every column but time. Anything else that is not
a number is refused, with file, line and column. Lines `# key: value` before the header say what the
recording is of.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from config.files import write_whole
from config.recordings.column_units import RPM_PER_UNIT
from config.recordings.recording_map import (
    UM_PER_UNIT,
    ColumnError,
    Columns,
    RecordingMap,
    are_days,
    fits,
    require_read_units,
    resolve_columns,
    usual_map,
)
from drivers.contract import FatalDriverError
from drivers.files.recording_time import SECONDS, TimeReader, time_reader
from models.recordings.dataset import DatasetError, Recording
from models.recordings.plausibility import are_rises
from models.recordings.slopes import SLOPE_SUFFIX, offset_and_slope
from models.records import FloatArray
from models.units import ZERO_CELSIUS_K

__all__ = [
    "SECONDS",
    "EncodingError",
    "RecordingFileError",
    "read_beginning",
    "read_header",
    "read_recording",
    "write_recording",
]
DELIMITERS = (",", ";", "\t")
MISSING = frozenset({"", "nan", "NaN", "NAN", "NA"})
MAX_FIELDS = 4096
"""A recording has hundreds of columns; more means that the file is something else."""
METADATA_MARK = "#"
SEPARATOR_LINE = "sep="
"""Spreadsheets begin a file with it; it says nothing that the header does not."""
FEWEST_COLUMNS = 3
"""A recording has a time, a temperature and a displacement."""
MOST_BEFORE_HEADER = 100
"""In so many lines after a first one that is no header, one is looked for."""
HOUR_S = 3600.0
LONGEST_STEP_S = 27 * 24 * HOUR_S
"""A run goes on for hours; a day that is read as a month is farther off [s]."""
FIRST_ROW = 2
"""Line of the row after the header, where nothing stands before it."""


class RecordingFileError(FatalDriverError):
    """A recording cannot be read; the text begins with file, line and column where there is one."""


class EncodingError(RecordingFileError):
    """A recording is not written in the encoding that was expected."""


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


def read_beginning(path: Path, rows: int, encoding: str = "utf-8") -> tuple[list[str], list[list[str]]]:
    """Return the names of a recording's columns and the texts of its first rows, whatever they hold.

    Raises `RecordingFileError`.
    """
    place = _Place(path)
    with _opened(place, encoding) as lines:
        header, delimiter = _header(place, lines)
        _require_names(place, header, lines)
        first = place.line + 1
        reader = csv.reader((line for line in lines if line.strip()), delimiter=delimiter)
        try:
            found = [[text.strip() for text in fields] for fields in islice(reader, rows)]
        except csv.Error as error:
            raise place.refuse(f"is not CSV ({error})") from error
        place.line = first
        if found and not any(map(_is_number, found[0])) and (sentence := second_header(header, found[0])):
            raise place.refuse(sentence)
        return header, found


def read_recording(path: Path, recording_map: RecordingMap | None = None) -> Recording:
    """Read a recording as it is, without down-sampling.

    Result: times count from the first row. Raises RecordingFileError naming file, line and column.

    `path`: CSV file with one header row. `recording_map`: what the columns mean; None takes the usual names
    (`config.recordings.recording_map.usual_map`).
    """
    place = _Place(path)
    with _opened(place, "utf-8" if recording_map is None else recording_map.encoding) as lines:
        header, delimiter = _header(place, lines)
        _require_names(place, header, lines)
        try:
            recording_map = recording_map or usual_map(header)
            columns = resolve_columns(recording_map, header)
        except ColumnError as error:
            raise place.refuse(f"{error}{_encoding_hint(header)}") from error
        if hint := _encoding_hint(header):
            raise place.refuse(f"the names of the columns are garbled{hint}")
        if recording_map.unit_row:
            _require_row_of_units(place, next(lines, ""), header, delimiter, recording_map)
        form = _Form(header=header, delimiter=delimiter, columns=columns, recording_map=recording_map)
        time_s, table = _rows(place, lines, form)
    first_temperature = 0 if columns.speed is None else 1
    inputs = [*columns.temperatures, *columns.axis_positions]
    first_displacement = first_temperature + len(inputs)
    first_position = first_displacement + len(columns.displacements)
    try:
        recording = Recording(
            name=path.name,
            time_s=time_s,
            speed_rpm=None if columns.speed is None else table[:, 0] * RPM_PER_UNIT[recording_map.speed_unit],
            temperature_names=tuple(header[i] for i in inputs),
            axis_positions=tuple(header[i] for i in columns.axis_positions),
            temperatures_degc=_in_degc(table[:, first_temperature:first_displacement], columns),
            displacement_names=tuple(columns.channels),
            displacements_um=table[:, first_displacement:first_position]
            * [UM_PER_UNIT[unit] for unit in columns.displacement_units],
        )
        return _with_slopes(recording, columns, recording_map, table[:, first_position:])
    except DatasetError as error:
        raise RecordingFileError(f"{path}: {error}") from error


def _in_degc(values: FloatArray, columns: Columns) -> FloatArray:
    """Return temperatures in degC, and the axis positions after them as they are."""
    found = values.copy()
    rises = are_rises(values[:, : len(columns.temperature_units)])
    for place, unit in enumerate(columns.temperature_units):
        found[:, place] = _degc(values[:, place], unit, rises=rises)
    return found


def _with_slopes(
    recording: Recording, columns: Columns, recording_map: RecordingMap, positions_mm: FloatArray
) -> Recording:
    """Return the recording in which displacements that were measured along an axis are offset and slope."""
    if not columns.slopes:
        return recording
    names, table = list(recording.displacement_names), recording.displacements_um.copy()
    slopes: dict[str, FloatArray] = {}
    pivots_mm = {}
    for (channel, column), position_mm in zip(columns.slopes.items(), positions_mm.T, strict=True):
        one, place = (recording_map.slopes or {})[channel], names.index(channel)
        try:
            table[:, place], slopes[channel + SLOPE_SUFFIX] = offset_and_slope(
                recording.time_s, position_mm, table[:, place], pivot_mm=one.pivot_mm, pass_s=one.pass_s
            )
        except DatasetError as error:
            raise DatasetError(f"slopes.{channel}: column {column + 1} ({one.position}): {error}") from error
        pivots_mm[channel + SLOPE_SUFFIX] = one.pivot_mm
    return replace(
        recording,
        displacement_names=(*names, *slopes),
        displacements_um=np.column_stack([table, *slopes.values()]),
        pivots_mm=pivots_mm,
    )


class _opened:
    """The file's lines; read errors and wrong encodings become sentences."""

    def __init__(self, place: _Place, encoding: str = "utf-8") -> None:
        self._place, self._encoding = place, "utf-8-sig" if encoding == "utf-8" else encoding

    def __enter__(self) -> Iterator[str]:
        try:
            self._file = self._place.path.open(encoding=self._encoding, newline="")
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
        except UnicodeError as error:
            self._place.line += 1
            byte = f" (byte {error.object[error.start]:#04x})" if isinstance(error, UnicodeDecodeError) else ""
            name = "UTF-8" if self._encoding == "utf-8-sig" else self._encoding
            sentence = (
                f"is not {name} at or after this line{byte}; save it as UTF-8, or name its encoding in the map, which "
                "`toolpoint thermal train --map-out map.yaml` proposes"
            )
            raise EncodingError(str(self._place.refuse(sentence))) from error
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
    lines.append(",".join(map(_quoted, columns)) + "\n")
    table = np.column_stack([values for values, _ in columns.values()])
    whole = ",".join(f"%.{decimals}f" for _, decimals in columns.values()) + "\n"
    for row in table:
        text = whole % tuple(row.tolist())
        lines.append(text if np.isfinite(row).all() else text.replace("-inf", "").replace("inf", "").replace("nan", ""))
    write_whole(path, "".join(lines))


def _quoted(name: str) -> str:
    """Return a column's name as a field of CSV."""
    return '"' + name.replace('"', '""') + '"' if any(mark in name for mark in ',"') else name


def _header(place: _Place, lines: Iterator[str]) -> tuple[list[str], str]:
    line = next(lines, "")
    while line.startswith(METADATA_MARK) or line.lower().startswith(SEPARATOR_LINE):
        line = next(lines, "")
    if not line.strip():
        raise place.refuse("has no header row with the names of its columns")
    delimiter = max(DELIMITERS, key=line.count)
    try:
        names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]
    except csv.Error as error:
        raise place.refuse(f"is not CSV ({error})") from error
    if len(names) > MAX_FIELDS:
        raise place.refuse(f"has {len(names)} columns; this is not a recording")
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise place.refuse(
            f"{', '.join(map(repr, twice))} is the name of several columns; give each a name of its own. Where the "
            f"next row holds the names, take this one out, or begin it with {METADATA_MARK}"
        )
    if all(_is_number(name) for name in names if name):
        raise place.refuse("begins with numbers; the first row must hold the names of the columns")
    return names, delimiter


def _require_names(place: _Place, header: list[str], lines: Iterator[str]) -> None:
    """Refuse a first line that cannot be the header, naming the line that seems to be it."""
    if len([name for name in header if name]) >= FEWEST_COLUMNS:
        return
    first, text = place.line, next((name for name in header if name), "")
    counts = [
        len([field for field in line.split(max(DELIMITERS, key=line.count)) if field.strip()])
        for line in islice(lines, MOST_BEFORE_HEADER)
    ]
    if max(counts, default=0) >= FEWEST_COLUMNS:
        found, place.line = first + 1 + counts.index(max(counts)), first
        raise place.refuse(
            f"{text[:40]!r} does not look like the names of the columns; where line {found} holds them, take out "
            f"the lines before it, or begin each with {METADATA_MARK}"
        )


def second_header(header: Sequence[str], row: Sequence[str]) -> str | None:
    """Return what to say where a row of texts names columns that have no name in the header, else None."""
    named = [(i, text) for i, text in enumerate(row[: len(header)], 1) if text.strip() and not header[i - 1]]
    if not named:
        return None
    column, text = named[0]
    return (
        f"{text.strip()[:40]!r} stands here in column {column}, which has no name in the row before: where this row "
        f"holds the names, take out the row before it, or begin that with {METADATA_MARK}; else give the column a name"
    )


def _encoding_hint(header: list[str]) -> str:
    """Return what to say where names look like UTF-8 that was read as another encoding, else ''."""
    try:
        meant = [name.encode("cp1252").decode("utf-8") for name in header]
    except UnicodeError:
        return ""
    if meant == header:
        return ""
    named = ", ".join(name for name, read in zip(meant, header, strict=True) if name != read)
    return f"; the file seems to be UTF-8 ({named}): say encoding: utf-8 in the map"


def _require_row_of_units(
    place: _Place, line: str, header: list[str], delimiter: str, recording_map: RecordingMap
) -> None:
    """Refuse a row of units that contradicts the map."""
    try:
        texts = next(csv.reader([line], delimiter=delimiter), [])
        if sentence := second_header(header, texts):
            raise place.refuse(sentence)
        require_read_units(recording_map, resolve_columns(recording_map, header), header, texts)
    except (ColumnError, csv.Error) as error:
        raise place.refuse(str(error)) from error


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class _Form:
    """How the rows of one file are written."""

    header: list[str]
    delimiter: str
    columns: Columns
    recording_map: RecordingMap


def _rows(place: _Place, lines: Iterator[str], form: _Form) -> tuple[FloatArray, FloatArray]:
    """Return times from the first row [s] and the table of speed, temperatures, displacements."""
    columns, header = form.columns, form.header
    speed = [] if columns.speed is None else [columns.speed]
    wanted = [*speed, *columns.temperatures, *columns.axis_positions, *columns.displacements, *columns.slopes.values()]
    decimal = form.recording_map.decimal or ("." if form.delimiter == "," else None)
    missing = MISSING.union(form.recording_map.missing or ())
    read_time = time_reader(form.recording_map)
    times: list[float] = []
    table: list[FloatArray] = []
    reader = csv.reader(lines, delimiter=form.delimiter)
    before: list[str] = []
    while True:
        try:
            fields = next(reader, None)
        except csv.Error as error:
            raise place.refuse(f"is not CSV ({error})") from error
        if fields is None:
            break
        if not any(field.strip() for field in fields) or fields == before:
            continue  # the same row twice says no more than once
        before = fields
        if not fits(fields, len(header)):
            raise place.refuse(
                f"has {len(fields)} fields where the header has {len(header)}; is the row cut off or the "
                "decimal mark a comma?"
            )
        times.append(_time(place, form, fields, read_time))
        if len(times) > 1 and times[-1] <= times[-2]:
            text = fields[columns.time].strip()
            sentence = _disorder(times, local=form.recording_map.local_times)
            raise place.refuse(f"{text!r} does not come after the row before; {sentence}", header[columns.time])
        if len(times) > 1 and times[-1] - times[-2] > LONGEST_STEP_S and "%m" in (form.recording_map.time_format or ""):
            sentence = "comes a month after the row before: are %d and %m exchanged in time_format? Else split the file"
            of_day = columns.time if columns.date is None else columns.date
            raise place.refuse(f"{fields[of_day].strip()!r} {sentence}", header[of_day])
        table.append(_numbers(place, header, fields, wanted, decimal, missing))
    if not times:
        raise place.refuse("holds no rows after its header")
    _require_seconds(place, times, form)
    time_s = np.array(times)
    return time_s - time_s[0], np.array(table)


def _require_seconds(place: _Place, times: list[float], form: _Form) -> None:
    """Refuse dates as spreadsheets count them that are taken for seconds: hours of them would last a second."""
    of_text = form.recording_map.time_format is not None or form.recording_map.time_unit != "s"
    if not of_text and are_days(times):
        sentence = f"{times[0]:.10g} and so on are days, as spreadsheets count dates: say time_unit: d in the map"
        place.line = 0
        raise place.refuse(sentence, form.header[form.columns.time])


def _disorder(times: list[float], *, local: bool) -> str:
    """Return what to do where the last of the times does not come after the one before.

    `local`: they are times of day without a zone.
    """
    back_s = times[-2] - times[-1]
    if back_s == 0.0:
        return "the same time stands twice: take one of the two rows out, or write times with seconds"
    if len(times) == 2:
        return "where the rows run from the newest to the oldest, sort them by time"
    if local and back_s <= HOUR_S:
        return "where clocks were set back to winter time there, say time_zone in the map; else sort the rows"
    return "sort the rows, and split the file where the logger was restarted"


def _time(place: _Place, form: _Form, fields: list[str], read_time: TimeReader) -> float:
    columns = form.columns
    texts = [fields[columns.time].strip()] if columns.date is None else [fields[columns.date].strip()]
    texts += [] if columns.date is None else [fields[columns.time].strip()]
    column = form.header[columns.time]
    if not all(texts):
        raise place.refuse("is empty; every row needs its time, so fill it in or take the row out", column)
    text = " ".join(texts)
    try:
        time_s = read_time(text)
    except (ValueError, OverflowError):
        time_s = math.nan
    if not math.isfinite(time_s):
        if [field.strip() for field in fields] == form.header:
            raise place.refuse("the names of the columns come again; split the file where the logger was restarted")
        wanted = form.recording_map.time_format
        sentence = "in the unit that the map gives" if wanted is None else f"of the form {wanted} that the map gives"
        if (
            place.line == FIRST_ROW
            and not form.recording_map.unit_row
            and not any(_is_number(text.replace(",", ".")) for text in fields)
        ):
            sentence += "; where this row holds units, say unit_row: true in the map"
        raise place.refuse(f"{text!r} is not a time {sentence}", column)
    return time_s


def _numbers(
    place: _Place, header: list[str], fields: list[str], wanted: list[int], decimal: str | None, missing: frozenset[str]
) -> FloatArray:
    try:
        numbers = np.array([float(fields[i]) for i in wanted])
        if decimal != "," and np.isfinite(numbers).all():
            return numbers
    except ValueError:
        pass
    texts = [(header[i], fields[i].strip()) for i in wanted]
    return np.array([math.nan if text in missing else _number(place, column, text, decimal) for column, text in texts])


def _number(place: _Place, column: str, text: str, decimal: str | None) -> float:
    """Return a field as a number; `decimal` is the mark that it may have, None: either."""
    try:
        if decimal == "," and "." in text:
            raise ValueError
        number = float(text if decimal == "." else text.replace(",", "."))
    except ValueError:
        raise place.refuse(f"{text[:40]!r} is not a number; {_advice(text, decimal)}", column) from None
    if math.isinf(number):
        raise place.refuse(f"{text!r} is not a possible value; leave the field empty where it is missing", column)
    return number


def _advice(text: str, decimal: str | None) -> str:
    if decimal == "." and "," in text:
        return "if its comma is the decimal mark, say decimal: ',' in the map"
    if decimal == "," and "." in text:
        return (
            "the map says that the decimal mark is a comma; where the point separates thousands, export without such "
            "points, where it is the decimal mark, say decimal: '.' in the map"
        )
    return f"where it stands for a missing value, say missing: [{text[:40]!r}] in the map, or leave the field empty"


def _degc(values: npt.NDArray[np.float64], unit: str, *, rises: bool) -> npt.NDArray[np.float64]:
    """Return recorded temperatures as degrees Celsius [degC], of the shape of `values`.

    `unit`: `degC`, `degF` or `K`. `rises`: since the start, which have no zero of their own.
    """
    per_k, at_0_degc = {"degC": (1.0, 0.0), "degF": (1.8, 32.0), "K": (1.0, ZERO_CELSIUS_K)}[unit]
    return (values - (0.0 if rises else at_0_degc)) / per_k
