"""Sparkplug B: payloads by the numbers of the specification, rows as metrics, and what a host may say."""

import contextlib
import itertools
import socket
import socketserver
import struct
import subprocess
import threading
from pathlib import Path

import paho.mqtt.client as paho
import pytest
from filled_store import fill, rows_waiting
from history_records import EPOCH_S
from hypothesis import given
from hypothesis import strategies as st
from mosquitto import mosquitto, wait_until
from paho.mqtt.enums import CallbackAPIVersion

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.running import SinkRunner
from daemon.sinks.sparkplug import SparkplugSink
from daemon.sinks.sparkplug_metrics import PAYLOAD, DataType, Metric, asks_for_rebirth, encode, row_metrics

REBIRTH = "Node Control/Rebirth"


def section(port: int | None, **changes: object) -> SinkConfig:
    known = {"host": "127.0.0.1", "port": port, "tls": False, "timeout_s": 30.0, "resend_s": 0.0, "group": "Plant"}
    return SinkConfig.model_validate({"name": "scada", "driver": "sparkplug", "sparkplug": known | changes})


# --- payloads ------------------------------------------------------------------------------


def wire(content: bytes) -> list[tuple[int, int | bytes]]:
    """Return number and content of every field of a message, read without any description of it."""
    found: list[tuple[int, int | bytes]] = []
    at = 0

    def varint() -> int:
        nonlocal at
        value, shift = 0, 0
        while True:
            byte = content[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(content):
        tag = varint()
        number, kind = tag >> 3, tag & 7
        if kind == 0:
            found.append((number, varint()))
            continue
        size = {1: 8, 5: 4}.get(kind) or varint()
        found.append((number, content[at : at + size]))
        at += size
    return found


VALUES = {
    DataType.INT64: st.integers(-(2**63), 2**63 - 1),
    DataType.INT32: st.integers(-(2**31), 2**31 - 1),
    DataType.DOUBLE: st.floats(allow_nan=False),
    DataType.BOOLEAN: st.booleans(),
    DataType.STRING: st.text(),
}
METRICS = st.sampled_from(list(VALUES)).flatmap(
    lambda kind: st.builds(
        Metric,
        name=st.text(min_size=1),
        datatype=st.just(kind),
        value=st.none() | VALUES[kind],
        utc_ms=st.integers(0, 2**63),
        historical=st.booleans(),
        properties=st.dictionaries(st.text(max_size=5), st.text(max_size=5) | st.integers(0, 2**31 - 1), max_size=2),
    )
)


def on_the_wire(kind: DataType, value: object) -> tuple[int, int | bytes]:
    """Return number and content of the field in which the specification puts a value."""
    if kind in (DataType.INT32, DataType.INT64):
        return (10, int(value) % 2**32) if kind is DataType.INT32 else (11, int(value) % 2**64)
    if kind is DataType.DOUBLE:
        return 13, struct.pack("<d", value)
    return (14, int(value)) if kind is DataType.BOOLEAN else (15, str(value).encode())


@given(st.lists(METRICS, max_size=4), st.integers(0, 2**63), st.none() | st.integers(0, 255))
def test_payloads_have_the_numbers_of_the_specification(metrics: list[Metric], utc_ms: int, seq: int | None) -> None:
    content = encode(metrics, utc_ms=utc_ms, seq=seq)
    fields = wire(content)
    assert [value for number, value in fields if number == 1] == [utc_ms]
    assert [value for number, value in fields if number == 3] == ([] if seq is None else [seq])
    inner = [dict(wire(value)) for number, value in fields if number == 2 and isinstance(value, bytes)]
    assert len(inner) == len(metrics) and {number for number, _ in fields} <= {1, 2, 3}
    for found, metric in zip(inner, metrics, strict=True):
        assert found[1] == metric.name.encode() and found[3] == metric.utc_ms and found[4] == metric.datatype
        assert found.get(5, 0) == metric.historical and found.get(7, 0) == (metric.value is None)
        assert 2 not in found, "no aliases"
        values = {number: value for number, value in found.items() if number >= 10}
        assert values == ({} if metric.value is None else dict([on_the_wire(metric.datatype, metric.value)]))
        properties = wire(found.get(9, b""))
        assert [value for number, value in properties if number == 1] == [key.encode() for key in metric.properties]
        for (_, content), given_value in zip(
            [each for each in properties if each[0] == 2], metric.properties.values(), strict=True
        ):
            text = isinstance(given_value, str)
            assert dict(wire(content)) == ({1: 12, 8: given_value.encode()} if text else {1: 3, 3: given_value})


@given(st.binary(max_size=200))
def test_a_command_that_is_none_asks_for_nothing(content: bytes) -> None:
    try:
        known = any(each.name == REBIRTH and each.boolean_value for each in PAYLOAD.FromString(content).metrics)
    except Exception:
        known = False
    assert asks_for_rebirth(content, REBIRTH) is known


def test_a_command_to_be_born_again_is_known() -> None:
    def asked(name: str, value: bool) -> bool:
        metric = Metric(name=name, datatype=DataType.BOOLEAN, value=value, utc_ms=1)
        return asks_for_rebirth(encode([metric], utc_ms=1, seq=None), REBIRTH)

    assert asked(REBIRTH, True) and not asked(REBIRTH, False) and not asked("Node Control/Reboot", True)


# --- rows ----------------------------------------------------------------------------------


def test_every_stream_makes_metrics_with_units_and_times(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=1.5)
    found: dict[str, list[Metric]] = {}
    with Outbox(store) as outbox:
        for stream in STREAMS.values():
            batch = outbox.batch(stream, outbox.end(stream).__class__())
            for row in batch.rows if batch is not None else ():
                metrics = row_metrics(stream, row)
                assert {each.utc_ms for each in metrics} == {row[0]}
                assert len({each.name for each in metrics}) == len(metrics)
                found[stream.name] = found.get(stream.name, []) + metrics
    names = {stream: {(each.name, each.properties.get("engUnit")) for each in found[stream]} for stream in found}
    assert names["temperatures"] == {(f"Sensor/{number}", "degC") for number in (11, 12, 13, 21, 22)}
    assert {("Thermal error/dx", "um"), ("Temperature/A", "degC"), ("Estimate/Confidence", None)} < names["estimates"]
    assert {("Compensation/Y", "um"), ("Output/State", None), ("Applied/Z", "um")} < names["writes"]
    assert {("CNC/Spindle speed", "rpm"), ("CNC/Alarm", None)} < names["cnc"]
    assert ("Displacement/dx", "um") in names["displacements"] and ("Reference/ID", None) in names["references"]
    assert {each.value for each in found["events"] if each.name == "Event/Person"} == {"Ada"}
    (outcome,) = {each.value for each in found["writes"] if each.name == "Output/Outcome of the write"}
    assert outcome == "verified"
    values = {(each.name, type(each.value)) for each in found["cnc"]}
    assert ("CNC/Alarm", bool) in values and ("CNC/Program", int) in values
    missing = [each for each in found["estimates"] if each.name == "Thermal error/dy"]
    assert missing and all(each.value is None for each in missing)


def test_a_rejected_temperature_is_told_as_bad() -> None:
    stream = STREAMS["temperatures"]
    row = dict.fromkeys(stream.columns, 0) | {"sensor_ids": [1, 2, 3], "degc": [20.5, 99.0, None], "quality": [0, 1, 2]}
    good, held, none = row_metrics(stream, tuple(row[name] for name in stream.columns))
    assert "Quality" not in good.properties and held.properties["Quality"] == 0 and none.properties["Quality"] == 500
    assert none.value is None


# --- hosts, configuration ------------------------------------------------------------------


def test_sessions_are_numbered_0_to_255_over_and_over() -> None:
    numbers = [SparkplugSink(section(1), "numbered")._bd_seq for _ in range(258)]
    assert numbers == [*range(256), 0, 1]
    assert SparkplugSink(section(1), "another")._bd_seq == 0


def problem(port: int, store: Path, group: str, **changes: object) -> str:
    """Send all that waits, or say why not."""
    stop = threading.Event()
    config = section(port, group=group, timeout_s=5.0, **changes)
    runner = SinkRunner(config, store, "mill", stop, wait=lambda _duration_s: stop.set())
    runner.run()
    return runner.cursor.problem


def test_a_right_that_is_missing_is_named_whatever_is_retained_there(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.2)
    rights = "topic readwrite spBv1.0/Plant/#\ntopic read spBv1.0/Else/#\nuser host\ntopic readwrite #\n"
    (tmp_path / "acl").write_text(rights)
    (tmp_path / "acl").chmod(0o600)
    with mosquitto(tmp_path, "allow_anonymous true", f"acl_file {tmp_path / 'acl'}") as port:
        words = ["-h", "127.0.0.1", "-p", str(port), "-u", "host", "-r", "-m", "garbage"]
        for topic in ("spBv1.0/Else/NBIRTH/mill", "spBv1.0/Plant/DBIRTH/mill/Machine", "spBv1.0/Plant/NCMD/mill"):
            subprocess.run(["mosquitto_pub", *words, "-t", topic], check=True)
        assert problem(port, store, "Plant") == ""
        assert "spBv1.0/Else/NBIRTH/mill did not come back: let `user_name` publish" in problem(port, store, "Else")


def test_a_broker_that_drops_a_large_birth_takes_no_rows(tmp_path: Path) -> None:
    """It says nothing: what it drops would count as sent."""
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.2)
    with mosquitto(tmp_path, "allow_anonymous true", "message_size_limit 300") as port:
        said = problem(port, store, "Plant")
    assert "spBv1.0/Plant/DBIRTH/mill/Machine did not come back" in said and "message_size_limit" in said
    cursor = Cursor.read(cursor_path(store, "scada"))
    assert cursor is not None and cursor.sent_rows == 0


def test_a_storm_of_commands_to_be_born_again_is_answered_and_keeps_no_row_back(tmp_path: Path) -> None:
    store, stop, kinds, numbers = tmp_path / "h.sqlite", threading.Event(), [], []
    fill(store, hours=0.5)

    def hear(_client: object, _data: object, message: paho.MQTTMessage) -> None:
        kinds.append(message.topic.split("/")[2])
        if kinds[-1] in ("NBIRTH", "DBIRTH", "DDATA"):
            numbers.append((kinds[-1], PAYLOAD.FromString(message.payload).seq))

    host = paho.Client(CallbackAPIVersion.VERSION2, "host", protocol=paho.MQTTv5)
    host.on_message = hear
    with mosquitto(tmp_path, "allow_anonymous true") as port:
        host.connect("127.0.0.1", port)
        host.subscribe("spBv1.0/Plant/#")
        host.loop_start()
        runner = SinkRunner(section(port), store, "mill", stop, wait=lambda _duration_s: stop.wait(0.05))
        thread = threading.Thread(target=runner.run)
        thread.start()
        try:
            wait_until(lambda: kinds.count("DBIRTH") == 1)
            asked = [Metric(name=REBIRTH, datatype=DataType.BOOLEAN, value=True, utc_ms=1)]
            for _ in range(1000):
                host.publish("spBv1.0/Plant/NCMD/mill", encode(asked, utc_ms=1, seq=0))
            wait_until(lambda: kinds.count("NCMD") == 1000)
            wait_until(lambda: "DBIRTH" in kinds[len(kinds) - kinds[::-1].index("NCMD") :])
            fill(store, start_s=EPOCH_S + 1800.0, hours=0.5)
            wait_until(lambda: not rows_waiting(store, runner.cursor))
        finally:
            stop.set()
            thread.join()
            host.loop_stop()
    assert runner.cursor.problem == "" and 2 <= kinds.count("NBIRTH") < 20
    for (_, before), (kind, number) in itertools.pairwise(numbers):
        assert number == (0 if kind == "NBIRTH" else (before + 1) % 256)


def test_a_node_that_was_not_born_does_not_die_and_one_that_was_does(tmp_path: Path) -> None:
    """A host that hears a death without a birth before it counts a session that never was."""
    store, heard = tmp_path / "h.sqlite", list[str]()
    fill(store, hours=0.2)
    host = paho.Client(CallbackAPIVersion.VERSION2, "host", protocol=paho.MQTTv5)
    host.on_message = lambda _client, _data, message: heard.append(message.topic.split("/")[2])
    with mosquitto(tmp_path, "allow_anonymous true") as port:
        host.connect("127.0.0.1", port)
        host.subscribe("spBv1.0/Plant/#", qos=1)
        host.loop_start()
        assert "is not online" in problem(port, store, "Plant", primary_host="scada")
        assert problem(port, store, "Plant") == ""
        wait_until(lambda: heard[-1:] == ["NDEATH"])
        host.loop_stop()
    assert heard[0] == "NBIRTH" and heard.count("NDEATH") == 1


def test_a_host_of_sparkplug_2_2_is_waited_for_too_and_what_is_left_of_it_does_not_count_beside_3_0(
    tmp_path: Path,
) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.2)
    here, away = (f'{{"online": {word}, "timestamp": 1}}' for word in ("true", "false"))
    said = {"old": ("ONLINE", None), "gone": ("OFFLINE", None), "renewed": ("OFFLINE", here), "both": ("ONLINE", away)}

    def waits(port: int, host: str) -> list[str]:
        """Send until nothing keeps the sink from it, or a few times; return what did."""
        stop, found = threading.Event(), list[str]()

        def wait(_duration_s: float) -> None:
            found.append(runner.cursor.problem)
            if not found[-1] or len(found) > 5:
                stop.set()
            stop.wait(0.05)

        config = section(port, group=host, primary_host=host)
        runner = SinkRunner(config, store, "mill", stop, wait=wait)
        runner.run()
        return found

    with mosquitto(tmp_path, "allow_anonymous true") as port:
        words = ["-h", "127.0.0.1", "-p", str(port), "-r"]
        for host, told in said.items():
            for topic, text in zip((f"STATE/{host}", f"spBv1.0/STATE/{host}"), told, strict=True):
                if text is not None:
                    subprocess.run(["mosquitto_pub", *words, "-t", topic, "-m", text], check=True)
        for host in ("gone", "both"):
            assert all("is not online" in each for each in waits(port, host))
        assert waits(port, "renewed")[-1] == waits(port, "old")[-1] == ""
    cursor = Cursor.read(cursor_path(store, "scada"))
    assert cursor is not None and not rows_waiting(store, cursor)


class OlderBroker(socketserver.ThreadingTCPServer):
    """Passes on to a broker who speaks MQTT 3.1.1, and answers who speaks 5 as brokers do that do not know it."""

    daemon_threads = True

    def __init__(self, port: int, way: str) -> None:
        super().__init__(("127.0.0.1", 0), _OlderConnection)
        self.broker, self.way = port, way


class _OlderConnection(socketserver.BaseRequestHandler):
    server: OlderBroker

    def handle(self) -> None:
        connect = self.request.recv(65536)
        version = connect[connect.index(b"MQTT") + 4]
        if version == 4:
            with socket.create_connection(("127.0.0.1", self.server.broker)) as broker:
                broker.sendall(connect)
                threading.Thread(target=self._pass_on, args=(broker, self.request), daemon=True).start()
                self._pass_on(self.request, broker)
        elif self.server.way == "refuses":
            self.request.sendall(b"\x20\x02\x00\x01")
        elif self.server.way == "is silent":
            self.request.recv(1)

    @staticmethod
    def _pass_on(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)


@pytest.mark.parametrize("way", ["refuses", "closes", "is silent"])
def test_a_broker_that_does_not_know_mqtt_5_gets_births_data_and_death(tmp_path: Path, way: str) -> None:
    """The specification asks for 3.1.1 alone."""
    store, heard = tmp_path / "h.sqlite", list[str]()
    fill(store, hours=0.2)
    host = paho.Client(CallbackAPIVersion.VERSION2, "host")
    host.on_message = lambda _client, _data, message: heard.append(message.topic.split("/")[2])
    with mosquitto(tmp_path, "allow_anonymous true") as port, OlderBroker(port, way) as older:
        threading.Thread(target=older.serve_forever, daemon=True).start()
        host.connect("127.0.0.1", port)
        host.subscribe("spBv1.0/Plant/#", qos=1)
        host.loop_start()
        assert problem(older.server_address[1], store, "Plant") == ""
        wait_until(lambda: heard[-1:] == ["NDEATH"])
        host.loop_stop()
        older.shutdown()
    assert heard[:2] == ["NBIRTH", "DBIRTH"] and heard.count("DDATA") > 10 and heard.count("NDEATH") == 1
    cursor = Cursor.read(cursor_path(store, "scada"))
    assert cursor is not None and not rows_waiting(store, cursor)
