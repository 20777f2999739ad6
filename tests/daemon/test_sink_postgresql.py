"""The history in PostgreSQL: nothing lost and nothing doubled, whatever is killed; refusals that name the key."""

import contextlib
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import history_records as make
import numpy as np
import psycopg
import pytest
import yaml
from certificates import make_certificate
from filled_store import add, fill
from history_records import EPOCH_S, SMALL, StillClock
from postgresql import PASSWORD, PATIENCE_S, USER, Server, postgresql
from tidied_store import housekeeping

from config.sample import sample_configuration
from config.schema.service import HistoryConfig
from config.schema.sinks import PostgresqlConfig, SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.simulation.processes import free_port
from daemon.sinks.contract import SinkError
from daemon.sinks.database import Database, authorities, scripts
from daemon.sinks.outbox import STREAMS
from daemon.sinks.postgresql import PostgresqlSink, this_computer
from daemon.sinks.postgresql_refusals import refusal
from daemon.sinks.running import SinkRunner, make_sink

MACHINE = "mill 7"
CONFIG = HistoryConfig(pack_after_s=3600.0)


@pytest.fixture(scope="module")
def running_server() -> Iterator[Server]:
    with postgresql() as made:
        yield made


@pytest.fixture
def server(running_server: Server) -> Server:
    running_server.empty()
    return running_server


def section(server: Server, folder: Path, **changes: object) -> SinkConfig:
    (folder / "password").write_text(f"{PASSWORD}\n")
    (folder / "password").chmod(0o600)
    known = {"host": "127.0.0.1", "port": server.port, "tls": False, "password_file": folder / "password"}
    return SinkConfig.model_validate({"name": "plant", "driver": "postgresql", "postgresql": known | changes})


def runner_for(server: Server, folder: Path, path: Path, machine: str = MACHINE, **changes: object) -> SinkRunner:
    """A sink that ends when nothing waits any more, or when it fails."""
    stop = threading.Event()
    config = section(server, folder, **changes)
    return SinkRunner(config, path, machine, stop, wait=lambda _duration_s: stop.set())


def send(server: Server, folder: Path, path: Path, **changes: object) -> Cursor:
    """Send all that waits."""
    runner = runner_for(server, folder, path, **changes)
    runner.run()
    return runner.cursor


def counts(server: Server) -> dict[str, int]:
    tables = {name: "reference_points" if name == "references" else name for name in STREAMS}
    return {name: server.ask(f"SELECT count(*) FROM toolpoint.{table}")[0][0] for name, table in tables.items()}


def test_every_record_arrives_with_its_values(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store)
    cursor = send(server, tmp_path, store)
    assert cursor.problem == ""
    assert cursor.sent_rows == cursor.stored_rows == sum(counts(server).values())
    assert counts(server) == {
        "temperatures": 72,
        **dict.fromkeys(("estimates", "cnc", "displacements", "events"), 36),
        "writes": 34,  # those of the last ten minutes wait for the guard's echo
        "probes": 0,
        "references": 4,
    }
    with HistoryReader(store) as reader:
        history = reader.temperatures([13, 11, 12], EPOCH_S, EPOCH_S + 4e4)
    found = server.ask(
        "SELECT extract(epoch FROM time)::float8, degc, quality, complete, faults->>0 FROM toolpoint.temperatures "
        "WHERE line = 'spindle' ORDER BY time"
    )
    assert [row[0] for row in found] == history.time_s[np.array(history.line) == "spindle"].tolist()
    assert found[1][1] == [20.0625, None, 20.1875] and found[1][3:] == (True, "ID 2 did not arrive")
    one = server.ask(
        "SELECT machine, label_degc->>'A', thermal_error_um->>'dy', cycle_time < time, in_domain "
        "FROM toolpoint.estimates ORDER BY time LIMIT 1"
    )
    assert one == [(MACHINE, "25.125", None, True, True)]
    assert server.ask("SELECT outcome, read_back = macros FROM toolpoint.writes GROUP BY 1, 2") == [("verified", True)]
    assert server.ask("SELECT text FROM toolpoint.events ORDER BY time LIMIT 1") == [("number 0\nsecond line \u00b5",)]
    by_sensor = server.ask(
        "SELECT degc FROM toolpoint.sensor_temperatures WHERE sensor_id = 12 AND machine = 'mill 7' ORDER BY time"
    )
    assert [row[0] for row in by_sensor] == [20.1875] * 36


def test_what_was_packed_meanwhile_arrives_and_repeats_change_nothing(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=1.5)
    send(server, tmp_path, store)
    fill(store, start_s=EPOCH_S + 5400.0, hours=3.5)
    assert housekeeping(store, CONFIG, EPOCH_S + 5 * 3600.0).packed_hours > 0
    cursor = send(server, tmp_path, store)
    assert cursor.problem == "" and cursor.sent_rows > cursor.stored_rows, "half an hour comes again with its chunk"
    assert counts(server)["temperatures"] == 120 and counts(server)["cnc"] == 60
    before = counts(server)
    server.ask("DELETE FROM toolpoint.deliveries RETURNING 1")
    again = send(server, tmp_path, store)
    assert counts(server) == before
    assert again.stored_rows == cursor.stored_rows and again.sent_rows > cursor.sent_rows, "it was all sent once more"


def test_a_write_is_sent_once_its_outcome_and_echo_are_known(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    clock = StillClock()
    writer = HistoryWriter(store, clock=clock, machine=SMALL)
    writer.start()
    with contextlib.closing(writer):
        written = make.macros(1, np.zeros(3))
        first = writer.write_intent(make.command(np.zeros(3)), written, "cycle")
        writer.temperatures(None, make.cycle("bed", 1, EPOCH_S + 1.0, np.zeros(2)))
        writer.event("note", "there").result(30.0)
        send(server, tmp_path, store)
        assert counts(server)["writes"] == 0
        writer.write_outcome(first, make.receipt(EPOCH_S, written)).result(30.0)
        send(server, tmp_path, store)
        assert counts(server)["writes"] == 0, "the guard has not taken it over yet"
        echoed = make.instant(EPOCH_S + 4.0)
        writer.write_echoed(int(first), replace(make.receipt(EPOCH_S, written).trace, echoed=echoed)).result(30.0)
        send(server, tmp_path, store)
        assert server.ask("SELECT outcome, echoed_after_ms FROM toolpoint.writes") == [("verified", 2500.0)]
        writer.write_intent(make.command(np.zeros(3)), written, "cycle")
        writer.temperatures(None, make.cycle("bed", 2, EPOCH_S + 7000.0, np.zeros(2)))
        writer.event("note", "later").result(30.0)
        send(server, tmp_path, store)
    assert server.ask("SELECT outcome FROM toolpoint.writes ORDER BY write_id") == [("verified",), ("intended",)]


def test_killed_and_restarted_under_load_nothing_is_lost_and_nothing_doubled(server: Server, tmp_path: Path) -> None:
    """The server is killed while rows come in and go out; the sender dies between its commit and its own note."""
    store = tmp_path / "h.sqlite"
    turns, deaths, stop = itertools.count(1), [], threading.Event()

    class Dying(PostgresqlSink):
        def _store(self, batch, generation):
            stored = super()._store(batch, generation)
            if next(turns) % 3 == 0:
                deaths.append(batch.stream.name)
                raise SinkError("the sender dies before it has noted the acknowledgement")
            return stored

    runner = SinkRunner(
        section(server, tmp_path), store, MACHINE, stop, Dying, wait=lambda _duration_s: stop.wait(0.02)
    )
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    sending = threading.Thread(target=runner.run)
    sending.start()
    try:
        for half_hour in range(24):
            add(writer, EPOCH_S + 1800.0 * half_hour, 0.5)
            if half_hour % 6 == 5:
                server.kill()
                server.start()
        writer.close()
        housekeeping(store, CONFIG, EPOCH_S + 6 * 3600.0)
        expected = {"temperatures": 288, **dict.fromkeys(("cnc", "estimates", "displacements", "events"), 144)}
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            with contextlib.suppress(psycopg.errors.UndefinedTable):  # the sender has not come through yet
                if {name: counts(server)[name] for name in expected} == expected:
                    break
            time.sleep(0.1)
    finally:
        stop.set()
        sending.join()
    assert {name: counts(server)[name] for name in expected} == expected
    assert server.ask("SELECT count(*), count(DISTINCT (line, time)) FROM toolpoint.temperatures") == [(288, 288)]
    assert deaths


def test_the_command_is_killed_and_goes_on_where_it_was(server: Server, tmp_path: Path) -> None:
    """`toolpoint sink run` as systemd runs it, killed without a word; `sink status` says how far it is."""
    store, config = tmp_path / "h.sqlite", tmp_path / "t.yaml"
    there = section(server, tmp_path).model_dump(mode="json")
    document = yaml.safe_load(sample_configuration())
    config.write_text(
        yaml.safe_dump(document | {"history": {"path": str(store)}, "sinks": [there | {"period_s": 0.05}]})
    )
    command = [sys.executable, "-P", "-m", "daemon.cli", "sink"]
    fill(store, hours=1.0)
    for turn, number in enumerate((signal.SIGKILL, signal.SIGTERM)):
        process = subprocess.Popen([*command, "run", "--config", str(config)], stderr=subprocess.DEVNULL)
        try:
            deadline_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline_s and stored(server) < 12 * (turn + 1):
                time.sleep(0.05)
            process.send_signal(number)
            assert process.wait(PATIENCE_S) == (0 if number == signal.SIGTERM else -number)
        finally:
            process.kill()
        fill(store, start_s=EPOCH_S + 3600.0 * (turn + 1), hours=1.0)
    assert stored(server) == 24
    done = subprocess.run([*command, "status", "-c", str(config), "--json", "-"], capture_output=True, check=False)
    assert done.returncode == 1
    (said,) = json.loads(done.stdout)["sinks"]
    assert not said["running"] and said["problem"] == "" and said["rows"]["waiting"]["cnc"] == 12
    words = subprocess.run([*command, "status", "-c", str(config)], capture_output=True, check=False, text=True)
    assert words.returncode == 1
    assert "plant (postgresql, 127.0.0.1:" in words.stdout and "12 cnc" in words.stdout


def stored(server: Server) -> int:
    """Return the polls that arrived; 0 before there is a table."""
    try:
        return counts(server)["cnc"]
    except psycopg.errors.UndefinedTable:
        return 0


def test_a_store_that_was_begun_anew_is_sent_from_its_beginning(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store)
    send(server, tmp_path, store)
    store.unlink()
    fill(store, start_s=EPOCH_S + 86_400.0, hours=1.0)
    assert "begun anew waits this minute" in send(server, tmp_path, store).problem and counts(server)["cnc"] == 36
    a_minute_later(server)
    assert send(server, tmp_path, store).problem == "" and counts(server)["cnc"] == 36 + 12


def a_minute_later(server: Server) -> None:
    with server.connection() as connection:
        connection.execute("UPDATE toolpoint.deliveries SET delivered = delivered - interval '1 minute'")


@pytest.mark.parametrize("generation", ["as it was", "of a store before"])
def test_a_database_that_is_restored_while_the_sink_is_connected_gets_again_what_it_lost(
    server: Server, tmp_path: Path, generation: str
) -> None:
    """As `pg_restore --clean` and COPY do, which end no connection."""
    store, stop, problems = tmp_path / "h.sqlite", threading.Event(), []
    fill(store, hours=0.5)
    send(server, tmp_path, store)
    copies = {name: f"copy_of_{name}" for name in (*counts(server), "deliveries") if name != "references"}
    with server.connection() as connection:
        for name, copy in copies.items():
            connection.execute(f"CREATE TEMP TABLE {copy} AS TABLE toolpoint.{name}")
        if generation == "of a store before":
            connection.execute("UPDATE copy_of_deliveries SET generation = 'before'")
        fill(store, start_s=EPOCH_S + 1800.0, hours=0.5)

        def wait(_duration_s: float) -> None:
            problems.append(runner.cursor.problem)
            if len(problems) == 1:
                assert counts(server)["cnc"] == 12
                for name, copy in copies.items():
                    connection.execute(f"DELETE FROM toolpoint.{name}")
                    connection.execute(f"INSERT INTO toolpoint.{name} SELECT * FROM {copy}")
                a_minute_later(server)
                fill(store, start_s=EPOCH_S + 3600.0, hours=0.5)
            if len(problems) > 5:
                stop.set()

        runner = SinkRunner(section(server, tmp_path), store, MACHINE, stop, wait=wait)
        runner.run()
    assert runner.cursor.problem == "" and any("it has less than it had" in problem for problem in problems)
    found = counts(server)
    assert (found["temperatures"], found["estimates"], found["cnc"], found["events"]) == (36, 18, 18, 18), (
        "each row once"
    )


def test_two_machines_of_one_name_do_not_mix_their_rows(server: Server, tmp_path: Path) -> None:
    first, second = tmp_path / "1.sqlite", tmp_path / "2.sqlite"
    for store in (first, second):
        fill(store, hours=0.5)
    assert send(server, tmp_path, first).problem == ""
    refused = send(server, tmp_path, second)
    assert (
        f"another store, or this one on another computer, has sent as {MACHINE} in the last minute" in refused.problem
    )
    assert refused.sent_rows == 0
    fill(first, start_s=EPOCH_S + 1800.0, hours=0.5)
    assert send(server, tmp_path, first).problem == "", "the other one did not disturb it"
    a_minute_later(server)
    assert send(server, tmp_path, second).problem == "", "the first is off, or was replaced"
    fill(first, start_s=EPOCH_S + 7200.0, hours=0.5)
    assert "another store" in send(server, tmp_path, first).problem, "it comes back"


class Copied(PostgresqlSink):
    """The sink of a computer whose disk is a copy of another one's."""

    def __init__(self, config: SinkConfig, machine: str) -> None:
        super().__init__(config, machine)
        self._computer = "the other one"


def test_a_copied_disk_is_refused_and_neither_computer_loses_a_row(server: Server, tmp_path: Path) -> None:
    """Both have the same store, each beyond the copy with rows of its own under the same numbers."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    fill(here / "h.sqlite", hours=0.5)
    assert send(server, tmp_path, here / "h.sqlite").problem == ""
    shutil.copytree(here, there)
    fill(here / "h.sqlite", start_s=EPOCH_S + 1800.0, hours=0.5)
    fill(there / "h.sqlite", start_s=EPOCH_S + 1860.0, hours=1.0)

    def send_from(folder: Path) -> Cursor:
        runner = runner_for(server, tmp_path, folder / "h.sqlite")
        runner._open_sink = make_sink if folder is here else Copied
        runner.run()
        return runner.cursor

    refused = send_from(there)
    assert "or this one on another computer, has sent" in refused.problem and counts(server)["cnc"] == 6
    assert send_from(here).problem == "", "the copy did not disturb it"
    a_minute_later(server)
    assert send_from(there).problem == "", "the first is off, or its disk was moved"
    fill(here / "h.sqlite", start_s=EPOCH_S + 3600.0, hours=0.25)
    assert "on another computer" in send_from(here).problem and counts(server)["cnc"] == 6 + 6 + 12
    a_minute_later(server)
    assert send_from(here).problem == "" and counts(server)["cnc"] == 6 + 6 + 12 + 3
    a_minute_later(server)
    fill(there / "h.sqlite", start_s=EPOCH_S + 7200.0, hours=0.25)
    assert send_from(there).problem == "" and counts(server)["cnc"] == 6 + 6 + 12 + 3 + 3


def test_a_computer_is_known_by_its_network_cards_and_stays_the_same_over_a_restart(tmp_path: Path) -> None:
    def computer(name: str, start: str, *addresses: str) -> str:
        cards = tmp_path / name / start
        for number, address in enumerate(addresses):
            (cards / f"eth{number}" / "device").mkdir(parents=True)
            (cards / f"eth{number}" / "address").write_text(f"{address}\n")
        (cards / "docker0").mkdir(parents=True)
        (cards / "docker0" / "address").write_text(f"{start}\n")
        (started := cards.with_suffix(".boot")).write_text(f"{start}\n")
        return this_computer(cards, started)

    assert computer("a", "1", "02:00:00:00:00:01", "02:00:00:00:00:02") == computer(
        "a", "2", "02:00:00:00:00:02", "02:00:00:00:00:01"
    )
    assert computer("a", "3", "02:00:00:00:00:01") != computer("b", "3", "02:00:00:00:00:03")
    assert computer("c", "4") != computer("c", "5") and this_computer(tmp_path / "no", tmp_path / "none") == ""
    assert this_computer() == this_computer() != ""


def test_two_readings_of_one_time_both_arrive_once(server: Server, tmp_path: Path) -> None:
    """As a clock makes them that is set back, or a file that tells whole seconds."""
    store = tmp_path / "h.sqlite"
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    for um in ((1.0, 2.0, 3.0), (1.0, 2.0, 3.5), (1.0, 2.0, 3.0)):
        writer.displacement(make.displacement(EPOCH_S, np.array(um)))
    writer.close()
    query = "SELECT (um->>'dy')::float8, (um->>'dz')::float8 FROM toolpoint.displacements ORDER BY 2"
    for _ in range(2):
        assert send(server, tmp_path, store).problem == ""
        assert server.ask(query) == [(2.0, 3.0), (2.0, 3.5)]
        server.ask("DELETE FROM toolpoint.deliveries RETURNING 1")


def test_wrong_clocks_are_stored_beside_the_months(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    for start_s in (0.0, 5e9, EPOCH_S):
        fill(store, start_s=start_s, hours=1.0)
    assert send(server, tmp_path, store).problem == ""
    assert server.ask("SELECT count(*) FROM toolpoint.cnc_other") == [(24,)]
    assert server.ask("SELECT count(*) FROM toolpoint.cnc_2025_10") == [(12,)]


def test_a_number_without_end_in_one_row_keeps_no_other_back(server: Server, tmp_path: Path) -> None:
    """JSON has no word for it, and the database takes none: in a macro or a displacement it is null."""
    store = tmp_path / "h.sqlite"
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    with contextlib.closing(writer):
        writer.cnc_sample(make.cnc_sample(EPOCH_S, macros={600: float("inf"), 601: 2.0}))
        writer.displacement(make.displacement(EPOCH_S, np.array([-np.inf, 1.0, np.nan])))
        writer.event("note", "after").result(30.0)
    assert send(server, tmp_path, store).problem == ""
    assert server.ask("SELECT macros FROM toolpoint.cnc") == [({"600": None, "601": 2.0},)]
    assert server.ask("SELECT um FROM toolpoint.displacements") == [({"dx": None, "dy": 1.0, "dz": None},)]


def test_machines_with_logins_of_their_own_act_as_the_role_that_owns_the_tables(server: Server, tmp_path: Path) -> None:
    """As the guide says; each fills a month that the other has not made."""
    login = "CREATE ROLE {0} LOGIN PASSWORD '{1}' IN ROLE {2}; ALTER ROLE {0} IN DATABASE toolpoint SET role = {2}"
    with server.connection() as connection:
        for name in ("mill_7", "mill_8"):
            connection.execute(login.format(name, PASSWORD, USER))
    for at, name in enumerate(("mill_7", "mill_8")):
        (tmp_path / name).mkdir()
        path = tmp_path / name / "history.sqlite"
        fill(path, start_s=EPOCH_S + at * 40 * 86_400.0, hours=0.2)
        runner = runner_for(server, tmp_path / name, path, user_name=name, machine=name)
        runner.run()
        assert runner.cursor.problem == ""
    assert server.ask("SELECT DISTINCT tableowner::text FROM pg_tables WHERE schemaname = 'toolpoint'") == [(USER,)]


PGBOUNCER = shutil.which("pgbouncer", path=f"{os.environ['PATH']}:/usr/sbin")


@contextlib.contextmanager
def pooler(server: Server) -> Iterator[int]:
    """PgBouncer, which lends a connection for one transaction; yields its port."""
    if PGBOUNCER is None:
        pytest.skip("PgBouncer is not installed (apt-get install pgbouncer)")
    port = free_port()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "users").write_text(f'"{USER}" "{PASSWORD}"\n')
        lines = ("[databases]", f"toolpoint = host=127.0.0.1 port={server.port} password='{PASSWORD}'")
        own = ("[pgbouncer]", "listen_addr = 127.0.0.1", f"listen_port = {port}", "unix_socket_dir =")
        users = (
            "auth_type = plain",
            f"auth_file = {folder / 'users'}",
            "pool_mode = transaction",
            f"admin_users = {USER}",
        )
        (folder / "pgbouncer.ini").write_text("\n".join((*lines, *own, *users, "")))
        account = "postgres" if os.geteuid() == 0 else None
        process = subprocess.Popen([PGBOUNCER, "-q", folder / "pgbouncer.ini"], user=account, cwd=folder)
        try:
            deadline_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < deadline_s:
                with contextlib.suppress(psycopg.OperationalError):
                    server.connection(port=port).close()
                    break
                time.sleep(0.05)
            yield port
        finally:
            process.kill()
            process.wait()


def test_a_pooler_that_lends_a_connection_for_one_transaction_is_as_good(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, stop = tmp_path / "h.sqlite", threading.Event()
    fill(store, hours=0.1)

    def patiently(done: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not done() and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert done(), runner.cursor

    with pooler(server) as port:
        with server.connection(port=port) as earlier:  # a version whose rows had fewer columns leaves this behind
            earlier.execute("CREATE TEMP TABLE staging_cnc (machine text, time timestamptz) ON COMMIT DELETE ROWS")
        config = section(server, tmp_path, port=port)
        runner = SinkRunner(config, store, MACHINE, stop, wait=lambda _duration_s: stop.wait(0.1))
        problems: list[str] = []
        monkeypatch.setattr(runner, "_note", problems.append)
        thread = threading.Thread(target=runner.run)
        thread.start()
        try:
            patiently(lambda: runner.cursor.stored_rows > 0)
            before = runner.cursor.stored_rows
            with server.connection("pgbouncer", port=port) as administrator:
                administrator.execute("RECONNECT")  # as after `server_lifetime`: the sink is not told
            fill(store, start_s=EPOCH_S + 3600.0, hours=0.1)
            patiently(lambda: runner.cursor.stored_rows > before or bool(problems))
        finally:
            stop.set()
            thread.join()
        assert not problems
        with server.connection(port=port) as other:
            assert other.execute("SHOW search_path").fetchone() == ('"$user", public',)


def standby(listening: socket.socket) -> None:
    """Answer as a server does that follows another one: whoever connects may read."""

    def told(kind: bytes, content: bytes) -> bytes:
        return kind + (len(content) + 4).to_bytes(4) + content

    settings = {"server_version": "15.4", "in_hot_standby": "on", "default_transaction_read_only": "off"}
    with contextlib.suppress(OSError):
        while True:
            connection, _ = listening.accept()
            with connection:
                connection.recv(4096)
                statuses = [told(b"S", f"{name}\0{value}\0".encode()) for name, value in settings.items()]
                connection.sendall(told(b"R", bytes(4)) + b"".join(statuses) + told(b"Z", b"I"))
                connection.recv(4096)


def test_of_several_servers_the_one_that_takes_writes_is_found(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    with socket.create_server(("127.0.0.2", server.port)) as listening:
        thread = threading.Thread(target=standby, args=(listening,), daemon=True)
        thread.start()
        cursor = send(server, tmp_path, store, host="127.0.0.2,127.0.0.1")
        assert cursor.problem == "" and cursor.sent_rows > 0
        assert "check that `host` is the primary" in send(server, tmp_path, store, host="127.0.0.2").problem
        listening.shutdown(socket.SHUT_RDWR)
        thread.join()


# --- refusals ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"database": "nowhere"}, "check `database`"),
        ({"user_name": "nobody"}, "check `user_name` and `password_file`"),
        ({"password_file": None}, "give `password_file`"),
        ({"password_file": Path("/nowhere/password")}, "`password_file` /nowhere/password cannot be read"),
        ({"tls": True}, "set `tls: false`"),
        ({"tls": True, "ca_certificate": Path("/nowhere/ca.pem")}, "`ca_certificate` /nowhere/ca.pem cannot be read"),
        ({"host": "no-such-host.invalid"}, "check `host`"),
        ({"port": 1}, "check `host`, `port`"),
    ],
)
def test_a_refusal_names_the_key(server: Server, tmp_path: Path, changes: dict[str, object], said: str) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    cursor = send(server, tmp_path, store, **changes)
    assert said in cursor.problem and "sink plant: database" in cursor.problem
    assert Cursor.read(cursor_path(store, "plant")) == cursor, "the status reads it there"


@pytest.mark.parametrize(
    ("said", "advised"),
    [
        ("FATAL: the database system is starting up", "starting, stopping"),
        ("cannot execute INSERT in a read-only transaction", "`host` is the primary"),
        ('FATAL: database "plant" does not exist', "check `database`"),
        ("connection failed: FATAL: could not write init file", "its disk may be full"),
        (
            'connection to server at "10.9.9.9", port 5432 failed: Network is unreachable',
            "check `host` and the network",
        ),
        ('connection to server at "10.9.9.9", port 5432 failed: No route to host', "check `host` and the network"),
    ],
)
def test_a_server_that_starts_is_not_taken_for_one_without_the_database(said: str, advised: str) -> None:
    assert advised in refusal(psycopg.OperationalError(said), PostgresqlConfig(host="db"))


def test_a_database_of_an_earlier_version_is_brought_up_to_date_and_keeps_its_rows(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, section_of_it = tmp_path / "h.sqlite", section(server, tmp_path).postgresql
    assert section_of_it is not None
    with monkeypatch.context() as earlier:
        earlier.setattr("daemon.sinks.database.scripts", lambda: scripts()[:1])
        database = Database(section_of_it, "database", "earlier")
        database.open()
        database.close()
    server.ask(
        "INSERT INTO toolpoint.cnc (machine, time, monotonic_ms, mode, run, alarm, program, sequence_number, "
        "power_on_count, work_offset, tool_number, macros) "
        "VALUES ('mill 6', '2026-01-31', 5, 'memory', 'started', false, 1, 2, 3, 54, 4, '{}') RETURNING 1"
    )
    fill(store, hours=0.5)
    assert send(server, tmp_path, store).problem == ""
    assert server.ask("SELECT version FROM toolpoint.schema_versions ORDER BY 1") == [(n,) for n, _ in scripts()]
    found = server.ask("SELECT machine, count(*), count(positions_mm) FROM toolpoint.cnc GROUP BY 1 ORDER BY 1")
    assert [row[0] for row in found] == ["mill 6", MACHINE] and found[0][1:] == (1, 0) and found[1][1] > 1


def test_a_newer_schema_is_refused_and_left_alone(server: Server, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    send(server, tmp_path, store)
    server.ask("INSERT INTO toolpoint.schema_versions VALUES (99) RETURNING 1")
    before = counts(server)
    fill(store, start_s=EPOCH_S + 7200.0, hours=0.5)
    cursor = send(server, tmp_path, store)
    assert "version 99, this version of toolpoint knows up to 7" in cursor.problem
    assert counts(server) == before


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE toolpoint.cnc DROP COLUMN mode",
        "ALTER TABLE toolpoint.cnc ALTER COLUMN mode TYPE integer USING 1",
        "ALTER TABLE toolpoint.cnc DROP CONSTRAINT cnc_pkey",
        "ALTER TABLE toolpoint.cnc ADD CONSTRAINT one UNIQUE (time, machine)",
        "ALTER TABLE toolpoint.cnc ADD COLUMN site text, ADD CONSTRAINT known CHECK (site IS NOT NULL) NOT VALID",
        "DROP TABLE toolpoint.cnc",
        "DROP TABLE toolpoint.deliveries",
        "DROP TABLE toolpoint.schema_versions",
    ],
)
def test_a_table_that_somebody_altered_is_named_and_loses_no_row(server: Server, tmp_path: Path, change: str) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.5)
    before = send(server, tmp_path, store)
    with server.connection() as connection:
        connection.execute(change)
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    with contextlib.closing(writer):
        sample = make.cnc_sample(EPOCH_S + 1800.0)
        for later_s in (0.0, 1.0):  # a clock that was set back: the time of day comes twice
            time_of_it = replace(sample.time, monotonic_s=sample.time.monotonic_s + later_s)
            writer.cnc_sample(replace(sample, time=time_of_it))
    after = send(server, tmp_path, store)
    assert "somebody has altered the tables in schema toolpoint" in after.problem and "Failing row" not in after.problem
    assert after.positions["cnc"] == before.positions["cnc"]


@pytest.fixture
def encoded(server: Server, request: pytest.FixtureRequest) -> Iterator[str]:
    """A database in another encoding: that of a cluster that was made without a locale, for one."""
    with server.connection("postgres") as connection:
        connection.execute(f"CREATE DATABASE encoded ENCODING '{request.param}' TEMPLATE template0")
        yield "encoded"
        connection.execute("DROP DATABASE encoded WITH (FORCE)")


@pytest.mark.parametrize("encoded", ["SQL_ASCII"], indirect=True)
def test_a_database_without_an_encoding_gets_every_text_as_it_is(server: Server, tmp_path: Path, encoded: str) -> None:
    store = tmp_path / "h.sqlite"
    writer = HistoryWriter(store, clock=StillClock(), machine=replace(SMALL, displacement_channels=("dx", "dy", "長")))
    writer.start()
    add(writer, EPOCH_S, 1.0)
    writer.close()
    for hours in (0.0, 0.5):
        fill(store, start_s=EPOCH_S + 3600.0, hours=hours)
        cursor = send(server, tmp_path, store, database=encoded)
        assert cursor.problem == "" and cursor.sent_rows == cursor.stored_rows
    with server.connection(encoded, client_encoding="UTF8") as connection:
        ask = connection.execute
        assert ask("SELECT count(*) FROM toolpoint.cnc_2025_10").fetchone() == (18,)
        assert ask("SELECT text FROM toolpoint.events LIMIT 1").fetchone() == ("number 0\nsecond line µ",)
        assert ask("SELECT um->>'長' FROM toolpoint.displacements ORDER BY time LIMIT 1").fetchone() == ("0.0",)


@pytest.mark.parametrize("encoded", ["LATIN1"], indirect=True)
def test_a_database_that_cannot_hold_every_text_is_refused_before_it_holds_anything(
    server: Server, tmp_path: Path, encoded: str
) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    refused = send(server, tmp_path, store, database=encoded)
    assert "has the encoding LATIN1" in refused.problem and "ENCODING 'UTF8'" in refused.problem
    assert refused.sent_rows == 0
    with server.connection(encoded) as connection:
        assert connection.execute("SELECT to_regnamespace('toolpoint')").fetchone() == (None,)


def test_a_server_that_hangs_in_the_middle_is_given_up_and_tried_again(server: Server, tmp_path: Path) -> None:
    """Its system goes on to say that the connection stands, and its own limit of a statement stands still with it."""
    with contextlib.closing(Database(section(server, tmp_path, timeout_s=0.2).postgresql, "db", "hangs")) as database:
        database.open()
        ((pid,),) = server.ask("SELECT pid FROM pg_stat_activity WHERE application_name = 'hangs'")
        os.kill(pid, signal.SIGSTOP)
        try:
            with pytest.raises(psycopg.OperationalError, match="says nothing") as said, database.transaction():
                database.connection.execute("SELECT 1")
        finally:
            os.kill(pid, signal.SIGCONT)
        assert "raise `timeout_s`" in str(database.refused(said.value))


def test_tls_takes_a_server_that_is_vouched_for_and_no_other(
    server: Server, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    store, other = tmp_path / "h.sqlite", tmp_path_factory.mktemp("other")
    fill(store, hours=0.2)
    make_certificate(other)
    make_certificate(tmp_path)
    server.secure(tmp_path / "monitor.crt", tmp_path / "monitor.key")
    known = {"tls": True, "host": "localhost", "ca_certificate": tmp_path / "monitor.crt"}
    assert send(server, tmp_path, store, **known).problem == "" and counts(server)["cnc"] == 2
    wrong = send(server, tmp_path, store, **known | {"ca_certificate": other / "monitor.crt"})
    assert "none that `ca_certificate` vouches for" in wrong.problem
    make_certificate(other, (-30, -1))
    server.secure(other / "monitor.crt", other / "monitor.key")
    expired = send(server, tmp_path, store, **known | {"ca_certificate": other / "monitor.crt"})
    assert "is not valid now by this computer's clock" in expired.problem
    key = send(server, tmp_path, store, **known | {"ca_certificate": tmp_path / "monitor.key"})
    assert "name a certificate in PEM by `ca_certificate`" in key.problem
    server.secure(tmp_path / "monitor.crt", tmp_path / "monitor.key")
    elsewhere = send(server, tmp_path, store, **known | {"host": "127.0.0.1"})
    assert "`host` must be a name in its certificate" in elsewhere.problem
    unknown = send(server, tmp_path, store, **known | {"ca_certificate": None})
    assert "none that `ca_certificate` vouches for" in unknown.problem, "this computer's authorities do not"
    assert authorities() == "system" or "BEGIN CERTIFICATE" in Path(authorities()).read_text("utf-8")
