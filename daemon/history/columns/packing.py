"""Packing whole hours of rows into chunks. Reads only; `retention.store_hour` swaps rows for the chunk."""

import json
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import ByteReader, FloatArray, inflate
from daemon.history.columns.encoding import block, deflate, encode_frame, encode_temperatures
from daemon.history.columns.frames import ColumnType, Frame, Kind, MappingColumn, decode_frame, frame_from_rows
from daemon.history.columns.joining import cycle_block
from daemon.history.columns.kinds import CYCLES, KINDS, TEMPERATURES
from daemon.history.columns.packed_hour import PackedHour, rows_of_hour, table_of
from daemon.history.columns.temperature_chunks import CycleBlock, decode_temperatures
from daemon.history.database import HOUR_MS
from models.quality import Quality
from models.units import degc_from_int16

MOST_BELATED = 5000
"""So many older chunks get their extremes in one run."""


FORMAT = 1
MAPPINGS = frozenset(
    {"thermal_error_um", "band_um", "label_degc", "um", "requested_um", "compensation_um", "applied_um"}
)
SCALARS = frozenset({"spindle_speed_rpm", "motor_temperature_degc"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Extremes:
    """Of each series in one hour."""

    names: tuple[str, ...]
    """`mapping.key` or the column; of temperatures none: the series are the positions of the line."""
    table: npt.NDArray[np.float32]
    """Least, greatest, mean, and of how many values, shape (4, series); zeros where there is none."""

    def place(self, name: str) -> int | None:
        """Return the column of a series, None where the hour has none of it."""
        return self.names.index(name) if name in self.names else None


def temperature_extremes(content: CycleBlock) -> bytes:
    """Return the extremes of the accepted values of one line, by position."""
    good = content.quality == Quality.GOOD
    return _encoded((), np.where(good, degc_from_int16(content.counts), np.nan))


def frame_extremes(kind: Kind, frame: Frame) -> bytes:
    """Return the extremes of a kind's numbers; b"" where it has none to show."""
    found = dict(_series(kind, frame))
    return _encoded(tuple(found), np.column_stack(list(found.values()))) if found else b""


def _series(kind: Kind, frame: Frame) -> Iterator[tuple[str, FloatArray]]:
    for column in kind.columns:
        if column.type is ColumnType.MAPPING and column.name in MAPPINGS:
            values: MappingColumn = frame.mapping(column.name)
            for key, numbers in values.values.items():
                yield f"{column.name}.{key}", numbers
        elif column.name in SCALARS:
            yield column.name, frame.numbers(column.name)


def _encoded(names: Sequence[str], values: FloatArray) -> bytes:
    """Encode the extremes of a table, shape (rows, series); NaN does not count."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1)
    least, greatest = np.where(known, values, np.inf).min(axis=0), np.where(known, values, -np.inf).max(axis=0)
    table = np.array([np.where(count, least, 0.0), np.where(count, greatest, 0.0), mean, count], dtype="<f4")
    planes = table.view(np.uint8).reshape(-1, 4).T
    return bytes([FORMAT]) + deflate(block(json.dumps(list(names)).encode()) + planes.tobytes())


def decode_extremes(data: bytes) -> Extremes:
    """Return what was encoded; raises ValueError when a newer version did it."""
    if data[0] != FORMAT:
        raise ValueError(f"extremes have format {data[0]}; this version of toolpoint knows {FORMAT}")
    reader = ByteReader(inflate(memoryview(data)[1:]))
    names = tuple(json.loads(bytes(reader.block())))
    planes = np.frombuffer(reader.rest(), dtype=np.uint8).reshape(4, -1)
    table = np.ascontiguousarray(planes.T).view("<f4").reshape(4, -1)
    return Extremes(names=names, table=table)


def pack_hours(connection: sqlite3.Connection, before_ms: int) -> Iterator[PackedHour]:
    """Yield the chunks of all whole hours before the given time, oldest first within a kind."""
    for name in (TEMPERATURES, *KINDS):
        table = table_of(name)[0]
        layout = "layout_id" if name == TEMPERATURES else "0"
        hours = connection.execute(
            f"SELECT DISTINCT utc_ms / {HOUR_MS}, {layout} FROM {table} WHERE utc_ms < ? ORDER BY 1, 2", (before_ms,)
        ).fetchall()
        for hour, layout_id in hours:
            pack = _pack_cycles if name == TEMPERATURES else _pack_rows
            if (packed := pack(connection, name, hour * HOUR_MS, layout_id)) is not None:
                yield packed


def _select(
    connection: sqlite3.Connection, kind: str, columns: Sequence[str], hour_ms: int, layout_id: int
) -> list[tuple[Any, ...]]:
    table, key = table_of(kind)
    parameters = {"hour_ms": hour_ms, "layout_id": layout_id, "last_id": 2**62}
    return connection.execute(
        f"SELECT {key}, {', '.join(columns)} FROM {table} WHERE {rows_of_hour(kind)} ORDER BY {key}", parameters
    ).fetchall()


def _packed(
    kind: str,
    hour_ms: int,
    layout_id: int,
    rows: list[tuple[Any, ...]],
    times_ms: Sequence[int],
    data: tuple[bytes, bytes],
) -> PackedHour:
    """Return one chunk; `data`: its content and its extremes."""
    return PackedHour(
        kind=kind,
        layout_id=layout_id,
        hour_ms=hour_ms,
        start_ms=min(times_ms),
        end_ms=max(times_ms),
        row_count=len(rows),
        last_id=rows[-1][0],
        data=data[0],
        extremes=data[1],
    )


def _pack_rows(connection: sqlite3.Connection, kind: str, hour_ms: int, layout_id: int) -> PackedHour | None:
    names = KINDS[kind].names
    rows = _select(connection, kind, names, hour_ms, layout_id)
    if not rows:
        return None
    frame = frame_from_rows(KINDS[kind], names, [row[1:] for row in rows])
    times_ms = frame.integers("utc_ms").tolist()
    data = encode_frame(KINDS[kind], frame), frame_extremes(KINDS[kind], frame)
    return _packed(kind, hour_ms, layout_id, rows, times_ms, data)


def _pack_cycles(connection: sqlite3.Connection, kind: str, hour_ms: int, layout_id: int) -> PackedHour | None:
    rows = _select(connection, kind, (*CYCLES.names, "counts", "flags"), hour_ms, layout_id)
    if not rows:
        return None
    content = cycle_block(CYCLES.names, [row[1:] for row in rows])
    times_ms = content.cycles.integers("utc_ms").tolist()
    data = encode_temperatures(content), temperature_extremes(content)
    return _packed(kind, hour_ms, layout_id, rows, times_ms, data)


def missing_extremes(connection: sqlite3.Connection) -> Iterator[PackedHour]:
    """Yield the extremes of chunks that a version without them has packed, the newest first, a bounded number."""
    kinds = TEMPERATURES, *KINDS
    chunks = connection.execute(
        "SELECT chunk_id, kind, layout_id, start_ms, end_ms, row_count, data FROM chunks AS c "
        # those that know their last row have extremes: the content of years would be read every ten minutes
        f"WHERE kind IN ({', '.join('?' * len(kinds))}) AND last_row_id IS NULL AND NOT EXISTS "
        "(SELECT 1 FROM extremes WHERE kind = c.kind AND layout_id = c.layout_id "
        f"AND hour_ms = c.start_ms / {HOUR_MS} * {HOUR_MS} AND chunk_id = c.chunk_id) "
        f"ORDER BY start_ms DESC LIMIT {MOST_BELATED}",
        kinds,
    )
    for chunk_id, kind, layout_id, start_ms, end_ms, row_count, data in chunks:
        try:
            extremes = _belated(connection, kind, layout_id, data)
        except Exception:  # a chunk that is damaged keeps nothing else from being packed
            extremes = b""
        yield PackedHour(
            kind=kind,
            layout_id=layout_id,
            hour_ms=start_ms // HOUR_MS * HOUR_MS,
            start_ms=start_ms,
            end_ms=end_ms,
            row_count=row_count,
            last_id=0,
            data=b"",
            extremes=extremes,
            chunk_id=chunk_id,
        )


def _belated(connection: sqlite3.Connection, kind: str, layout_id: int, data: bytes) -> bytes:
    """Return the extremes of a chunk's content."""
    if kind != TEMPERATURES:
        return frame_extremes(KINDS[kind], decode_frame(KINDS[kind], data))
    (members,) = connection.execute("SELECT members FROM layouts WHERE layout_id = ?", (layout_id,)).fetchone()
    return temperature_extremes(decode_temperatures(data, range(len(json.loads(members))), ("utc_ms",)))
