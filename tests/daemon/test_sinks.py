"""Sinks beside the daemon: retention that waits up to a bound, and what status and the daemon say of them."""

import asyncio
import errno
import json
import queue
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
from history_records import EPOCH_S, SMALL, StillClock
from structlog.testing import capture_logs
from tidied_store import housekeeping, packed_here

from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.service import HistoryConfig
from config.schema.sinks import SinkConfig
from daemon.cli import main
from daemon.history import tidying
from daemon.history.cursors import Cursor, cursor_path
from daemon.history.database import HistoryError, connect_reader
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.housekeeping.jobs import job_snapshots
from daemon.sinks import contract, running
from daemon.sinks.contract import Progress, SinkError
from daemon.sinks.outbox import STREAMS, Outbox
from daemon.sinks.running import SinkRunner, alone, run_sinks, sink_status
from daemon.sinks.watching import watch
from drivers.contract import LinkError

DAY_S = 86_400.0
SINK = SinkConfig.model_validate({"name": "plant", "driver": "postgresql", "postgresql": {"host": "db"}})


@pytest.fixture(autouse=True)
def no_packing_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has tests of its own (`test_history_packing`), and takes half a second of each housekeeping."""
    monkeypatch.setattr(tidying, "packed_hours", packed_here)


class Taker:
    """A sink in memory, in which a row counts once however often it comes."""

    def __init__(self) -> None:
        self.rows: dict[str, set[str]] = {name: set() for name in STREAMS}

    def open(self, cursor: Cursor):
        return cursor.positions

    def needs_rows(self) -> bool:
        return True

    def transfer(self, outbox: Outbox, progress: Progress) -> bool:
        more = False
        for stream in STREAMS.values():
            if (batch := outbox.batch(stream, progress.position(stream.name))) is not None:
                before = len(self.rows[stream.name])
                self.rows[stream.name] |= {json.dumps(row) for row in batch.rows}
                progress.took(batch, len(self.rows[stream.name]) - before)
                more |= not batch.last
        return more

    def close(self) -> None:
        pass


def take(store: Path, taker: Taker) -> Cursor:
    """Let a sink take all that waits."""
    stop = threading.Event()
    runner = SinkRunner(SINK, store, "mill", stop, lambda _config, _machine: taker, lambda _duration_s: stop.set())
    runner.run()
    return runner.cursor


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


@pytest.mark.parametrize(("anyway_s", "looks"), [(1e9, 3), (0.0, 40)])
def test_a_store_that_stands_still_is_not_read_and_a_new_row_goes_with_the_next_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, anyway_s: float, looks: int
) -> None:
    monkeypatch.setattr(running, "LOOK_ANYWAY_S", anyway_s)
    store, stop, waits = tmp_path / "h.sqlite", threading.Event(), []
    writer_of(store, 10.0).close()
    held: list[int] = []

    class Counting(Taker):
        def transfer(self, outbox: Outbox, progress: Progress) -> bool:
            held.append(sum(map(len, self.rows.values())))
            return super().transfer(outbox, progress)

    def wait(_duration_s: float) -> None:
        waits.append(len(held))
        if len(waits) == 20:
            with closing(writer_of(store, 20.0)) as writer:
                writer.event("note", "one more")
        if len(waits) == 40:
            stop.set()

    taker = Counting()
    SinkRunner(SINK, store, "mill", stop, lambda _config, _machine: taker, wait).run()
    assert "one more" in "".join(taker.rows["events"])
    assert waits[20] == waits[19] + 1
    assert waits[-1] == looks  # the first one leaves files of its own beside the store


def test_a_cursor_that_cannot_be_written_is_said_once_and_not_with_every_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, stop, waits = tmp_path / "h.sqlite", threading.Event(), iter(range(6))
    writer_of(store, EPOCH_S).close()

    def full(_cursor: Cursor, path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    def wait(_duration_s: float) -> None:
        if next(waits) == 5:
            stop.set()

    monkeypatch.setattr(Cursor, "write", full)
    with capture_logs() as logs:
        SinkRunner(SINK, store, "mill", stop, lambda _config, _machine: Taker(), wait).run()
    assert [each["event"] for each in logs] == ["sink.failed", "sink.cursor"]


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
        assert len(said) == 1 and said[0].startswith("rows that a sink has not taken were deleted (12 temperatures)")
        assert "history.keep_for_sinks_days" in said[0]
    finally:
        await asyncio.to_thread(writer.close)


async def test_what_a_sink_misses_is_said_once_a_day_and_shown_while_it_lasts(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    config = HistoryConfig(keep_temperatures_days=1.0, keep_for_sinks_days=0.5, pack_after_s=3e7)
    writer = writer_of(store, EPOCH_S, sinks=("plant",))
    try:
        for hours in range(0, 102, 6):  # the daemon runs on, and the sink is away
            writer._clock.utc_s = EPOCH_S + hours * 3600.0
            hour(writer, writer._clock.utc_s)
            await writer.flushed()
            await writer.request_housekeeping(config)
            (tidying,) = job_snapshots(writer, ())
            assert ("that a sink has not taken" in tidying.problem) == (hours > 36), f"{hours}: {tidying.problem}"
        await writer.flushed()
        with HistoryReader(store) as reader:
            said = [event.text for event in reader.events(0.0, 4e9) if event.kind == "sinks"]
        assert len(said) == 3 and "(48 temperatures)" in said[1], said
        take(store, taker := Taker())
        for hours in range(102, 156, 6):
            writer._clock.utc_s = EPOCH_S + hours * 3600.0
            writer.event("test", "still here")
            await writer.flushed()
            await writer.request_housekeeping(config)
        with HistoryReader(store) as reader:
            said = [event.text for event in reader.events(0.0, 4e9) if event.kind == "sinks"]
        missed = sum(int(text.split("(")[1].split()[0]) for text in said)
        assert missed + len(taker.rows["temperatures"]) == 17 * 12, "what it missed last is said, too"
        assert writer.housekeeping.problem == ""
    finally:
        await asyncio.to_thread(writer.close)


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
    with alone(store):
        (after,) = sink_status(configuration, time.time())
    assert after["rows"] == {"sent": 36, "stored": 36, "repeated": 0, "waiting": {}} and after["running"]
    assert after["newest_utc_s"]["cnc"] == EPOCH_S + 3300.0
    (ended,) = sink_status(configuration, time.time())
    assert not ended["running"] and ended["problem"] == ""
    with alone(store):
        (stuck,) = sink_status(configuration, time.time() + 1000.0)
    assert stuck["running"] and "has been at one piece" in stuck["problem"]


async def test_the_daemon_shows_a_sink_as_a_link(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    path = cursor_path(store, "plant")
    up: list[bool] = []
    with pytest.raises(LinkError, match="sink plant: its process does not run"):
        await watch(SINK, store, lambda: up.append(True), 0.0)
    Cursor(alive_utc_s=time.time()).write(path)
    with alone(store):
        looking = asyncio.create_task(watch(SINK, store, lambda: up.append(True), 0.0))
        while not up and not looking.done():
            await asyncio.sleep(0.001)
        Cursor(alive_utc_s=time.time(), problem="the disk of the database is full").write(path)
        with pytest.raises(LinkError, match="the disk of the database is full"):
            await looking
        Cursor(alive_utc_s=time.time()).write(path)
        looking = asyncio.create_task(watch(SINK, store, lambda: None, 0.0))
    with pytest.raises(LinkError, match="its process does not run"):
        await asyncio.wait_for(looking, 10.0)


def test_the_service_manager_hears_what_keeps_the_sinks_from_sending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `systemctl status toolpoint-sink` shows it: a folder that is not there, which is then made."""
    monkeypatch.setattr("daemon.sinks.running.TELL_PERIOD_S", 0.05)
    files, heard, stop = tmp_path / "files", queue.SimpleQueue[str](), threading.Event()
    writer_of(tmp_path / "h.sqlite", EPOCH_S).close()
    sink = {"name": "files", "driver": "parquet", "parquet": {"folder": str(files)}}
    configuration = machine_with(tmp_path / "h.sqlite", sinks=[SinkConfig.model_validate(sink)])
    running = threading.Thread(target=run_sinks, args=(configuration, stop, heard.put))
    running.start()
    try:
        while (said := heard.get(timeout=30.0)) == "sending":
            pass
        assert "sink files" in said and str(files) in said
        files.mkdir()
        while (said := heard.get(timeout=30.0)) != "sending":
            assert "sink files" in said
    finally:
        stop.set()
        running.join()


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


def test_the_command_without_the_section_says_where_to_read(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    subprocess.run([sys.executable, "-P", "-m", "daemon.cli", "sample-config", "-o", str(path)], check=True)
    path.write_text(path.read_text().split("\nsinks:")[0])
    done = CliRunner().invoke(main, ["sink", "status", "--config", str(path)])
    assert done.exit_code == 2 and "there is no section `sinks`" in done.output


def test_history_tells_the_last_cycle_of_each_line_in_words(tmp_path: Path) -> None:
    store = tmp_path / "h.sqlite"
    writer = writer_of(store, EPOCH_S)
    try:
        before = CliRunner().invoke(main, ["history", "--store", str(store)]).output
        hour(writer, EPOCH_S)
    finally:
        writer.close()
    assert "last cycle committed of each line: none yet" in before, before
    after = CliRunner().invoke(main, ["history", "--store", str(store)]).output
    assert "last cycle committed of each line: bed 12" in after, after


def test_status_ends_with_1_unless_every_sink_runs_and_can_send(tmp_path: Path) -> None:
    store, path = tmp_path / "h.sqlite", tmp_path / "t.yaml"
    writer_of(store, EPOCH_S).close()
    document = yaml.safe_load(sample_configuration())
    path.write_text(
        yaml.safe_dump(document | {"history": {"path": str(store)}, "sinks": [SINK.model_dump(mode="json")]})
    )

    def status() -> int:
        return CliRunner().invoke(main, ["sink", "status", "--config", str(path)]).exit_code

    assert status() == 1  # no process sends
    with alone(store):
        Cursor(alive_utc_s=time.time()).write(cursor_path(store, SINK.name))
        assert status() == 0
        Cursor(alive_utc_s=time.time(), problem="the database refuses").write(cursor_path(store, SINK.name))
        assert status() == 1


def test_what_comes_back_is_tried_again_within_a_quarter_of_the_time_that_it_was_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(contract.random, "uniform", lambda _low, _high: 1.0)
    retry, away_s = contract.Retry(), 0.0
    while away_s < 1000.0:
        wait_s = retry.after_failure()
        assert wait_s <= min(contract.RETRY_FIRST_S + away_s / 4.0 + 1e-9, contract.RETRY_LONGEST_S)
        away_s += wait_s
    assert wait_s == contract.RETRY_LONGEST_S
