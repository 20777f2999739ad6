"""What the plant's store takes from a broker: rows of the topics they come by, and nothing that is none."""

import hashlib
import json
import re
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from fleet_kills import plant_broker
from mosquitto import mosquitto
from paho.mqtt.publish import multiple, single
from postgresql import PASSWORD, Server, postgresql
from structlog.testing import capture_logs

from config.schema.plant_store import PlantStoreConfig, SubscriptionConfig
from daemon.cli import main
from daemon.simulation.processes import free_port
from daemon.sinks.database import MIGRATING, STORE, Database
from daemon.sinks.outbox import STREAMS
from daemon.sinks.plant_store import LARGEST_MESSAGE, PlantStore, StoredRow, Subscription, _put, row_of

EVENT = {
    **{"key": "k", "machine": "mill/7", "stream": "events", "utc_ms": 1_760_000_400_000, "monotonic_ms": 5},
    **{"kind": "note", "text": "warm", "person": None},
}
REFERENCE = {
    **{"key": "k", "machine": "mill/7", "stream": "references", "utc_ms": 1_760_000_400_000, "reference_id": "r"},
    **{"source": "s", "sensor_ids": [1], "degc": [20.0], "program": 1, "work_offset": 54, "power_on_count": 3},
}
TOPIC = "toolpoint/mill%2F7/history/events"
PATIENCE_S = 60.0
LONG = "".join(hashlib.sha256(bytes([n])).hexdigest() for n in range(150))


def test_a_row_is_taken_by_its_topic() -> None:
    row = row_of(TOPIC, json.dumps(EVENT).encode(), "toolpoint")
    assert (row.stream, row.machine, row.utc_ms) == (STREAMS["events"], "mill/7", 1_760_000_400_000)
    assert row.values[0].isoformat() == "2025-10-09T09:00:00+00:00" and row.values[1:] == (5, "note", "warm", None)


@pytest.mark.parametrize(
    ("topic", "payload", "said"),
    [
        (TOPIC, b"\xff", "no JSON"),
        (TOPIC, b"[" * 100_000, "no JSON"),
        (TOPIC, b"[]", "no JSON object"),
        (TOPIC, EVENT | {"machine": 7}, "`machine` is no name"),
        ("toolpoint/mill 8/history/events", EVENT, "not those of its topic"),
        ("toolpoint/mill%2F7/history/cnc", EVENT, "not those of its topic"),
        (TOPIC, EVENT | {"stream": "secrets"}, "not those of its topic"),
        (TOPIC, EVENT | {"utc_ms": True}, "`utc_ms` is no whole number"),
        (TOPIC, EVENT | {"utc_ms": 10**30}, "`utc_ms` is no time"),
        (TOPIC, {name: value for name, value in EVENT.items() if name != "kind"}, "`kind` is missing"),
        (TOPIC, EVENT | {"text": ["a"]}, "`text` is not what that field holds"),
        (TOPIC, EVENT | {"text": {"a": 1}}, "`text` is not what that field holds"),
        (TOPIC, EVENT | {"text": 5}, "`text` is not what that field holds"),
        (TOPIC, EVENT | {"text": "\ud800"}, "`text` is not what that field holds"),
        (TOPIC, EVENT | {"monotonic_ms": "NaN"}, "`monotonic_ms` is not what that field holds"),
        (TOPIC, EVENT | {"monotonic_ms": float("nan")}, "NaN is no number"),
        (TOPIC, json.dumps(EVENT).replace(": 5,", ": 1e999,").encode(), "`monotonic_ms` is not what that field holds"),
        (TOPIC.replace("events", "references"), REFERENCE | {"degc": [{}]}, "`degc` is not what that field holds"),
        (TOPIC.replace("events", "references"), REFERENCE | {"degc": [[1.0]]}, "`degc` is not what that field holds"),
        (TOPIC.replace("events", "references"), REFERENCE | {"degc": 5}, "`degc` is not what that field holds"),
    ],
)
def test_what_is_no_row_is_refused_with_the_field(topic: str, payload: object, said: str) -> None:
    content = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    with pytest.raises(ValueError, match=said):
        row_of(topic, content, "toolpoint")


def test_a_row_of_a_machine_with_an_earlier_version_is_taken() -> None:
    stream = STREAMS["cnc"]
    texts, mappings = {"mode": "memory", "run": "started"}, {"macros": {"500": 1.5}}
    row = dict.fromkeys(stream.columns, 1) | {"alarm": False, "utc_ms": EVENT["utc_ms"]} | texts | mappings
    content = {"machine": "mill/7", "stream": "cnc"} | {k: v for k, v in row.items() if k != "positions_mm"}
    taken = row_of("toolpoint/mill%2F7/history/cnc", json.dumps(content).encode(), "toolpoint")
    assert taken.values[stream.columns.index("positions_mm")] is None
    content["positions_mm"] = {"X": 1.5}
    taken = row_of("toolpoint/mill%2F7/history/cnc", json.dumps(content).encode(), "toolpoint")
    assert taken.values[stream.columns.index("positions_mm")] == '{"X": 1.5}'


@pytest.fixture(scope="module")
def server():
    with postgresql() as server:
        yield server


def section(server: Server, port: int, folder: Path, **changes: object) -> PlantStoreConfig:
    (folder / "password").write_text(PASSWORD)
    (folder / "password").chmod(0o600)
    there = {"host": "127.0.0.1", "port": server.port, "tls": False, "password_file": folder / "password"}
    broker = {"host": "127.0.0.1", "port": port, "tls": False} | changes
    return PlantStoreConfig.model_validate({"mqtt": broker, "postgresql": there})


def test_the_row_that_the_guide_shows_is_one() -> None:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "publish-over-mqtt.md"
    (shown,) = re.findall(r"```json\n(.*?)\n```", page.read_text("utf-8"), re.DOTALL)
    assert row_of("toolpoint/mill 7/history/cnc", shown.encode(), "toolpoint").stream is STREAMS["cnc"]


def test_messages_that_are_no_rows_are_counted_in_the_status_and_do_not_fill_the_log(
    server: Server, tmp_path: Path
) -> None:
    """Sixty thousand of another version made as many lines, and the status said that they were stored."""
    broker, stop, told = plant_broker(tmp_path), threading.Event(), list[str]()
    broker.start()
    work = PlantStore(section(server, broker.port, tmp_path), stop, told.append)
    store = threading.Thread(target=work.run)
    older = json.dumps({name: value for name, value in EVENT.items() if name != "kind"})
    try:
        with capture_logs() as logged:
            store.start()
            deadline_s = time.monotonic() + PATIENCE_S
            while not any("were left out" in each for each in told) and time.monotonic() < deadline_s:
                multiple([(TOPIC, older, 1, False)] * 200, hostname="127.0.0.1", port=broker.port)
                time.sleep(0.2)
            stop.set()
            store.join()
    finally:
        stop.set()
        store.join()
        broker.kill()
    said = next(each for each in told if "were left out" in each)
    assert f"were left out, the last one: {TOPIC}: `kind` is missing" in said
    assert int(re.search(r"(\d+) of them are no rows", said)[1]) >= 100
    assert 1 <= sum(each["event"] == "store.refused" for each in logged) <= 10


def test_a_message_that_the_database_refuses_keeps_no_other_back(server: Server, tmp_path: Path) -> None:
    broker, stop = plant_broker(tmp_path), threading.Event()
    broker.start()
    store = threading.Thread(target=PlantStore(section(server, broker.port, tmp_path), stop).run)

    def publish(**changes: object) -> None:
        payload = json.dumps(EVENT | changes)
        single(TOPIC, payload, qos=1, hostname="127.0.0.1", port=broker.port)

    def stored() -> list[str]:
        found = server.ask("SELECT to_regclass('toolpoint.events')")[0][0]
        return [] if found is None else [text for (text,) in server.ask("SELECT text FROM toolpoint.events ORDER BY 1")]

    try:
        store.start()
        deadline_s = time.monotonic() + PATIENCE_S
        while not server.ask("SELECT to_regclass('toolpoint.deliveries')")[0][0] and time.monotonic() < deadline_s:
            time.sleep(0.05)
        texts = ("one", "with a \0 in it", "two", "two")
        while stored() != ["one", "two"] and time.monotonic() < deadline_s:
            for text in texts:  # again where the store had not subscribed yet
                publish(text=text)
            publish(text="no kind", kind=None)
            publish(text="a key that is too long for an index", kind=LONG)
            publish(text="half of a character \ud800")
            publish(text="a" * LARGEST_MESSAGE)
            time.sleep(0.2)
        assert stored() == ["one", "two"]
        newest = server.ask("SELECT machine, stream, extract(epoch FROM newest)::int FROM toolpoint.deliveries")
        assert newest == [("mill/7", "events", 1_760_000_400)]
    finally:
        stop.set()
        store.join()
        broker.kill()


def test_two_that_make_the_tables_of_a_month_at_once_do_not_wait_for_each_other(server: Server, tmp_path: Path) -> None:
    there = section(server, 1, tmp_path).postgresql

    def row(name: str, utc_ms: int) -> StoredRow:
        words = {"stream": name, "machine": "mill/7", "utc_ms": utc_ms, "alarm": False, "mode": "memory"}
        of_row = {"run": "started", "macros": {"500": 1.5}, "positions_mm": None, "source": "s", "um": {"Z": 1.0}}
        content = dict.fromkeys(STREAMS[name].columns, 1) | of_row | words
        return row_of(f"toolpoint/mill%2F7/history/{name}", json.dumps(content).encode(), "toolpoint")

    store, sink = (Database(there, "database", name) for name in (STORE, "toolpoint sink plant"))
    october_ms, november_ms = 1_760_000_400_000, 1_762_000_400_000
    failed = list[BaseException]()

    def put() -> None:
        try:
            _put(store, [row("cnc", october_ms), row("displacements", november_ms)])
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=put)
    try:
        store.open()
        sink.open()
        _put(store, [row("cnc", october_ms - 1)])
        cnc = STREAMS["cnc"]
        with sink.transaction() as connection:
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (MIGRATING,))  # as before it makes what is missing
            thread.start()
            deadline_s = time.monotonic() + PATIENCE_S
            while not server.ask("SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted")[0][0]:
                assert time.monotonic() < deadline_s and thread.is_alive()
                time.sleep(0.02)
            sink.put(cnc, [("mill/7", *row("cnc", november_ms).values)], [november_ms // 86_400_000])
        thread.join()
        assert failed == []
        assert server.ask("SELECT count(*) FROM toolpoint.cnc") == [(3,)]
    finally:
        thread.join()
        store.close()
        sink.close()


def test_a_kept_session_is_at_work_with_its_first_row_not_when_the_broker_answers_after_a_thousand() -> None:
    topic = TOPIC.encode()
    content = len(topic).to_bytes(2) + topic + b"\x00\x01\x00{}"

    def serve(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with connection:
            connection.recv(4096)
            connection.sendall(b"\x20\x03\x01\x00\x00" + bytes((0x32, len(content))) + content)
            while connection.recv(4096):
                pass

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve, args=(listening,))
        thread.start()
        there = {"host": "127.0.0.1", "port": listening.getsockname()[1], "tls": False, "timeout_s": 2.0}
        subscription = Subscription(SubscriptionConfig.model_validate(there))
        try:
            subscription.open()
            assert [each.topic for each in subscription.take(1.0)] == [TOPIC]
        finally:
            subscription.close()
            thread.join()


def test_a_database_that_was_restored_behind_the_broker_is_noticed_with_the_machines(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.sinks.plant_store.TELL_PERIOD_S", 0.2)
    broker, stop, told = plant_broker(tmp_path), threading.Event(), list[str]()
    broker.start()
    kept = tmp_path / "newest.json"
    plant_store = PlantStore(section(server, broker.port, tmp_path), stop, told.append, kept)
    plant_store._retry.after_failure = lambda: 0.1
    thread = threading.Thread(target=plant_store.run)

    def until(done: Callable[[], object], meanwhile: Callable[[], object] = lambda: None) -> None:
        deadline_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline_s, told
            meanwhile()
            time.sleep(0.1)

    def publish() -> None:
        single(TOPIC, json.dumps(EVENT), qos=1, hostname="127.0.0.1", port=broker.port)

    try:
        thread.start()
        until(lambda: plant_store._newest, publish)
        broker.kill()  # and with it the session of the store, which begins anew
        broker.start()
        until(lambda: told[-1].startswith("stores") and any(each.startswith("cannot") for each in told))
        assert not any("has less" in each for each in told), "nothing was lost"
        server.ask("UPDATE toolpoint.deliveries SET newest = newest - interval '1 day' RETURNING 1")  # last night's
        broker.kill()
        broker.start()
        until(lambda: any("`database` has less of mill/7 than this store had put there" in each for each in told))
        until(lambda: plant_store._newest, publish)
        stop.set()
        thread.join()
        server.ask("UPDATE toolpoint.deliveries SET newest = newest - interval '1 day' RETURNING 1")  # and once more
        stop.clear()
        told.clear()
        thread = threading.Thread(target=PlantStore(plant_store._config, stop, told.append, kept).run)
        thread.start()
        until(lambda: any("`database` has less of mill/7" in each for each in told))
    finally:
        stop.set()
        thread.join()
        broker.kill()


def test_the_rights_that_the_guide_gives_keep_a_machine_from_writing_for_another(
    server: Server, tmp_path: Path
) -> None:
    guide = (Path(__file__).parents[2] / "docs/how-to/run-a-plant.md").read_text("utf-8")
    (rights,) = re.findall(r"```\n(user store\n.*?)```", guide, re.DOTALL)
    (tmp_path / "acl").write_text(rights)
    (tmp_path / "passwords").write_text(f"store:{PASSWORD}\nmill-7:own\n")
    subprocess.run(["mosquitto_passwd", "-U", str(tmp_path / "passwords")], check=True)
    for name in ("acl", "passwords"):
        (tmp_path / name).chmod(0o600)
    lines = ("allow_anonymous false", f"password_file {tmp_path / 'passwords'}", f"acl_file {tmp_path / 'acl'}")
    stop = threading.Event()
    with mosquitto(tmp_path, *lines) as port:
        config = section(server, port, tmp_path, user_name="store", password_file=tmp_path / "password")
        store = threading.Thread(target=PlantStore(config, stop).run)
        store.start()
        try:
            found: list[tuple[str]] = []
            deadline_s = time.monotonic() + PATIENCE_S
            while not found and time.monotonic() < deadline_s:
                for machine in ("mill 8", "mill 7"):
                    payload, topic = json.dumps(EVENT | {"machine": machine}), f"toolpoint/{machine}/history/events"
                    account = {"username": "mill-7", "password": "own"}
                    single(topic, payload, qos=1, hostname="127.0.0.1", port=port, auth=account)
                time.sleep(0.1)
                if server.ask("SELECT to_regclass('toolpoint.events')")[0][0]:
                    found = server.ask(
                        "SELECT DISTINCT machine FROM toolpoint.events WHERE machine IN ('mill 7', 'mill 8')"
                    )
            assert found == [("mill 7",)]
        finally:
            stop.set()
            store.join()


def test_a_store_that_cannot_store_says_why_and_its_status_ends_with_1(server: Server, tmp_path: Path) -> None:
    config, stop, told = section(server, free_port(), tmp_path), threading.Event(), []

    def tell(status: str) -> None:
        told.append(status)
        stop.set()

    PlantStore(config, stop, tell).run()
    assert told[0].startswith(f"cannot store, tries again: broker 127.0.0.1:{config.mqtt.server_port}: ")
    path = tmp_path / "plant.yaml"
    path.write_text(yaml.safe_dump(config.model_dump(mode="json", exclude_defaults=True)))
    ask = ["fleet", "store", "--config", str(path), "--status"]
    done = CliRunner().invoke(main, ask)
    deadline_s = time.monotonic() + 30.0
    while "no store is connected to the database" not in done.output:  # the server may see its end a moment later
        assert time.monotonic() < deadline_s, done.output
        done = CliRunner().invoke(main, ask)
    assert done.exit_code == 1
    with server.connection() as connection:
        connection.execute("SET application_name = 'toolpoint store'")
        done = CliRunner().invoke(main, [*ask, "--late-s", "3600"])
        assert done.exit_code == 1 and "no machine's newest row is younger than 3600 s" in done.output
        connection.execute(  # its clock was ahead, and nothing came since
            "INSERT INTO toolpoint.deliveries VALUES "
            "('mill 8', 'events', '', 0, 0, now() + interval '1 year', now() - interval '2 hours')"
        )
        done = CliRunner().invoke(main, [*ask, "--late-s", "3600"])
        assert done.exit_code == 1 and "mill 8: 7200 s late" in done.output, done.output
        connection.execute(
            "INSERT INTO toolpoint.deliveries VALUES ('mill 9', 'events', '', 0, 0, now() - interval '3 minutes') "
            "ON CONFLICT DO NOTHING"
        )
        done = CliRunner().invoke(main, [*ask, "--late-s", "3600", "--json", "-"])
        assert done.exit_code == 0, done.output
        (found,) = [each for each in json.loads(done.stdout)["machines"] if each["machine"] == "mill 9"]
        assert 180.0 <= found["late_s"] < 3600.0
