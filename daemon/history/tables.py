"""Records as flat tables whose column names carry units, for export and for people."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import FloatArray, IntArray
from daemon.history.columns.frames import ColumnType, Frame, Kind, MappingColumn
from daemon.history.columns.kinds import KINDS, TEMPERATURES
from daemon.history.decimation import recorded_hours
from daemon.history.reader import EventRecord, HistoryReader
from daemon.history.series import NOT_IN_CYCLE, TemperatureHistory
from models.quality import Quality, Reason
from models.records import WriteOutcome

WINDOW_S = 3600.0
"""Tables are read and written in pieces of this length."""
FLAGS = frozenset({"alarm", "in_domain"})
EVENTS = "events"
SKIPPED = frozenset({"monotonic_ms"})
KEY_NAMES = {
    "um": "{}_um",
    "reasons": "{}_reason",
    "thermal_error_um": "{}_thermal_error_um",
    "band_um": "{}_band_um",
    "label_degc": "{}_degc",
    "label_reference_degc": "{}_at_reference_degc",
    "requested_um": "{}_requested_um",
    "compensation_um": "{}_compensation_um",
    "macros": "macro_{}",
    "positions_mm": "position_{}",
    "read_back": "macro_{}_read_back",
    "applied_um": "{}_applied_um",
}
"""Name of the table's column for each key of a mapping."""
_NO_TIME = np.datetime64("NaT", "ms")

Values = FloatArray | IntArray | npt.NDArray[np.datetime64] | npt.NDArray[np.bool_] | list[str | None]


class TableType(Enum):
    """What a column of a table holds."""

    TIME = auto()
    """datetime64[ms], UTC; NaT where there is none."""
    NUMBER = auto()
    """float64; NaN where there is none."""
    INTEGER = auto()
    FLAG = auto()
    TEXT = auto()


@dataclass(frozen=True, slots=True, kw_only=True)
class TableColumn:
    name: str
    type: TableType


class Table:
    """One kind of record over an interval, read window by window."""

    def __init__(
        self,
        reader: HistoryReader,
        what: str,
        from_utc_s: float,
        to_utc_s: float,
        *,
        sensor_ids: Sequence[int] | None = None,
        quality: bool = False,
    ) -> None:
        self._reader, self.what = reader, what
        self._sensor_ids = reader.sensor_ids() if sensor_ids is None else tuple(sensor_ids)
        self._quality = quality
        self._windows = _windows(reader, what, from_utc_s, to_utc_s)
        self._keys = self._mapping_keys(KINDS[what]) if what in KINDS else {}
        self.columns = tuple(column for column, _ in self._read(0.0, 0.0))

    @property
    def window_count(self) -> int:
        return len(self._windows)

    def windows(self) -> Iterator[list[Values]]:
        """Yield the table in pieces: per column its values, in the order of `columns`."""
        for from_s, to_s in self._windows:
            yield [values for _, values in self._read(from_s, to_s)]

    def _read(self, from_s: float, to_s: float) -> Iterator[tuple[TableColumn, Values]]:
        if self.what == TEMPERATURES:
            history = self._reader.temperatures(self._sensor_ids, from_s, to_s)
            return _temperature_columns(history, self._quality)
        if self.what == EVENTS:
            return _event_columns(self._reader.events(from_s, to_s))
        return _frame_columns(KINDS[self.what], self._reader.frame(KINDS[self.what], from_s, to_s), self._keys)

    def _mapping_keys(self, kind: Kind) -> dict[str, list[str]]:
        """Return every key that a mapping has anywhere in the interval: the columns must be known first."""
        mappings = [column.name for column in kind.columns if column.type is ColumnType.MAPPING]
        keys: dict[str, dict[str, None]] = {name: {} for name in mappings}
        for from_s, to_s in self._windows:
            frame = self._reader.frame(kind, from_s, to_s, mappings)
            for name in mappings:
                keys[name] |= dict.fromkeys(frame.mapping(name).values)
        if "read_back" in keys:
            keys["read_back"] = keys["macros"]
        if "reasons" in keys:
            keys["reasons"] = keys["um"]
        return {name: list(found) for name, found in keys.items()}


def _event_columns(events: Sequence[EventRecord]) -> Iterator[tuple[TableColumn, Values]]:
    yield from _clock_columns(np.array([round(1e3 * event.time_s) for event in events], dtype=np.int64))
    for name in ("kind", "text", "person"):
        yield _column(name, TableType.TEXT), [getattr(event, name) for event in events]


def _windows(reader: HistoryReader, what: str, from_s: float, to_s: float) -> list[tuple[float, float]]:
    """Return the hours that hold something: one row of another century leaves a million empty ones between."""
    if (extent := reader.extent(what)) is None:
        return []
    first_s, end_s = max(from_s, extent[0]), min(to_s, extent[1] + 0.001)
    hours = sorted(recorded_hours(reader, what, first_s, end_s)) if first_s < end_s else []
    starts = [hour_ms / 1e3 for hour_ms in hours]
    return [(max(start, first_s), min(start + WINDOW_S, end_s)) for start in starts]


def _times(ms: IntArray | FloatArray) -> npt.NDArray[np.datetime64]:
    known = np.isfinite(ms)
    return np.where(known, np.where(known, ms, 0).astype(np.int64).astype("datetime64[ms]"), _NO_TIME)


def _column(name: str, type_: TableType) -> TableColumn:
    return TableColumn(name=name, type=type_)


def _clock_columns(utc_ms: IntArray) -> Iterator[tuple[TableColumn, Values]]:
    yield _column("time_utc", TableType.TIME), _times(utc_ms)
    yield _column("utc_s", TableType.NUMBER), utc_ms / 1e3


def _temperature_columns(history: TemperatureHistory, quality: bool) -> Iterator[tuple[TableColumn, Values]]:
    yield from _clock_columns(np.rint(history.time_s * 1e3).astype(np.int64))
    yield _column("line", TableType.TEXT), list(history.line)
    yield _column("cycle", TableType.INTEGER), history.number
    for index, sensor_id in enumerate(history.sensor_ids):
        yield _column(f"t{sensor_id}_degc", TableType.NUMBER), history.degc[:, index]
        if quality:
            words = _words(Quality, history.quality[:, index])
            yield _column(f"t{sensor_id}_quality", TableType.TEXT), words
            yield _column(f"t{sensor_id}_reason", TableType.TEXT), _words(Reason, history.reason[:, index])


def names_of(codes: type[Quality] | type[Reason] | type[WriteOutcome]) -> dict[int, str]:
    return {int(code): code.name.lower().replace("_", " ") for code in codes}


def _words(
    codes: type[Quality] | type[Reason] | type[WriteOutcome], values: npt.NDArray[np.generic]
) -> list[str | None]:
    """Return codes as their names; empty where the sensor has no value in the row's cycle."""
    names: dict[int, str | None] = {**names_of(codes), NOT_IN_CYCLE: None}
    return [names.get(int(value), str(value)) for value in values]


def _frame_columns(kind: Kind, frame: Frame, keys: dict[str, list[str]]) -> Iterator[tuple[TableColumn, Values]]:
    for column in kind.columns:
        if column.name in SKIPPED:
            continue
        if column.name == "utc_ms":
            yield from _clock_columns(frame.integers("utc_ms"))
        elif column.type is ColumnType.MAPPING:
            yield from _mapping_columns(frame, column.name, keys[column.name])
        elif column.type is ColumnType.TEXT:
            yield _column(column.name, TableType.TEXT), frame.texts(column.name)
        else:
            yield _scalar_column(frame, column.name)


def _scalar_column(frame: Frame, name: str) -> tuple[TableColumn, Values]:
    values = frame.columns[name]
    assert isinstance(values, np.ndarray)
    if name == "outcome":
        return _column(name, TableType.TEXT), _words(WriteOutcome, values)
    if name in FLAGS:
        return _column(name, TableType.FLAG), values.astype(bool)
    if name.endswith("_utc_ms"):
        return _column(name.replace("_utc_ms", "_time_utc"), TableType.TIME), _times(values)
    if name.endswith("_ms"):
        return _column(name.replace("_ms", "_s"), TableType.NUMBER), values / 1e3
    if name.endswith("_us"):
        stage = name.removesuffix("_us").removesuffix("delay").strip("_")
        return _column(f"{stage}_delay_s".lstrip("_"), TableType.NUMBER), values / 1e6
    if values.dtype == np.int64:
        return _column(name, TableType.INTEGER), values
    return _column(name, TableType.NUMBER), values


def _mapping_columns(frame: Frame, name: str, keys: list[str]) -> Iterator[tuple[TableColumn, Values]]:
    mapping = frame.mapping(name)
    as_written = _as_written(frame) if name == "read_back" else None
    for key in keys:
        values = mapping.values.get(key, np.full(frame.rows, np.nan))
        if as_written is not None:
            written = frame.mapping("macros").values.get(key, values)
            values = np.where(as_written, written, values)
        if name == "reasons":
            codes = np.nan_to_num(values).astype(np.uint8)
            yield _column(KEY_NAMES[name].format(key), TableType.TEXT), _words(Reason, codes)
        else:
            yield _column(KEY_NAMES[name].format(key), TableType.NUMBER), values


def _as_written(frame: Frame) -> npt.NDArray[np.bool_]:
    """Return the rows in which exactly what was written was read back (which is stored as NULL)."""
    mapping: MappingColumn = frame.mapping("read_back")
    absent = np.array([keys is None for keys in mapping.shapes] or [False], dtype=bool)
    settled = frame.integers("outcome") != int(WriteOutcome.INTENDED)
    as_written: npt.NDArray[np.bool_] = np.logical_and(absent[mapping.shape_of_row], settled)
    return as_written
