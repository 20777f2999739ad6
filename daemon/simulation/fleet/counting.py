"""What arrived: the rows of the machines' stores held against those of the database, and how late they came.

The stores are read with SQL of their own, not with the sinks' reader, so that a row which that one overlooks counts as
lost. Of a cycle the sum of its temperatures is compared too.
"""

import bisect
import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
import psycopg

from daemon.history.cursors import Cursor, cursor_path
from daemon.history.database import connect_reader
from daemon.simulation.fleet.machines import Committed, FleetPlan
from models.units import int16_from_degc

LOOK_PERIOD_S = 0.1
"""From one query for what has arrived to the next; a delay is known to this."""
MS = "(extract(epoch FROM time) * 1000)::bigint"
KEYS: Mapping[str, tuple[str, str, str]] = {
    "temperatures": (
        "SELECT t.utc_ms, l.name, t.counts FROM temperature_cycles AS t JOIN layouts AS l USING (layout_id)",
        "temperatures",
        f"{MS}, line, degc",
    ),
    "estimates": ("SELECT utc_ms, line FROM estimates", "estimates", f"{MS}, line"),
    "writes": ("SELECT utc_ms, write_id FROM writes", "writes", f"{MS}, write_id"),
    "cnc": ("SELECT utc_ms, sequence_number FROM cnc_samples", "cnc", f"{MS}, sequence_number"),
    "displacements": ("SELECT utc_ms, source FROM displacements", "displacements", f"{MS}, source"),
    "events": ("SELECT utc_ms, text FROM events", "events", f"{MS}, text"),
    "references": ("SELECT utc_ms, reference_id FROM reference_points", "reference_points", f"{MS}, reference_id"),
}
"""Stream -> the keys of its rows in a store, its table in the database, and the same keys there."""
NEWEST = """
SELECT k.machine, k.line, (extract(epoch FROM (
    SELECT max(t.time) FROM toolpoint.temperatures AS t WHERE t.machine = k.machine AND t.line = k.line
)) * 1000)::bigint
FROM unnest(%s::text[], %s::text[]) AS k (machine, line)
"""
Row = tuple[Any, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Rows of all machines together."""

    sent: int
    """By the senders' own count, repeats with them; what a killed one had not noted is missing."""
    acknowledged: int
    """Rows of the stores that the senders know to be taken."""
    stored: int
    """Rows in the database."""
    duplicates: int
    """Rows in the database that no row of a store stands for, or that stand there once more."""
    lost: int
    """Rows of the stores that are not in the database."""


def _sum_counts(counts: Any) -> int:
    """Return the sum of temperatures as counts, as the store holds them."""
    values = np.frombuffer(counts, dtype="<i2").astype(np.int64)
    return int(values[values != np.iinfo(np.int16).min].sum())


def _sum_degc(degc: Sequence[float | None]) -> int:
    return _sum_counts(int16_from_degc(np.array([np.nan if each is None else each for each in degc])).tobytes())


def _of_store(plan: FleetPlan, number: int, stream: str) -> Iterator[Row]:
    query, _, _ = KEYS[stream]
    with closing(connect_reader(plan.store(number))) as connection:
        for row in connection.execute(query):
            yield (row[0], row[1], _sum_counts(row[2])) if stream == "temperatures" else tuple(row)


def count_rows(plan: FleetPlan, connection: psycopg.Connection[Any], sink: str) -> Rows:
    """Hold the stores against the database, machine by machine."""
    found: Counter[str] = Counter()
    for number, name in enumerate(plan.names):
        cursor = Cursor.read(cursor_path(plan.store(number), sink)) or Cursor()
        found["sent"] += cursor.sent_rows
        found["acknowledged"] += _acknowledged(plan, number, cursor)
        for stream, (_, table, columns) in KEYS.items():
            there: Counter[Row] = Counter()
            query = f"SELECT {columns} FROM toolpoint.{table} WHERE machine = %s AND time >= to_timestamp(%s)"
            for row in connection.execute(query, (name, plan.start_utc_s)):
                there[(row[0], row[1], _sum_degc(row[2])) if stream == "temperatures" else tuple(row)] += 1
            here = Counter(_of_store(plan, number, stream))
            found["stored"] += there.total()
            found["lost"] += (here - there).total()
            found["duplicates"] += (there - here).total()
    names = ("sent", "acknowledged", "stored", "duplicates", "lost")
    return Rows(**{name: found[name] for name in names})


def stored_rows(plan: FleetPlan, connection: psycopg.Connection[Any]) -> int:
    """Return how many rows of the machines the database has."""
    counts = " + ".join(
        f"(SELECT count(*) FROM toolpoint.{table} WHERE machine = ANY(%(names)s) AND time >= to_timestamp(%(start)s))"
        for _, table, _ in KEYS.values()
    )
    given = {"names": list(plan.names), "start": plan.start_utc_s}
    (found,) = connection.execute(f"SELECT {counts}", given).fetchone() or (0,)
    return int(found)


def _acknowledged(plan: FleetPlan, number: int, cursor: Cursor) -> int:
    """Return how many rows of a store lie before the positions of a cursor."""
    tables = {"temperatures": "temperature_cycles", "cnc": "cnc_samples", "references": "reference_points"}
    with closing(connect_reader(plan.store(number))) as connection:
        return sum(
            _rows_up_to(connection, tables.get(stream, stream), position.row)
            for stream, position in cursor.positions.items()
        )


def _rows_up_to(connection: sqlite3.Connection, table: str, row: int) -> int:
    name = "write_id" if table == "writes" else "id"
    (found,) = connection.execute(f"SELECT count(*) FROM {table} WHERE {name} <= ?", (row,)).fetchone()
    return int(found)


class ArrivalWatch:
    """Asks the database again and again, in a thread of its own, for the newest cycle of every line."""

    def __init__(self, dsn: str, machines: Sequence[str], lines: Sequence[str]) -> None:
        self._dsn = dsn
        self._keys = [(machine, line) for machine in machines for line in lines]
        self._seen: dict[tuple[str, str], list[tuple[int, float]]] = {key: [] for key in self._keys}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arrivals", daemon=True)

    def __enter__(self) -> "ArrivalWatch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                with psycopg.connect(self._dsn, autocommit=True, connect_timeout=5) as connection:
                    while not self._stop.wait(LOOK_PERIOD_S):
                        self._look(connection)
            except psycopg.Error:  # the database is away, or has no table yet
                self._stop.wait(LOOK_PERIOD_S)

    def _look(self, connection: psycopg.Connection[Any]) -> None:
        machines, lines = zip(*self._keys, strict=True)
        found = connection.execute(NEWEST, (list(machines), list(lines))).fetchall()
        now_s = time.monotonic()
        for machine, line, newest_ms in found:
            seen = self._seen[machine, line]
            if newest_ms is not None and (not seen or newest_ms > seen[-1][0]):
                seen.append((newest_ms, now_s))

    def lags_s(self, plan: FleetPlan, commits: Sequence[Committed]) -> list[float]:
        """Return per cycle the time from its commit in the store until a query showed it [s]; those not seen miss."""
        names, found = plan.names, []
        for each in commits:
            seen = self._seen[names[each.machine], each.line]
            at = bisect.bisect_left(seen, (each.utc_ms, 0.0))
            if at < len(seen):
                found.append(max(0.0, seen[at][1] - each.monotonic_s))
        return found
