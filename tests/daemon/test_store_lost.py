"""The store goes away while it is written: nothing is acknowledged that is not in the file that stands there."""

import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import history_records as make
import pytest
from control_rig import HandClock, machine
from history_records import EPOCH_S, SMALL, StillClock
from other_user import OTHER, as_root, as_user, in_child

from daemon.app import Daemon
from daemon.history.database import HistoryError, connect_writer
from daemon.history.reader import HistoryReader
from daemon.history.store_lock import WriterLock
from daemon.history.writer import HistoryWriter

FOREVER_S = 30.0
SHARED_FIRST, SHARED_SIZE = 0x40000002, 510
"""Bytes of a database that SQLite locks for as long as it is open in WAL mode."""


class Watched:
    """A writer with what it called back, which tests wait for."""

    def __init__(self, store: Path) -> None:
        self.store = store
        self.acknowledged: list[int] = []
        self.problems: list[str] = []
        self._said = threading.Condition()
        self.writer = HistoryWriter(
            store,
            clock=StillClock(),
            machine=SMALL,
            on_acknowledged=lambda _line, number: self._say(self.acknowledged, number),
            on_problem=lambda problem: self._say(self.problems, problem),
        )

    def _say(self, heard: list, what: object) -> None:
        with self._said:
            heard.append(what)
            self._said.notify_all()

    def cycles(self, first: int, last: int) -> None:
        """Record these cycles and wait until the last is acknowledged, each with a commit of its own."""
        for number in range(first, last + 1):
            self.put(number)
            self.until(lambda number=number: number in self.acknowledged)

    def put(self, number: int) -> None:
        cycle = make.cycle("spindle", number, EPOCH_S + 10 * number, [25.0, 24.5, 23.0625])
        self.writer.temperatures(None, cycle)

    def until(self, condition: Callable[[], bool]) -> None:
        with self._said:
            assert self._said.wait_for(condition, FOREVER_S), (self.acknowledged, self.problems)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "state" / "history.sqlite"


@pytest.fixture
def watched(store: Path) -> Iterator[Watched]:
    watched = Watched(store)
    watched.writer.start()
    watched.writer.put_state("wanted", {"z": True})
    watched.cycles(1, 3)
    yield watched
    watched.writer.close()


def numbers_in(store: Path) -> list[int]:
    with HistoryReader(store) as reader:
        return reader.temperatures([13], EPOCH_S, EPOCH_S + 1e6).number.tolist()


def events_in(store: Path) -> list[str]:
    with HistoryReader(store) as reader:
        return [event.text for event in reader.events(0, 2e9) if event.kind == "history"]


def delete(store: Path) -> None:
    store.unlink()


def delete_all(store: Path) -> None:
    for path in store.parent.glob("history.sqlite*"):
        path.unlink()


def move(store: Path) -> None:
    store.rename(store.with_name("elsewhere.sqlite"))


def move_folder(store: Path) -> None:
    store.parent.rename(store.parent.with_name("elsewhere"))


def remove_folder(store: Path) -> None:
    shutil.rmtree(store.parent)


def empty_file(store: Path) -> None:
    store.with_name("new").touch()
    store.with_name("new").replace(store)


@pytest.mark.parametrize("happens", [delete, delete_all, move, move_folder, remove_folder, empty_file])
def test_what_is_acknowledged_is_in_the_file_that_stands_there(
    watched: Watched, happens: Callable[[Path], None]
) -> None:
    store = watched.store
    happens(store)
    watched.cycles(4, 8)
    assert numbers_in(store) == [4, 5, 6, 7, 8]
    assert "while the daemon writes it. Records wait in memory" in watched.problems[0]
    watched.until(lambda: watched.problems[-1] == "")
    watched.writer.submit(lambda _: None).result(FOREVER_S)
    (event,) = events_in(store)
    assert "while the daemon wrote it; a new one was begun" in event
    watched.writer.close()
    assert HistoryWriter(store, clock=StillClock(), machine=SMALL).get_state("wanted") == {"z": True}
    assert watched.writer.dropped == {}


def test_a_store_that_was_moved_is_whole_where_it_is_now(watched: Watched) -> None:
    move(watched.store)
    watched.cycles(4, 4)
    assert numbers_in(watched.store.with_name("elsewhere.sqlite"))[:3] == [1, 2, 3]


def test_another_store_in_its_place_is_not_written(watched: Watched, tmp_path: Path) -> None:
    store, mine, other = watched.store, tmp_path / "mine.sqlite", tmp_path / "other.sqlite"
    second = Watched(other)
    second.writer.start()
    second.cycles(1, 1)
    second.writer.close()
    os.link(store, mine)
    before = numbers_in(other)
    other.replace(store)
    watched.put(4)
    watched.until(lambda: any("another store stands in the place" in problem for problem in watched.problems))
    assert watched.acknowledged == [1, 2, 3] and watched.writer.waiting == 1
    assert numbers_in(store) == before
    mine.replace(store)
    watched.until(lambda: 4 in watched.acknowledged)
    assert numbers_in(store)[-1] == 4


@pytest.mark.parametrize("content", [b"no database at all" * 100, None])
def test_what_is_no_store_in_its_place_is_left_alone(watched: Watched, tmp_path: Path, content: bytes | None) -> None:
    foreign = tmp_path / "foreign"
    if content is None:
        with closing(sqlite3.connect(foreign)) as connection:
            connection.execute("CREATE TABLE theirs (x)")
            connection.commit()
    else:
        foreign.write_bytes(content)
    before = foreign.read_bytes()
    delete_all(watched.store)
    foreign.replace(watched.store)
    watched.put(4)
    watched.until(lambda: len(watched.problems) > 1)
    assert watched.store.read_bytes() == before and watched.acknowledged == [1, 2, 3]
    watched.store.unlink()
    watched.until(lambda: 4 in watched.acknowledged)
    assert numbers_in(watched.store) == [4]


def test_an_older_copy_is_gone_on_with_and_said(watched: Watched) -> None:
    store = watched.store
    copy = store.with_name("copy")
    with closing(sqlite3.connect(store)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
    watched.writer.put_state("wanted", {"z": False})
    watched.cycles(4, 4)
    delete_all(store)
    copy.rename(store)
    watched.cycles(5, 5)
    assert numbers_in(store) == [1, 2, 3, 5]
    watched.writer.submit(lambda _: None).result(FOREVER_S)
    assert "a copy of it stands in its place" in events_in(store)[0]
    with HistoryReader(store) as reader:
        assert reader.get_state("wanted") == {"z": False}


def test_a_deleted_log_loses_nothing(watched: Watched, tmp_path: Path) -> None:
    store = watched.store
    store.with_name("history.sqlite-wal").unlink()
    watched.cycles(4, 6)
    shutil.copyfile(store, tmp_path / "as a power cut leaves it")
    assert numbers_in(store) == [1, 2, 3, 4, 5, 6]
    watched.writer.submit(lambda _: None).result(FOREVER_S)
    assert "-wal was deleted while the daemon wrote it; nothing of it is lost" in events_in(store)[0]


@as_root
def test_a_folder_that_becomes_read_only_holds_records_back_until_it_is_not(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.mkdir()
    os.chown(folder, OTHER, OTHER)
    for above in (tmp_path, *tmp_path.parents):
        if above.stat().st_uid == os.geteuid() and not above.stat().st_mode & 0o001:
            above.chmod(above.stat().st_mode | 0o011)

    def work() -> str:
        watched = Watched(folder / "history.sqlite")
        watched.writer.start()
        watched.cycles(1, 2)
        folder.chmod(0o555)
        watched.cycles(3, 4)
        folder.chmod(0o755)
        delete_all(watched.store)
        folder.chmod(0o555)
        watched.put(5)
        watched.until(lambda: any("cannot be opened" in problem for problem in watched.problems))
        assert watched.acknowledged == [1, 2, 3, 4]
        folder.chmod(0o755)
        watched.until(lambda: 5 in watched.acknowledged)
        watched.writer.close()
        return str(numbers_in(watched.store))

    assert as_user(OTHER, work) == "[5]"


# --- one writer ------------------------------------------------------------------------------


def test_without_the_lock_file_a_second_writer_is_refused_all_the_same(watched: Watched) -> None:
    store = watched.store
    store.with_name("history.sqlite.lock").unlink()

    def second() -> str:
        try:
            Watched(store).writer.start()
        except HistoryError as error:
            return str(error)
        return "started"

    sentence = in_child(second)
    assert "another process writes this store, although its lock file is gone" in sentence
    with pytest.raises(HistoryError, match="although its lock file is gone"):
        Watched(store).writer.start()
    watched.cycles(4, 5)
    assert numbers_in(store) == [1, 2, 3, 4, 5]


def test_what_a_daemon_reads_at_its_start_nobody_changes_before_it_writes(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    daemon = Daemon(configuration, HandClock())

    def second() -> str:
        try:
            Watched(configuration.history.path).writer.start()
        except HistoryError as error:
            return str(error)
        return "started"

    assert f"process {os.getpid()} writes this store" in in_child(second)
    daemon._history.start()
    daemon._history.close()
    assert in_child(second) == "started"


def test_a_store_that_another_writer_has_begun_anew_is_left_to_it(watched: Watched) -> None:
    store = watched.store
    delete_all(store)
    other = WriterLock(store)
    other.acquire()
    connect_writer(store).close()
    other.hold()
    watched.put(4)
    watched.until(lambda: any("another process writes this store" in problem for problem in watched.problems))
    assert watched.acknowledged == [1, 2, 3]
    other.release()
    watched.until(lambda: 4 in watched.acknowledged)


@pytest.mark.parametrize("damaged", ["""'"3f'""", "x'ff00'"])
def test_a_store_whose_identity_is_damaged_is_written_all_the_same(watched: Watched, damaged: str) -> None:
    watched.writer.close()
    with closing(sqlite3.connect(watched.store)) as connection:
        connection.execute(f"UPDATE state SET json = {damaged} WHERE key = 'store_id'")
        connection.commit()
    again = Watched(watched.store)
    again.writer.start()
    again.cycles(4, 4)
    delete_all(watched.store)
    again.cycles(5, 5)
    again.writer.close()
    assert numbers_in(watched.store) == [5] and again.problems[-1] == ""
