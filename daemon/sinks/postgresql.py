"""The PostgreSQL sink: rows of one machine, and how far they have come, in one transaction.

The position stands in the database: one that was restored from an older copy gets again what it lost. Where another
computer has sent the same store, it may be beyond what this one has sent: then the cursor says how far that is.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import psycopg

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position
from daemon.sinks.contract import Progress
from daemon.sinks.database import EPOCH, Database, time_of
from daemon.sinks.outbox import DAY_MS, STREAMS, Batch, Outbox
from daemon.sinks.postgresql_refusals import LESS_THAN_BEFORE, name_taken
from daemon.sinks.row_messages import JSON_COLUMNS
from models.records import WriteOutcome

CARDS = Path("/sys/class/net")
STARTED = Path("/proc/sys/kernel/random/boot_id")
"""For a computer without network cards of its own, such as a container: another number after each start."""


@functools.cache
def this_computer(cards: Path = CARDS, started: Path = STARTED) -> str:
    """Return a number that is the same over restarts and reveals no address; '' where nothing tells."""
    found = sorted({_read(each / "address") for each in cards.glob("*") if (each / "device").exists()} - {""})
    known = " ".join(found) or _read(started)
    return hashlib.sha256(known.encode()).hexdigest()[:16] if known else ""


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text("ascii").strip()
    return ""


def spelled_out(value: Any) -> Any:
    r"""Return JSON without escapes such as \u9577, which a database takes in the encoding UTF8 only."""
    return json.dumps(json.loads(value), ensure_ascii=False) if isinstance(value, str) and "\\u" in value else value


CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {
    **dict.fromkeys(JSON_COLUMNS, spelled_out),
    "utc_ms": time_of,
    "cycle_utc_ms": time_of,
    "complete": bool,
    "alarm": bool,
    "in_domain": bool,
    "accepted": bool,
    "outcome": lambda code: WriteOutcome(code).name.lower(),
}

DELIVERED = """
INSERT INTO deliveries (machine, stream, generation, computer, last_row, last_chunk, newest)
VALUES (%s, %s, %s, %s, %s, %s, %s)
ON CONFLICT (machine, stream) DO UPDATE SET generation = excluded.generation, computer = excluded.computer,
    last_row = excluded.last_row, last_chunk = excluded.last_chunk, newest = excluded.newest, delivered = now()
RETURNING (
    SELECT count(*) FROM deliveries AS other
    WHERE other.machine = deliveries.machine AND other.delivered BETWEEN now() - interval '1 minute' AND now()
    AND (
        other.generation NOT IN ('', deliveries.generation)
        OR (other.computer <> deliveries.computer AND '' NOT IN (other.computer, deliveries.computer))
    )
), EXISTS (
    SELECT FROM deliveries AS before WHERE before.machine = deliveries.machine AND before.stream = deliveries.stream
    AND before.generation = %s AND before.last_row >= %s AND before.last_chunk >= %s
)
"""
"""Says how many streams of this machine another store or computer has brought in the last minute, and whether the
database still was as far as it is known to have been."""


class PostgresqlSink:
    """One connection to one database."""

    def __init__(self, config: SinkConfig, machine: str) -> None:
        assert config.postgresql is not None
        self._machine, self._computer = machine, this_computer()
        where = f"sink {config.name}: database {config.place}"
        self._database = Database(config.postgresql, where, f"toolpoint sink {config.name}")
        self._there: dict[str, tuple[str, int, int]] = {}
        """By stream: generation, row and chunk that the database has come to."""

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Connect, bring the schema up to date, and return how far the database itself has come."""
        self._database.open()
        try:
            found = self._database.connection.execute(
                "SELECT stream, computer IN ('', %s), generation, last_row, last_chunk FROM toolpoint.deliveries "
                "WHERE machine = %s",
                (self._computer, self._machine),
            ).fetchall()
        except (psycopg.Error, OSError) as error:
            raise self._database.refused(error) from error
        positions = {}
        for stream, own, generation, row, chunk in found:
            self._there[stream] = generation, row, chunk
            if generation != cursor.generation:
                continue
            known = Position(row=row, chunk=chunk) if own else cursor.positions.get(stream, Position())
            positions[stream] = Position(row=min(row, known.row), chunk=min(chunk, known.chunk))
        return positions

    def close(self) -> None:
        self._database.close()

    def needs_rows(self) -> bool:
        return True

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Send a batch of each stream; True while one of them has more."""
        more = False
        for stream in STREAMS.values():
            batch = outbox.batch(stream, progress.position(stream.name))
            if batch is None:
                continue
            try:
                stored = self._store(batch, progress.cursor.generation)
            except (psycopg.Error, OSError) as error:
                raise self._database.refused(error) from error
            progress.took(batch, stored)
            more |= not batch.last
        return more

    def _store(self, batch: Batch, generation: str) -> int:
        """Store a batch and where the stream then stands; return how many rows were not there before."""
        stream = batch.stream
        convert = [CONVERSIONS.get(name) for name in stream.columns]
        rows = ((self._machine, *(c(v) if c else v for c, v in zip(convert, row, strict=True))) for row in batch.rows)
        with self._database.transaction() as connection:
            stored = self._database.put(stream, rows, {row[0] // DAY_MS for row in batch.rows})
            position = batch.after.row, batch.after.chunk, EPOCH + timedelta(seconds=batch.newest_utc_s)
            place = self._machine, stream.name, generation, self._computer
            before = self._there.get(stream.name)
            told = connection.execute(DELIVERED, (*place, *position, *(before or ("", 0, 0)))).fetchone()
            assert told is not None
            others, is_as_far = told
            if others:
                raise self._database.problem(name_taken(self._machine))
            if before is not None and not is_as_far:
                raise self._database.problem(LESS_THAN_BEFORE)
        self._there[stream.name] = generation, batch.after.row, batch.after.chunk
        return stored
