"""Sinks beside the daemon: retention that waits up to a bound, and what status and the daemon say of them."""

import asyncio
import json
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import history_records as make
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from control_rig import machine
from filled_store import fill
from history_records import EPOCH_S, SMALL, StillClock

from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.service import HistoryConfig
from config.schema.sinks import SinkConfig
from daemon.cli import main
from daemon.history import HistoryReader, HistoryWriter, housekeeping
from daemon.history.cursors import Cursor, cursor_path
from daemon.history.database import HistoryError, connect_reader
from daemon.sinks.contract import Progress, Retry, SinkError, SinkWaitsError
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.running import SinkRunner, run_sinks, sink_status
from daemon.sinks.watching import watch
from drivers.contract import LinkError

DAY_S = 86_400.0
SINK = SinkConfig.model_validate({"name": "plant", "driver": "postgresql", "postgresql": {"host": "db"}})


class Taker:
    """A sink in memory, in which a row counts once however often it comes."""

    def __init__(self) -> None:
        self.rows: dict[str, set[str]] = {name: set() for name in STREAMS}

    def open(self, cursor: Cursor):
        return cursor.positions

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        more = False
        for stream in STREAMS.values():
            if (batch := outbox.batch(stream, progress.position(stream.name))) is not None:
                before = len(self.rows[stream.name])
                self.rows[stream.name] |= {json.dumps(row) for row in batch.rows}
                progress.took(batch, len(self.rows[stream.name]) - before)
                more = True
        return more

    def close(self) -> None:
        pass


def take(store: Path, taker: Taker) -> Cursor:
    """Let a sink take all that waits."""
    stop = threading.Event()
    runner = SinkRunner(SINK, store, "mill", stop, lambda _config, _machine: taker, lambda _duration_s: stop.set())
    runner.run()
    return runner.cursor


def test_a_process_that_waits_says_that_it_runs_before_it_tries_again(tmp_path: Path) -> None:
    """A minute's wait and a try that hangs for another are together longer than one that runs may be silent."""
    store, stop, said_s = tmp_path / "h.sqlite", threading.Event(), []
    writer_of(store, 0.0).close()
    waited_s = [0.0]

    def away(_config: SinkConfig, _machine: str) -> Taker:
        cursor = Cursor.read(cursor_path(store, SINK.name))
        said_s.append((cursor.alive_utc_s if cursor is not None else 0.0) - waited_s[0])
        raise SinkError("away")

    def wait(_duration_s: float) -> None:
        time.sleep(0.01)
        waited_s[0] = time.time()
        if len(said_s) == 2:
            stop.set()

    SinkRunner(SINK, store, "mill", stop, away, wait).run()
    assert said_s[1] >= 0.0


@pytest.mark.parametrize("away_s", [0.5, 1.2, 3.0, 20.0, 100.0])
def test_what_was_away_is_found_back_within_half_of_its_absence(tmp_path: Path, away_s: float) -> None:
    store, stop, waited_s = tmp_path / "h.sqlite", threading.Event(), [0.0]
    writer_of(store, 0.0).close()

    def server(_config: SinkConfig, _machine: str) -> Taker:
        if waited_s[0] < away_s:
            raise SinkError("away")
        stop.set()
        return Taker()

    def wait(duration_s: float) -> None:
        waited_s[0] += duration_s

    SinkRunner(SINK, store, "mill", stop, server, wait).run()
    assert waited_s[0] - away_s <= 0.3 + 0.6 * away_s


def test_a_connection_that_never_lasts_is_tried_less_and_less_often_and_one_that_lasted_at_once() -> None:
    now_s = 0.0
    retry, waits = Retry(lambda: now_s), []
    for lasted_s in (*[1.0] * 20, 11.0):
        retry.works()
        now_s += lasted_s
        waits.append(retry.after_failure())
    assert waits[19] >= 40.0 and waits[20] < 0.3


def test_a_connection_that_stood_while_it_waited_for_a_reader_is_tried_again_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lost after hours again and again, it was away for a minute each time, as if it had never been there."""
    store, stop, waits, now_s = tmp_path / "h.sqlite", threading.Event(), [], [0.0]
    writer_of(store, 0.0).close()
    monkeypatch.setattr("daemon.sinks.running.Retry", lambda: Retry(lambda: now_s[0]))

    class Waiting(Taker):
        looks = 0

        def transfer(self, outbox: Outbox, progress: Progress) -> bool:
            now_s[0] += 3600.0
            self.looks += 1
            raise SinkWaitsError("nobody reads") if self.looks < 3 else SinkError("lost")

    def wait(duration_s: float) -> None:
        if duration_s != SINK.period_s:
            waits.append(duration_s)
        if len(waits) == 20:
            stop.set()

    SinkRunner(SINK, store, "mill", stop, lambda _config, _machine: Waiting(), wait).run()
    assert max(waits) < 0.3


def writer_of(store: Path, utc_s: float, **changes: object) -> HistoryWriter:
    writer = HistoryWriter(store, clock=StillClock(utc_s), machine=SMALL, **changes)
    writer.start()
    return writer


def hour(writer: HistoryWriter, start_s: float) -> None:
    """One hour of cycles and samples."""
    for k in range(12):
        writer.temperatures(None, make.cycle("bed", k + 1, start_s + 300.0 * k, np.full(2, 20.0 + k)))
        writer.cnc_sample(make.cnc_sample(start_s + 300.0 * k))
        writer.estimate(make.estimate(start_s + 300.0 * k, np.zeros(3)))


async def test_retention_waits_for_a_sink_and_then_drops_the_oldest_and_says_so(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    config = HistoryConfig(keep_temperatures_days=10.0, keep_for_sinks_days=5.0)
    writer = writer_of(store, EPOCH_S, sinks=("plant",))
    try:
        hour(writer, EPOCH_S)
        hour(writer, EPOCH_S + 3 * DAY_S)
        for hours in range(16 * 24):  # the daemon runs on
            writer._clock.utc_s = EPOCH_S + hours * 3600.0
            writer.event("test", "still here")
        await writer.flushed()
        for days, left in ((4.0, 24), (12.0, 24), (15.5, 12)):
            writer._clock.utc_s = EPOCH_S + days * DAY_S
            assert await writer.request_housekeeping(config) is not None
            with HistoryReader(store) as reader:
                assert reader.row_count("temperatures") == left, f"after {days} days"
                assert reader.row_count("cnc") == 24, "those are kept longer anyway"
        taker = Taker()
        await asyncio.to_thread(take, store, taker)
        assert len(taker.rows["temperatures"]) == 12 and len(taker.rows["cnc"]) == 24
        await writer.request_housekeeping(config)
        with HistoryReader(store) as reader, closing(connect_reader(store)) as connection:
            assert reader.row_count("temperatures") == 0, "it was taken, and is older than ten days"
            (extremes,) = connection.execute("SELECT count(*) FROM extremes WHERE kind = 'temperatures'").fetchone()
            assert extremes == 0
            said = [event.text for event in reader.events(0.0, 4e9) if event.kind == "sinks"]
        assert len(said) == 1 and said[0].startswith("12 rows of temperatures that a sink has not taken were deleted")
        assert "history.keep_for_sinks_days" in said[0]
    finally:
        await asyncio.to_thread(writer.close)


def test_without_sinks_nothing_waits(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S)
    writer.close()
    housekeeping(store, HistoryConfig(keep_temperatures_days=1.0), EPOCH_S + 1.2 * DAY_S)
    with HistoryReader(store) as reader:
        assert reader.row_count("temperatures") == 0


def test_a_look_that_finds_nothing_asks_the_store_twice(tmp_path: Path) -> None:
    """A sink looks every two seconds, beside a machine."""
    fill(tmp_path / "h.sqlite", hours=1.0)
    asked: list[str] = []
    with Outbox(tmp_path / "h.sqlite") as outbox:
        ends = {name: outbox.end(stream) for name, stream in STREAMS.items()}
        outbox._connection.set_trace_callback(asked.append)
        assert [outbox.batch(stream, ends[name]) for name, stream in STREAMS.items()] == [None] * len(STREAMS)
    assert len(asked) == 2, asked


def test_numbers_of_rows_are_not_given_again_when_all_rows_were_packed(tmp_path: Path) -> None:
    """A night without the daemon packs everything; the sink away meanwhile must miss nothing of before or after."""
    store, taker = tmp_path / "h.sqlite", Taker()
    for day in range(4):
        writer = writer_of(store, EPOCH_S + day * DAY_S)
        hour(writer, EPOCH_S + day * DAY_S)
        writer.close()
        if day in (0, 2):
            take(store, taker)
        housekeeping(store, HistoryConfig(), EPOCH_S + (day + 0.9) * DAY_S)
        with closing(connect_reader(store)) as connection:
            assert connection.execute("SELECT count(*) FROM temperature_cycles").fetchone() == (0,)
    cursor = take(store, taker)
    assert {name: len(rows) for name, rows in taker.rows.items() if rows} == dict.fromkeys(
        ("temperatures", "cnc", "estimates"), 48
    )
    assert cursor.stored_rows == 3 * 48


def test_chunks_of_an_earlier_version_are_sent_first(tmp_path: Path) -> None:
    store, taker = tmp_path / "h.sqlite", Taker()
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S)
    hour(writer, EPOCH_S + DAY_S)
    writer.close()
    housekeeping(store, HistoryConfig(), EPOCH_S + 0.9 * DAY_S)
    with closing(sqlite3.connect(store)) as connection:
        connection.execute("UPDATE chunks SET last_row_id = NULL")
        connection.commit()
    cursor = take(store, taker)
    assert len(taker.rows["temperatures"]) == 24 and cursor.sent_rows == cursor.stored_rows == 72
    assert take(store, taker).sent_rows == 72


def test_a_restored_or_older_copy_is_sent_again(tmp_path: Path) -> None:
    store, copy, taker = tmp_path / "h.sqlite", tmp_path / "copy.sqlite", Taker()
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S)
    writer.close()
    copy.write_bytes(store.read_bytes())
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S + 7200.0)
    writer.close()
    take(store, taker)
    for suffix in ("-wal", "-shm"):
        Path(f"{store}{suffix}").unlink(missing_ok=True)
    copy.replace(store)
    take(store, taker)
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S + 14_400.0)
    writer.close()
    take(store, taker)
    assert len(taker.rows["temperatures"]) == 36


def test_a_cursor_that_is_damaged_means_that_everything_is_sent_again(tmp_path: Path) -> None:
    store, taker = tmp_path / "h.sqlite", Taker()
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S)
    writer.close()
    take(store, taker)
    for content in (b"", b"\x00\x00", b"[]", b'{"positions": {"cnc": {"row": 1, "of": 2}}}', b'{"positions": 3}'):
        cursor_path(store, "plant").write_bytes(content)
        assert Cursor.read(cursor_path(store, "plant")) is None
    assert take(store, taker).sent_rows == 36 and len(taker.rows["temperatures"]) == 12


def machine_with(store: Path, **changes: object) -> Configuration:
    return machine(store.parent).model_copy(update={"history": HistoryConfig(path=store), **changes})


# --- what is said --------------------------------------------------------------------------


def test_status_says_what_waits_and_why(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    writer = writer_of(store, EPOCH_S)
    hour(writer, EPOCH_S)
    writer.close()
    configuration = machine_with(store, sinks=[SINK])
    (before,) = sink_status(configuration, time.time())
    assert before["rows"]["waiting"] == {"temperatures": 12, "cnc": 12, "estimates": 12}
    assert before["oldest_waiting_utc_s"] == EPOCH_S and not before["running"]
    take(store, Taker())
    (after,) = sink_status(configuration, time.time())
    assert after["rows"] == {"sent": 36, "stored": 36, "repeated": 0, "waiting": {}} and after["running"]
    assert after["newest_utc_s"]["cnc"] == EPOCH_S + 3300.0
    (later,) = sink_status(configuration, time.time() + 1000.0)
    assert not later["running"]


async def test_the_daemon_shows_a_sink_as_a_link(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    path = cursor_path(store, "plant")
    up: list[bool] = []
    with pytest.raises(LinkError, match="sink plant: its process does not run"):
        await watch(SINK, store, lambda: up.append(True), 0.0)
    Cursor(alive_utc_s=time.time()).write(path)
    looking = asyncio.create_task(watch(SINK, store, lambda: up.append(True), 0.0))
    while not up:
        await asyncio.sleep(0.001)
    Cursor(alive_utc_s=time.time(), problem="the disk of the database is full").write(path)
    with pytest.raises(LinkError, match="the disk of the database is full"):
        await looking


async def test_a_sink_whose_server_answers_slowly_is_not_taken_for_a_process_that_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.sinks.running.ALIVE_PERIOD_S", 0.1)
    monkeypatch.setattr("daemon.sinks.watching.SILENT_AFTER_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        mqtt = {"host": "127.0.0.1", "port": server.getsockname()[1], "tls": False, "timeout_s": 10.0}
        sink = SinkConfig.model_validate({"name": "plant", "driver": "mqtt", "mqtt": mqtt})
        configuration = machine_with(tmp_path / "h.sqlite").model_copy(update={"sinks": [sink]})
        writer_of(configuration.history.path, 0.0).close()
        stop = threading.Event()
        process = threading.Thread(target=run_sinks, args=(configuration, stop))
        process.start()
        try:
            await asyncio.sleep(2.0)
            with pytest.raises(LinkError, match="sink plant: its process runs and has been at one piece"):
                await watch(sink, configuration.history.path, lambda: None, 0.0)
            (status,) = sink_status(configuration, time.time())
            assert status["running"] and "at one piece for more than" in status["problem"]
        finally:
            stop.set()
            process.join()
    await asyncio.sleep(1.2)
    with pytest.raises(LinkError, match="its process does not run"):
        await watch(sink, configuration.history.path, lambda: None, 0.0)


def test_a_second_process_is_refused(tmp_path: Path) -> None:
    configuration = machine_with(tmp_path / "h.sqlite")
    stop = threading.Event()
    first = threading.Thread(target=run_sinks, args=(configuration, stop))
    first.start()
    try:
        while not cursor_path(configuration.history.path, "").with_name("lock").exists():
            time.sleep(0.001)
        deadline_s = time.monotonic() + 30.0
        while time.monotonic() < deadline_s:
            over = threading.Event()
            over.set()
            try:
                run_sinks(configuration, over)
            except HistoryError as error:
                assert "another process sends this store" in str(error)
                break
        else:
            pytest.fail("two processes sent one store")
    finally:
        stop.set()
        first.join()


def test_what_keeps_the_command_from_starting_for_a_while_ends_it_with_1(tmp_path: Path) -> None:
    """With 2 the unit would stay down for good: a disk that is read-only at the start is mounted again later."""
    path = tmp_path / "t.yaml"
    (tmp_path / "store").write_text("a file in the way")
    sinks = [{"name": "files", "driver": "parquet", "parquet": {"folder": str(tmp_path)}}]
    document = yaml.safe_load(sample_configuration())
    document |= {"history": {"path": str(tmp_path / "store/h.sqlite")}, "sinks": sinks}
    path.write_text(yaml.safe_dump(document))
    words = [sys.executable, "-P", "-m", "daemon.cli", "sink", "run", "--config", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "cannot be written" in done.stderr and "Traceback" not in done.stderr


def test_the_command_without_the_section_says_where_to_read(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    subprocess.run([sys.executable, "-P", "-m", "daemon.cli", "sample-config", "-o", str(path)], check=True)
    path.write_text(path.read_text().split("\nsinks:")[0])
    done = CliRunner().invoke(main, ["sink", "status", "--config", str(path)])
    assert done.exit_code == 2 and "there is no section `sinks`" in done.output
