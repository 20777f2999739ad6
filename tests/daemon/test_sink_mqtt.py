"""The history at an MQTT broker: JSON that others read, nothing lost whatever is killed, refusals that name the key."""

import itertools
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import history_records as make
import jinja2
import numpy as np
import paho.mqtt.client as paho
import pytest
import yaml
from certificates import make_certificate
from filled_store import add, fill, rows_waiting
from history_records import EPOCH_S, SMALL, StillClock
from mosquitto import PATIENCE_S, Mosquitto, mosquitto, subscriber, wait_until
from paho.mqtt.enums import CallbackAPIVersion
from strict_broker import strict_broker
from tidied_store import housekeeping

from config.sample import sample_configuration
from config.schema.service import HistoryConfig
from config.schema.sinks import BrokerConfig, SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from daemon.history.writer import HistoryWriter
from daemon.sinks import running
from daemon.sinks.ahead import Ahead
from daemon.sinks.broker import Broker, Message
from daemon.sinks.contract import Progress, SinkError
from daemon.sinks.current import current_values
from daemon.sinks.mqtt import BY_NAME, MqttSink
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.row_messages import JSON_COLUMNS
from daemon.sinks.running import SinkRunner

MACHINE = "mill 7"
BASE = "toolpoint/mill 7"
OPEN = "allow_anonymous true"


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with mosquitto(tmp_path_factory.mktemp("broker"), OPEN) as port:
        yield port


def section(port: int | None, /, **changes: object) -> SinkConfig:
    known = {"host": "127.0.0.1", "port": port, "tls": False, "timeout_s": 30.0, "resend_s": 0.0}
    return SinkConfig.model_validate({"name": "plant", "driver": "mqtt", "mqtt": known | changes})


def runner_for(config: SinkConfig, path: Path, machine: str = MACHINE) -> SinkRunner:
    """A sink that ends when nothing waits any more, or when it fails."""
    stop = threading.Event()
    return SinkRunner(config, path, machine, stop, wait=lambda _duration_s: stop.set())


def send(config: SinkConfig, path: Path, machine: str = MACHINE) -> Cursor:
    """Send all that waits."""
    runner = runner_for(config, path, machine)
    runner.run()
    return runner.cursor


def rows(messages: list[tuple[bool, str, str]], stream: str) -> list[dict[str, object]]:
    return [json.loads(payload) for _, topic, payload in messages if topic.endswith(f"/history/{stream}")]


def test_every_record_arrives_with_its_values_and_a_key(port: int, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store)
    expected = {
        "temperatures": 72,
        **dict.fromkeys(("estimates", "cnc", "displacements", "events"), 36),
        "writes": 34,  # those of the last ten minutes wait for the guard's echo
        "references": 4,
    }
    with subscriber(port, f"{BASE}/history/#") as listener:
        cursor = send(section(port), store)
        listener.until(lambda messages: len(messages) >= sum(expected.values()))
    assert cursor.problem == "" and cursor.sent_rows == cursor.stored_rows == sum(expected.values())
    assert not any(retained for retained, _, _ in listener.messages)
    for stream in STREAMS:
        found = rows(listener.messages, stream)
        assert len({row["key"] for row in found}) == len(found) == expected.get(stream, 0), stream
        for row in found:
            assert set(row) == {"key", "machine", "stream", *STREAMS[stream].columns} and row["machine"] == MACHINE
            assert not any(isinstance(row[name], str) for name in JSON_COLUMNS & set(row))
    spindle = [row for row in rows(listener.messages, "temperatures") if row["line"] == "spindle"]
    assert spindle[1]["sensor_ids"] == [13, 11, 12] and spindle[1]["degc"] == [20.0625, None, 20.1875]
    assert spindle[1]["complete"] is True and spindle[1]["faults"] == ["ID 2 did not arrive"]
    (estimate, *_) = rows(listener.messages, "estimates")
    assert estimate["label_degc"]["A"] == 25.125 and estimate["thermal_error_um"]["dy"] is None
    (write, *_) = rows(listener.messages, "writes")
    assert write["outcome"] == "verified" and write["read_back"] == write["macros"]
    (event, *_) = rows(listener.messages, "events")
    assert event["text"] == "number 0\nsecond line \u00b5" and event["utc_ms"] == round(EPOCH_S * 1e3)


def test_what_is_now_is_retained_and_home_assistant_is_told(port: int, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.5)
    assert send(section(port, history=[]), store, "lathe/2").problem == ""
    base = "toolpoint/lathe%2F2"
    with subscriber(port, f"{base}/#", "homeassistant/#") as listener:
        listener.until(
            lambda messages: (
                listener.last(f"{base}/state") is not None
                and listener.last(f"{base}/status") is not None
                and sum('"lathe/2"' in payload for _, _, payload in messages) == 1 + 6 + 17
            )
        )
        state = listener.last(f"{base}/state")
    assert all(retained for retained, _, _ in listener.messages)
    assert listener.last(f"{base}/status") == "offline", "the sink has ended"
    assert state["state"] == "ACTIVE" and state["reason"] == "following" and state["machine"] == "lathe/2"
    assert state["compensation_um"] == {"X": 0.0, "Y": 5.0, "Z": 1.0}
    assert state["error_with_um"] == {"X": None, "Y": 1.5 - 6.25, "Z": -2.25 - 1.25}
    assert state["error_without_um"] == {"dx": 1.0, "dy": None, "dz": 5.0}
    assert state["label_degc"] == {"A": 25.125, "Room": 21.5} and state["cnc_alarm"] is False and state["alarm"] == ""
    told = [(topic, json.loads(text)) for _, topic, text in listener.messages if topic.startswith("homeassistant/")]
    told = [(topic, content) for topic, content in told if content["device"]["name"] == "lathe/2"]
    assert len(told) == 6 + sum(len(state[name]) for name in BY_NAME) == len({each["unique_id"] for _, each in told})
    shown = {
        content["name"]: jinja2.Template(content["value_template"]).render(value_json=state) for _, content in told
    }
    assert shown["State"] == "ACTIVE" and shown["Alarm"] == shown["CNC alarm"] == "OFF"
    assert shown["Compensation Y"] == "5.0" and shown["Temperature A"] == "25.125"
    assert shown["Thermal error without compensation dy"] == "None", "unknown to Home Assistant"
    (of_cnc,) = (content["value_template"] for _, content in told if content["name"] == "CNC alarm")
    for cnc_alarm, seen in ((True, "ON"), (None, "None")):
        assert jinja2.Template(of_cnc).render(value_json=state | {"cnc_alarm": cnc_alarm}) == seen
    for topic, content in told:
        component, device, name, last = topic.removeprefix("homeassistant/").split("/")
        assert component in ("sensor", "binary_sensor") and last == "config"
        assert (device + name).replace("_", "").isalnum()
        assert content["state_topic"] == f"{base}/state" and content["availability_topic"] == f"{base}/status"


def test_rows_wait_until_somebody_subscribes(port: int, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.5)
    stop, problems = threading.Event(), []
    runner = SinkRunner(section(port), store, "waiting", stop, wait=lambda _duration_s: stop.wait(0.02))
    sending = threading.Thread(target=runner.run)
    sending.start()
    try:
        wait_until(lambda: runner.cursor.problem)
        problems.append(runner.cursor.problem)
        assert runner.cursor.sent_rows == 0
        with subscriber(port, "toolpoint/waiting/history/cnc", "toolpoint/waiting/status") as listener:
            listener.until(lambda messages: len(rows(messages, "cnc")) >= 6)
            assert listener.last("toolpoint/waiting/status") == "online", "the connection stands"
            wait_until(lambda: runner.cursor.sent_rows >= 6)
    finally:
        stop.set()
        sending.join()
    assert "nobody has subscribed to toolpoint/waiting/history/cnc, toolpoint/waiting/history/d" in problems[0]
    assert "take them out of `history`" in problems[0]
    assert runner.cursor.positions["cnc"].row == 6 and runner.cursor.positions["estimates"].row == 0


def test_what_was_packed_meanwhile_arrives_and_repeats_have_the_same_key(port: int, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    with subscriber(port, f"{BASE}/history/#") as listener:
        fill(store, hours=1.5)
        send(section(port), store)
        fill(store, start_s=EPOCH_S + 5400.0, hours=3.5)
        assert housekeeping(store, HistoryConfig(pack_after_s=3600.0), EPOCH_S + 5 * 3600.0).packed_hours > 0
        cursor = send(section(port), store)
        listener.until(lambda messages: len(messages) >= cursor.sent_rows)
    for stream, expected in (("temperatures", 120), ("cnc", 60), ("estimates", 60)):
        found = rows(listener.messages, stream)
        assert len(found) > expected, "half an hour comes again with its chunk"
        contents = {row["key"]: row for row in found}
        assert len(contents) == expected and all(contents[row["key"]] == row for row in found)


def test_killed_and_restarted_under_load_nothing_is_lost(tmp_path: Path) -> None:
    """The broker, which keeps nothing on its disk, is killed under load; the sender dies before its own note."""
    broker, store = Mosquitto(tmp_path, OPEN), tmp_path / "h.sqlite"
    turns, deaths, stop = itertools.count(1), [], threading.Event()

    class Dying(MqttSink):
        def _send(self, batch):
            reached = super()._send(batch)
            if reached and next(turns) in (3, 20):
                deaths.append(batch.stream.name)
                raise SinkError("the sender dies before it has noted the acknowledgement")
            return reached

    broker.start()
    runner = SinkRunner(
        section(broker.port, resend_s=3600.0), store, MACHINE, stop, Dying, wait=lambda _duration_s: stop.wait(0.02)
    )
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    sending = threading.Thread(target=runner.run)
    expected = {"temperatures": 96, **dict.fromkeys(("cnc", "estimates", "displacements", "events"), 48)}
    with subscriber(broker.port, f"{BASE}/history/#") as listener:
        sending.start()
        try:
            for half_hour in range(8):
                add(writer, EPOCH_S + 1800.0 * half_hour, 0.5)
                if half_hour % 3 == 1:
                    broker.kill()
                    broker.start()
            writer.close()
            housekeeping(store, HistoryConfig(pack_after_s=3600.0), EPOCH_S + 4 * 3600.0)
            listener.until(
                lambda messages: all(
                    len({row["key"] for row in rows(messages, name)}) == count for name, count in expected.items()
                )
            )
        finally:
            stop.set()
            sending.join()
            broker.kill()
    assert len(deaths) == 2


def test_the_command_is_killed_and_the_broker_tells_that_it_is_gone(port: int, tmp_path: Path) -> None:
    store, config = tmp_path / "h.sqlite", tmp_path / "t.yaml"
    there = section(port).model_dump(mode="json")
    document = yaml.safe_load(sample_configuration()) | {"machine": "killed", "history": {"path": str(store)}}
    config.write_text(yaml.safe_dump(document | {"sinks": [there | {"period_s": 0.05}]}))
    fill(store, hours=0.5)
    command = [sys.executable, "-P", "-m", "daemon.cli", "sink"]
    with subscriber(port, "toolpoint/killed/#") as listener:
        for number in (signal.SIGKILL, signal.SIGTERM):
            process = subprocess.Popen([*command, "run", "--config", str(config)], stderr=subprocess.DEVNULL)
            try:
                listener.until(lambda messages: bool(messages) and listener.last("toolpoint/killed/status") == "online")
                process.send_signal(number)
                assert process.wait(PATIENCE_S) == (0 if number == signal.SIGTERM else -number)
                listener.until(lambda messages: listener.last("toolpoint/killed/status") == "offline")
            finally:
                process.kill()
    asked = subprocess.run([*command, "status", "-c", str(config)], capture_output=True, check=False, text=True)
    assert asked.returncode == 1, "it does not run"
    assert f"plant (mqtt, 127.0.0.1:{port}/toolpoint)" in asked.stdout and "NOT encrypted" in asked.stdout


# --- what counts as taken ------------------------------------------------------------------


def test_the_cursor_follows_when_the_connection_has_lasted(tmp_path: Path) -> None:
    store, now_s = tmp_path / "h.sqlite", [0.0]
    fill(store, hours=0.5)
    progress = Progress(cursor=Cursor(generation="one"), save=lambda _cursor: None)
    ahead = Ahead(10.0, lambda: now_s[0])
    with Outbox(store) as outbox:
        stream = STREAMS["cnc"]
        batch = outbox.batch(stream, ahead.position(progress, "cnc"))
        assert batch is not None
        ahead.took(batch)
        for now_s[0], row in ((9.0, 0), (10.0, 6)):
            ahead.settle(progress)
            assert progress.position("cnc").row == row
            assert ahead.position(progress, "cnc") == batch.after and outbox.batch(stream, batch.after) is None
        ahead.took(batch)
        progress.cursor = Cursor(generation="two")
        assert ahead.position(progress, "cnc").row == 0, "the store was begun anew"
        now_s[0] = 99.0
        ahead.settle(progress)
        assert progress.position("cnc").row == 0


# --- what is now ---------------------------------------------------------------------------


def test_state_and_alarm_follow_the_newest_of_write_and_event(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    clock = StillClock()
    writer = HistoryWriter(store, clock=clock, machine=SMALL)
    writer.start()

    def told() -> tuple[object, ...]:
        writer.event("note", "there").result(30.0)
        with Outbox(store) as outbox:
            values = current_values(outbox)
        return values["state"], values["reason"], values["alarm"], values["error_with_um"].get("Z")

    try:
        assert told() == (None, None, "", None)
        written = make.macros(1, np.zeros(3))
        writer.write_outcome(
            writer.write_intent(make.command(np.array([0.0, 0.0, 4.0])), written, "tick"),
            make.receipt(EPOCH_S, written),
        )
        assert told() == ("ACTIVE", "following", "", -7.25)
        clock.utc_s += 1.0
        writer.event("state", "ACTIVE -> HOLD: line spindle: silent", "daemon")
        assert told() == ("HOLD", "line spindle: silent", "", None)
        clock.utc_s += 1.0
        writer.event("alarm", "held for longer than 900 s: silent", "daemon")
        assert told() == ("HOLD", "line spindle: silent", "held for longer than 900 s: silent", None)
        clock.utc_s += 1.0
        writer.event("state", "HOLD -> OFF: asked", "daemon")
        assert told() == ("OFF", "asked", "", None)
    finally:
        writer.close()


# --- refusals ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A broker with a user who may write below toolpoint/ alone."""
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "passwords").write_text("plant:lathe 7\nguest:guest\n")
    subprocess.run(["mosquitto_passwd", "-U", str(folder / "passwords")], check=True)
    (folder / "acl").write_text("user plant\ntopic readwrite toolpoint/#\nuser guest\ntopic read toolpoint/#\n")
    for name in ("passwords", "acl"):
        (folder / name).chmod(0o600)
    lines = ("allow_anonymous false", f"password_file {folder / 'passwords'}", f"acl_file {folder / 'acl'}")
    with mosquitto(folder, *lines) as port:
        yield port


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("max_packet_size 400", "a message is larger than the broker takes (mosquitto: max_packet_size)"),
        ("message_size_limit 300", "a message is larger than the broker takes (mosquitto: message_size_limit)"),
        ("retain_available false", "it must keep retained messages (mosquitto: retain_available)"),
        ("max_qos 0", "it must take quality of service 1 (mosquitto: max_qos)"),
    ],
)
def test_a_limit_of_the_broker_is_named(tmp_path: Path, setting: str, said: str) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    with mosquitto(tmp_path, OPEN, setting) as port:
        for _ in range(10):  # a connection that ends with bytes unread may take the broker's last word with it
            cursor = send(section(port), store)
            if said in cursor.problem:
                break
    assert said in cursor.problem and cursor.sent_rows == 0


@pytest.mark.parametrize("changes", [{"mqtt": {"history": []}}, {"sparkplug": {"group": "Plant"}}])
def test_a_lost_broker_is_noticed_though_the_store_stands_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, dict[str, object]]
) -> None:
    monkeypatch.setattr(running, "LOOK_ANYWAY_S", 1e9)
    store, stop, broker = tmp_path / "h.sqlite", threading.Event(), Mosquitto(tmp_path, OPEN)
    fill(store, hours=0.1)
    broker.start()
    ((driver, more),) = changes.items()
    there = {"host": "127.0.0.1", "port": broker.port, "tls": False, "timeout_s": 30.0} | more
    config = SinkConfig.model_validate({"name": "plant", "driver": driver, driver: there})
    problems: list[str] = []

    def wait(_duration_s: float) -> None:
        problems.append(runner.cursor.problem)
        if len(problems) == 5:
            broker.kill()
        threading.Event().wait(0.05)
        if problems[-1] or len(problems) > 200:
            stop.set()

    runner = SinkRunner(config, store, MACHINE, stop, wait=wait)
    runner.run()
    assert not any(problems[:5]) and problems[-1].startswith(f"sink plant: broker 127.0.0.1:{broker.port}: ")


def test_no_more_waits_for_its_acknowledgement_than_the_broker_allows(tmp_path: Path) -> None:
    """It ends the connection else; HiveMQ allows ten."""
    store = tmp_path / "h.sqlite"
    fill(store, hours=1.0)
    with strict_broker(receive_maximum=3) as broker:
        cursor = send(section(broker.port), store)
    assert cursor.problem == "" and 0 < broker.most <= 3


CONNACK, GRANTED, NO_CODES = b"\x20\x03\x00\x00\x00", b"\x90\x04\x00\x01\x00\x01", b"\x90\x03\x00\x01\x00"
TOPIC_OF_NO_TEXT = b"\x30\x06\x00\x02\xff\xfe\x00x"


@pytest.mark.parametrize(
    ("answer", "came"), [(NO_CODES, []), (GRANTED + TOPIC_OF_NO_TEXT, ["\ufffd\ufffd"])], ids=["no codes", "topic"]
)
def test_a_broker_that_breaks_its_protocol_ends_no_thread(
    answer: bytes, came: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended, topics = list[object](), list[str]()
    monkeypatch.setattr(threading, "excepthook", ended.append)

    def serve(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        for each in (CONNACK, answer):
            connection.recv(4096)
            connection.sendall(each)
        connection.recv(4096)
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve, args=(listening,))
        thread.start()
        config = BrokerConfig(host="127.0.0.1", port=listening.getsockname()[1], tls=False, timeout_s=1.0)
        broker = Broker(config, "sink x", "someone")
        broker.on_message(lambda topic, _payload, _retained: topics.append(topic))
        broker.connect(Message(topic="state", payload=b"away"))
        if came:
            broker.subscribe("commands")
            assert broker.comes(lambda: topics == came, PATIENCE_S)
        else:
            with pytest.raises(SinkError, match="sink x: no acknowledgement within `timeout_s`"):
                broker.subscribe("commands")
        broker.close()
        thread.join()
    assert ended == []


@pytest.mark.parametrize("silent", [True, False])
def test_a_broker_that_does_not_know_mqtt_5_is_told_from_a_bad_network(silent: bool) -> None:
    """Some answer nothing to a version that they do not know, some end the connection."""

    def serve(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        connection.recv(4096)
        if silent:
            connection.recv(4096)
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve, args=(listening,))
        thread.start()
        config = BrokerConfig(host="127.0.0.1", port=listening.getsockname()[1], tls=False, timeout_s=2.0)
        broker = Broker(config, "sink x", "someone")
        with pytest.raises(SinkError, match=r"it (speaks|does not speak) MQTT 5, for Sparkplug at least 3\.1\.1"):
            broker.connect(Message(topic="state", payload=b"away"))
        broker.close()
        thread.join()


def test_a_broker_that_ends_connections_in_the_middle_has_every_row(tmp_path: Path) -> None:
    store, stop = tmp_path / "h.sqlite", threading.Event()
    fill(store, hours=3.0)
    with strict_broker(cut_after=(100, 20_000, 40_000, 41_000), waits_s=0.002) as broker:
        runner = SinkRunner(section(broker.port), store, MACHINE, stop, wait=lambda _s: stop.wait(0.01))
        thread = threading.Thread(target=runner.run)
        thread.start()
        try:
            wait_until(lambda: not broker.cut_after and not rows_waiting(store, runner.cursor))
        finally:
            stop.set()
            thread.join()
    keys = {json.loads(payload)["key"] for topic, payload in broker.taken if "/history/" in topic}
    assert len(keys) == 72 + 4 * 36 + 34 + 4


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"password": "wrong"}, "check `user_name` and `password_file`"),
        ({"user_name": "nobody"}, "check `user_name` and `password_file`"),
        ({"user_name": None, "password_file": None}, "check `user_name` and `password_file`"),
        ({"password_file": Path("/nowhere/password")}, "`password_file` /nowhere/password cannot be read"),
        ({"tls": True}, "set `tls: false`"),
        ({"tls": True, "ca_certificate": Path("/nowhere/ca.pem")}, "`ca_certificate` /nowhere/ca.pem cannot be read"),
        ({"host": "no-such-host.invalid"}, "check `host`"),
        ({"port": 1}, "check `host`, `port` (1)"),
        ({"user_name": "guest", "password": "guest"}, "`user_name`"),
        ({}, "`user_name` may not publish to homeassistant/"),
    ],
)
def test_a_refusal_names_the_key(guarded: int, tmp_path: Path, changes: dict[str, object], said: str) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.1)
    (tmp_path / "password").write_text(f"{changes.pop('password', 'lathe 7')}\n")
    (tmp_path / "password").chmod(0o600)
    known = {"user_name": "plant", "password_file": tmp_path / "password", "history": []}
    cursor = send(section(guarded, **known | changes), store)
    assert said in cursor.problem and "sink plant: broker" in cursor.problem
    assert Cursor.read(cursor_path(store, "plant")) == cursor, "the status reads it there"


def follow(config: SinkConfig, path: Path, stop: threading.Event) -> tuple[SinkRunner, threading.Thread]:
    """A sink that goes on until it is told to stop."""
    runner = SinkRunner(config, path, "twins", stop, wait=lambda _duration_s: stop.wait(0.05))
    thread = threading.Thread(target=runner.run)
    thread.start()
    return runner, thread


def test_a_second_computer_of_one_name_is_refused_and_waits_until_the_first_is_gone(port: int, tmp_path: Path) -> None:
    first, second = tmp_path / "1.sqlite", tmp_path / "2.sqlite"
    for store, hours in ((first, 0.5), (second, 1.0)):
        fill(store, hours=hours)
    ends = threading.Event(), threading.Event()
    with subscriber(port, "toolpoint/twins/#") as listener:
        one, working = follow(section(port), first, ends[0])
        try:
            wait_until(lambda: not rows_waiting(first, one.cursor))
            before = len(rows(listener.messages, "cnc"))
            two, waiting = follow(section(port), second, ends[1])
            try:
                wait_until(lambda: "another store sends as twins" in two.cursor.problem)
                assert "`machine` must differ" in two.cursor.problem and two.cursor.sent_rows == 0
                fill(first, start_s=EPOCH_S + 7200.0, hours=0.5)
                wait_until(lambda: not rows_waiting(first, one.cursor))
                assert one.cursor.problem == "" and len(rows(listener.messages, "cnc")) == before + 6
                assert listener.last("toolpoint/twins/status") == "online", "the refused one does not say offline"
                ends[0].set()
                working.join()
                wait_until(lambda: not rows_waiting(second, two.cursor))
                assert two.cursor.problem == ""
            finally:
                ends[1].set()
                waiting.join()
        finally:
            ends[0].set()
            working.join()


def test_a_row_tells_of_which_store_it_is(port: int, tmp_path: Path) -> None:
    store, heard = tmp_path / "h.sqlite", []
    fill(store, hours=0.1)
    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.on_message = lambda _client, _data, message: heard.append(dict(message.properties.UserProperty))
    client.on_subscribe = lambda *_: heard.append("subscribed")
    client.connect("127.0.0.1", port)
    client.subscribe(f"{BASE}/history/#", 1)
    client.loop_start()
    wait_until(lambda: heard)
    cursor = send(section(port), store)
    wait_until(lambda: len(heard) == 1 + cursor.sent_rows)
    client.loop_stop()
    assert cursor.sent_rows > 0 and heard[1:] == cursor.sent_rows * [{"store": cursor.generation}]


def test_tls_takes_a_broker_that_is_vouched_for_and_no_other(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    store, other = tmp_path / "h.sqlite", tmp_path_factory.mktemp("other")
    fill(store, hours=0.2)
    make_certificate(other)
    make_certificate(tmp_path)
    keys = tuple(f"{key} {tmp_path / name}" for key, name in (("certfile", "monitor.crt"), ("keyfile", "monitor.key")))
    known = {"tls": True, "host": "localhost", "ca_certificate": tmp_path / "monitor.crt", "history": []}
    with mosquitto(tmp_path, OPEN, *keys) as port:

        def problem(**changes: object) -> str:
            return send(section(port, **known | changes), store).problem

        assert problem() == ""
        assert "none that `ca_certificate` vouches for" in problem(ca_certificate=other / "monitor.crt")
        assert "`host` must be a name in its certificate" in problem(host="127.0.0.1")
        assert "none that `ca_certificate` vouches for" in problem(ca_certificate=None)
        assert "set `tls: true`" in problem(tls=False, ca_certificate=None)
