"""Which columns of a recording are time, spindle speed, temperatures and displacements."""

import re
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Literal, TypeVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import Field

from config.loader import load_yaml_model
from config.recordings.column_units import contradiction
from config.schema.base import Problems, Seconds, Section, checked
from models.recordings.slopes import SLOPE_SUFFIX

_OF_A_DATE = ("%d", "%j", "%D", "%x", "%c", "%Y", "%y", "%m", "%b", "%B", "%s")
UM_PER_UNIT = {"um": 1.0, "mm": 1000.0, "in": 25400.0}
TemperatureUnit = Literal["degC", "degF", "K"]
DisplacementUnit = Literal["um", "mm", "in"]
Unit = TypeVar("Unit", bound=str)


class SlopeMap(Section):
    """A displacement that was measured at several positions of its axis."""

    position: str = Field(min_length=1, description="column that holds the axis position [mm]")
    pivot_mm: float = Field(
        allow_inf_nan=False, description="where the slope adds nothing [mm]: the displacement is told for here"
    )
    pass_s: Seconds = Field(600.0, description="the axis comes to all positions and back in this time [s]")


class RecordingMap(Section):
    """Map from the columns of a recording to what they mean."""

    time: str = Field(min_length=1, description="column that holds the time")
    time_unit: Literal["ms", "s", "min", "h", "d", "iso"] = Field(
        "s", description="unit of the time column; iso: date and time as ISO 8601"
    )
    time_format: str | None = Field(
        None,
        min_length=2,
        description="form of the times (strptime), such as %d.%m.%Y %H:%M:%S, where it is not ISO 8601",
    )
    date: str | None = Field(
        None, min_length=1, description="column of the date, where `time` holds the time of day; joined by one blank"
    )
    time_zone: str | None = Field(
        None, description="IANA name of the zone of times without an offset, such as Europe/Zurich; none: UTC"
    )
    speed: str | None = Field(None, description="column that holds the spindle speed [1/min], if there is one")
    speed_unit: Literal["1/min", "krpm", "1/s", "rad/s"] = Field("1/min", description="unit of the spindle speed")
    temperatures: list[str] = Field(
        min_length=1, description="columns that hold temperatures [degC]: names or patterns such as t*"
    )
    temperature_units: dict[str, TemperatureUnit] | None = Field(
        None, description="unit of temperature columns by name or pattern; degrees Celsius where it says nothing"
    )
    displacements: list[str] = Field(
        min_length=1, description="columns that hold displacements [um]: names or patterns such as c*"
    )
    displacement_units: dict[str, DisplacementUnit] | None = Field(
        None, description="unit of displacement columns by name or pattern; micrometres where it says nothing"
    )
    displacement_names: dict[str, str] | None = Field(
        None, description="what the channel of a displacement column is called; as the column where it says nothing"
    )
    axis_positions: list[str] | None = Field(
        None, min_length=1, description="columns that hold axis positions [mm], if there are any: names or patterns"
    )
    slopes: dict[str, SlopeMap] | None = Field(
        None,
        description="displacement channels that were measured at several axis positions: each becomes itself at the "
        "pivot, and a slope along the axis [um/m]",
    )
    decimal: Literal[".", ","] | None = Field(
        None, description="decimal mark; none: a comma is one where it does not separate fields"
    )
    encoding: Literal["utf-8", "latin-1", "cp1252", "cp932", "utf-16"] = Field("utf-8", description="text encoding")
    unit_row: bool = Field(False, description="the row after the header holds units")
    missing: list[str] | None = Field(
        None, description="texts that stand where a value is missing, such as OL, beside an empty field, nan and NA"
    )
    sample_s: Seconds = Field(60.0, description="the recording is averaged to this time between rows [s]")

    @property
    def local_times(self) -> bool:
        """Times may be those of a wall clock whose zone the map does not say; a time of day alone has none."""
        return self.time_zone is None and (self.time_unit == "iso" or self.has_dates)

    @property
    def has_dates(self) -> bool:
        """The form of the times says a date."""
        return any(part in (self.time_format or "") for part in _OF_A_DATE)

    @checked
    def _readable_times(self) -> Problems:
        of_text = self.time_format is not None or self.time_unit == "iso"
        if self.time_format is not None and self.time_unit != "s":
            yield ("time_unit",), "goes with numbers and with ISO 8601, not with time_format; leave one of them out"
        if self.time_format is not None and "%" not in self.time_format:
            yield ("time_format",), f"{self.time_format!r} has no part such as %H; write it like %d.%m.%Y %H:%M:%S"
        if self.date is not None and not of_text:
            yield ("date",), "needs time_format, or time_unit: iso, which say how date and time are written"
        if self.time_zone is not None:
            if not of_text:
                yield ("time_zone",), f"a time in {self.time_unit} has no zone; leave it out"
            elif self.time_unit != "iso" and not self.has_dates:
                yield (
                    ("time_zone",),
                    "a time of day without a date has no zone; leave it out, or name the column `date`",
                )
            try:
                ZoneInfo(self.time_zone)
            except (ValueError, OSError, ZoneInfoNotFoundError):
                yield ("time_zone",), f"{self.time_zone!r} is no zone of this computer; write one such as Europe/Zurich"


class ColumnError(ValueError):
    """A map does not fit the columns of a recording; `key` names the entry of the map."""

    def __init__(self, key: str, sentence: str) -> None:
        self.key = key
        super().__init__(f"{key}: {sentence}")


class Columns(Section):
    """Numbers of the columns of one file, from 0."""

    time: int
    date: int | None
    speed: int | None
    temperatures: list[int]
    temperature_units: list[TemperatureUnit]
    """Of each temperature."""
    axis_positions: list[int]
    displacements: list[int]
    displacement_units: list[DisplacementUnit]
    """Of each displacement."""
    channels: list[str]
    """What each displacement is called."""
    slopes: dict[str, int]
    """Column of the axis position by channel, of those that were measured at several positions."""


def load_recording_map(path: Path) -> RecordingMap:
    """Read a map; raises `ConfigurationError` with file, line, column and key of everything wrong."""
    return load_yaml_model(path, RecordingMap)


def resolve_columns(recording_map: RecordingMap, header: Sequence[str]) -> Columns:
    """Return the columns that the map means in a file with this header.

    A column named as time, date or speed is never also a temperature or a displacement. What is the name of a column
    means that column, whatever brackets it has; else it is a pattern. Raises `ColumnError` for a name or pattern
    without a column, and for a column with two meanings.
    """
    time = _named("time", recording_map.time, header)
    date = None if recording_map.date is None else _named("date", recording_map.date, header)
    speed = None if recording_map.speed is None else _named("speed", recording_map.speed, header)
    taken = {time}
    for key, column, name in (("date", date, recording_map.date), ("speed", speed, recording_map.speed)):
        if column in taken:
            raise ColumnError(key, f"column {name!r} is the {'time' if column == time else 'date'} already")
        taken |= {column} if column is not None else set()
    temperatures = _matching("temperatures", recording_map.temperatures, header, taken)
    displacements = _matching("displacements", recording_map.displacements, header, taken)
    positions = _matching("axis_positions", recording_map.axis_positions or [], header, taken)
    for key, others, meanings in (
        ("displacements", temperatures, "temperature and displacement"),
        ("axis_positions", temperatures, "temperature and axis position"),
        ("axis_positions", displacements, "displacement and axis position"),
    ):
        if both := sorted(set(others) & set(displacements if key == "displacements" else positions)):
            raise ColumnError(
                key, f"{_listed(header[i] for i in both)} would be {meanings} at once; write narrower patterns"
            )
    _require_units(header, {"temperatures": temperatures, "displacements": displacements})
    channels = _channels(recording_map.displacement_names or {}, header, displacements)
    found = Columns(
        time=time,
        date=date,
        speed=speed,
        temperatures=temperatures,
        temperature_units=_units_of("temperature", recording_map.temperature_units or {}, header, temperatures, "degC"),
        axis_positions=positions,
        displacements=displacements,
        displacement_units=_units_of(
            "displacement", recording_map.displacement_units or {}, header, displacements, "um"
        ),
        channels=channels,
        slopes=_slopes(recording_map.slopes or {}, header, channels, {*temperatures, *displacements}),
    )
    require_read_units(recording_map, found, header)
    return found


def require_read_units(
    recording_map: RecordingMap, columns: Columns, header: Sequence[str], row: Sequence[str] | None = None
) -> None:
    """Refuse a column in another unit than it is read in, by `row` or its name; raises `ColumnError`."""
    of_number = recording_map.time_format is None and recording_map.time_unit != "iso"
    read: list[tuple[str, int, str]] = [("time", columns.time, recording_map.time_unit)] if of_number else []
    read += [] if columns.speed is None else [("speed", columns.speed, recording_map.speed_unit)]
    for kind, places, units in (
        ("displacements", columns.displacements, columns.displacement_units),
        ("temperatures", columns.temperatures, columns.temperature_units),
    ):
        read += [(kind, column, unit) for column, unit in zip(places, units, strict=True)]
    if row is None:
        patterns = (*(recording_map.displacement_units or ()), *(recording_map.temperature_units or ()))
        said = {i for pattern in patterns for i in _matches(pattern, header)}
        said |= {columns.time} if "time_unit" in recording_map.model_fields_set else set()
        said |= (
            {columns.speed} if columns.speed is not None and "speed_unit" in recording_map.model_fields_set else set()
        )
        read = [one for one in read if one[1] not in said]
    else:
        read += [("axis_positions", column, "mm") for column in columns.axis_positions]
    for kind, column, meant in read:
        text = None if row is None else row[column] if column < len(row) else ""
        if sentence := contradiction(kind, header[column], meant, text):
            raise ColumnError(kind, sentence)


def _require_units(header: Sequence[str], columns: Mapping[str, Sequence[int]]) -> None:
    """Refuse a column that has the unit of the other kind in its name, and not its own."""
    for key, other in (("temperatures", "displacements"), ("displacements", "temperatures")):
        for name in (header[i] for i in columns[key]):
            if _UNITS[other].search(name) and not _UNITS[key].search(name):
                raise ColumnError(
                    key, f"column {name!r} is among the {other}, by the unit in its name; say so in the map"
                )


def _slopes(
    slopes: Mapping[str, SlopeMap], header: Sequence[str], channels: Sequence[str], taken: set[int]
) -> dict[str, int]:
    found = {}
    for channel, one in slopes.items():
        if channel not in channels:
            raise ColumnError("slopes", f"{channel!r} is no displacement channel; there are {_listed(channels)}")
        if (name := channel + SLOPE_SUFFIX) in channels:
            raise ColumnError("slopes", f"{name!r} is what the slope is called; call that column otherwise")
        found[channel] = _named("slopes", one.position, header)
        if found[channel] in taken:
            raise ColumnError("slopes", f"column {one.position!r} is a temperature or displacement already")
    return found


def _units_of(
    what: str, units: Mapping[str, Unit], header: Sequence[str], columns: Sequence[int], usual: Unit
) -> list[Unit]:
    found = dict.fromkeys(columns, usual)
    for pattern, unit in units.items():
        matches = set(_matches(pattern, header)) & set(columns)
        if not matches:
            names = _listed(header[i] for i in columns)
            raise ColumnError(f"{what}_units", f"no {what} column matches {pattern!r}; there are {names}")
        found |= dict.fromkeys(matches, unit)
    return list(found.values())


def _channels(names: Mapping[str, str], header: Sequence[str], displacements: Sequence[int]) -> list[str]:
    columns = [header[i] for i in displacements]
    if unknown := sorted(set(names) - set(columns)):
        raise ColumnError(
            "displacement_names", f"{unknown[0]!r} is no displacement column; there are {_listed(columns)}"
        )
    found = [names.get(column, column) for column in columns]
    if twice := sorted({name for name in found if found.count(name) > 1}):
        raise ColumnError("displacement_names", f"two columns would be called {twice[0]!r}; call each otherwise")
    return found


def fits(fields: Sequence[str], columns: int) -> bool:
    """Return whether a row has a field for each column, and beyond them empty ones at most."""
    return len(fields) >= columns and not any(text.strip() for text in fields[columns:])


def are_days(numbers: Sequence[float]) -> bool:
    """Return whether increasing numbers are dates as spreadsheets count them: they go on by parts of a day."""
    if len(numbers) < 2 or not _DAYS[0] <= numbers[0] <= numbers[-1] <= _DAYS[1]:
        return False
    return median(second - first for first, second in pairwise(numbers)) <= _DAY_STEP


def matching_names(recording_map: RecordingMap, header: Sequence[str]) -> dict[str, list[str]]:
    """Return the names of the columns of each kind in a file with this header; raises `ColumnError`."""
    keys = {"speed": [recording_map.speed] if recording_map.speed else []}
    keys |= {kind: getattr(recording_map, kind) or [] for kind in ("temperatures", "axis_positions", "displacements")}
    present = {key: [one for one in names if _matches(one, header)] for key, names in keys.items()}
    if not present["temperatures"] or not present["displacements"]:
        lacking = [key for key in ("temperatures", "displacements") if not present[key]]
        raise ColumnError(lacking[0], f"no column matches {keys[lacking[0]][0]!r}; the columns are {_listed(header)}")
    columns = resolve_columns(
        recording_map.model_copy(
            update={
                **present,
                **units_and_names(recording_map, header),
                "speed": next(iter(present["speed"]), None),
                "axis_positions": present["axis_positions"] or None,
            }
        ),
        header,
    )
    found = {
        kind: [header[i] for i in getattr(columns, kind)]
        for kind in ("temperatures", "axis_positions", "displacements")
    }
    return {"speed": present["speed"], **found}


def units_and_names(recording_map: RecordingMap, header: Sequence[str]) -> dict[str, Any]:
    """Return units, names and slopes of columns as far as a file with this header has the columns."""
    units, names = recording_map.displacement_units or {}, recording_map.displacement_names or {}
    of_temperatures = recording_map.temperature_units or {}
    called = {names.get(column, column) for column in header}
    slopes = recording_map.slopes or {}
    return {
        "temperature_units": {p: unit for p, unit in of_temperatures.items() if _matches(p, header)} or None,
        "displacement_units": {pattern: unit for pattern, unit in units.items() if _matches(pattern, header)} or None,
        "displacement_names": {column: name for column, name in names.items() if column in header} or None,
        "slopes": {channel: one for channel, one in slopes.items() if channel in called} or None,
    }


def _matches(pattern: str, header: Sequence[str]) -> list[int]:
    """Return the columns of that name; else those that match it as a pattern."""
    named = [i for i, name in enumerate(header) if name == pattern]
    return named or [i for i, name in enumerate(header) if fnmatchcase(name, pattern)]


def _named(key: str, name: str, header: Sequence[str]) -> int:
    if name not in header:
        raise ColumnError(key, f"there is no column {name!r}; the columns are {_listed(header)}")
    return list(header).index(name)


def _matching(key: str, patterns: Sequence[str], header: Sequence[str], taken: set[int]) -> list[int]:
    chosen: set[int] = set()
    for pattern in patterns:
        matches = set(_matches(pattern, header)) - taken
        if not matches:
            raise ColumnError(key, f"no column matches {pattern!r}; the columns are {_listed(header)}")
        chosen |= matches
    return sorted(chosen)


def _listed(names: Iterable[str]) -> str:
    texts = list(names)
    return ", ".join(texts) if len(texts) <= 12 else ", ".join([*texts[:10], f"... ({len(texts)} in all)"])


MILLISECONDS_FROM = 1e11
"""A time of more is no seconds since 1970, but ms, from 1973 on."""
_DAYS = (20_000.0, 80_000.0)
"""Dates as spreadsheets count them, from 1954 to 2119."""
_DAY_STEP = 0.02
"""Rows that are farther apart [d] are no recording."""
_UNITS = {"temperatures": re.compile(r"°\s*C|℃|\bdeg_?C"), "displacements": re.compile(r"[µμ]m|\bum\b")}
_TIME_NAMES = {"t": "s", "time": "s", "time_s": "s", "utc_s": "s", "time_min": "min", "time_h": "h", "utc": "iso"}
_SPEED_NAMES = ("rpm", "speed", "speed_rpm", "spindle_speed_rpm")
_MAP_IT = "give a map, which `toolpoint thermal train RECORDING -o model.json --map-out map.yaml` proposes"
_TEMPERATURE_PATTERNS = ("[tT][0-9]*",)
_CHANNEL_WITH_UNIT = re.compile(r"([XYZ]|c)[0-9]+_um")
_DISPLACEMENT_PATTERNS = ("c[0-9]*", "[XYZ][0-9]*", "*_um")


def usual_map(header: Sequence[str]) -> RecordingMap:
    """Return the map of a recording whose columns carry the usual names; raises `ColumnError`.

    Usual are t, time, time_s or utc_s [s], time_min, time_h, utc (ISO 8601); rpm or speed_rpm; t1 or T1 and so on for
    temperatures; c1, Y1, Z2 or anything ending in _um for displacements, of which Z1_um is the channel Z1.
    """
    time = next((name for name in header if name in _TIME_NAMES), None)
    if time is None:
        raise ColumnError("time", f"no column carries a usual name ({', '.join(_TIME_NAMES)}); {_MAP_IT}")
    found = {
        "temperatures": _present(_TEMPERATURE_PATTERNS, header),
        "displacements": _present(_DISPLACEMENT_PATTERNS, header),
    }
    for key, patterns in found.items():
        if not patterns:
            raise ColumnError(key, f"no column carries a usual name for {key}; {_MAP_IT}")
    return RecordingMap.model_validate(
        {
            "time": time,
            "time_unit": _TIME_NAMES[time],
            "speed": next((name for name in header if name in _SPEED_NAMES), None),
            "displacement_names": _without_unit(found["displacements"], header) or None,
            **found,
        }
    )


def _without_unit(patterns: Sequence[str], header: Sequence[str]) -> dict[str, str]:
    """Return the channels of columns such as Z1_um, which would carry a usual name without their unit."""
    columns = [name for name in header if any(fnmatchcase(name, pattern) for pattern in patterns)]
    named = {name: name.removesuffix("_um") for name in columns if _CHANNEL_WITH_UNIT.fullmatch(name)}
    return {column: channel for column, channel in named.items() if channel not in header}


def _present(patterns: Sequence[str], header: Sequence[str]) -> list[str]:
    return [pattern for pattern in patterns if any(fnmatchcase(name, pattern) for name in header)]
