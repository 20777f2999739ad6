"""Housekeeping on the writing connection: packs rows, deletes what is too old, frees pages."""

import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from config.schema.service import HistoryConfig
from daemon.history.columns.kinds import CNC, CYCLES, DISPLACEMENTS, ESTIMATES, TEMPERATURES, WRITES
from daemon.history.columns.packed_hour import PackedHour, rows_of_hour, table_of
from daemon.history.database import HOUR_MS

if TYPE_CHECKING:
    from daemon.history.cursors import Position

DAY_MS = 86_400_000
SLICE_ROWS = 2000
SLICE_CHUNKS = 50
SPARE_PAGES = 2048
"""Free pages (8 MiB) that stay in the file for the rows of the next hours."""
SLICE_PAGES = 1024


@dataclass(slots=True, kw_only=True)
class HousekeepingReport:
    packed_hours: int = 0
    untaken: Counter[str] = field(default_factory=Counter)
    """Stream -> rows removed that a sink had not taken."""


def store_hour(connection: sqlite3.Connection, hour: PackedHour) -> bool:
    """Put a chunk in the place of its rows, in one transaction.

    False, with nothing changed, when the rows are no longer those that were packed. An older chunk gets its extremes.
    """
    if hour.chunk_id is not None:
        _store_extremes(connection, hour, hour.chunk_id)
        return False
    table, _ = table_of(hour.kind)
    connection.execute("BEGIN IMMEDIATE")
    inserted = connection.execute(
        "INSERT INTO chunks (kind, layout_id, start_ms, end_ms, row_count, data, last_row_id) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)",
        (hour.kind, hour.layout_id, hour.start_ms, hour.end_ms, hour.row_count, hour.data, hour.last_id),
    )
    assert inserted.lastrowid is not None
    _store_extremes(connection, hour, inserted.lastrowid)
    removed = connection.execute(
        f"DELETE FROM {table} WHERE {rows_of_hour(hour.kind)}",
        {"hour_ms": hour.hour_ms, "layout_id": hour.layout_id, "last_id": hour.last_id},
    ).rowcount
    if removed != hour.row_count:
        connection.execute("ROLLBACK")
        return False
    connection.execute("COMMIT")
    return True


def _store_extremes(connection: sqlite3.Connection, hour: PackedHour, chunk_id: int) -> None:
    connection.execute(
        "INSERT OR REPLACE INTO extremes (kind, layout_id, hour_ms, chunk_id, data) VALUES (?, ?, ?, ?, ?)",
        (hour.kind, hour.layout_id, hour.hour_ms, chunk_id, hour.extremes),
    )


def retention(config: HistoryConfig) -> list[tuple[str, str, float]]:
    """Return table, name of the chunks (empty without) and days kept, for each kind of record."""
    return [
        (CYCLES.table, TEMPERATURES, config.keep_temperatures_days),
        (CNC.table, CNC.name, config.keep_cnc_days),
        (DISPLACEMENTS.table, DISPLACEMENTS.name, config.keep_displacements_days),
        (ESTIMATES.table, ESTIMATES.name, config.keep_estimates_days),
        (WRITES.table, WRITES.name, config.keep_writes_days),
        ("events", "", config.keep_writes_days),
        ("probes", "", config.keep_writes_days),
        ("reference_points", "", config.keep_writes_days),
    ]


def tidy(
    connection: sqlite3.Connection,
    config: HistoryConfig,
    now_utc_s: float,
    report: HousekeepingReport,
    held: "Mapping[str, Position] | None" = None,
) -> bool:
    """Remove one slice of what is too old, or give back one slice of free pages; True while there is more.

    `held`: what the sinks have taken. What they have not stays longer by `keep_for_sinks_days`; the oldest goes first.
    What was written after something that stays, stays too: the clock was behind then.
    """
    for table, kind, keep_days in retention(config):
        cutoff_ms = int(now_utc_s * 1e3 - keep_days * DAY_MS)
        stream = kind or ("references" if table == "reference_points" else table)
        late_ms = cutoff_ms - int(config.keep_for_sinks_days * DAY_MS)
        staying = _first_that_stays(connection, table, kind, cutoff_ms, int(now_utc_s * 1e3))
        for too_old, untaken in _too_old(table, None if held is None else held.get(stream), cutoff_ms, late_ms):
            too_old["row"] = min(too_old["row"], staying)
            rows = _delete(connection, table, too_old, SLICE_ROWS, "1")
            chunks = _delete(connection, "chunks", too_old | {"kind": kind}, SLICE_CHUNKS, "row_count")
            if untaken and rows + chunks:
                report.untaken[stream] += sum(rows + chunks)
            if len(rows) == SLICE_ROWS or len(chunks) == SLICE_CHUNKS:
                return True
        connection.execute(
            "DELETE FROM extremes WHERE kind = ? AND layout_id IN (SELECT layout_id FROM layouts UNION SELECT 0) "
            "AND hour_ms < ? AND hour_ms >= 0 AND NOT EXISTS (SELECT 1 FROM chunks AS c "
            "WHERE c.chunk_id = extremes.chunk_id AND c.kind = extremes.kind)",
            (kind, cutoff_ms // HOUR_MS * HOUR_MS),
        )
    return _vacuum(connection)


def _first_that_stays(connection: sqlite3.Connection, table: str, kind: str, cutoff_ms: int, now_ms: int) -> int:
    """Return the number of the oldest row, or of the last of the oldest chunk of a line, that is not too old."""
    (number,) = connection.execute(
        "SELECT coalesce((SELECT min(last_row_id) FROM chunks WHERE chunk_id IN (SELECT (SELECT chunk_id FROM chunks "
        "WHERE kind = :kind AND layout_id = of.layout_id AND start_ms BETWEEN :cutoff AND :now ORDER BY start_ms "
        "LIMIT 1) FROM (SELECT layout_id FROM layouts UNION SELECT 0) AS of)), "
        f"(SELECT {_row_id(table)} FROM {table} WHERE utc_ms BETWEEN :cutoff AND :now ORDER BY utc_ms LIMIT 1))",
        {"kind": kind, "cutoff": cutoff_ms, "now": now_ms},
    ).fetchone()
    return 2**62 if number is None else int(number)


def _row_id(table: str) -> str:
    return "write_id" if table == WRITES.table else "id"


def _too_old(
    table: str, held: "Position | None", cutoff_ms: int, late_ms: int
) -> Iterator[tuple[dict[str, Any], bool]]:
    """Yield what may go, the values of `_delete`, and whether a sink has not taken it."""
    everything = {"row": 2**62, "chunk": 2**62, "needed_ms": 2**62, "row_id": _row_id(table)}
    if held is None:
        yield everything | {"cutoff_ms": cutoff_ms}, False
        return
    needed_ms = 2**62 if held.needed_from_ms is None else held.needed_from_ms
    taken = {"row": held.row, "chunk": held.chunk, "needed_ms": needed_ms}
    yield everything | taken | {"cutoff_ms": cutoff_ms}, False
    yield everything | {"cutoff_ms": late_ms}, True


def _delete(
    connection: sqlite3.Connection, table: str, too_old: Mapping[str, Any], limit: int, returning: str
) -> list[int]:
    """Delete a slice of rows or chunks; return a number for each."""
    condition = f"utc_ms < :cutoff_ms AND utc_ms < :needed_ms AND {too_old['row_id']} <= :row"
    among = table
    if table == "chunks":
        among = "chunks INDEXED BY chunks_by_time"  # else the content of years is read on the writing connection
        condition = (
            "kind = :kind AND start_ms < :cutoff_ms AND end_ms < :cutoff_ms AND end_ms < :needed_ms "
            "AND CASE WHEN last_row_id IS NULL THEN chunk_id <= :chunk ELSE last_row_id <= :row END"
        )
    found = connection.execute(
        f"DELETE FROM {table} WHERE rowid IN (SELECT rowid FROM {among} WHERE {condition} LIMIT {limit}) "
        f"RETURNING {returning}",
        too_old,
    )
    return [number for (number,) in found.fetchall()]


def _vacuum(connection: sqlite3.Connection) -> bool:
    (free,) = connection.execute("PRAGMA freelist_count").fetchone()
    surplus = min(free - SPARE_PAGES, SLICE_PAGES)
    if surplus <= 0:
        return False
    # One step frees one page, and only executescript steps on when a statement has no columns.
    connection.executescript(f"PRAGMA incremental_vacuum({surplus});")
    (left,) = connection.execute("PRAGMA freelist_count").fetchone()
    return bool(SPARE_PAGES < left < free)
