"""The alarm sink on a real output task, its store, its local socket and a real web server."""

import asyncio
import contextlib
import shutil
import sqlite3
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from alarm_servers import Posts, mail_server, web_server
from certificates import make_certificate
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc
from pydantic import BaseModel

from config.loader import load_configuration
from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.sinks import AlarmsConfig, SinkConfig
from daemon.app import Daemon
from daemon.cli.operate.sink import in_words
from daemon.monitor.control_socket import ControlSocket
from daemon.sinks.alarms import sink as alarm_sink
from daemon.sinks.alarms.ledger import Condition
from daemon.sinks.alarms.observing import HELD, Lasting, certificates, of_computer, of_status
from daemon.sinks.alarms.sink import AlarmSink
from daemon.sinks.running import SinkRunner, alone, make_messenger, run_sinks, sink_status
from daemon.snapshots import LinkSnapshot


class Hall:
    """A machine whose output task runs here, its daemon's socket, and who is told of its alarms."""

    def __init__(self, rig: Rig, posts: Posts, **alarms: object) -> None:
        self.rig, self.posts, self.away_s = rig, posts, 0.0
        webhook = {"url": posts.url, "alarms": {"interval_s": 60.0, "disk_free_percent": 1e-9} | alarms}
        self.config = SinkConfig.model_validate({"name": "chat", "driver": "webhook", "webhook": webhook})
        self.configuration = rig.configuration.model_copy(update={"sinks": [self.config]})

    def _now_utc_s(self) -> float:
        return self.rig.clock.now().utc_s + self.away_s

    def _run(self) -> SinkRunner:
        stop = threading.Event()
        runner = self.runner_until(stop, lambda _duration_s: stop.set())
        runner.run()
        return runner

    def runner_until(self, stop: threading.Event, wait: Callable[[float], None]) -> SinkRunner:
        def make(config: SinkConfig, _machine: str) -> AlarmSink:
            return AlarmSink(config, self.configuration, make_messenger(config), self._now_utc_s)

        store = self.configuration.history.path
        return SinkRunner(self.config, store, "mill", stop, make, wait)

    async def look(self, after_s: float = 0.0) -> list[str]:
        """Let time pass without the output task; return what people were told at one look of a sink begun anew."""
        self.away_s += after_s
        await self.rig.history.flushed()
        before = len(self.posts.taken)
        self.runner = await asyncio.to_thread(self._run)
        return [alarm["sentence"] for post in self.posts.taken[before:] for alarm in post["alarms"]]

    async def status(self) -> str:
        (status,) = await asyncio.to_thread(sink_status, self.configuration, time.time())
        return in_words(status, 30.0)


@contextlib.asynccontextmanager
async def hall(folder: Path, **alarms: object) -> AsyncIterator[Hall]:
    clock = HandClock()
    configuration = machine(folder)
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    with web_server() as posts:
        async with running(rig), serving(rig):
            yield Hall(rig, posts, **alarms)


@contextlib.asynccontextmanager
async def serving(rig: Rig) -> AsyncIterator[None]:
    ready = asyncio.Event()
    socket = ControlSocket(rig.configuration.service.socket, None, rig.desk().handle)
    task = asyncio.create_task(socket.run(ready.set))
    await ready.wait()
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def fault(rig: Rig, why: str) -> None:
    rig.control.journal.raise_fault(why)
    await rig.turn()
    assert rig.control.memory.state.value == "FAULT"


async def acknowledged(rig: Rig) -> None:
    assert rig.acknowledge("Ada") == ""
    await rig.turn()
    assert rig.control.memory.state.value != "FAULT"


async def test_a_fault_is_told_and_its_end_too(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        assert await it.look() == []
        assert "sent 0 messages; last acknowledged never" in await it.status(), "what was read alone is not sent"
        await fault(it.rig, "read-back differs: #501")
        (said,) = await it.look()
        assert said.startswith("FAULT, since 20") and said.endswith("read-back differs: #501")
        assert await it.look(3600.0) == []
        await it.rig.turn(after_s=720.0)
        await acknowledged(it.rig)
        (said,) = await it.look()
        assert said == "over after 12 min: FAULT: read-back differs: #501"
        assert "sent 2 messages; last acknowledged 20" in await it.status()
        assert await it.look(1e5) == []


def test_a_reason_that_is_found_again_after_a_restoration_stands_in_the_alarm_once() -> None:
    track = alarm_sink.OutputTrack()
    for text in ("macro #500 holds 0, we wrote 28", "macro #505 holds 0, we wrote 28"):
        track, _ = track.after(0.0, "fault", text)
    track, _ = track.after(1.0, "state", "OFF -> FAULT: macro #500 holds 0, we wrote 28")
    track, _ = track.after(99.0, "fault", "macro #500 holds 0, we wrote 28")
    assert track.now is not None and track.now.reasons == 2
    assert track.now.reason == "macro #500 holds 0, we wrote 28; macro #505 holds 0, we wrote 28"


async def test_a_fault_that_came_and_went_while_the_sender_was_away_is_told(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        await it.look()
        for _ in range(3):
            await fault(it.rig, "a write was refused")
            await it.rig.turn(after_s=60.0)
            await acknowledged(it.rig)
        (said,) = await it.look(60.0)
        assert said.startswith("over after ") and said.endswith(": FAULT (3 times): a write was refused")


async def test_a_long_hold_and_a_silent_daemon(tmp_path: Path) -> None:
    async with hall(tmp_path, hold_longer_than_s=100.0, daemon_longer_than_s=50.0) as it:
        await it.rig.turn()
        await fault(it.rig, "why")
        await it.look()
        await acknowledged(it.rig)
        assert it.rig.control.memory.state.value == "HOLD", "after a FAULT the output stays where it was"
        (said,) = await it.look(60.0)
        assert said.startswith("over after ") and ": FAULT: " in said
        it.rig.clock.monotonic_s += 101.0
        (said,) = await it.look()
        assert said.startswith("HOLD, since")
    # the daemon is stopped now
    with web_server() as posts:
        it = Hall(it.rig, posts, daemon_longer_than_s=50.0)
        it.away_s = 1000.0
        assert (await look_without_daemon(it)) == []
        it.away_s = 1051.0
        (said,) = await look_without_daemon(it)
        assert said.startswith("the daemon does not run, since") and "systemctl status toolpoint" in said


async def look_without_daemon(it: Hall) -> list[str]:
    before = len(it.posts.taken)
    await asyncio.to_thread(it._run)
    return [alarm["sentence"] for post in it.posts.taken[before:] for alarm in post["alarms"]]


async def test_a_server_that_refuses_loses_nothing_and_the_runner_says_which_key(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        await it.look()
        await fault(it.rig, "why")
        it.posts.status = 401
        assert await it.look() == []
        assert "check `token_file`" in it.runner.cursor.problem
        (status,) = await asyncio.to_thread(sink_status, it.configuration, time.time())
        assert "check `token_file`" in status["problem"] and status["rows"]["waiting"] == {}
        it.posts.status = 200
        (said,) = await it.look()
        assert said.endswith("why") and it.runner.cursor.problem == ""
        assert len(it.posts.asked) == 2


async def test_a_fault_waits_no_longer_for_a_proxy_than_until_it_reaches_its_server(tmp_path: Path) -> None:
    async with hall(tmp_path, interval_s=300.0) as it:
        await it.rig.turn()
        await it.look()
        await fault(it.rig, "why")
        it.posts.status = 502
        assert await it.look() == [] and "it answers 502" in it.runner.cursor.problem
        it.posts.status = 200
        (said,) = await it.look(60.0)
        assert said.endswith("why") and it.runner.cursor.problem == ""


@pytest.mark.parametrize("status", [500, 504])
async def test_who_has_a_message_and_does_not_say_so_gets_it_again_no_more_often_than_others(
    tmp_path: Path, status: int
) -> None:
    async with hall(tmp_path, interval_s=300.0) as it:
        await it.rig.turn()
        await it.look()
        await fault(it.rig, "why")
        it.posts.status = status
        await it.look()
        assert f"it answers {status}" in it.runner.cursor.problem
        for _ in range(3):
            await it.look(60.0)
        assert len(it.posts.asked) == 1, "each of them may be one more message for people"
        await it.look(180.0)
        assert len(it.posts.asked) == 2
        it.posts.status = 200
        (said,) = await it.look(300.0)
        assert said.endswith("why") and it.runner.cursor.problem == ""


async def test_what_is_not_known_to_be_taken_is_a_problem_until_it_is(tmp_path: Path) -> None:
    async with hall(tmp_path, interval_s=300.0) as it:
        await it.rig.turn()
        await fault(it.rig, "why")
        it.posts.status = 504
        problems, stop = [], threading.Event()

        def wait(_duration_s: float) -> None:
            problems.append(runner.cursor.problem)
            it.away_s += 100.0
            if len(problems) == 3:
                it.posts.status = 200
            if len(problems) == 5:
                stop.set()

        await it.rig.history.flushed()
        runner = it.runner_until(stop, wait)
        await asyncio.to_thread(runner.run)
        assert ["504" in problem for problem in problems] == [True, True, True, False, False]
        assert len(it.posts.asked) == 2


async def test_who_gets_no_alarms_is_a_problem_that_status_shows(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        await fault(it.rig, "why")
        await it.rig.history.flushed()
        with mail_server(refused=("shift@plant.example",)) as box:
            mail = {"host": "localhost", "port": box.port, "encryption": "none", "sender": "tp@plant.example"}
            mail |= {"recipients": ["shift@plant.example", "anna@plant.example"], "alarms": {"disk_free_percent": 1e-9}}
            it.config = SinkConfig.model_validate({"name": "chat", "driver": "mail", "mail": mail})
            it.configuration = it.rig.configuration.model_copy(update={"sinks": [it.config]})
            runner = await asyncio.to_thread(it._run)
        assert len(box.letters) == 1 and runner.cursor.sent_rows == 1
        (status,) = await asyncio.to_thread(sink_status, it.configuration, time.time())
        assert status["problem"].endswith("it refuses shift@plant.example: check `recipients`")


async def test_a_store_that_cannot_be_read_keeps_no_alarm_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one whose disk is gone: the daemon still says how the machine is."""
    monkeypatch.setattr(alarm_sink, "LOOK_S", 0.0)
    async with hall(tmp_path) as it:
        await it.rig.turn()
        await it.look()
        store, away = it.configuration.history.path, tmp_path / "away"
        await it.rig.history.flushed()
        store.rename(away)
        store.mkdir()
        it.rig.control.journal.raise_fault("why")
        await it.rig.turn()
        stop, waits = threading.Event(), []

        def wait(_duration_s: float) -> None:
            waits.append(it.runner.cursor.problem)
            it.away_s += 31.0
            if len(waits) == 5:
                stop.set()

        it.runner = it.runner_until(stop, wait)
        await asyncio.to_thread(it.runner.run)
        said = [alarm["sentence"] for post in it.posts.taken for alarm in post["alarms"]]
        assert len([each for each in said if each.startswith("FAULT, since") and each.endswith("why")]) == 1, said
        assert all("what happens is not told: " in problem for problem in waits)
        store.rmdir()
        away.rename(store)
        await it.look()
        assert it.runner.cursor.problem == ""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a disk of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", str(folder)], check=False, capture_output=True).returncode:
        pytest.skip("only root may mount a disk")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def remounted(folder: Path, how: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{how}", str(folder)], check=True, capture_output=True)


async def test_who_starts_on_a_disk_that_cannot_be_written_tells_it_and_its_end(
    tmp_path: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a failure of the disk the service manager starts both anew: the daemon cannot run, the sender must."""
    monkeypatch.setattr(alarm_sink, "LOOK_S", 0.0)
    alarms = {"interval_s": 0.001, "daemon_longer_than_s": 0.001, "disk_free_percent": 1e-9}

    def told() -> set[tuple[str, str]]:
        return {(alarm["change"], alarm["kind"]) for post in posts.taken for alarm in post["alarms"]}

    async def until_told(what: tuple[str, str]) -> None:
        async with asyncio.timeout(60.0):
            while what not in told():
                await asyncio.sleep(0.05)

    configuration = machine(tmp_path)
    clock = HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        await rig.turn()
        await rig.history.flushed()
        store = small_disk / "history.sqlite"
        with contextlib.closing(sqlite3.connect(configuration.history.path)) as source:
            source.execute("VACUUM INTO ?", (str(store),))
        with alone(store):
            pass  # as the sender did before the disk failed
        with web_server() as posts:
            sink = {"name": "chat", "driver": "webhook", "period_s": 0.05}
            config = SinkConfig.model_validate(sink | {"webhook": {"url": posts.url, "alarms": alarms}})
            history = configuration.history.model_copy(update={"path": store})
            there = configuration.model_copy(update={"history": history, "sinks": [config]})
            stop = threading.Event()
            remounted(small_disk, "ro")
            sender = asyncio.create_task(asyncio.to_thread(run_sinks, there, stop))
            try:
                await until_told(("raised", "daemon"))
                remounted(small_disk, "rw")
                async with serving(rig):
                    await until_told(("ended", "daemon"))
            finally:
                stop.set()
                await sender


async def test_a_share_that_does_not_answer_keeps_no_alarm_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A back-up's folder may lie on one: its server is away, and to look at the room on it takes hours."""
    answers = threading.Event()
    full = Condition(kind="disk", subject="/share", text="1.0 % of the disk is free", since_utc_s=0.0)
    monkeypatch.setattr(alarm_sink, "of_computer", lambda *_: [full] if answers.wait(20.0) else [])
    async with hall(tmp_path) as it:
        answers.set()
        await it.rig.turn()
        (said,) = await it.look()
        assert said.startswith("disk /share, since")
        answers.clear()
        monkeypatch.setattr(alarm_sink, "SHARE_WITHIN_S", 0.01)
        await fault(it.rig, "read-back differs: #501")
        (said,) = await it.look(60.0)
        assert said.startswith("FAULT, since"), "nobody knows whether the disk is free again"
        answers.set()


def test_alarms_hold_no_history_back(tmp_path: Path) -> None:
    webhook = SinkConfig.model_validate({"name": "chat", "driver": "webhook", "webhook": {"url": "http://h/x"}})
    plant = SinkConfig.model_validate({"name": "plant", "driver": "parquet", "parquet": {"folder": "/x"}})
    configuration = machine(tmp_path).model_copy(update={"sinks": [webhook, plant]})
    daemon = Daemon(configuration, HandClock())
    assert daemon._history.housekeeping._sinks == ["plant"]


# --- what counts as wrong ------------------------------------------------------------------


async def status_of(rig: Rig) -> dict:
    return await rig.desk().handle({"command": "status"}, "Ada")


def judged(
    status: dict, configuration: Configuration, *, at_s: tuple[float, ...] = (0.0, 1e4)
) -> list[tuple[str, str]]:
    """What is wrong when it has been so for long."""
    since, found = {}, []
    for now_s in at_s:
        lasting = Lasting(since, now_s)
        found = list(of_status(status, configuration, AlarmsConfig(), "sink chat", lasting))
        since = lasting.since_utc_s
    return [(each.kind, each.subject) for each in found]


async def test_links_and_sensors_count_after_their_time_and_the_own_link_never(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        link = LinkSnapshot(
            name="latsis bed",
            up=False,
            problem="no port",
            attempts=1,
            failures=1,
            losses=0,
            last_problem="",
            last_problem_utc_s=None,
        )
        it.rig.snapshots.links = (link, replace(link, name="sink chat"), replace(link, name="CNC", up=True))
        status = await status_of(it.rig)
        status["temperatures"] = {"not_good": {"1": "no accepted value for too long"}, "not_good_count": 1}
        status["estimate"] = {"imputed": [1, 2]}
        assert judged(status, it.configuration, at_s=(0.0, 100.0)) == []
        found = judged(status, it.configuration)
        assert found[0] == ("link", "latsis bed") and len(found) == 3
        assert [subject.split()[0] for _, subject in found[1:]] == ["1", "2"]
        status["temperatures"] = {"not_good": {str(k): "x" for k in range(1, 21)}, "not_good_count": 100}
        assert [each for each in judged(status, it.configuration) if each[0] == "sensor"] == [("sensor", "")]


async def test_a_sensor_that_is_still_wrong_is_not_over_because_many_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        status = await status_of(it.rig)
        monkeypatch.setattr(alarm_sink, "asked", lambda _: status)
        said: list[list[str]] = []
        for count in (2, 30, 1):
            status["temperatures"] = {
                "not_good": {str(k): "x" for k in range(1, count + 1)[:20]},
                "not_good_count": count,
            }
            said += [await it.look(after_s) for after_s in (60.0, 1e4, 60.0)]
        (_, first, _, _, many, _, end, _, _) = said
        assert [each.partition(" (")[0] for each in first] == ["sensor 1", "sensor 2"]
        assert [each.partition(",")[0] for each in many] == ["many sensors"]
        assert sorted(each.partition(": ")[2].partition(" (")[0] for each in end) == [
            "many sensors: 30 sensors do not count, such as 1, 2, 3, 4, 5",
            "sensor 2",
        ]
        assert sum(map(len, said)) == 5


async def test_alarms_of_output_model_and_store(tmp_path: Path) -> None:
    async with hall(tmp_path) as it:
        await it.rig.turn()
        status = await status_of(it.rig)
        assert judged(status, it.configuration) == []
        status["output"] |= {"state": "HOLD", "alarm": f"{HELD} 300 s: why"}
        assert judged(status, it.configuration) == [], "HOLD has an alarm of its own"
        status["output"]["alarm"] = "the guard does not apply the block (status 6, see docs/reference/macros.md)"
        status["model"] = {"problem": "the checksum differs"}
        status["history"]["problem"] = "the disk is full"
        status["spindle_speed"] = {"alarm": "no resonance"}
        status["jobs"] = [{"name": "backup", "problem": "the folder does not answer"}, {"name": "x", "problem": ""}]
        expected = [("output", ""), ("output", "spindle speed"), ("model", "refused"), ("store", ""), ("job", "backup")]
        assert judged(status, it.configuration) == expected


def test_certificates_that_end_soon_are_named_by_their_key(tmp_path: Path) -> None:
    make_certificate(tmp_path)  # ends in a day
    (tmp_path / "clients").mkdir()
    shutil.copy(tmp_path / "monitor.crt", tmp_path / "clients" / "erp.pem")
    (tmp_path / "broken.pem").write_text("-----BEGIN CERTIFICATE-----\nno\n-----END CERTIFICATE-----\n")
    content = yaml.safe_load(sample_configuration())
    content["service"] |= {
        "tls_certificate": str(tmp_path / "monitor.crt"),
        "tls_key": str(tmp_path / "monitor.key"),
        "users": str(tmp_path / "users.yaml"),
    }
    content["opcua_server"] = {
        "certificate": str(tmp_path / "server.der"),
        "private_key": str(tmp_path / "server.pem"),
        "trusted_clients": str(tmp_path / "clients"),
    }
    content["sinks"] = [
        {
            "name": "people",
            "driver": "mail",
            "mail": {
                "host": "m",
                "sender": "a@b",
                "recipients": ["c@d"],
                "ca_certificate": str(tmp_path / "broken.pem"),
            },
        }
    ]
    content["history"]["path"] = str(tmp_path / "h.sqlite")
    path = tmp_path / "t.yaml"
    path.write_text(yaml.safe_dump(content))
    configuration = load_configuration(path)
    assert {key for key, _ in certificates(configuration)} == {
        "service.tls_certificate",
        "sinks[0].mail.ca_certificate",
        "opcua_server.certificate",
        "opcua_server.trusted_clients erp.pem",
    }
    found = list(of_computer(configuration, AlarmsConfig(disk_free_percent=1e-9), (), time.time()))
    assert [each.subject for each in found] == ["service.tls_certificate", "opcua_server.trusted_clients erp.pem"]
    assert "monitor.crt ends on 20" in found[0].text and found[0].text.endswith("renew it")
    assert (
        list(of_computer(configuration, AlarmsConfig(disk_free_percent=1e-9, certificate_days=0.1), (), time.time()))
        == []
    )
    late, _ = of_computer(configuration, AlarmsConfig(disk_free_percent=1e-9), (), time.time() + 3 * 86_400)
    assert "monitor.crt ended on 20" in late.text


def test_a_folder_of_clients_that_cannot_be_read_keeps_no_other_alarm_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Section(BaseModel):
        trusted_clients: Path
        certificate: Path

    def refused(_: Path) -> Iterator[Path]:
        raise PermissionError

    section = Section(trusted_clients=tmp_path, certificate=tmp_path / "server.der")
    monkeypatch.setattr(Path, "iterdir", refused)
    assert list(certificates(section)) == [("certificate", tmp_path / "server.der")]


def test_a_disk_that_is_nearly_full_stays_so_until_there_is_clearly_more(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    usage = shutil.disk_usage(tmp_path)
    free = 100.0 * usage.free / usage.total
    more = AlarmsConfig().model_copy(update={"disk_free_percent": free + 1.0})
    (found,) = of_computer(configuration, more, (), 0.0)
    assert (found.kind, found.subject) == ("disk", str(tmp_path)) and "free space on it" in found.text
    less = more.model_copy(update={"disk_free_percent": free - 1.0})
    assert list(of_computer(configuration, less, (), 0.0)) == []
    assert len(list(of_computer(configuration, less, [("disk", str(tmp_path))], 0.0))) == 1
