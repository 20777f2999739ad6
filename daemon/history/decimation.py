"""Recorded values as series over time, decimated to least, greatest and mean of as many buckets as fit a screen."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import FloatArray
from daemon.history.columns.frames import Kind
from daemon.history.columns.joining import ms_from_s
from daemon.history.columns.kinds import CNC, DISPLACEMENTS, ESTIMATES, TEMPERATURES, WRITES
from daemon.history.columns.packing import Extremes, decode_extremes
from daemon.history.database import HOUR_MS
from daemon.history.reader import EventRecord, HistoryReader
from daemon.history.restart_reader import TABLES, naming_damage
from models.quality import Quality

HOUR_S = 3600.0
"""Rows are read in pieces of this length."""
COARSE_S = 1800.0
"""Buckets of at least this length are filled from the extremes of packed hours, which have one value for each [s]."""
TEMPERATURE = "temperature"
"""`temperature.61`: one sensor, as measured and accepted [degC]."""
OF_FRAMES = {
    "label": (ESTIMATES, "label_degc"),
    "label_reference": (ESTIMATES, "label_reference_degc"),
    "estimated": (ESTIMATES, "thermal_error_um"),
    "band": (ESTIMATES, "band_um"),
    "measured": (DISPLACEMENTS, "um"),
    "requested": (WRITES, "requested_um"),
    "written": (WRITES, "compensation_um"),
    "applied": (WRITES, "applied_um"),
}
"""First word of a series' name -> the kind of record and the mapping that hold it; the second word is the key."""
SCALARS = {"spindle_speed": "spindle_speed_rpm", "motor_temperature": "motor_temperature_degc"}
"""Series with one word -> column of a poll of the CNC."""

Piece = Iterator[tuple[str, tuple[FloatArray, FloatArray]]]
"""Per series its times [s] and values; values that are none are NaN."""


class SeriesError(ValueError):
    """There is no such series; the text names it."""


def recorded_hours(reader: HistoryReader, kind: str, from_utc_s: float, to_utc_s: float) -> set[int]:
    """Return the beginning [ms] of every hour that holds something of a kind."""
    span = ms_from_s(from_utc_s) // HOUR_MS * HOUR_MS, ms_from_s(to_utc_s)
    hour = f"(({{0}} + {HOUR_MS} * 10000000) / {HOUR_MS} - 10000000) FROM {{1}} WHERE {{0}} >= ? AND {{0}} < ?"
    queries = (
        (f"SELECT DISTINCT {hour.format('utc_ms', TABLES[kind])}", span),
        (f"SELECT DISTINCT {hour.format('start_ms', 'chunks')} AND kind = ?", (*span, kind)),
    )
    with naming_damage(reader.path), reader._snapshot() as connection:
        return {hour * HOUR_MS for sql, values in queries for (hour,) in connection.execute(sql, values)}


class SeriesReader(HistoryReader):
    """A reader for the monitor: it knows the extremes of packed hours too, and looks for events."""

    def positions(self, sensor_ids: Collection[int]) -> list[tuple[int, dict[int, int]]]:
        """Return for each layout of a line that holds one of the sensors: its number, position of each by its ID."""
        found = []
        with naming_damage(self.path):
            layouts = self._line_layouts()
        for layout_id, _, members in layouts:
            if places := {i: position for position, i in enumerate(members) if i in sensor_ids}:
                found.append((layout_id, places))
        return found

    def extremes(self, kind: str, layout_id: int, from_utc_s: float, to_utc_s: float) -> Iterator[tuple[int, Extremes]]:
        """Yield the packed hours [ms] of a kind, and in temperatures of a line, with the extremes of their series."""
        span = ms_from_s(from_utc_s) // HOUR_MS * HOUR_MS, ms_from_s(to_utc_s)
        found = self._connection.execute(
            "SELECT hour_ms, data FROM extremes WHERE kind = ? AND layout_id = ? AND hour_ms >= ? AND hour_ms < ?",
            (kind, layout_id, *span),
        )
        with naming_damage(self.path):
            for hour_ms, data in found:
                if data:
                    yield hour_ms, decode_extremes(data)

    def latest_events(
        self, from_utc_s: float, to_utc_s: float, kind: str, text: str, limit: int
    ) -> tuple[list[EventRecord], dict[str, int]]:
        """Return events, the newest first, and of each kind how many there are; '' asks for every kind, for any text.

        `text` is looked for in what happened and in who did it.
        """
        during = "FROM events WHERE utc_ms >= ? AND utc_ms < ?"
        holds = "AND instr(lower(text || ' ' || coalesce(person, '')), lower(?)) > 0"
        asked = (ms_from_s(from_utc_s), ms_from_s(to_utc_s), text)
        with naming_damage(self.path), self._snapshot() as connection:
            found = connection.execute(
                f"SELECT utc_ms, kind, text, person {during} {holds} AND ? IN ('', kind) "
                "ORDER BY utc_ms DESC, id DESC LIMIT ?",
                (*asked, kind, limit),
            ).fetchall()
            counts = dict(connection.execute(f"SELECT kind, count(*) {during} {holds} GROUP BY kind", asked))
        return [EventRecord(time_s=ms / 1e3, kind=kind, text=text, person=who) for ms, kind, text, who in found], counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Decimated:
    """One series; only buckets that hold a value."""

    t: FloatArray
    """Mean time of the values in each bucket [s], UTC."""
    least: FloatArray
    greatest: FloatArray
    mean: FloatArray


@dataclass(slots=True, kw_only=True)
class Buckets:
    """Least, greatest and mean of the values in equal pieces of time."""

    from_s: float
    width_s: float
    count: int
    least: FloatArray = field(init=False)
    greatest: FloatArray = field(init=False)
    _total: FloatArray = field(init=False)
    _time: FloatArray = field(init=False)
    _values: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Begin without values."""
        self.least, self.greatest = np.full(self.count, np.inf), np.full(self.count, -np.inf)
        self._total, self._time, self._values = (np.zeros(self.count) for _ in range(3))

    def add(self, time_s: FloatArray, values: FloatArray) -> None:
        """Add values; those that are NaN, and those outside the time, do not count."""
        self.add_extremes(time_s, values, values, values, np.ones(values.size))

    def add_extremes(
        self, time_s: FloatArray, least: FloatArray, greatest: FloatArray, mean: FloatArray, weight: FloatArray
    ) -> None:
        """Add pieces that are decimated already, each with as many values as `weight` says."""
        place = np.floor((time_s - self.from_s) / self.width_s)
        counts = np.isfinite(mean) & (time_s >= self.from_s) & (place < self.count) & (weight > 0)
        at: npt.NDArray[np.intp] = place[counts].astype(np.intp)
        np.minimum.at(self.least, at, least[counts])
        np.maximum.at(self.greatest, at, greatest[counts])
        share = weight[counts]
        self._total += np.bincount(at, mean[counts] * share, self.count)
        self._time += np.bincount(at, (time_s[counts] - self.from_s) * share, self.count)
        self._values += np.bincount(at, share, self.count)

    def series(self) -> Decimated:
        held = self._values > 0
        count = self._values[held]
        return Decimated(
            t=self.from_s + self._time[held] / count,
            least=self.least[held],
            greatest=self.greatest[held],
            mean=self._total[held] / count,
        )


def decimated(
    reader: SeriesReader,
    names: Sequence[str],
    from_s: float,
    to_s: float,
    points: int,
    go_on: Callable[[], object] = lambda: None,
) -> dict[str, Decimated]:
    """Return series in at most `points` buckets each; `go_on` may raise to break off. Raises SeriesError."""
    width_s = (to_s - from_s) / points
    buckets = {name: Buckets(from_s=from_s, width_s=width_s, count=points) for name in names}
    for source in _by_source(names):
        first, last = _within(reader.extent(source.kind), from_s, to_s)
        covered: set[int] = set()
        if width_s >= COARSE_S:
            covered = _add_hours(reader, source, buckets, (first, last), go_on)
        for start, stop in _windows(reader, source.kind, first, last, covered):
            go_on()
            for name, (time_s, values) in source.read(reader, start, stop):
                buckets[name].add(time_s, values)
    return {name: each.series() for name, each in buckets.items()}


def _within(extent: tuple[float, float] | None, from_s: float, to_s: float) -> tuple[float, float]:
    return (from_s, from_s) if extent is None else (max(from_s, extent[0]), min(to_s, extent[1] + 0.001))


def _windows(
    reader: SeriesReader, kind: str, first_s: float, last_s: float, covered: set[int]
) -> Iterator[tuple[float, float]]:
    """Yield the hours that hold something and are not covered, cut to the time that is asked for."""
    if not first_s < last_s:
        return
    for hour_ms in sorted(recorded_hours(reader, kind, first_s, last_s) - covered):
        start, stop = max(first_s, hour_ms / 1e3), min(last_s, hour_ms / 1e3 + HOUR_S)
        if start < stop:
            yield start, stop


def _add_hours(
    reader: SeriesReader,
    source: "_Source",
    buckets: Mapping[str, Buckets],
    span: tuple[float, float],
    go_on: Callable[[], object],
) -> set[int]:
    """Add the extremes of the packed hours; return the hours that are covered by that."""
    covered: set[int] = set()
    for layout_id, places in source.layouts(reader):
        hours: list[int] = []
        found: dict[str, list[npt.NDArray[np.float32]]] = {name: [] for name in places}
        none = np.zeros(4, dtype=np.float32)
        for hour_ms, extremes in reader.extremes(source.kind, layout_id, *span):
            go_on()
            hours.append(hour_ms)
            table = extremes.table
            for name, place in places.items():
                column = place if isinstance(place, int) else extremes.place(place)
                found[name].append(none if column is None or column >= table.shape[1] else table[:, column])
        if hours:
            middle_s = np.array(hours) / 1e3 + HOUR_S / 2.0
            for name, columns in found.items():
                least, greatest, mean, count = np.stack(columns, axis=1).astype(np.float64)
                buckets[name].add_extremes(middle_s, least, greatest, mean, count)
        covered |= set(hours)
    return covered


Place = int | str
"""Position on a line, or name in the extremes of a kind."""


class _Source(Protocol):
    """One kind of record with the series that are wanted of it."""

    @property
    def kind(self) -> str: ...

    def read(self, reader: SeriesReader, from_s: float, to_s: float) -> Piece:
        """Yield the series with times [s] and values; values that are none are NaN."""

    def layouts(self, reader: SeriesReader) -> list[tuple[int, dict[str, Place]]]:
        """Return where the series stand in the extremes, by layout."""


@dataclass(frozen=True, kw_only=True)
class _Temperatures:
    sensors: Mapping[int, str]
    kind: str = TEMPERATURES

    def read(self, reader: SeriesReader, from_s: float, to_s: float) -> Piece:
        found = reader.temperatures(list(self.sensors), from_s, to_s)
        for column, sensor_id in enumerate(found.sensor_ids):
            good = found.quality[:, column] == Quality.GOOD
            yield self.sensors[sensor_id], (found.time_s[good], found.degc[good, column])

    def layouts(self, reader: SeriesReader) -> list[tuple[int, dict[str, Place]]]:
        return [
            (layout_id, {self.sensors[sensor_id]: position for sensor_id, position in places.items()})
            for layout_id, places in reader.positions(self.sensors)
        ]


@dataclass(frozen=True, kw_only=True)
class _Frames:
    source: Kind
    series: Mapping[str, tuple[str, str]]
    """Name of the series -> column, and key where the column is a mapping."""

    @property
    def kind(self) -> str:
        return self.source.name

    def read(self, reader: SeriesReader, from_s: float, to_s: float) -> Piece:
        frame = reader.frame(self.source, from_s, to_s, sorted({column for column, _ in self.series.values()}))
        time_s, none = frame.integers("utc_ms") / 1e3, np.full(frame.rows, np.nan)
        for name, (column, key) in self.series.items():
            values = frame.mapping(column).values.get(key, none) if key else frame.numbers(column)
            yield name, (time_s, values)

    def layouts(self, reader: SeriesReader) -> list[tuple[int, dict[str, Place]]]:
        return [(0, {name: f"{column}.{key}" if key else column for name, (column, key) in self.series.items()})]


def _by_source(names: Sequence[str]) -> list[_Source]:
    """Return what reads the series, each kind of record once for all of them."""
    sensors: dict[int, str] = {}
    frames: dict[str, tuple[Kind, dict[str, tuple[str, str]]]] = {}
    for name in names:
        word, _, key = name.partition(".")
        if word == TEMPERATURE and key.isascii() and key.isdecimal() and len(key) < 9:
            sensors[int(key)] = name
            continue
        if word in OF_FRAMES and key:
            kind, column = OF_FRAMES[word]
        elif name in SCALARS:
            kind, column = CNC, SCALARS[name]
        else:
            raise SeriesError(f"there is no series {name!r}; GET /api/v1/names lists them")
        frames.setdefault(kind.name, (kind, {}))[1][name] = (column, key)
    found: list[_Source] = [_Temperatures(sensors=sensors)] if sensors else []
    return [*found, *(_Frames(source=kind, series=series) for kind, series in frames.values())]
