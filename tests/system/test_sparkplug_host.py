"""Sparkplug B against a host application on another implementation: Eclipse Tahu's codec, with mosquitto between."""

import base64
import contextlib
import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from filled_store import add, fill
from history_records import EPOCH_S, SMALL, StillClock
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mosquitto import Mosquitto, mosquitto, wait_until
from node_packages import NEEDS_NODE, installed

from config.sample import sample_configuration
from config.schema.sinks import SinkConfig
from daemon.history.writer import HistoryWriter
from daemon.sinks import current
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.running import SinkRunner
from daemon.sinks.sparkplug_metrics import DataType, Metric, encode, row_metrics

PEER = Path(__file__).resolve().parent / "sparkplug_peer"
PATIENCE_S = 60.0
OPEN = "allow_anonymous true"
pytestmark = [pytest.mark.wires, NEEDS_NODE]


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    return installed(PEER)


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with mosquitto(tmp_path_factory.mktemp("broker"), OPEN) as port:
        yield port


class Host:
    """The host application as a process, and what it has taken."""

    def __init__(self, environment: dict[str, str], **options: object) -> None:
        self._process = subprocess.Popen(
            ["node", str(PEER / "host.js"), json.dumps({"host": "scada", "online": True, "rebirths": True} | options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )
        self.messages: list[dict[str, Any]] = []
        self._changed = threading.Condition()
        self._subscribed = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        assert self._subscribed.wait(PATIENCE_S)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            content = json.loads(line)
            with self._changed:
                if "kind" in content:
                    self.messages.append(content)
                else:
                    self._subscribed.set()
                self._changed.notify_all()

    def say(self, word: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{word}\n")
        self._process.stdin.flush()

    def until(self, enough: Callable[[], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(enough, PATIENCE_S), [
                (each["kind"], each["seq"], each["wrong"]) for each in self.messages[-8:]
            ]

    def of(self, *kinds: str) -> list[dict[str, Any]]:
        return [each for each in list(self.messages) if each["kind"] in kinds]

    def values(self) -> dict[tuple[str, int], Any]:
        """Return value by name and time of all data and births."""
        found = self.of("DDATA", "DBIRTH")
        return {(m["name"], m["utc_ms"]): m["value"] for each in found for m in each["metrics"]}

    @property
    def kinds(self) -> list[str]:
        """Kinds of messages in their order, data left out."""
        return [each["kind"] for each in list(self.messages) if each["kind"] != "DDATA"]

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()
        self._thread.join()


@contextlib.contextmanager
def host(environment: dict[str, str], port: int, node: str, **options: object) -> Iterator[Host]:
    made = Host(environment, port=port, group="Plant", node=node, **options)
    try:
        yield made
    finally:
        made.close()


def section(port: int, **changes: object) -> SinkConfig:
    known = {"host": "127.0.0.1", "port": port, "tls": False, "timeout_s": 30.0, "resend_s": 0.0, "group": "Plant"}
    return SinkConfig.model_validate(
        {"name": "scada", "driver": "sparkplug", "period_s": 0.05, "sparkplug": known | changes}
    )


@contextlib.contextmanager
def sending(config: SinkConfig, store: Path, node: str) -> Iterator[SinkRunner]:
    stop = threading.Event()
    runner = SinkRunner(config, store, node, stop, wait=lambda _duration_s: stop.wait(0.02))
    thread = threading.Thread(target=runner.run)
    thread.start()
    try:
        yield runner
    finally:
        stop.set()
        thread.join()


def expected(store: Path) -> dict[tuple[str, int], Any]:
    """Return value by name and time of all that waits in a store."""
    found: dict[tuple[str, int], Any] = {}
    with Outbox(store, rows_at_once=10_000) as outbox:
        for stream in STREAMS.values():
            batch = outbox.batch(stream, outbox.end(stream).__class__())
            for row in batch.rows if batch is not None else ():
                found |= {(each.name, each.utc_ms): each.value for each in row_metrics(stream, row)}
    return found


def test_a_host_gets_every_value_in_order_and_a_rebirth_whenever_it_asks(
    environment: dict[str, str], port: int, tmp_path: Path
) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=6.0)
    wanted = expected(store)
    with host(environment, port, "mill 7") as scada, sending(section(port), store, "mill 7") as runner:
        scada.until(lambda: wanted.keys() <= scada.values().keys())
        told = scada.values()
        assert {key: told[key] for key in wanted} == wanted
        assert len(scada.of("DDATA")) > 400, "the numbers went round"
        assert all(m["historical"] for each in scada.of("DDATA") for m in each["metrics"]), "it was told at birth"
        node, device = scada.messages[:2]
        assert (node["kind"], node["seq"], device["kind"], device["seq"]) == ("NBIRTH", 0, "DBIRTH", 1)
        types = {m["name"]: (m["type"], m["value"]) for m in node["metrics"]}
        assert types["bdSeq"] == ("Int64", 0) and types["Node Control/Rebirth"] == ("Boolean", False)
        units = {m["name"]: m["unit"] for m in device["metrics"]}
        assert units["Sensor/11"] == "degC" and units["Compensation/Y"] == "um" and units["Sensor/21"] == "degC"

        scada.say("garbage")
        for turn in (2, 3):
            scada.say("rebirth")
            scada.until(lambda turn=turn: len(scada.of("DBIRTH")) == turn)
        assert [each["metrics"][0]["value"] for each in scada.of("NBIRTH")] == [0, 0, 0], "the session is the same"
        newest = {m["name"]: m for m in scada.of("DBIRTH")[-1]["metrics"]}
        assert newest == {m["name"]: m for m in device["metrics"]}

        fill(store, start_s=EPOCH_S + 6 * 3600.0, hours=0.5)
        later = expected(store)
        scada.until(lambda: later.keys() <= scada.values().keys())
        live = [m for each in scada.of("DDATA") for m in each["metrics"] if (m["name"], m["utc_ms"]) not in wanted]
        assert live and not any(m["historical"] for m in live if m["name"].startswith("Sensor/"))
        assert runner.cursor.problem == ""
    assert [each["wrong"] for each in scada.messages if each["wrong"]] == []


def test_without_its_primary_host_nothing_is_sent(environment: dict[str, str], port: int, tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.5)
    wanted = expected(store)
    config = section(port, primary_host="main")
    with (
        host(environment, port, "waiting", host="main", online=False) as scada,
        sending(config, store, "waiting") as runner,
    ):
        wait_until(lambda: "`primary_host` is not online by its topic spBv1.0/STATE/main" in runner.cursor.problem)
        assert scada.messages == [] and runner.cursor.sent_rows == 0
        scada.say("online")
        scada.until(lambda: wanted.keys() <= scada.values().keys())
        scada.say("offline")
        scada.until(lambda: scada.kinds == ["NBIRTH", "DBIRTH", "NDEATH"])
        fill(store, start_s=EPOCH_S + 1800.0, hours=0.5)
        wait_until(lambda: "`primary_host` is not online" in runner.cursor.problem)
        sent = len(scada.messages)
        scada.say("online")
        scada.until(lambda: expected(store).keys() <= scada.values().keys())
        assert scada.messages[sent]["kind"] == "NBIRTH", "nothing was sent meanwhile"
    sessions = [each["metrics"][0]["value"] for each in scada.of("NBIRTH", "NDEATH")]
    assert sessions[:3] == [sessions[0], sessions[0], sessions[2]] and sessions[2] > sessions[0]
    assert [each["wrong"] for each in scada.messages if each["wrong"]] == []


def test_the_command_is_killed_and_its_death_has_the_number_of_its_birth(
    environment: dict[str, str], port: int, tmp_path: Path
) -> None:
    store, config = tmp_path / "h.sqlite", tmp_path / "t.yaml"
    fill(store, hours=0.5)
    document = yaml.safe_load(sample_configuration()) | {"machine": "killed", "history": {"path": str(store)}}
    config.write_text(yaml.safe_dump(document | {"sinks": [section(port).model_dump(mode="json")]}))
    command = [sys.executable, "-P", "-m", "daemon.cli", "sink", "run", "--config", str(config)]
    with host(environment, port, "killed") as scada:
        for turn, number in enumerate((signal.SIGKILL, signal.SIGTERM), 1):
            process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            try:
                scada.until(lambda turn=turn: len(scada.of("DBIRTH")) == turn)
                process.send_signal(number)
                process.wait(PATIENCE_S)
                scada.until(lambda turn=turn: len(scada.of("NDEATH")) == turn)
            finally:
                process.kill()
        assert scada.kinds == ["NBIRTH", "DBIRTH", "NDEATH"] * 2
    assert [each["wrong"] for each in scada.messages if each["wrong"]] == []


def test_a_machine_of_which_nothing_is_recorded_is_dead_until_something_is(
    environment: dict[str, str], port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "h.sqlite"
    fill(store, hours=0.5)
    monkeypatch.setattr(current, "SILENT_AFTER_S", 0.0)
    with host(environment, port, "silent") as scada, sending(section(port), store, "silent"):
        scada.until(lambda: scada.kinds == ["NBIRTH", "DBIRTH", "DDEATH"])
        monkeypatch.setattr(current, "SILENT_AFTER_S", 3600.0)
        fill(store, start_s=EPOCH_S + 1800.0, hours=0.2)
        scada.until(lambda: scada.kinds == ["NBIRTH", "DBIRTH", "DDEATH", "DBIRTH"])
        scada.until(lambda: expected(store).keys() <= scada.values().keys())
    assert [each["wrong"] for each in scada.messages if each["wrong"]] == []


def test_the_broker_is_killed_under_load_and_nothing_is_lost(environment: dict[str, str], tmp_path: Path) -> None:
    broker, store = Mosquitto(tmp_path, OPEN), tmp_path / "h.sqlite"
    broker.start()
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    config = section(broker.port, resend_s=3600.0, primary_host="scada")
    try:
        with host(environment, broker.port, "shaken") as scada, sending(config, store, "shaken"):
            for half_hour in range(6):
                add(writer, EPOCH_S + 1800.0 * half_hour, 0.5)
                if half_hour % 2 == 1:
                    broker.kill()
                    broker.start()
            writer.close()
            wanted = expected(store)
            scada.until(lambda: wanted.keys() <= scada.values().keys())
            told = scada.values()
    finally:
        broker.kill()
    assert {key: told[key] for key in wanted} == wanted


# --- the codec -----------------------------------------------------------------------------


class Codec:
    """Eclipse Tahu's codec as a process."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            ["node", str(PEER / "codec.js")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )

    def decode(self, content: bytes) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(base64.b64encode(content).decode() + "\n")
        self._process.stdin.flush()
        found: dict[str, Any] = json.loads(self._process.stdout.readline())
        return found

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture(scope="module")
def codec(environment: dict[str, str]) -> Iterator[Codec]:
    made = Codec(environment)
    yield made
    made.close()


TEXT = st.text(st.characters(blacklist_categories=("Cs",)), max_size=8)
KINDS = {
    "Int64": (DataType.INT64, st.integers(0, 2**63 - 1)),
    "Double": (DataType.DOUBLE, st.integers(-(2**40), 2**40).map(lambda number: number / 64.0)),
    "Boolean": (DataType.BOOLEAN, st.booleans()),
    "String": (DataType.STRING, TEXT),
}
METRICS = st.sampled_from(list(KINDS.values())).flatmap(
    lambda kind: st.builds(
        Metric,
        name=TEXT,
        datatype=st.just(kind[0]),
        value=st.none() | kind[1],
        utc_ms=st.integers(0, 2**53),
        historical=st.booleans(),
        properties=st.fixed_dictionaries({}, optional={"engUnit": TEXT, "Quality": st.sampled_from([0, 192, 500])}),
    )
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(METRICS, max_size=4), st.integers(1, 255))
def test_another_codec_reads_what_ours_writes(codec: Codec, metrics: list[Metric], seq: int) -> None:
    found = codec.decode(encode(metrics, utc_ms=12, seq=seq))
    assert found["timestamp"] == "12" and found["seq"] == str(seq) and len(found["metrics"]) == len(metrics)
    for read, metric in zip(found["metrics"], metrics, strict=True):
        assert read["name"] == metric.name and read["type"] == next(
            k for k, v in KINDS.items() if v[0] == metric.datatype
        )
        value = str(metric.value) if metric.datatype is DataType.INT64 and metric.value is not None else metric.value
        assert read["value"] == value and read["timestamp"] == str(metric.utc_ms)
        assert read["historical"] == metric.historical and read["properties"] == dict(metric.properties)
