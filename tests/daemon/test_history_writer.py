"""The writer: what is committed when, what survives a failing disk, what is refused."""

import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock

from daemon.history import database
from daemon.history.database import HistoryError
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from models.records import WriteOutcome

FOREVER_S = 30.0


class Watched:
    """A writer with what it called back."""

    def __init__(self, path: Path, **options: object) -> None:
        self.acknowledged: list[tuple[str, int]] = []
        self.problems: list[str] = []
        self.clock = StillClock()
        self.writer = HistoryWriter(
            path,
            clock=self.clock,
            machine=SMALL,
            on_acknowledged=lambda line, number: self.acknowledged.append((line, number)),
            on_problem=self.problems.append,
            **options,
        )

    def commit(self) -> None:
        self.writer.submit(lambda _: None).result(FOREVER_S)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "history.sqlite"


@pytest.fixture
def watched(store: Path) -> Iterator[Watched]:
    watched = Watched(store)
    watched.writer.start()
    yield watched
    watched.writer.close()


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + FOREVER_S
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.01)


def spindle_cycle(number: int, first_s: float | None = None) -> object:
    return make.cycle("spindle", number, EPOCH_S + 10 * number if first_s is None else first_s, [25.0, 24.5, 23.0625])


def test_cycle_is_acknowledged_when_it_can_be_read(watched: Watched, store: Path) -> None:
    seen: list[dict[str, int]] = []

    def look(_line: str, _number: int) -> None:
        with HistoryReader(store) as reader:
            seen.append(reader.acknowledged())

    watched.writer._engine._on_acknowledged = look
    watched.writer.temperatures(None, spindle_cycle(7))
    wait_until(lambda: bool(seen))
    assert seen == [{"spindle": 7}]


def test_sample_is_committed_at_the_latest_when_its_time_is_up(
    watched: Watched, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.history.writer.SAMPLE_COMMIT_S", 0.05)
    watched.writer.cnc_sample(make.cnc_sample(EPOCH_S))
    with HistoryReader(store) as reader:
        wait_until(lambda: reader.row_count("cnc") == 1)
        assert reader.cnc(EPOCH_S - 1, EPOCH_S + 1).time_s == pytest.approx([EPOCH_S], abs=1e-3)
    assert watched.acknowledged == [], "no cycle has taken it along"


async def test_intent_is_awaitable_and_settled_by_its_outcome(watched: Watched, store: Path) -> None:
    written = make.macros(5, np.array([0.0, 1.5, -2.5]))
    write_id = watched.writer.write_intent(make.command([0.0, 1.5, -2.5]), written, "cycle")
    number = await write_id
    assert number == write_id == 1
    with HistoryReader(store) as reader:
        (open_,) = reader.unsettled_writes()
        assert (open_.write_id, open_.outcome, open_.macros) == (1, WriteOutcome.INTENDED, written)
        assert open_.read_back == ()
    await watched.writer.write_outcome(write_id, make.receipt(EPOCH_S, written))
    with HistoryReader(store) as reader:
        assert reader.unsettled_writes() == []
        (settled,) = reader.writes(EPOCH_S - 1, EPOCH_S + 1)
    assert settled.outcome is WriteOutcome.VERIFIED
    assert settled.read_back == tuple(value for _, value in written)
    assert settled.applied_um == {"X": None, "Y": 1.5, "Z": -2.25}
    assert settled.requested_um == {"X": 0.0, "Y": 1.875, "Z": -3.125}
    assert (settled.state, settled.enable, settled.limits_hit) == ("ACTIVE", (False, True, True), ("Z slew",))
    assert settled.delay_s == pytest.approx(
        {"cleansed": 0.0004, "estimated": 0.0008, "written": 0.0012, "read_back": 0.0016}, abs=1e-6
    )


async def test_an_intent_that_is_kept_elsewhere_is_committed_with_its_outcome(
    watched: Watched, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.history.writer.SAMPLE_COMMIT_S", 3600.0)
    await watched.writer.flushed()
    written = make.macros(5, np.array([0.0, 1.5, -2.5]))
    write_id = watched.writer.write_intent(make.command([0.0, 1.5, -2.5]), written, "estimate", kept=True)
    assert watched.writer.waiting == 1
    with HistoryReader(store) as reader:
        assert reader.unsettled_writes() == []
    await watched.writer.write_outcome(write_id, make.receipt(EPOCH_S, written))
    assert write_id.commit.done
    with HistoryReader(store) as reader:
        (settled,) = reader.writes(EPOCH_S - 1, EPOCH_S + 1)
    assert (settled.outcome, settled.macros) == (WriteOutcome.VERIFIED, written)


def test_numbers_of_writes_go_on_after_a_restart(store: Path) -> None:
    for expected in (1, 2):
        watched = Watched(store)
        watched.writer.start()
        assert watched.writer.write_intent(None, ((500, 1.0),), "commission", "somebody") == expected
        watched.writer.close()


def test_second_writer_is_refused_until_the_first_has_closed(watched: Watched, store: Path) -> None:
    second = Watched(store)
    with pytest.raises(HistoryError, match=r"process \d+ writes this store"):
        second.writer.start()
    watched.writer.close()
    third = Watched(store)
    third.writer.start()
    third.writer.close()


def test_record_that_cannot_be_stored_costs_only_itself(watched: Watched, store: Path) -> None:
    watched.writer.temperatures(None, spindle_cycle(1))
    watched.writer.cnc_sample(make.cnc_sample(EPOCH_S, program=object()))
    watched.writer.cnc_sample(make.cnc_sample(EPOCH_S))
    watched.commit()
    assert watched.writer.dropped == {"CNC samples": 1}
    assert "one of the CNC samples cannot be stored and is dropped" in watched.problems[0]
    assert watched.problems[-1] == "", "the store itself works"
    with HistoryReader(store) as reader:
        assert (reader.row_count("temperatures"), reader.row_count("cnc")) == (1, 1)


def test_locked_store_keeps_records_until_it_is_free(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.1)
    watched = Watched(store)
    watched.writer.start()
    watched.commit()
    with closing(sqlite3.connect(store, isolation_level=None)) as intruder:
        intruder.execute("BEGIN IMMEDIATE")
        watched.writer.temperatures(None, spindle_cycle(1))
        watched.writer.event("note", "meanwhile")
        wait_until(lambda: bool(watched.problems))
        assert "another program has locked it" in watched.problems[0]
        assert watched.acknowledged == []
        assert watched.writer.problem
        intruder.execute("ROLLBACK")
    wait_until(lambda: watched.acknowledged == [("spindle", 1)])
    watched.writer.close()
    assert (watched.problems[-1], watched.writer.dropped) == ("", {})


def test_full_queue_gives_up_measurements_before_the_audit(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.1)
    watched = Watched(store, queue_limit=6)
    watched.writer.start()
    watched.commit()
    with closing(sqlite3.connect(store, isolation_level=None)) as intruder:
        intruder.execute("BEGIN IMMEDIATE")
        watched.writer.event("note", "first")
        for k in range(9):
            watched.writer.cnc_sample(make.cnc_sample(EPOCH_S + k))
        watched.writer.event("note", "last")
        wait_until(lambda: watched.writer.problem != "")
        wait_until(lambda: watched.writer.waiting == 6)
        intruder.execute("ROLLBACK")
    wait_until(lambda: watched.writer.waiting == 0 and watched.writer.problem == "")
    watched.writer.close()
    with HistoryReader(store) as reader:
        assert [event.text for event in reader.events(0, EPOCH_S + 1)] == ["first", "last"]
        assert reader.cnc(0, EPOCH_S + 100).time_s.tolist() == [EPOCH_S + k for k in (5, 6, 7, 8)]
    assert watched.writer.dropped == {"CNC samples": 5}
    assert any("dropped: 5 CNC samples" in problem for problem in watched.problems)


def test_writing_from_the_loop_does_not_wait_for_the_disk(watched: Watched) -> None:
    release = threading.Event()
    stuck = watched.writer.submit(lambda _: release.wait(FOREVER_S))
    for number in range(100):
        watched.writer.temperatures(None, spindle_cycle(number))
        watched.writer.event("note", str(number))
    assert not stuck.done, "the queue must take records while the disk is stuck"
    release.set()
    watched.commit()
    assert watched.acknowledged[-1] == ("spindle", 99)


class TestStore:
    """The file itself."""

    def test_newer_store_is_refused(self, store: Path) -> None:
        database.connect_writer(store).close()
        newer = database.schema_version() + 1
        with closing(sqlite3.connect(store)) as connection:
            connection.execute(f"PRAGMA user_version={newer}")
        known = database.schema_version()
        with pytest.raises(HistoryError, match=rf"has schema {newer}, this version of toolpoint knows up to {known}"):
            Watched(store).writer.start()
        with pytest.raises(HistoryError, match=rf"has schema {newer}"):
            HistoryReader(store)

    def test_store_of_another_program_is_refused_untouched(self, store: Path) -> None:
        with closing(sqlite3.connect(store)) as connection:
            connection.execute("CREATE TABLE theirs (x)")
            connection.commit()
        before = store.read_bytes()
        with pytest.raises(HistoryError, match="belongs to another program"):
            Watched(store).writer.start()
        with pytest.raises(HistoryError, match="belongs to another program"):
            HistoryReader(store)
        assert store.read_bytes() == before

    def test_absent_store_is_named(self, store: Path) -> None:
        with pytest.raises(HistoryError, match=r"history\.sqlite: there is no history store"):
            HistoryReader(store)

    def test_older_store_is_migrated_even_when_it_is_only_asked(
        self, store: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        first = Watched(store)
        first.writer.start()
        first.writer.put_state("wanted", {"Z": True})
        first.writer.close()
        scripts = [*database.schema_scripts(), (database.schema_version() + 1, "CREATE TABLE added (x INTEGER);")]
        monkeypatch.setattr(database, "schema_scripts", lambda: scripts)
        with pytest.raises(HistoryError, match="start the daemon once, which migrates it"):
            HistoryReader(store)
        assert Watched(store).writer.get_state("wanted") == {"Z": True}
        with HistoryReader(store) as reader:
            assert reader.get_state("wanted") == {"Z": True}

    def test_failing_migration_leaves_the_old_schema(self, store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        database.connect_writer(store).close()
        scripts = [
            *database.schema_scripts(),
            (database.schema_version() + 1, "CREATE TABLE added (x INTEGER); CREATE TABLE added (x INTEGER);"),
        ]
        with monkeypatch.context() as patch:
            patch.setattr(database, "schema_scripts", lambda: scripts)
            with pytest.raises(sqlite3.OperationalError, match="already exists"):
                database.connect_writer(store)
        HistoryReader(store).close()


def test_an_event_with_half_a_surrogate_pair_or_control_characters_is_kept(watched: Watched, store: Path) -> None:
    watched.writer.event("refused", "enable \ud800: there is no axis \x1b[2J", "anna").result(FOREVER_S)
    with HistoryReader(store) as reader:
        (event,) = reader.events(0.0, 2.0**40)
    assert event.text == "enable \\ud800: there is no axis \\x1b[2J"
