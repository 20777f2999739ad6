"""Which columns of a recording are time, spindle speed, temperatures and displacements."""

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

from pydantic import Field

from config.loader import load_yaml_model
from config.schema.base import Seconds, Section


class RecordingMap(Section):
    """Map from the columns of a recording to what they mean."""

    time: str = Field(min_length=1, description="column that holds the time")
    time_unit: Literal["s", "min", "h", "iso"] = Field(
        "s", description="unit of the time column; iso: date and time as ISO 8601"
    )
    speed: str | None = Field(None, description="column that holds the spindle speed [1/min], if there is one")
    temperatures: list[str] = Field(
        min_length=1, description="columns that hold temperatures [degC]: names or patterns such as t*"
    )
    displacements: list[str] = Field(
        min_length=1, description="columns that hold displacements [um]: names or patterns such as c*"
    )
    axis_positions: list[str] | None = Field(
        None, min_length=1, description="columns that hold axis positions [mm], if there are any: names or patterns"
    )
    sample_s: Seconds = Field(60.0, description="the recording is averaged to this time between rows [s]")


class ColumnError(ValueError):
    """A map does not fit the columns of a recording; `key` names the entry of the map."""

    def __init__(self, key: str, sentence: str) -> None:
        self.key = key
        super().__init__(f"{key}: {sentence}")


class Columns(Section):
    """Numbers of the columns of one file, from 0."""

    time: int
    speed: int | None
    temperatures: list[int]
    axis_positions: list[int]
    displacements: list[int]


def load_recording_map(path: Path) -> RecordingMap:
    """Read a map; raises `ConfigurationError` with file, line, column and key of everything wrong."""
    return load_yaml_model(path, RecordingMap)


def resolve_columns(recording_map: RecordingMap, header: Sequence[str]) -> Columns:
    """Return the columns that the map means in a file with this header.

    A column named as time or speed is never also a temperature or a displacement. Raises
    `ColumnError` for a name or pattern without a column, and for a column with two meanings.
    """
    time = _named("time", recording_map.time, header)
    speed = None if recording_map.speed is None else _named("speed", recording_map.speed, header)
    if speed == time:
        raise ColumnError("speed", f"column {recording_map.speed!r} is the time already")
    taken = {time} if speed is None else {time, speed}
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
    return Columns(
        time=time, speed=speed, temperatures=temperatures, axis_positions=positions, displacements=displacements
    )


def _named(key: str, name: str, header: Sequence[str]) -> int:
    if name not in header:
        raise ColumnError(key, f"there is no column {name!r}; the columns are {_listed(header)}")
    return list(header).index(name)


def _matching(key: str, patterns: Sequence[str], header: Sequence[str], taken: set[int]) -> list[int]:
    chosen: set[int] = set()
    for pattern in patterns:
        matches = {i for i, name in enumerate(header) if fnmatchcase(name, pattern)} - taken
        if not matches:
            raise ColumnError(key, f"no column matches {pattern!r}; the columns are {_listed(header)}")
        chosen |= matches
    return sorted(chosen)


def _listed(names: Iterable[str]) -> str:
    texts = list(names)
    return ", ".join(texts) if len(texts) <= 12 else ", ".join([*texts[:10], f"... ({len(texts)} in all)"])


_TIME_NAMES = {"t": "s", "time": "s", "time_s": "s", "utc_s": "s", "time_min": "min", "time_h": "h", "utc": "iso"}
_SPEED_NAMES = ("rpm", "speed", "speed_rpm", "spindle_speed_rpm")
_TEMPERATURE_PATTERNS = ("[tT][0-9]*",)
_DISPLACEMENT_PATTERNS = ("c[0-9]*", "[XYZ][0-9]*", "*_um")


def usual_map(header: Sequence[str]) -> RecordingMap:
    """Return the map of a recording whose columns carry the usual names.

    Usual are t, time, time_s or utc_s [s], time_min, time_h, utc (ISO 8601); rpm or speed_rpm;
    t1 or T1 and so on for temperatures; c1, Y1, Z2 or anything ending in _um for displacements.
    Raises `ColumnError` when a kind is not there under a usual name.
    """
    time = next((name for name in header if name in _TIME_NAMES), None)
    if time is None:
        raise ColumnError("time", f"no column carries a usual name ({', '.join(_TIME_NAMES)}); write a map")
    found = {
        "temperatures": _present(_TEMPERATURE_PATTERNS, header),
        "displacements": _present(_DISPLACEMENT_PATTERNS, header),
    }
    for key, patterns in found.items():
        if not patterns:
            raise ColumnError(key, f"no column carries a usual name for {key}; write a map")
    return RecordingMap.model_validate(
        {
            "time": time,
            "time_unit": _TIME_NAMES[time],
            "speed": next((name for name in header if name in _SPEED_NAMES), None),
            **found,
        }
    )


def _present(patterns: Sequence[str], header: Sequence[str]) -> list[str]:
    return [pattern for pattern in patterns if any(fnmatchcase(name, pattern) for name in header)]
