"""What a sink has not taken yet, read from the store in bounded batches in order of the rows' numbers.

Rows that were packed meanwhile come out of their chunk, with the same content: nothing is missed, and a chunk of which
some rows were sent before is sent whole, which the keys make harmless. No transaction is held while a batch is sent.
"""

import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from daemon.history.columns.frames import Frame, Kind, MappingColumn, decode_frame, frame_from_rows
from daemon.history.columns.joining import cycle_block
from daemon.history.columns.kinds import CNC, CYCLES, DISPLACEMENTS, ESTIMATES, KINDS, TEMPERATURES, WRITES
from daemon.history.columns.temperature_chunks import CycleBlock, decode_temperatures
from daemon.history.cursors import Position, generation
from daemon.history.reader import HistoryReader
from daemon.history.restart_reader import naming_damage
from models.units import degc_from_int16

ROWS_AT_ONCE = 500
"""Rows of a batch; a packed hour comes whole, some thousand rows."""
ECHO_WAIT_MS = 600_000
"""A write waits this long for the guard's echo before it is sent."""
OUTCOME_WAIT_MS = 3_600_000
"""A write whose outcome is not known is sent without it when it is older than this."""
DAY_MS = 86_400_000
NO_ROW = 2**62
"""Above every number of a row."""
Row = tuple[Any, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """One kind of record as sinks get it."""

    name: str
    table: str
    columns: tuple[str, ...]
    """Names of the values of a row; `utc_ms` comes first. JSON objects are texts."""
    id: str = "id"
    chunks: str = ""
    """Kind of its chunks, '' where it is not packed."""


def _of_kind(kind: Kind) -> Stream:
    names = tuple(name for name in kind.names if name != "utc_ms")
    key = "write_id" if kind is WRITES else "id"
    return Stream(name=kind.name, table=kind.table, columns=("utc_ms", *names), id=key, chunks=kind.name)


_CYCLE = ("utc_ms", *(name for name in CYCLES.names if name != "utc_ms"))
STREAMS = {
    stream.name: stream
    for stream in (
        Stream(
            name=TEMPERATURES,
            table=CYCLES.table,
            columns=(*_CYCLE, "line", "sensor_ids", "degc", "quality", "reason"),
            chunks=TEMPERATURES,
        ),
        *(_of_kind(kind) for kind in (ESTIMATES, WRITES, CNC, DISPLACEMENTS)),
        Stream(name="events", table="events", columns=("utc_ms", "monotonic_ms", "kind", "text", "person")),
        Stream(
            name="probes",
            table="probes",
            columns=(
                *("utc_ms", "monotonic_ms", "axis", "deviation_um", "applied_um", "thermal_error_um"),
                *("reference_id", "accepted", "reason"),
            ),
        ),
        Stream(
            name="references",
            table="reference_points",
            columns=(
                *("utc_ms", "reference_id", "source", "sensor_ids", "degc", "program", "work_offset"),
                "power_on_count",
            ),
        ),
    )
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Rows that go to a sink together."""

    stream: Stream
    rows: list[Row]
    after: Position
    """Where the stream stands when the sink has acknowledged them."""
    last: bool = False
    """Nothing that could be sent comes after it."""

    @property
    def newest_utc_s(self) -> float:
        return float(max(row[0] for row in self.rows)) / 1e3


class Outbox(HistoryReader):
    """One look at the store; open a new one now and then, so that a store that was begun anew is seen."""

    def __init__(self, path: Path, rows_at_once: int = ROWS_AT_ONCE) -> None:
        super().__init__(path)
        self._rows_at_once = rows_at_once
        self._last_rows: dict[str, int] | None = None
        self._old_chunks: bool | None = None

    def __enter__(self) -> Self:
        return self

    def generation(self) -> str:
        with naming_damage(self.path):
            return generation(self._connection)

    def start(self, stream: Stream, position: Position) -> Position:
        """Return the position, or the beginning where the store has never come as far: it is an older copy."""
        return position if position.row <= self.last_row(stream) else Position()

    def last_row(self, stream: Stream) -> int:
        """Return the highest number that a row of a stream ever had, as of the first time that this is asked."""
        if self._last_rows is None:
            with naming_damage(self.path):
                found = self._connection.execute("SELECT name, seq FROM sqlite_sequence")
                self._last_rows = {name: int(last) for name, last in found}
        return self._last_rows.get(stream.table, 0)

    def batch(self, stream: Stream, position: Position) -> Batch | None:
        """Return what comes next; None when nothing waits."""
        if position.row >= self.last_row(stream) and not self._has_old_chunks():
            return None
        with naming_damage(self.path), self._snapshot() as connection:
            if (
                old := self._chunk(
                    connection, stream, "chunk_id", "last_row_id IS NULL AND chunk_id > ?", position.chunk
                )
            ) is not None:
                chunk_id, layout_id, data = old
                rows = self._unpacked(stream, layout_id, data)
                return Batch(stream=stream, rows=rows, after=replace(position, chunk=chunk_id))
            next_chunk = self._chunk(connection, stream, "last_row_id", "last_row_id > ?", position.row)
            before = NO_ROW if next_chunk is None else next_chunk[0]
            if (raw := self._raw(connection, stream, position, before)) is not None:
                return raw if raw.rows else None
            if next_chunk is None:
                return None
            last_row_id, layout_id, data = next_chunk
            rows = self._unpacked(stream, layout_id, data)
            return Batch(stream=stream, rows=rows, after=replace(position, row=last_row_id))

    def newest(self, stream: Stream, column: str, *among: str) -> dict[str, Any]:
        """Return the newest row of which a column is one of these (none given: anything), by column; {} where none is.

        What is packed is older than an hour, and not looked at.
        """
        names = _names(stream)
        condition = f"{column} IN ({', '.join('?' * len(among))})" if among else f"{column} IS NOT NULL"
        with naming_damage(self.path), self._snapshot() as connection:
            found = connection.execute(
                f"SELECT {', '.join(names)} FROM {stream.table} WHERE {condition} ORDER BY {stream.id} DESC LIMIT 1",
                among,
            ).fetchall()
            rows = self._as_sent(stream, names, found) if found else []
        return dict(zip(stream.columns, rows[0], strict=True)) if rows else {}

    def lines(self) -> dict[str, tuple[int, ...]]:
        """Return every sensor that ever hung on a line, in ascending order, by line."""
        found: dict[str, set[int]] = {}
        with naming_damage(self.path):
            for _, line, members in self._line_layouts():
                found.setdefault(line, set()).update(members)
        return {line: tuple(sorted(found[line])) for line in sorted(found)}

    def written(self) -> int:
        """Return a number that grows with every row."""
        with naming_damage(self.path):
            (last,) = self._connection.execute("SELECT coalesce(sum(seq), 0) FROM sqlite_sequence").fetchone()
            return int(last)

    def end(self, stream: Stream) -> Position:
        """Return where a stream stands when everything has been taken."""
        with naming_damage(self.path), self._snapshot() as connection:
            found = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = ?", (stream.table,))
            (row,) = found.fetchone() or (0,)
            query = "SELECT coalesce(max(chunk_id), 0) FROM chunks WHERE kind = ?"
            (chunk,) = connection.execute(query, (stream.chunks,)).fetchone()
        return Position(row=row, chunk=chunk)

    def waiting(self, stream: Stream, position: Position) -> tuple[int, float | None]:
        """Return how many rows wait (of a packed hour all), and the time [s] of the oldest."""
        needed_ms = 2**62 if position.needed_from_ms is None else position.needed_from_ms
        chunks, values = _chunks_after(stream, position)
        queries: list[tuple[str, tuple[object, ...]]] = [
            (
                f"SELECT count(*), min(utc_ms) FROM {stream.table} WHERE {stream.id} > ? OR utc_ms >= ?",
                (position.row, needed_ms),
            ),
            (f"SELECT sum(row_count), min(start_ms) {chunks}", values),
        ]
        with naming_damage(self.path), self._snapshot() as connection:
            found = [connection.execute(sql, values).fetchone() for sql, values in queries]
        oldest = [ms for _, ms in found if ms is not None]
        return sum(count or 0 for count, _ in found), min(oldest) / 1e3 if oldest else None

    def days(self, stream: Stream, position: Position) -> tuple[list[int], Position]:
        """Return the days (since 1970) of rows that wait after a position, and the newest position."""
        needed_ms = 2**62 if position.needed_from_ms is None else position.needed_from_ms
        with naming_damage(self.path), self._snapshot() as connection:
            found = {
                day
                for (day,) in connection.execute(
                    f"SELECT DISTINCT utc_ms / {DAY_MS} FROM {stream.table} WHERE {stream.id} > ? OR utc_ms >= ?",
                    (position.row, needed_ms),
                )
            }
            (row,) = connection.execute(f"SELECT coalesce(max({stream.id}), 0) FROM {stream.table}").fetchone()
            waiting, values = _chunks_after(stream, position)
            chunks = connection.execute(f"SELECT DISTINCT start_ms / {DAY_MS} {waiting}", values)
            found |= {day for (day,) in chunks}
            packed_row, chunk = connection.execute(
                "SELECT coalesce(max(last_row_id), 0), coalesce(max(chunk_id), 0) FROM chunks WHERE kind = ?",
                (stream.chunks,),
            ).fetchone()
        after = Position(row=max(position.row, row, packed_row), chunk=max(position.chunk, chunk))
        return sorted(found), after

    def unpacked_rows(self, stream: Stream, from_ms: int, to_ms: int) -> list[Row]:
        """Return the rows of a stream that is never packed, in an interval."""
        with naming_damage(self.path):
            found = self._connection.execute(
                f"SELECT {', '.join(_names(stream))} FROM {stream.table} WHERE utc_ms >= ? AND utc_ms < ? "
                f"ORDER BY utc_ms, {stream.id}",
                (from_ms, to_ms),
            ).fetchall()
            return self._completed(stream, found)

    # --- rows that are not packed --------------------------------------------------------------

    def _raw(self, connection: sqlite3.Connection, stream: Stream, position: Position, before: int) -> Batch | None:
        """Return rows before a number; None when there are none, a batch without rows when the first must wait."""
        names = _names(stream)
        found = connection.execute(
            f"SELECT {stream.id}, {', '.join(names)} FROM {stream.table} WHERE {stream.id} > ? AND {stream.id} < ? "
            f"ORDER BY {stream.id} LIMIT ?",
            (position.row, before, self._rows_at_once),
        ).fetchall()
        if not found:
            return None
        last = before == NO_ROW and len(found) < self._rows_at_once
        if stream.name == WRITES.name and not (found := _settled(found, names, self._now_ms(connection))):
            return Batch(stream=stream, rows=[], after=position)
        rows = self._as_sent(stream, names, [row[1:] for row in found])
        return Batch(stream=stream, rows=rows, after=replace(position, row=found[-1][0]), last=last)

    def _as_sent(self, stream: Stream, names: Sequence[str], rows: list[Row]) -> list[Row]:
        """Return rows of a table as sinks get them."""
        if stream.name == TEMPERATURES:
            return list(self._cycle_rows(rows))
        if stream.chunks:
            return _frame_rows(KINDS[stream.chunks], stream, frame_from_rows(KINDS[stream.chunks], names, rows))
        return self._completed(stream, rows)

    def _now_ms(self, connection: sqlite3.Connection) -> int | None:
        """Return the time of the last cycle that was committed, which goes by the daemon's clock."""
        (newest,) = connection.execute("SELECT max(utc_ms) FROM acknowledged").fetchone()
        return None if newest is None else int(newest)

    def _cycle_rows(self, rows: Sequence[Row]) -> Iterator[Row]:
        """Yield cycles of several lines in the order of their rows."""
        at = 0
        while at < len(rows):
            layout_id = rows[at][-1]
            end = next((i for i in range(at, len(rows)) if rows[i][-1] != layout_id), len(rows))
            yield from self._of_block(layout_id, cycle_block(CYCLES.names, [row[:-1] for row in rows[at:end]]))
            at = end

    def _completed(self, stream: Stream, rows: list[Row]) -> list[Row]:
        """Return rows that are not packed as sinks get them."""
        if stream.name != "references":
            return rows
        return [(*row[:3], *self._reference(row[3], row[4]), *row[5:]) for row in rows]

    def _reference(self, layout_id: int, degc: bytes) -> tuple[list[int], list[float | None]]:
        values = [None if np.isnan(value) else value for value in np.frombuffer(degc, dtype="<f8").tolist()]
        return self._members(layout_id)[1], values

    # --- packed hours --------------------------------------------------------------------------

    def _has_old_chunks(self) -> bool:
        """Return whether anything was packed before rows had lasting numbers."""
        if self._old_chunks is None:
            kinds = [stream.chunks for stream in STREAMS.values() if stream.chunks]
            query = (
                f"SELECT 1 FROM chunks WHERE kind IN ({', '.join('?' * len(kinds))}) AND last_row_id IS NULL LIMIT 1"
            )
            with naming_damage(self.path):
                self._old_chunks = self._connection.execute(query, kinds).fetchone() is not None
        return self._old_chunks

    def _chunk(
        self, connection: sqlite3.Connection, stream: Stream, number: str, condition: str, after: int
    ) -> tuple[int, int, bytes] | None:
        if not stream.chunks:
            return None
        found: tuple[int, int, bytes] | None = connection.execute(
            f"SELECT {number}, layout_id, data FROM chunks WHERE kind = ? AND {condition} ORDER BY {number} LIMIT 1",
            (stream.chunks, after),
        ).fetchone()
        return found

    def _unpacked(self, stream: Stream, layout_id: int, data: bytes) -> list[Row]:
        if stream.name == TEMPERATURES:
            _, members = self._members(layout_id)
            return list(self._of_block(layout_id, decode_temperatures(data, range(len(members)))))
        kind = KINDS[stream.chunks]
        return _frame_rows(kind, stream, decode_frame(kind, data))

    def _of_block(self, layout_id: int, block: CycleBlock) -> Iterator[Row]:
        line, members = self._members(layout_id)
        degc = degc_from_int16(block.counts)
        columns = [_plain(block.cycles, name) for name in _CYCLE]
        for index, cycle in enumerate(zip(*columns, strict=True)):
            values = [None if np.isnan(value) else round(value, 5) for value in degc[index].tolist()]
            yield (*cycle, line, members, values, block.quality[index].tolist(), block.reason[index].tolist())

    def _members(self, layout_id: int) -> tuple[str, list[int]]:
        found = self._connection.execute("SELECT name, members FROM layouts WHERE layout_id = ?", (layout_id,))
        name, members = found.fetchone()
        return str(name), json.loads(members)


def _chunks_after(stream: Stream, position: Position) -> tuple[str, tuple[object, ...]]:
    """Return the end of a query for the packed hours that wait, and its values.

    By an index, and not by the content of years for the number of each hour's last row.
    """
    text = "FROM chunks WHERE (kind = ?1 AND last_row_id > ?2) OR (kind = ?1 AND last_row_id IS NULL AND chunk_id > ?3)"
    values = stream.chunks, position.row, position.chunk
    if position.needed_from_ms is None:
        return text, values
    return f"{text} OR (kind = ?1 AND start_ms >= ?4)", (*values, position.needed_from_ms)


def _names(stream: Stream) -> tuple[str, ...]:
    """Return the columns of a stream's table of which its rows are made."""
    if stream.name == TEMPERATURES:
        return (*CYCLES.names, "counts", "flags", "layout_id")
    if stream.name == "references":
        return ("utc_ms", "reference_id", "source", "layout_id", "degc", *stream.columns[-3:])
    return KINDS[stream.chunks].names if stream.chunks else stream.columns


def _settled(found: list[Row], names: Sequence[str], now_ms: int | None) -> list[Row]:
    """Return the writes before the first one that may still change."""
    outcome, echoed, state, utc_ms = (1 + names.index(n) for n in ("outcome", "echoed_after_ms", "state", "utc_ms"))
    for index, row in enumerate(found):
        waits = OUTCOME_WAIT_MS if row[outcome] == 0 else ECHO_WAIT_MS if row[echoed] is None and row[state] else 0
        if waits and (now_ms is None or abs(now_ms - row[utc_ms]) < waits):
            return found[:index]
    return found


def _frame_rows(kind: Kind, stream: Stream, frame: Frame) -> list[Row]:
    columns = [_plain(frame, name) for name in stream.columns]
    if kind is WRITES:
        written, outcome = columns[stream.columns.index("macros")], frame.integers("outcome").tolist()
        at = stream.columns.index("read_back")
        columns[at] = [
            macros if text is None and code != 0 else text
            for text, macros, code in zip(columns[at], written, outcome, strict=True)
        ]
    return list(zip(*columns, strict=True))


def _plain(frame: Frame, name: str) -> list[Any]:
    """Return a column as numbers, texts and None; JSON as texts."""
    column = frame.columns[name]
    if isinstance(column, MappingColumn):
        return [_json(column.row(index)) for index in range(frame.rows)]
    if isinstance(column, list):
        return column
    if column.dtype.kind == "f":
        return [None if np.isnan(value) else value for value in column.tolist()]
    return list(column.tolist())


def _json(mapping: Mapping[str, float | None] | None) -> str | None:
    return None if mapping is None else json.dumps(mapping)
