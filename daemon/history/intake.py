"""The bounded queue between those who record and the thread that writes the store."""

import asyncio
import concurrent.futures
import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from typing import Any

from daemon.history.layout import Layout

LayoutIds = dict[Layout, int]
Execute = Callable[[sqlite3.Connection, LayoutIds], object]
LONGEST_WAIT_S = 10.0
"""The thread that writes looks at the queue this often at least: what may wait as long wakes nobody, who would compete
with the way to the macro for the interpreter [s]."""


class Commit:
    """Resolves when the record is committed; awaitable in a loop, or `result(timeout_s)` in a thread.

    Hardly any caller waits for one of the many commits, so a future is made only for one that does.
    """

    __slots__ = ("_error", "_future", "_value", "done")
    _making = threading.Lock()

    def __init__(self) -> None:
        self._future: concurrent.futures.Future[Any] | None = None
        self._value: Any = None
        self._error: BaseException | None = None
        self.done = False

    def __await__(self) -> Generator[Any, None, Any]:
        return asyncio.wrap_future(self._waited()).__await__()

    def result(self, timeout_s: float | None = None) -> Any:
        return self._waited().result(timeout_s)

    def resolve(self, value: Any = None) -> None:
        self._end(value, None)

    def fail(self, error: BaseException) -> None:
        self._end(None, error)

    def _end(self, value: Any, error: BaseException | None) -> None:
        with self._making:
            if self.done:
                raise concurrent.futures.InvalidStateError("a commit ends once")
            self._value, self._error, self.done = value, error, True
            future = self._future
        if future is not None:
            self._tell(future)

    def _waited(self) -> "concurrent.futures.Future[Any]":
        with self._making:
            if self._future is not None:
                return self._future
            future = self._future = concurrent.futures.Future()
            future.set_running_or_notify_cancel()  # so that a cancelled waiter does not cancel the commit
            done = self.done
        if done:
            self._tell(future)
        return future

    def _tell(self, future: "concurrent.futures.Future[Any]") -> None:
        if self._error is not None:
            future.set_exception(self._error)
        else:
            future.set_result(self._value)


@dataclass(slots=True, kw_only=True)
class Entry:
    """One thing to be written, in the order of the queue."""

    kind: str
    """In words, plural: it is what a message about dropped records says."""
    execute: Execute
    bulk: bool = False
    """Measurements are given up before the audit when the queue is full."""
    is_job: bool = False
    """Runs on the connection outside the batch's transaction and is not repeated."""
    acknowledges: tuple[str, int, int] | None = None
    """Line, cycle number and utc_ms."""
    commit: Commit = field(default_factory=Commit)


class Intake:
    """Thread-safe; `put` never waits for the disk."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._changed = threading.Condition()
        self._audit: deque[Entry] = deque()
        self._bulk: deque[Entry] = deque()
        self._due_s = float("inf")
        self.closed = False
        self.dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._audit) + len(self._bulk)

    def put(self, entry: Entry, *, within_s: float) -> None:
        """Queue an entry to be taken within the given time (together with all that is queued then)."""
        with self._changed:
            if self.closed:
                self._drop(entry)
                return
            self._append(entry)
            due_s = time.monotonic() + within_s
            if due_s < self._due_s:
                self._due_s = due_s
                if within_s < LONGEST_WAIT_S:
                    self._changed.notify()

    def _append(self, entry: Entry) -> None:
        if len(self) >= self._limit:
            self._drop((self._bulk or self._audit).popleft())
        (self._bulk if entry.bulk else self._audit).append(entry)

    def _drop(self, entry: Entry) -> None:
        self.dropped[entry.kind] += 1
        entry.commit.fail(
            sqlite3.OperationalError("dropped: the store could not be written for too long, or is closed")
        )

    def count_dropped(self, entry: Entry, error: Exception) -> None:
        """Give up an entry that can never be written."""
        with self._changed:
            self.dropped[entry.kind] += 1
        entry.commit.fail(error)

    def take(self, not_before_s: float) -> list[Entry]:
        """Wait until something is due and `not_before_s` (monotonic) past, or the queue closed; take everything."""
        with self._changed:
            while not self.closed:
                wait_s = max(self._due_s, not_before_s) - time.monotonic()
                if wait_s <= 0:
                    break
                self._changed.wait(min(wait_s, LONGEST_WAIT_S))
            entries = [*self._audit, *self._bulk]
            self._audit.clear()
            self._bulk.clear()
            self._due_s = float("inf")
            return entries

    def put_back(self, entries: Iterable[Entry]) -> None:
        """Return what could not be written to the head of the queue; what does not fit is dropped, oldest first."""
        with self._changed:
            newer = [*self._audit, *self._bulk]
            self._audit.clear()
            self._bulk.clear()
            for entry in (*entries, *newer):
                self._append(entry)
            self._due_s = time.monotonic() if len(self) else self._due_s

    def close(self) -> None:
        """Take no more waiting: the reader gets what is queued at once."""
        with self._changed:
            self.closed = True
            self._changed.notify()
