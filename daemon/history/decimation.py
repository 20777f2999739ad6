"""Recorded values as series over time, decimated to least, greatest and mean of as many buckets as fit a screen."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import FloatArray
from daemon.history.columns.kinds import CNC, DISPLACEMENTS, ESTIMATES, WRITES
from daemon.history.reader import HistoryReader
from models.quality import Quality

WINDOW_S = 3600.0
"""Rows are read in pieces of this length."""
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

Pieces = Iterator[dict[str, tuple[FloatArray, FloatArray]]]
"""Per series its times [s] and values, piece by piece; values that are none are NaN."""


class SeriesError(ValueError):
    """There is no such series; the text names it."""


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
        self,
        time_s: FloatArray,
        least: FloatArray,
        greatest: FloatArray,
        mean: FloatArray,
        weight: FloatArray,
    ) -> None:
        """Add pieces that are decimated already, each with as many values as `weight` says."""
        place = np.floor((time_s - self.from_s) / self.width_s)
        counts = np.isfinite(mean) & (place >= 0) & (place < self.count) & (weight > 0)
        at: npt.NDArray[np.intp] = place[counts].astype(np.intp)
        np.minimum.at(self.least, at, least[counts])
        np.maximum.at(self.greatest, at, greatest[counts])
        share = weight[counts]
        self._total += np.bincount(at, mean[counts] * share, self.count)
        self._time += np.bincount(at, (time_s[counts] - self.from_s) * share, self.count)
        self._values += np.bincount(at, share, self.count)

    def series(self) -> Decimated:
        """Return what was added."""
        held = self._values > 0
        count = self._values[held]
        return Decimated(
            t=self.from_s + self._time[held] / count,
            least=self.least[held],
            greatest=self.greatest[held],
            mean=self._total[held] / count,
        )


def decimated(
    reader: HistoryReader,
    names: Sequence[str],
    from_s: float,
    to_s: float,
    points: int,
    go_on: Callable[[], object] = lambda: None,
) -> dict[str, Decimated]:
    """Return series in at most `points` buckets each.

    `go_on` is called between pieces and raises to break off. Raises SeriesError naming a series that cannot be.
    """
    groups = _by_source(names)
    width_s = (to_s - from_s) / points
    buckets = {name: Buckets(from_s=from_s, width_s=width_s, count=points) for name in names}
    for read in groups:
        for piece in read(reader, from_s, to_s):
            go_on()
            for name, (time_s, values) in piece.items():
                buckets[name].add(time_s, values)
    return {name: each.series() for name, each in buckets.items()}


def check_names(names: Sequence[str]) -> None:
    """Raise SeriesError naming the first series that cannot be."""
    _by_source(names)


def _by_source(names: Sequence[str]) -> list[Callable[[HistoryReader, float, float], Pieces]]:
    """Return what reads the series, each source once for all of them."""
    sensors: dict[int, str] = {}
    keys: dict[str, dict[str, tuple[str, str]]] = {}
    scalars: dict[str, str] = {}
    for name in names:
        word, _, key = name.partition(".")
        if word == TEMPERATURE and key.isdecimal() and len(key) < 9:
            sensors[int(key)] = name
        elif word in OF_FRAMES and key:
            kind, mapping = OF_FRAMES[word]
            keys.setdefault(kind.name, {})[name] = (mapping, key)
        elif name in SCALARS:
            scalars[name] = SCALARS[name]
        else:
            raise SeriesError(f"there is no series {name!r}; GET /api/v1/names lists them")
    sources: list[Callable[[HistoryReader, float, float], Pieces]] = []
    if sensors:
        sources.append(lambda reader, from_s, to_s: _temperatures(reader, sensors, from_s, to_s))
    for kind_name, wanted in keys.items():
        sources.append(lambda r, f, t, k=kind_name, w=wanted: _mappings(r, k, w, f, t))  # type: ignore[misc]
    if scalars:
        sources.append(lambda reader, from_s, to_s: _scalars(reader, scalars, from_s, to_s))
    return sources


def _windows(reader: HistoryReader, kind: str, from_s: float, to_s: float) -> Iterator[tuple[float, float]]:
    extent = reader.extent(kind)
    if extent is None:
        return
    start, end = max(from_s, extent[0]), min(to_s, extent[1] + 0.001)
    while start < end:
        stop = min(end, (start // WINDOW_S + 1.0) * WINDOW_S)
        yield start, stop
        start = stop


def _temperatures(reader: HistoryReader, sensors: Mapping[int, str], from_s: float, to_s: float) -> Pieces:
    for start, stop in _windows(reader, "temperatures", from_s, to_s):
        found = reader.temperatures(list(sensors), start, stop)
        piece = {}
        for column, sensor_id in enumerate(found.sensor_ids):
            good = found.quality[:, column] == Quality.GOOD
            piece[sensors[sensor_id]] = found.time_s[good], found.degc[good, column]
        yield piece


def _mappings(
    reader: HistoryReader, kind_name: str, wanted: Mapping[str, tuple[str, str]], from_s: float, to_s: float
) -> Pieces:
    kind = {kind.name: kind for kind in (DISPLACEMENTS, ESTIMATES, WRITES)}[kind_name]
    columns = sorted({mapping for mapping, _ in wanted.values()})
    for start, stop in _windows(reader, kind_name, from_s, to_s):
        frame = reader.frame(kind, start, stop, columns)
        time_s = frame.integers("utc_ms") / 1e3
        none = np.full(frame.rows, np.nan)
        yield {name: (time_s, frame.mapping(column).values.get(key, none)) for name, (column, key) in wanted.items()}


def _scalars(reader: HistoryReader, wanted: Mapping[str, str], from_s: float, to_s: float) -> Pieces:
    for start, stop in _windows(reader, CNC.name, from_s, to_s):
        frame = reader.frame(CNC, start, stop, list(wanted.values()))
        time_s = frame.integers("utc_ms") / 1e3
        yield {name: (time_s, frame.numbers(column)) for name, column in wanted.items()}
