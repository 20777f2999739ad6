"""Which store a run of the daemon writes, so that another one put in its place meanwhile is not taken for it."""

import json
import sqlite3
import uuid
from collections.abc import Sequence
from pathlib import Path

from daemon.history.database import HistoryError
from daemon.history.rows import PUT_STATE

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
            connection.execute("COMMIT")
        if not lost:
            return ""
        now = "a new one was begun" if began else "a copy of it stands in its place, and is gone on with"
        return f"the store {lost} while the daemon wrote it; {now}: {path}. What the other file holds is not in it"

    def _found(self, connection: sqlite3.Connection) -> str | None:
        row = connection.execute("SELECT json FROM state WHERE key = ?", (KEY,)).fetchone()
        return None if row is None else str(json.loads(row[0]))
