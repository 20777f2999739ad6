"""The plant's PostgreSQL database: its schema, and rows by COPY into a staging table, then what is not there yet.

Every table has a key, so that a repeat changes nothing. Where TimescaleDB is there when the schema is made, the tables
of rows over time are its hypertables, else they have partitions by month; one that is partitioned stays so.
"""

import contextlib
import math
import ssl
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from importlib import resources
from pathlib import Path
from typing import Any

import psycopg
import structlog
from psycopg import errors, sql
from psycopg.waiting import READY_NONE

from config.schema.sinks import PostgresqlConfig
from config.secret_files import SecretError, read_secret
from daemon.sinks.contract import SinkError
from daemon.sinks.outbox import Stream
from daemon.sinks.postgresql_refusals import newer_schema, other_encoding, refusal
from daemon.sinks.row_messages import KEYS

log = structlog.get_logger(__name__)
SCHEMA = "toolpoint"
STORE = "toolpoint store"
"""What the connection of a plant's store is called."""
ANSWER_TIMES = 6
"""An answer may take so many times as long as connecting."""
GIVE_UP_TIMES = 7
"""After so many a server is given up that does not keep to its own limit, because it hangs."""
SETTINGS = (
    "SELECT set_config('search_path', %s, true), set_config('statement_timeout', %s, true), "
    "set_config('client_min_messages', 'warning', true)"
)
"""For one transaction; the last keeps quiet about tables that are there already."""
MIGRATING = 7_413_015
"""Number of the lock under which tables are made, so that the sinks of several machines do not make them at once."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
FIRST_YEAR, LAST_YEAR = 2000, 2100
"""Months of these years have a partition each; what a wrong clock has put elsewhere shares one."""
PARTITIONED = ("temperatures", "estimates", "writes", "cnc", "displacements")
PARTITIONING = " PARTITION BY RANGE (time)"
"""What the first script says of them."""
CHUNK = "7 days"
"""What a hypertable keeps together: TimescaleDB's own choice."""
ENCODINGS = ("UTF8", "SQL_ASCII")
"""Encodings of a database that holds every text; the second is none, and keeps what it is given."""
TABLES = {"references": "reference_points"}
"""Stream -> its table, where that is called otherwise."""
COLUMNS = {"utc_ms": "time", "cycle_utc_ms": "cycle_time"}
AUTHORITIES = ("/etc/ssl/certs/ca-certificates.crt", "/etc/pki/tls/certs/ca-bundle.crt")
"""Where Debian and Fedora keep them."""


def time_of(ms: int) -> datetime:
    """Return a time in milliseconds since 1970 as the database takes it."""
    return EPOCH + timedelta(milliseconds=ms)


def scripts() -> list[tuple[int, str]]:
    """Return the numbered SQL files of the schema in order."""
    folder = resources.files("daemon.sinks") / "schema"
    files = sorted((each for each in folder.iterdir() if each.name.endswith(".sql")), key=lambda each: each.name)
    return [(int(each.name.partition("_")[0]), each.read_text(encoding="utf-8")) for each in files]


def key_of(stream: Stream) -> sql.Composable:
    """Return what tells rows of a stream apart: a repeat is left out by that alone, whatever else a table has got."""
    names = ("machine", *(COLUMNS.get(name, name) for name in KEYS[stream.name]))
    hashed = {"text": sql.SQL("md5(text)"), "um": sql.SQL("md5(um::text)")}  # as the schema's own indexes have them
    return sql.SQL(", ").join(hashed.get(name, sql.Identifier(name)) for name in names)


def authorities() -> str:
    """Return the file of the authorities that this computer knows; the library that psycopg brings looks elsewhere."""
    known = (ssl.get_default_verify_paths().cafile, *AUTHORITIES)
    return next((path for path in known if path is not None and Path(path).is_file()), "system")


class PatientConnection(psycopg.Connection[Any]):
    """Gives a server up that says nothing for too long: one that hangs does not keep to `statement_timeout` either."""

    patience_s = math.inf

    def wait(self, gen: Any, *rest: Any, **more: Any) -> Any:
        """Wait for an answer; raises OperationalError, and the connection is closed, when it takes too long."""
        return super().wait(self._bounded(gen), *rest, **more)

    def _bounded(self, gen: Generator[Any, Any, Any]) -> Generator[Any, Any, Any]:
        until_s, ready = time.monotonic() + self.patience_s, None
        while True:
            if ready == READY_NONE and time.monotonic() > until_s:
                self.pgconn.finish()
                raise psycopg.OperationalError(f"statement timeout: the server says nothing for {self.patience_s:g} s")
            try:
                ready = yield gen.send(ready)
            except StopIteration as end:
                return end.value


class Database:
    """One connection; a new one is made after every SinkError."""

    def __init__(self, config: PostgresqlConfig, where: str, application: str) -> None:
        self._config, self._where, self._application = config, where, application
        self._connection: PatientConnection | None = None
        self._months: set[tuple[str, int, int]] = set()
        self._partitioned: set[str] = set()
        self._version = 0

    @property
    def connection(self) -> psycopg.Connection[Any]:
        """The connection, in which whoever uses it begins and ends transactions."""
        assert self._connection is not None
        return self._connection

    def open(self) -> None:
        """Connect and bring the schema up to date; raises SinkError."""
        try:
            connection = self._connection = self._connect()
            with connection.transaction():
                self._set(connection)
                self._migrate(connection)
            connection.patience_s = GIVE_UP_TIMES * self._config.timeout_s
            found = connection.execute(
                "SELECT relname FROM pg_class WHERE relnamespace = %s::regnamespace AND relkind = 'p'", (SCHEMA,)
            )
            self._partitioned = {name for (name,) in found}
        except (psycopg.Error, OSError) as error:
            raise self.refused(error) from error

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()

    def refused(self, error: Exception) -> SinkError:
        return self.problem(refusal(error, self._config))

    def problem(self, text: str) -> SinkError:
        return SinkError(f"{self._where}: {text}")

    @contextlib.contextmanager
    def transaction(self) -> Iterator[psycopg.Connection[Any]]:
        """Begin and commit a transaction, in which rows are put."""
        months = set(self._months)
        try:
            with self.connection.transaction():
                self._set(self.connection)
                yield self.connection
        except BaseException:
            self._months = months  # what was made is gone with the rest
            raise

    def _set(self, connection: psycopg.Connection[Any]) -> None:
        """Begin a transaction as every one begins: a pooler may give each another connection, and others get it then.

        Not as `options` of the connection: a pooler (PgBouncer) leaves those out.
        """
        connection.execute(SETTINGS, (SCHEMA, str(int(ANSWER_TIMES * self._config.timeout_s * 1e3))))

    def put(self, stream: Stream, rows: Iterable[Sequence[Any]], days: Iterable[int]) -> int:
        """Store rows of a stream, machine first, within a transaction; return how many were not there before.

        `days` since 1970 of which there are rows. Raises psycopg.Error.
        """
        connection = self.connection
        table = TABLES.get(stream.name, stream.name)
        names = [sql.Identifier(COLUMNS.get(name, name)) for name in stream.columns]
        # A pooler lends a connection with what another version of this product has made for its columns.
        target, staging = sql.Identifier(SCHEMA, table), sql.Identifier(f"staging_{table}_{self._version}")
        columns = sql.SQL(", ").join([sql.Identifier("machine"), *names])
        self.make_months(stream, days)
        like = sql.SQL("CREATE TEMP TABLE IF NOT EXISTS {} ON COMMIT DELETE ROWS AS SELECT {} FROM {} WITH NO DATA")
        connection.execute(like.format(staging, columns, target))
        with connection.cursor() as cursor:
            with cursor.copy(sql.SQL("COPY {} ({}) FROM STDIN").format(staging, columns)) as copy:
                for row in rows:
                    copy.write_row(row)
            insert = sql.SQL("INSERT INTO {} ({}) SELECT {} FROM {} ON CONFLICT ({}) DO NOTHING")
            cursor.execute(insert.format(target, columns, columns, staging, key_of(stream)))
            return cursor.rowcount

    def make_months(self, stream: Stream, days: Iterable[int]) -> None:
        """Make the partitions of a stream that are missing, within a transaction.

        One that puts rows of several streams makes those of all of them first: the lock under which they are made is
        taken before a table's, or two that do so at a month's beginning would wait for each other.
        """
        table = TABLES.get(stream.name, stream.name)
        if table not in self._partitioned:
            return
        dates = {time_of(86_400_000 * day).date() for day in days}
        missing = {(table, day.year, day.month) for day in dates if FIRST_YEAR <= day.year < LAST_YEAR} - self._months
        if not missing:
            return
        for _, year, month in sorted(missing):
            name = f"{SCHEMA}.{table}_{year}_{month:02d}"
            if self.connection.execute("SELECT to_regclass(%s)", (name,)).fetchone() != (None,):
                continue  # made by another machine's sink; asking for it again would wait for all that write there
            self.connection.execute("SELECT pg_advisory_xact_lock(%s)", (MIGRATING,))
            after = (year + month // 12, month % 12 + 1)
            make = sql.SQL("CREATE TABLE IF NOT EXISTS {} PARTITION OF {} FOR VALUES FROM ({}) TO ({})")
            query = make.format(
                sql.Identifier(SCHEMA, f"{table}_{year}_{month:02d}"),
                sql.Identifier(SCHEMA, table),
                sql.Literal(f"{year}-{month:02d}-01 00:00:00+00"),
                sql.Literal(f"{after[0]}-{after[1]:02d}-01 00:00:00+00"),
            )
            # Rows that came while a month's table was dropped stand in TABLE_other, and those that follow do too.
            with contextlib.suppress(errors.CheckViolation), self.connection.transaction():
                self.connection.execute(query)
        self._months |= missing

    # --- connection and schema -----------------------------------------------------------------

    def _connect(self) -> PatientConnection:
        config = self._config
        answer_ms = int(ANSWER_TIMES * config.timeout_s * 1e3)
        tls: dict[str, Any] = {"sslmode": "disable"}
        if config.tls:
            tls = {"sslmode": "verify-full", "sslrootcert": str(config.ca_certificate or authorities())}
            if config.ca_certificate is not None and not config.ca_certificate.is_file():
                raise self.problem(f"`ca_certificate` {config.ca_certificate} cannot be read: check the path")
        connection = PatientConnection.connect(
            host=config.host,
            port=config.port,
            dbname=config.database,
            user=config.user_name,
            password=self._password(),
            connect_timeout=max(2, round(config.timeout_s)),
            tcp_user_timeout=answer_ms,
            keepalives_idle=max(1, round(config.timeout_s)),
            application_name=self._application,
            client_encoding="UTF8",  # else that of the database, which may be none (SQL_ASCII)
            target_session_attrs="read-write",  # of several servers, or addresses of one name, that which takes writes
            autocommit=True,
            prepare_threshold=None,  # behind a pooler another connection may have statements of the same names
            **tls,
        )
        connection.patience_s = GIVE_UP_TIMES * config.timeout_s
        return connection

    def _password(self) -> str | None:
        path = self._config.password_file
        try:
            return None if path is None else read_secret("password_file", path)
        except SecretError as error:
            raise self.problem(str(error)) from error

    def _migrate(self, connection: PatientConnection) -> None:
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
        self._version = known[-1][0]
        if version > known[-1][0]:
            raise SinkError(f"{self._where}: {newer_schema(version, known[-1][0])}")
        encoding = connection.info.parameter_status("server_encoding")
        if version == 0 and encoding not in ENCODINGS:
            raise SinkError(f"{self._where}: {other_encoding(str(encoding))}")
        if version < known[-1][0]:  # a table of years takes longer than an answer may
            connection.execute("SET LOCAL statement_timeout = 0")
            connection.patience_s = math.inf
        for number, script in known:
            if number > version:
                if number > 1:
                    connection.execute(script)
                elif not self._make_hypertables(connection, script):
                    connection.execute(script)
                    for table in PARTITIONED:
                        make = sql.SQL("CREATE TABLE {} PARTITION OF {} DEFAULT")
                        names = sql.Identifier(SCHEMA, f"{table}_other"), sql.Identifier(SCHEMA, table)
                        connection.execute(make.format(*names))
                connection.execute("INSERT INTO schema_versions (version) VALUES (%s)", (number,))

    def _make_hypertables(self, connection: psycopg.Connection[Any], script: str) -> bool:
        """Apply the first script with TimescaleDB, where that is there and takes it."""
        found = connection.execute(
            "SELECT n.nspname FROM pg_proc AS p JOIN pg_namespace AS n ON n.oid = p.pronamespace "
            "WHERE p.proname = 'create_hypertable' LIMIT 1"
        ).fetchone()
        if found is None:
            return False
        make = sql.SQL(
            "SELECT {}(%s::regclass, 'time', chunk_time_interval => %s::interval, create_default_indexes => false)"
        ).format(sql.Identifier(found[0], "create_hypertable"))
        try:
            with connection.transaction():
                connection.execute(script.replace(PARTITIONING, ""))
                for table in PARTITIONED:
                    connection.execute(make, (f"{SCHEMA}.{table}", CHUNK))
        except psycopg.Error as error:
            log.warning("database.timescaledb", problem=f"not used: {refusal(error, self._config)}")
            return False
        return True
