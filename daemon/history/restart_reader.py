"""Reads of the store what the daemon itself goes on from; raw rows and packed hours alike."""

import json
import sqlite3
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from heapq import merge
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from daemon.history.columns.frames import Frame, Kind, concatenate, decode_frame, frame_from_rows
from daemon.history.columns.joining import cycle_block, in_order, merge_cycles, ms_from_s, texts_of, time_s_of
from daemon.history.columns.kinds import CNC, CYCLES, DISPLACEMENTS, KINDS, TEMPERATURES, WRITES
from daemon.history.columns.packed_hour import id_column
from daemon.history.columns.temperature_chunks import CycleBlock, decode_temperatures
from daemon.history.database import HOUR_MS, HistoryError, connect_reader
from daemon.history.series import CncHistory, TemperatureHistory, WriteRecord, possible_macros, write_records
from models.errors import RefusedInputError
from models.records import OF_SOURCE

P = ParamSpec("P")
R = TypeVar("R", bound="RestartReader")
T = TypeVar("T")

TABLES = {
    TEMPERATURES: CYCLES.table,
    **{kind.name: kind.table for kind in KINDS.values()},
    "events": "events",
    "probes": "probes",
}
"""Table of each kind of record that can be counted and listed."""


@contextmanager
def naming_damage(path: Path) -> Iterator[None]:
    """Raise HistoryError when a page of the store is not as it was written."""
    try:
        yield
    except RefusedInputError:
        raise
    except (sqlite3.DatabaseError, ValueError, TypeError, LookupError, ArithmeticError, zlib.error) as error:
        if isinstance(error, sqlite3.DatabaseError):
            corrupt = getattr(error, "sqlite_errorname", "").startswith("SQLITE_CORRUPT")
            if not corrupt and not str(error).startswith("Could not decode to UTF-8"):
                raise
        raise HistoryError(
            f"{path}: the store is damaged ({error}); move it aside and restore a back-up "
            "(`toolpoint restore`), or let the daemon begin a new one"
        ) from error


OF_CYCLE = ("utc_ms", "monotonic_ms", "number")
NEWEST_OF_FILES = "max(utc_ms) FROM displacements WHERE source NOT LIKE ?"
LAST_PACKED = (
    "SELECT max(end_ms) FROM chunks INDEXED BY chunks_by_time WHERE kind = ?1 AND start_ms > "
    f"(SELECT max(start_ms) FROM chunks WHERE kind = ?1) - {HOUR_MS}"
)
"""The index tells where to look: the content of years would be read for each one's end."""


def named_damage(read: Callable[Concatenate[R, P], T]) -> Callable[Concatenate[R, P], T]:
    """Return a reading method that names damage."""

    @wraps(read)
    def named(self: R, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with naming_damage(self.path):
            return read(self, *args, **kwargs)

    return named


class RestartReader:
    """One read-only connection; for one thread. Times are UTC seconds, from <= t < to."""

    def __init__(self, path: Path, *, also_on_full_disk: bool = False) -> None:
        self.path = path
        self._connection = connect_reader(path, also_on_full_disk=also_on_full_disk)

    def close(self) -> None:
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _snapshot(self) -> Iterator[sqlite3.Connection]:
        """One view of rows and chunks, so that an hour packed meanwhile is neither missing nor doubled."""
        if self._connection.in_transaction:
            yield self._connection
            return
        self._connection.execute("BEGIN")
        try:
            yield self._connection
        finally:
            self._connection.execute("COMMIT")

    @named_damage
    def sensor_ids(self) -> tuple[int, ...]:
        """Return all sensors of which the store knows, in ascending order."""
        return tuple(sorted({i for _, _, members in self._line_layouts() for i in members}))

    @named_damage
    def temperatures(self, sensor_ids: Sequence[int] | None, from_utc_s: float, to_utc_s: float) -> TemperatureHistory:
        """Return the cycles of all lines on which one of the sensors hangs (None: all sensors)."""
        wanted = self.sensor_ids() if sensor_ids is None else tuple(sensor_ids)
        column_of = {sensor_id: column for column, sensor_id in enumerate(wanted)}
        parts = []
        with self._snapshot():
            for layout_id, line, members in self._line_layouts():
                if positions := [position for position, i in enumerate(members) if i in column_of]:
                    columns = [column_of[members[position]] for position in positions]
                    for content in self._cycles(layout_id, positions, ms_from_s(from_utc_s), ms_from_s(to_utc_s)):
                        parts.append((line, columns, content))
        return merge_cycles(wanted, parts, ms_from_s(from_utc_s), ms_from_s(to_utc_s))

    def _line_layouts(self) -> list[tuple[int, str, list[int]]]:
        found = self._connection.execute("SELECT layout_id, name, members FROM layouts WHERE kind = 'line'")
        return [(layout_id, name, json.loads(members)) for layout_id, name, members in found]

    def _cycles(self, layout_id: int, positions: list[int], from_ms: int, to_ms: int) -> Iterator[CycleBlock]:
        for data in self._chunks(TEMPERATURES, layout_id, from_ms, to_ms):
            yield decode_temperatures(data, positions, OF_CYCLE)
        rows = self._connection.execute(
            f"SELECT {', '.join(OF_CYCLE)}, counts, flags FROM temperature_cycles "
            "WHERE layout_id = ? AND utc_ms >= ? AND utc_ms < ? ORDER BY id",
            (layout_id, from_ms, to_ms),
        ).fetchall()
        if rows:
            block = cycle_block(OF_CYCLE, rows)
            yield replace(
                block,
                counts=block.counts[:, positions],
                quality=block.quality[:, positions],
                reason=block.reason[:, positions],
            )

    def _chunks(self, kind: str, layout_id: int, from_ms: int, to_ms: int) -> list[bytes]:
        found = self._connection.execute(
            "SELECT data FROM chunks WHERE kind = ? AND layout_id = ? AND start_ms > ? AND start_ms < ? "
            "AND end_ms >= ? ORDER BY start_ms, chunk_id",
            (kind, layout_id, from_ms - HOUR_MS, to_ms, from_ms),
        )
        return [data for (data,) in found]

    @named_damage
    def frame(self, kind: Kind, from_utc_s: float, to_utc_s: float, names: Collection[str] | None = None) -> Frame:
        """Return the rows of a kind as columns, in order of time."""
        from_ms, to_ms = ms_from_s(from_utc_s), ms_from_s(to_utc_s)
        wanted = kind.closure(names) | {"utc_ms"}
        columns = [name for name in kind.names if name in wanted]
        with self._snapshot() as connection:
            frames = [decode_frame(kind, data, wanted) for data in self._chunks(kind.name, 0, from_ms, to_ms)]
            rows = connection.execute(
                f"SELECT {', '.join(columns)} FROM {kind.table} WHERE utc_ms >= ? AND utc_ms < ? "
                f"ORDER BY {id_column(kind)}",
                (from_ms, to_ms),
            ).fetchall()
        joined = concatenate([*frames, frame_from_rows(kind, columns, rows)])
        return in_order(joined, from_ms, to_ms)

    @named_damage
    def cnc(self, from_utc_s: float, to_utc_s: float) -> CncHistory:
        frame = self.frame(CNC, from_utc_s, to_utc_s)
        return CncHistory(
            time_s=time_s_of(frame),
            monotonic_s=frame.integers("monotonic_ms") / 1e3,
            mode=texts_of(frame, "mode"),
            run=texts_of(frame, "run"),
            alarm=frame.integers("alarm").astype(bool),
            program=frame.integers("program"),
            sequence_number=frame.integers("sequence_number"),
            spindle_speed_rpm=frame.numbers("spindle_speed_rpm"),
            motor_temperature_degc=frame.numbers("motor_temperature_degc"),
            clock_s=frame.numbers("clock_ms") / 1e3,
            power_on_count=frame.integers("power_on_count"),
            work_offset=frame.integers("work_offset"),
            tool_number=frame.integers("tool_number"),
            macros={int(key): values for key, values in frame.mapping("macros").values.items()},
            positions_mm=frame.mapping("positions_mm").values,
        )

    @named_damage
    def unsettled_writes(self) -> list[WriteRecord]:
        """Return the intents whose outcome is not known: the daemon ended in between."""
        rows = self._connection.execute(
            f"SELECT {', '.join(WRITES.names)} FROM writes WHERE outcome = 0 ORDER BY write_id"
        ).fetchall()
        return write_records(frame_from_rows(WRITES, WRITES.names, rows))

    @named_damage
    def last_write_id(self) -> int | None:
        """Return the highest number of a write in the audit, None where there never was one."""
        found = self._connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'writes'").fetchone()
        return None if found is None else int(found[0])

    @named_damage
    def last_written_macros(self, of: Sequence[int] = ()) -> dict[int, tuple[float, ...]] | None:
        """Return per macro what it may hold: the last verified value, then what later writes may have left.

        Of the compensation's block and what was written since; or `of` these macros, as far as hours that are not
        packed tell. None when the audit says nothing of them.
        """
        return possible_macros(self._writes_backwards(packed=not of), of) or None

    def _writes_backwards(self, *, packed: bool) -> Iterator[WriteRecord]:
        """Yield the newest first, by number: a clock that was ahead for a while has left later times."""
        query = f"SELECT {', '.join(WRITES.names)} FROM writes ORDER BY write_id DESC"
        rows = (frame_from_rows(WRITES, WRITES.names, [row]) for row in self._connection.execute(query))
        query = "SELECT data FROM chunks WHERE kind = ? ORDER BY last_row_id DESC"
        hours = self._connection.execute(query, (WRITES.name,)) if packed else ()
        frames = rows, (decode_frame(WRITES, data) for (data,) in hours)
        records = ((each for frame in of for each in reversed(write_records(frame))) for of in frames)
        yield from merge(*records, key=lambda record: -record.write_id)

    @named_damage
    def get_state(self, key: str) -> Any:
        """Return what the daemon kept under a key; None where there is nothing."""
        found = self._connection.execute("SELECT json FROM state WHERE key = ?", (key,)).fetchone()
        return None if found is None else json.loads(found[0])

    @named_damage
    def last_displacement_utc_s(self) -> float | None:
        """Return the time of the newest displacement that stood in a file; of packed ones, of any; None without any."""
        query = f"SELECT coalesce((SELECT {NEWEST_OF_FILES}2), ({LAST_PACKED}))"
        (newest_ms,) = self._connection.execute(query, (DISPLACEMENTS.name, f"{OF_SOURCE}%")).fetchone()
        return None if newest_ms is None else float(newest_ms) / 1e3

    @named_damage
    def extent(self, kind: str) -> tuple[float, float] | None:
        """Return first and last time [s] of a kind ('temperatures', 'cnc', ..); None where there is nothing."""
        query = f"SELECT min(start_ms), ({LAST_PACKED}) FROM chunks WHERE kind = ?1 UNION ALL SELECT min(utc_ms), "
        found = self._connection.execute(f"{query}max(utc_ms) FROM {TABLES[kind]}", (kind,))
        times = [ms / 1e3 for pair in found for ms in pair if ms is not None]
        return (min(times), max(times)) if times else None
