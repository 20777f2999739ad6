"""Reads a recording (CSV) into arrays, by a map of its columns.

Comma, semicolon or tab between fields (told by the header), UTF-8 with or without a byte-order
mark or what the map says, decimal commas where the comma does not separate fields or the map says so.
An empty field, `nan` or `NA` is a missing value in every column but time. Anything else that is not
a number is refused, with file, line and column. Lines `# key: value` before the header say what the
recording is of.
"""

import csv
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from config.files import write_whole
from config.recordings.column_units import RPM_PER_UNIT, has_thousands
from config.recordings.recording_map import (
    MILLISECONDS_FROM,
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
from drivers.files.recording_lines import (
    METADATA_MARK,
    Place,
    RecordingFileError,
    encoding_hint,
    header_of,
    is_number,
    opened,
    require_names,
    second_header,
)
from drivers.files.recording_time import TimeReader, time_reader
from models.recordings.dataset import DatasetError, Recording
from models.recordings.plausibility import are_rises
from models.recordings.slopes import SLOPE_SUFFIX, offset_and_slope
from models.records import FloatArray
from models.units import ZERO_CELSIUS_K

MISSING = frozenset({"", "nan", "NaN", "NAN", "NA"})
HOUR_S = 3600.0
LONGEST_STEP_S = 27 * 24 * HOUR_S
"""A run goes on for hours; a day that is read as a month is farther off [s]."""
LARGEST = 1e9
"""No sensor says more, in whatever unit; what stands for a missing value may."""
_MISSING_SAID = "where it stands for a missing value, say missing: [{!r}] in the map, or leave the field empty"
_WITH_UNIT = re.compile(r"[+-]?\d+([.,]\d*)?\s*([°℃℉%µμ]|[a-z])[a-z/]*", re.IGNORECASE)


def read_recording(path: Path, recording_map: RecordingMap | None = None) -> Recording:
    """Read a recording as it is, times from the first row; None: usual names. Raises RecordingFileError."""
    place = Place(path)
    with opened(place, "utf-8" if recording_map is None else recording_map.encoding) as lines:
        header, delimiter = header_of(place, lines)
        rest = require_names(place, header, lines)
        try:
            recording_map = recording_map or usual_map(header)
            columns = resolve_columns(recording_map, header)
        except ColumnError as error:
            raise place.refuse(f"{error}{encoding_hint(header)}") from error
        if hint := encoding_hint(header):
            raise place.refuse(f"the names of the columns are garbled{hint}")
        if recording_map.unit_row:
            _require_row_of_units(place, next(rest, ""), header, delimiter, recording_map)
        form = _Form(header=header, delimiter=delimiter, columns=columns, recording_map=recording_map)
        time_s, table = _rows(place, rest, form)
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


def write_recording(path: Path, metadata: Mapping[str, object], columns: Mapping[str, tuple[FloatArray, int]]) -> None:
    """Write a recording as `read_recording` reads it, in one step; `columns`: values and decimals. Raises OSError."""
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


def _require_row_of_units(
    place: Place, line: str, header: list[str], delimiter: str, recording_map: RecordingMap
) -> None:
    """Refuse a row of units that contradicts the map."""
    try:
        texts = next(csv.reader([line], delimiter=delimiter), [])
        if sentence := second_header(header, texts):
            raise place.refuse(sentence)
        require_read_units(recording_map, resolve_columns(recording_map, header), header, texts)
    except (ColumnError, csv.Error) as error:
        raise place.refuse(str(error)) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class _Form:
    """How the rows of one file are written."""

    header: list[str]
    delimiter: str
    columns: Columns
    recording_map: RecordingMap


def _rows(place: Place, lines: Iterator[str], form: _Form) -> tuple[FloatArray, FloatArray]:
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
        times.append(_time(place, form, fields, read_time, first=not times))
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


def _require_seconds(place: Place, times: list[float], form: _Form) -> None:
    """Refuse a time that counts something else than seconds: hours of it would last a second, or years."""
    unit = form.recording_map.time_unit
    if form.recording_map.time_format is not None or unit == "iso":
        return
    if times[0] > MILLISECONDS_FROM:
        advice = "say time_unit: ms in the map"
        if unit != "s" or times[0] > 1000.0 * MILLISECONDS_FROM:
            advice = "say the unit of the time in the map, or convert what is in finer parts than ms to seconds"
        sentence = f"no seconds since 1970 are so many: {advice}"
    elif unit == "s" and are_days(times):
        sentence = f"{times[0]:.10g} and so on are days, as spreadsheets count dates: say time_unit: d in the map"
    else:
        return
    place.line = 0
    raise place.refuse(sentence, form.header[form.columns.time])


def _disorder(times: list[float], *, local: bool) -> str:
    """Return what to do where the last of the times, perhaps of day and `local`, does not come after the others."""
    back_s = times[-2] - times[-1]
    if back_s == 0.0:
        return "the same time stands twice: take one of the two rows out, or write times with seconds"
    if len(times) == 2:
        return "where the rows run from the newest to the oldest, sort them by time"
    if local and back_s <= HOUR_S:
        return "where clocks were set back to winter time there, say time_zone in the map; else sort the rows"
    return "sort the rows, and split the file where the logger was restarted"


def _time(place: Place, form: _Form, fields: list[str], read_time: TimeReader, *, first: bool) -> float:
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
        if has_thousands(text):
            raise place.refuse(f"{text!r} has a mark that separates thousands; export without it", column)
        wanted, unit = form.recording_map.time_format, form.recording_map.time_unit
        sentence = "as ISO 8601 writes it" if wanted is None else f"of the form {wanted} that the map gives"
        if wanted is None and unit != "iso":
            advice = "where it is a date or a time of day, say time_unit: iso or time_format in a map"
            sentence = f"in {unit}; {advice}"
        if first and not form.recording_map.unit_row and not any(is_number(text.replace(",", ".")) for text in fields):
            sentence += "; where this row holds units, say unit_row: true in the map"
        raise place.refuse(f"{text!r} is not a time {sentence}", column)
    return time_s


def _numbers(
    place: Place, header: list[str], fields: list[str], wanted: list[int], decimal: str | None, missing: frozenset[str]
) -> FloatArray:
    try:
        numbers = np.array([float(fields[i]) for i in wanted])
        told = missing == MISSING or missing.isdisjoint(fields[i].strip() for i in wanted)  # a code may be a number
        if told and decimal != "," and (np.abs(numbers) <= LARGEST).all():
            return numbers
    except ValueError:
        pass
    texts = [(header[i], fields[i].strip()) for i in wanted]
    if decimal is None:
        of_mark = {mark: next((t for _, t in texts if mark in t and t not in missing), None) for mark in ",."}
        if all(of_mark.values()):
            comma, point = of_mark.values()
            raise place.refuse(
                f"{comma!r} has a comma and {point!r} a point: say in the map which of them is the decimal mark "
                "(decimal), and export without marks that separate thousands"
            )
    return np.array([math.nan if text in missing else _number(place, column, text, decimal) for column, text in texts])


def _number(place: Place, column: str, text: str, decimal: str | None) -> float:
    """Return a field as a number; `decimal` is the mark that it may have, None: either."""
    try:
        if decimal == "," and "." in text:
            raise ValueError
        number = float(text if decimal == "." else text.replace(",", "."))
    except ValueError:
        raise place.refuse(f"{text[:40]!r} is not a number; {_advice(text, decimal)}", column) from None
    if abs(number) > LARGEST:
        raise place.refuse(f"{text!r} is not a possible value; {_MISSING_SAID.format(text)}", column)
    return number


def _advice(text: str, decimal: str | None) -> str:
    if decimal == "." and "," in text and not has_thousands(text):
        return "where its comma is the decimal mark, say decimal: ',' in the map, else export without it"
    if decimal == "," and "." in text and not has_thousands(text):
        return (
            "the map says that the decimal mark is a comma; where the point separates thousands, export without such "
            "points, where it is the decimal mark, say decimal: '.' in the map"
        )
    if has_thousands(text):
        return "where a mark separates thousands, export without it"
    if _WITH_UNIT.fullmatch(text):
        return "write the number alone, and its unit into the name of the column"
    return _MISSING_SAID.format(text[:40])


def _degc(values: npt.NDArray[np.float64], unit: str, *, rises: bool) -> npt.NDArray[np.float64]:
    """Return recorded temperatures, or `rises` since the start, as degrees Celsius [degC]."""
    per_k, at_0_degc = {"degC": (1.0, 0.0), "degF": (1.8, 32.0), "K": (1.0, ZERO_CELSIUS_K)}[unit]
    return (values - (0.0 if rises else at_0_degc)) / per_k
