"""Keeps a store to one writer, and notices when the store's file is no longer the one that is written.

One lock on a file beside the store, which says who holds it, and one on the store's own, for when somebody deletes the
first; both of flock(2). The system drops SQLite's own locks when the process closes *any* descriptor of a file: so the
store is opened here before SQLite opens it, closed after it, and never opened twice.
"""

import fcntl
import json
import os
import sqlite3
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from daemon.history.database import HistoryError
from daemon.history.rows import PUT_STATE

RESTORATION_BEGUN = ".toolpoint-restore-begun"
"""Folder beside a store while its files are exchanged; it stays when that is broken off."""


class StoreLostError(HistoryError):
    """The file that was written is no longer the store; nothing of what was committed last counts."""


_never_closed: list[int] = []
"""Descriptors of stores that another writer holds: closing one could take away the locks of that writer, when it is
one of this process."""


class WriterLock:
    """Keeps a second writer away from a store, in this and in other processes."""

    def __init__(self, path: Path, *, restores: bool = False) -> None:
        self._path = path
        self._restores = restores
        self._descriptor: int | None = None
        self._store: int | None = None

    def acquire(self) -> None:
        """Take both locks where they are not held yet, or raise HistoryError naming who holds them."""
        if self._descriptor is not None:
            return
        lock_path = Path(f"{self._path}.lock")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660)
        except OSError as error:
            raise HistoryError(f"{lock_path}: cannot be created ({error.strerror}); check history.path") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(descriptor)
            raise HistoryError(
                f"{self._path}: process {holder} writes this store; two writers would damage it. "
                "Stop that process, or give this one another history.path"
            ) from error
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode("ascii"), 0)
        self._descriptor = descriptor
        try:
            self.hold(create=False)
            if not self._restores and os.path.lexists(begun := self._path.with_name(RESTORATION_BEGUN)):
                raise HistoryError(
                    f"{begun}: `toolpoint restore` was broken off; run it again, which puts all back first"
                )
        except HistoryError:
            self.release()
            raise

    def hold(self, *, create: bool = True) -> None:
        """Lock the store's own file where it stands now; SQLite must not have it open yet.

        Raises HistoryError when another writer holds it. A disk that does not let it be opened is left to SQLite,
        whose errors say why.
        """
        if not self.lost() and self._store is not None:
            return
        before, self._store = self._store, None
        if before is not None:
            os.close(before)
        try:
            if create:
                self._path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._path, os.O_RDWR | os.O_CLOEXEC | (os.O_CREAT if create else 0), 0o644)
        except OSError:
            return
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            _never_closed.append(descriptor)
            raise HistoryError(
                f"{self._path}: another process writes this store, although its lock file is gone; two writers would "
                f"damage it. Stop that process (`fuser {self._path}` names it), or give this one another history.path"
            ) from error
        self._store = descriptor

    def lost(self) -> str:
        """Return in words what became of the file that is held, '' while it is the store."""
        if self._store is None:
            return ""
        try:
            there = self._path.stat()
        except FileNotFoundError:
            return "was deleted or moved away"
        except OSError as error:
            return f"can no longer be found ({error.strerror})"
        return "" if os.path.samestat(there, os.fstat(self._store)) else "was replaced by another file"

    def release(self) -> None:
        """Let another writer in; without effect when the lock is not held."""
        for descriptor in (self._store, self._descriptor):
            if descriptor is not None:
                os.close(descriptor)
        self._store = self._descriptor = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


# --- which store ---------------------------------------------------------------------------

KEY = "store_id"
"""Under this key the states of a store hold its identity."""
Kept = Sequence[tuple[str, str, int]]
"""States for the next start: key, JSON, utc_ms."""


class StoreIdentity:
    """The identity of the store that was opened first in this run."""

    def __init__(self) -> None:
        self._id: str | None = None

    def settle(self, connection: sqlite3.Connection, path: Path, lost: str, kept: Kept, now_ms: int) -> str:
        """Accept the store that was opened, or refuse it with HistoryError; return what became of a lost one.

        `lost` says what became of the one before, '' where there was none or it is the same. A store that is begun
        anew, or an older copy, gets the states that are kept for the next start.
        """
        found = self._found(connection)
        if self._id is None:
            self._id = found or uuid.uuid4().hex
        began = found is None and not connection.execute("SELECT EXISTS (SELECT 1 FROM layouts)").fetchone()[0]
        if lost and not began and found != self._id:
            raise HistoryError(
                f"{path}: another store stands in the place of the one that this daemon writes, which {lost}; nothing "
                "is written into it. Put the right file back, or restart the daemon to go on with this one"
            )
        if found != self._id or lost:
            states = [*(kept if lost else ()), (KEY, json.dumps(self._id), now_ms)]
            connection.execute("BEGIN IMMEDIATE")
            connection.executemany(PUT_STATE, states)
            if lost:  # rows may get numbers once more that sinks have taken already
                connection.execute("UPDATE generation SET text = lower(hex(randomblob(16)))")
            connection.execute("COMMIT")
        if not lost:
            return ""
        now = "a new one was begun" if began else "a copy of it stands in its place, and is gone on with"
        return f"the store {lost} while the daemon wrote it; {now}: {path}. What the other file holds is not in it"

    def _found(self, connection: sqlite3.Connection) -> str | None:
        row = connection.execute("SELECT json FROM state WHERE key = ? AND json_valid(json)", (KEY,)).fetchone()
        return None if row is None else str(json.loads(row[0]))
