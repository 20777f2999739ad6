"""The PostgreSQL sink: COPY into a staging table, then insert what is not there yet, in one transaction.

Every table has a key, so that a repeat changes nothing. The position stands in the database too: a database that was
restored from an older copy gets again what it lost.
"""

import ssl
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from importlib import resources
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, Position
from daemon.sinks.contract import Progress, SinkError
from daemon.sinks.outbox import STREAMS, Batch, Outbox
from daemon.sinks.postgresql_refusals import newer_schema, refusal, unreadable
from models.records import WriteOutcome

SCHEMA = "toolpoint"
ANSWER_TIMES = 6
"""An answer may take so many times as long as connecting."""
MIGRATING = 7_413_015
"""Number of the lock under which tables are made, so that the sinks of several machines do not make them at once."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
FIRST_YEAR, LAST_YEAR = 2000, 2100
"""Months of these years have a partition each; what a wrong clock has put elsewhere shares one."""
PARTITIONED = ("temperatures", "estimates", "writes", "cnc", "displacements")
TABLES = {"references": "reference_points"}
"""Stream -> its table, where that is called otherwise."""
COLUMNS = {"utc_ms": "time", "cycle_utc_ms": "cycle_time"}
AUTHORITIES = ("/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt")
"""Where Debian and Fedora keep them."""
Convert = Callable[[Any], Any]


def _time(ms: int) -> datetime:
    return EPOCH + timedelta(milliseconds=ms)


CONVERSIONS: Mapping[str, Convert] = {
    "utc_ms": _time,
    "cycle_utc_ms": _time,
    "complete": bool,
    "alarm": bool,
    "in_domain": bool,
    "accepted": bool,
    "outcome": lambda code: WriteOutcome(code).name.lower(),
}


def scripts() -> list[tuple[int, str]]:
    """Return the numbered SQL files of the schema in order."""
    folder = resources.files("daemon.sinks") / "schema"
    files = sorted((each for each in folder.iterdir() if each.name.endswith(".sql")), key=lambda each: each.name)
    return [(int(each.name.partition("_")[0]), each.read_text(encoding="utf-8")) for each in files]


def authorities() -> str:
    """Return the file of the authorities that this computer knows; the library that psycopg brings looks elsewhere."""
    known = (ssl.get_default_verify_paths().cafile, *AUTHORITIES)
    return next((path for path in known if path is not None and Path(path).is_file()), "system")


class PostgresqlSink:
    """One connection to one database."""

    def __init__(self, config: SinkConfig, machine: str) -> None:
        assert config.postgresql is not None
        self._config, self._machine = config.postgresql, machine
        self._where = f"sink {config.name}: database {config.place}"
        self._application = f"toolpoint sink {config.name}"
        self._connection: psycopg.Connection[Any] | None = None
        self._staged: set[str] = set()
        self._months: set[tuple[str, int, int]] = set()

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Connect, bring the schema up to date, and return how far the database itself has come."""
        try:
            connection = self._connection = self._connect()
            with connection.transaction():
                self._migrate(connection)
                found = connection.execute(
                    "SELECT stream, last_row, last_chunk FROM deliveries WHERE machine = %s AND generation = %s",
                    (self._machine, cursor.generation),
                ).fetchall()
        except (psycopg.Error, OSError) as error:
            raise SinkError(f"{self._where}: {refusal(error, self._config)}") from error
        return {stream: Position(row=row, chunk=chunk) for stream, row, chunk in found}

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        """Send a batch of each stream; True while one of them had one."""
        more = False
        for stream in STREAMS.values():
            batch = outbox.batch(stream, progress.position(stream.name))
            if batch is None:
                continue
            try:
                stored = self._store(batch, progress.cursor.generation)
            except (psycopg.Error, OSError) as error:
                raise SinkError(f"{self._where}: {refusal(error, self._config)}") from error
            progress.took(batch, stored)
            more = True
        return more

    def _store(self, batch: Batch, generation: str) -> int:
        """Store a batch and where the stream then stands; return how many rows were not there before."""
        connection = self._connection
        assert connection is not None
        stream = batch.stream
        table = TABLES.get(stream.name, stream.name)
        names = [sql.Identifier(COLUMNS.get(name, name)) for name in stream.columns]
        target, staging = sql.Identifier(SCHEMA, table), sql.Identifier(f"staging_{table}")
        columns = sql.SQL(", ").join([sql.Identifier("machine"), *names])
        convert = [CONVERSIONS.get(name) for name in stream.columns]
        with connection.transaction():
            if table in PARTITIONED:
                self._make_partitions(connection, table, batch)
            if table not in self._staged:
                like = sql.SQL("CREATE TEMP TABLE IF NOT EXISTS {} (LIKE {}) ON COMMIT DELETE ROWS")
                connection.execute(like.format(staging, target))
            with connection.cursor() as cursor:
                with cursor.copy(sql.SQL("COPY {} ({}) FROM STDIN").format(staging, columns)) as copy:
                    for row in batch.rows:
                        values = (c(v) if c else v for c, v in zip(convert, row, strict=True))
                        copy.write_row((self._machine, *values))
                insert = sql.SQL("INSERT INTO {} ({}) SELECT {} FROM {} ON CONFLICT DO NOTHING")
                cursor.execute(insert.format(target, columns, columns, staging))
                stored = cursor.rowcount
            connection.execute(
                "INSERT INTO deliveries (machine, stream, generation, last_row, last_chunk, newest) "
                "VALUES (%s, %s, %s, %s, %s, %s) ON CONFLICT (machine, stream) DO UPDATE SET "
                "generation = excluded.generation, last_row = excluded.last_row, last_chunk = excluded.last_chunk, "
                "newest = excluded.newest, delivered = now()",
                (
                    *(self._machine, stream.name, generation, batch.after.row, batch.after.chunk),
                    EPOCH + timedelta(seconds=batch.newest_utc_s),
                ),
            )
        self._staged.add(table)
        return stored

    def _make_partitions(self, connection: psycopg.Connection[Any], table: str, batch: Batch) -> None:
        days = {_time(ms).date() for ms in {86_400_000 * (row[0] // 86_400_000) for row in batch.rows}}
        missing = {(table, day.year, day.month) for day in days if FIRST_YEAR <= day.year < LAST_YEAR} - self._months
        if not missing:
            return
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (MIGRATING,))
        for _, year, month in sorted(missing):
            after = (year + month // 12, month % 12 + 1)
            make = sql.SQL("CREATE TABLE IF NOT EXISTS {} PARTITION OF {} FOR VALUES FROM ({}) TO ({})")
            connection.execute(
                make.format(
                    sql.Identifier(SCHEMA, f"{table}_{year}_{month:02d}"),
                    sql.Identifier(SCHEMA, table),
                    sql.Literal(f"{year}-{month:02d}-01 00:00:00+00"),
                    sql.Literal(f"{after[0]}-{after[1]:02d}-01 00:00:00+00"),
                )
            )
        self._months |= missing

    # --- connection and schema -----------------------------------------------------------------

    def _connect(self) -> psycopg.Connection[Any]:
        config = self._config
        answer_ms = int(ANSWER_TIMES * config.timeout_s * 1e3)
        tls: dict[str, Any] = {"sslmode": "disable"}
        if config.tls:
            tls = {"sslmode": "verify-full", "sslrootcert": str(config.ca_certificate or authorities())}
            if config.ca_certificate is not None and not config.ca_certificate.is_file():
                raise SinkError(f"{self._where}: {unreadable('ca_certificate', config.ca_certificate, 'no file')}")
        connection: psycopg.Connection[Any] = psycopg.connect(
            host=config.host,
            port=config.port,
            dbname=config.database,
            user=config.user_name,
            password=self._password(),
            connect_timeout=max(2, round(config.timeout_s)),
            tcp_user_timeout=answer_ms,
            keepalives_idle=max(1, round(config.timeout_s)),
            application_name=self._application,
            options=f"-c statement_timeout={answer_ms} -c search_path={SCHEMA}",
            autocommit=True,
            **tls,
        )
        return connection

    def _password(self) -> str | None:
        path = self._config.password_file
        if path is None:
            return None
        try:
            return path.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise SinkError(f"{self._where}: {unreadable('password_file', path, error)}") from error

    def _migrate(self, connection: psycopg.Connection[Any]) -> None:
        """Apply the scripts that the database does not have yet; refuse a schema of a newer version."""
        connection.execute("SELECT pg_advisory_xact_lock(%s)", (MIGRATING,))
        there = connection.execute("SELECT 1 FROM pg_namespace WHERE nspname = %s", (SCHEMA,)).fetchone()
        if there is None:
            connection.execute(sql.SQL("CREATE SCHEMA {}").format(sql.Identifier(SCHEMA)))
        connection.execute(
            "CREATE TABLE IF NOT EXISTS schema_versions (version integer PRIMARY KEY, "
            "applied timestamptz NOT NULL DEFAULT now())"
        )
        (version,) = connection.execute("SELECT coalesce(max(version), 0) FROM schema_versions").fetchone() or (0,)
        known = scripts()
        if version > known[-1][0]:
            raise SinkError(f"{self._where}: {newer_schema(version, known[-1][0])}")
        for number, script in known:
            if number > version:
                connection.execute(script)
                for table in PARTITIONED if number == 1 else ():
                    make = sql.SQL("CREATE TABLE {} PARTITION OF {} DEFAULT")
                    names = sql.Identifier(SCHEMA, f"{table}_other"), sql.Identifier(SCHEMA, table)
                    connection.execute(make.format(*names))
                connection.execute("INSERT INTO schema_versions (version) VALUES (%s)", (number,))
