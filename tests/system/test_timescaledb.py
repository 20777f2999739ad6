"""The plant's database on TimescaleDB itself, which Debian has not: a build of it that runs in node, from npm.

That build ends at a COPY, so the rows go in by INSERT; what COPY does beforehand concerns a temporary table only.
"""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from filled_store import fill
from node_packages import NEEDS_NODE, installed
from psycopg import sql

from config.schema.sinks import PostgresqlConfig
from daemon.history.cursors import Position
from daemon.simulation.processes import free_port
from daemon.sinks.database import COLUMNS, PARTITIONED, SCHEMA, TABLES, Database, key_of, scripts
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.postgresql import CONVERSIONS

PEER = Path(__file__).resolve().parent / "timescaledb_peer"
pytestmark = [pytest.mark.wires, pytest.mark.slow, NEEDS_NODE]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PostgresqlConfig]:
    password, port = tmp_path_factory.mktemp("timescaledb") / "password", free_port()
    password.write_text("postgres")
    password.chmod(0o600)
    words = ["node", str(PEER / "server.js"), str(port)]
    with subprocess.Popen(words, env=installed(PEER), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as peer:
        assert peer.stdout is not None and peer.stdout.readline().strip() == "ready"
        there = {"host": "127.0.0.1", "port": port, "database": "postgres", "user_name": "postgres", "tls": False}
        yield PostgresqlConfig.model_validate(there | {"password_file": password})
        peer.kill()


@contextlib.contextmanager
def opened(config: PostgresqlConfig) -> Iterator[Database]:
    with contextlib.closing(Database(config, "database", "test")) as database:
        database.open()
        yield database


def test_tables_over_time_are_hypertables_that_hold_every_row_once(config: PostgresqlConfig, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=1.0)
    with opened(config):
        pass
    with opened(config) as database, database.transaction() as connection, Outbox(store) as outbox:  # again: it stays
        ask = connection.execute
        found = ask("SELECT hypertable_name FROM timescaledb_information.hypertables WHERE num_dimensions = 1")
        assert {name for (name,) in found} == set(PARTITIONED)
        assert ask("SELECT max(version) FROM schema_versions").fetchone() == (scripts()[-1][0],)
        for stream in STREAMS.values():
            batch = outbox.batch(stream, Position())
            if batch is None:
                continue
            target = sql.Identifier(SCHEMA, TABLES.get(stream.name, stream.name))
            names = ["machine", *(COLUMNS.get(name, name) for name in stream.columns)]
            insert = sql.SQL("INSERT INTO {} ({}) VALUES ({}) ON CONFLICT ({}) DO NOTHING").format(
                target,
                sql.SQL(", ").join(map(sql.Identifier, names)),
                sql.SQL(", ").join(sql.Placeholder() * len(names)),
                key_of(stream),
            )
            convert = [CONVERSIONS.get(name, lambda value: value) for name in stream.columns]
            for row in batch.rows * 2:
                ask(insert, ("mill 7", *(change(value) for change, value in zip(convert, row, strict=True))))
            assert ask(sql.SQL("SELECT count(*) FROM {}").format(target)).fetchone() == (len(batch.rows),)
        assert ask("SELECT count(*) > 0 FROM timescaledb_information.chunks").fetchone() == (True,)
        assert ask("SELECT count(DISTINCT sensor_id) FROM sensor_temperatures").fetchone() == (5,)
        ask("SELECT * FROM model_errors")
