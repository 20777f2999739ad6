"""The thread that owns the writing connection: group commits, retries, jobs."""

import sqlite3
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import structlog

from daemon.history.database import HistoryError, connect_writer
from daemon.history.intake import Entry, Intake, LayoutIds
from daemon.history.layout import Layout, MachineLayout
from daemon.history.rows import ACKNOWLEDGE, PUT_STATE
from daemon.history.store_lock import Kept, StoreIdentity, StoreLostError, WriterLock

log = structlog.get_logger(__name__)

RETRY_FIRST_S = 0.5
RETRY_LONGEST_S = 30.0
_CAUSES = {
    "SQLITE_FULL": "the disk is full; free space on it",
    "SQLITE_IOERR": "the disk reports an error; look at the kernel's log",
    "SQLITE_BUSY": "another program has locked it; close that program",
    "SQLITE_LOCKED": "another program has locked it; close that program",
    "SQLITE_CANTOPEN": "it cannot be opened; check the folder, its permissions and free space",
    "SQLITE_READONLY": "it may not be written; check its permissions and how the disk is mounted",
    "SQLITE_CORRUPT": "it is damaged; stop the daemon, put the file aside and restore a backup",
    "SQLITE_NOTADB": "it is damaged; stop the daemon, put the file aside and restore a backup",
}
_BAD_RECORD = (ValueError, TypeError, KeyError, AttributeError, OverflowError)
_BAD_ROW = (sqlite3.IntegrityError, sqlite3.DataError, sqlite3.InterfaceError, sqlite3.ProgrammingError)


def cause_in_words(error: Exception) -> str:
    """Return what an error of the store means for a person."""
    if isinstance(error, HistoryError):
        return str(error)
    name = getattr(error, "sqlite_errorname", None) or ""
    for prefix, words in _CAUSES.items():
        if name.startswith(prefix):
            return f"{words} ({error})"
    return f"{type(error).__name__}: {error}"


class Unwritable(Exception):
    """One entry that no retry will help."""

    def __init__(self, entry: Entry, error: Exception) -> None:
        super().__init__(str(error))
        self.entry, self.error = entry, error


class Engine:
    """Writes what the intake holds; reports trouble in sentences and goes on."""

    def __init__(
        self,
        path: Path,
        intake: Intake,
        layout: MachineLayout,
        lock: WriterLock,
        *,
        on_acknowledged: Callable[[str, int], None],
        on_problem: Callable[[str], None],
        on_lost: Callable[[str], object],
        kept: Callable[[], Kept],
    ) -> None:
        """`on_lost` is called when a lost store is begun anew; `kept` returns the states of this run."""
        self._path, self._intake, self._layout, self._lock = path, intake, layout, lock
        self._on_lost, self._kept = on_lost, kept
        self._identity = StoreIdentity()
        self._lost = ""
        """What became of the store that was written before, until another one is."""
        self._log_path = Path(f"{path}-wal")
        self._log_inode: int | None = None
        self._on_acknowledged, self._on_problem = on_acknowledged, on_problem
        self._connection: sqlite3.Connection | None = None
        self._layout_ids: LayoutIds = {}
        self.problem = ""
        """What keeps the store from being written, in words; empty when nothing does."""
        self.attempted_s = float("inf")
        """When the commit that is under way was begun; inf: none is."""
        self._retry_s = RETRY_FIRST_S
        self._not_before_s = float("-inf")
        self._opened = threading.Event()
        self._give_up_s = float("inf")
        self._reported_dropped: Counter[str] = Counter()
        self._dropped_states = 0
        """States among the dropped that the store has got since."""
        self.refusal: HistoryError | None = None
        self.last_write_id: int | None = None
        self._thread = threading.Thread(target=self._run, name="history-writer", daemon=True)

    def start(self) -> None:
        """Start the thread and wait until it has tried to open the store once."""
        self._thread.start()
        self._opened.wait()

    def stop(self, within_s: float) -> bool:
        """Write what is queued, close the store, end the thread within a time; False when the disk does not let go."""
        self._give_up_s = time.monotonic() + within_s
        self._intake.close()
        if self._thread.ident is not None:
            self._thread.join(within_s + 10.0)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._open()
        except HistoryError as error:
            self.refusal = error
            return
        except Exception as error:  # as in `_attempt`: else nothing is recorded any more, and nothing says so
            self._fail(error)
        finally:
            self._opened.set()
        while not self._intake.closed or len(self._intake):
            batch = self._intake.take(self._not_before_s)
            self.attempted_s = time.monotonic()
            self._attempt(batch)
            self.attempted_s = float("inf")
            if self._intake.closed and self.problem and not self._wait_for_retry():
                break
        self._close()

    def _wait_for_retry(self) -> bool:
        """Wait for the next attempt while closing; False when there is no time left for one."""
        if self._not_before_s >= self._give_up_s:
            left = len(self._intake)
            self.report(f"{self._path}: {left} records could not be written before the end and are lost")
            return False
        time.sleep(max(0.0, self._not_before_s - time.monotonic()))
        return True

    def _attempt(self, batch: list[Entry]) -> None:
        records = [entry for entry in batch if not entry.is_job]
        jobs = [entry for entry in batch if entry.is_job]
        while True:
            try:
                connection = self._open()
                self._write(connection, records)
            except Unwritable as bad:
                records.remove(bad.entry)
                self._give_up(bad.entry, bad.error)
            except StoreLostError as error:
                self._intake.put_back([*records, *jobs])
                self._lose(error)
                return
            except Exception as error:  # a mistake in this program must not end the record: loud, and tried again
                self._intake.put_back([*records, *jobs])
                self._fail(error)
                return
            else:
                break
        self._recover()
        for entry in records:
            entry.commit.resolve()
            if entry.acknowledges:
                self._call(self._on_acknowledged, *entry.acknowledges[:2])
        for job in jobs:
            self._run_job(job)

    def _write(self, connection: sqlite3.Connection, records: list[Entry]) -> None:
        if not records:
            return
        self._prove()
        connection.execute("BEGIN IMMEDIATE")
        for entry in records:
            try:
                entry.execute(connection, self._layout_ids)
            except (*_BAD_RECORD, *_BAD_ROW) as error:
                connection.execute("ROLLBACK")
                raise Unwritable(entry, error) from error
        latest = {e.acknowledges[0]: e.acknowledges for e in records if e.acknowledges}
        connection.executemany(ACKNOWLEDGE, latest.values())
        if (dropped := self._intake.dropped["states"]) > self._dropped_states:
            connection.executemany(PUT_STATE, self._kept())
        connection.execute("COMMIT")
        self._dropped_states = dropped
        self._prove()
        self._secure_log(connection)

    def _prove(self) -> None:
        """Raise StoreLostError when what is committed does not reach the file that stands in the store's place."""
        if lost := self._lock.lost():
            raise StoreLostError(lost)

    def _secure_log(self, connection: sqlite3.Connection) -> None:
        """Bring what is committed from the log into the store itself when the log was deleted."""
        try:
            there = self._log_path.stat().st_ino
        except OSError:
            there = None
        if self._log_inode in (None, there):
            self._log_inode = there
            return
        (busy, _, _) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        self._close()
        if busy:
            raise StoreLostError("has lost its log (-wal)")
        self._call(self._on_lost, f"{self._log_path} was deleted while the daemon wrote it; nothing of it is lost")

    def _run_job(self, job: Entry) -> None:
        try:
            connection = self._open()
            self._prove()
            result = job.execute(connection, self._layout_ids)
        except Exception as error:  # the caller of the job gets its error; closing rolls back
            self._close()
            job.commit.fail(error)
        else:
            job.commit.resolve(result)

    def _give_up(self, entry: Entry, error: Exception) -> None:
        self._intake.count_dropped(entry, error)
        self._reported_dropped[entry.kind] += 1
        self.report(f"{self._path}: one of the {entry.kind} cannot be stored and is dropped ({error})")

    def _open(self) -> sqlite3.Connection:
        if self._connection is None:
            self._lost = self._lost or self._lock.lost()
            self._lock.hold()
            connection = connect_writer(self._path)
            try:
                self._prove()
                now_ms = time.time_ns() // 1_000_000
                told = self._identity.settle(connection, self._path, self._lost, self._kept(), now_ms)
                self._learn_layouts(connection)
            except Exception:
                connection.close()
                raise
            self._connection, self._log_inode, self._lost = connection, None, ""
            if told:
                self._call(self._on_lost, told)
        return self._connection

    def _learn_layouts(self, connection: sqlite3.Connection) -> None:
        for layout in self._layout.layouts:
            self._layout_ids[layout] = _layout_id(connection, layout)
        (last,) = connection.execute("SELECT max(seq) FROM sqlite_sequence WHERE name = 'writes'").fetchone()
        self.last_write_id = last or 0

    def _close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is None:
            return
        try:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            connection.close()
        except sqlite3.Error as error:
            log.error("history.close", path=str(self._path), problem=str(error))

    def _fail(self, error: Exception) -> None:
        self._close()
        self._not_before_s = time.monotonic() + self._retry_s
        self._retry_s = min(2 * self._retry_s, RETRY_LONGEST_S)
        self.report(
            f"{self._path}: the history cannot be written: {cause_in_words(error)}. "
            f"Records wait in memory and are written when it works again; compensation goes on{self._newly_dropped()}"
        )

    def _lose(self, error: StoreLostError) -> None:
        """Give the file up that is no longer the store; what was not acknowledged goes to the one in its place."""
        self._lost = str(error)
        if self._connection is not None:
            _take_log_along(self._connection, self._path, self._log_inode)
        self._close()
        self._not_before_s = time.monotonic() + RETRY_FIRST_S
        self.report(
            f"{self._path}: the store {error} while the daemon writes it. Records wait in memory until it is found or "
            "begun anew; compensation goes on"
        )

    def _recover(self) -> None:
        if not self.problem:
            return
        if dropped := self._newly_dropped():
            self.report(f"{self._path}: the history is written again{dropped}")
        self.problem, self._retry_s, self._not_before_s = "", RETRY_FIRST_S, float("-inf")
        self._call(self._on_problem, "")

    def _newly_dropped(self) -> str:
        new = self._intake.dropped - self._reported_dropped
        self._reported_dropped += new
        return f"; dropped: {', '.join(f'{count} {kind}' for kind, count in new.items())}" if new else ""

    def report(self, sentence: str) -> None:
        """Say what is wrong, once, until something could be written again."""
        if sentence != self.problem:
            self.problem = sentence
            self._call(self._on_problem, sentence)

    def _call(self, callback: Callable[..., object], *arguments: object) -> None:
        """Call back; whatever goes wrong there must not end this thread."""
        try:
            callback(*arguments)
        except Exception:
            log.exception("history.callback", path=str(self._path))


def _layout_id(connection: sqlite3.Connection, layout: Layout) -> int:
    """Return the number of a layout, which gets one where it is new."""
    key = (layout.kind, layout.name, layout.members)
    find = "SELECT layout_id FROM layouts WHERE kind = ? AND name = ? AND members = ?"
    found = connection.execute(find, key).fetchone()
    if found is None:
        connection.execute("INSERT INTO layouts (kind, name, members) VALUES (?, ?, ?)", key)
        found = connection.execute(find, key).fetchone()
    return int(found[0])


def _take_log_along(connection: sqlite3.Connection, path: Path, inode: int | None) -> None:
    """Bring the log into the file that is given up: SQLite would take it for the log of the one in its place.

    Its index (-shm) goes too: a program that still reads the file that is given up would share it with the new store.
    """
    try:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        (busy, _, _) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        log_path = Path(f"{path}-wal")
        if log_path.exists() and log_path.stat().st_ino == inode:
            if busy:
                log_path.rename(f"{log_path}.lost")
            else:
                log_path.unlink()
            Path(f"{path}-shm").unlink(missing_ok=True)
    except (sqlite3.Error, OSError) as error:
        log.error("history.log_left", path=str(path), problem=str(error))
