"""Open the store: its schema, migration and refusal, and the lock that keeps it to one writer."""

import fcntl
import os
import sqlite3
from importlib import resources
from pathlib import Path
from typing import Self
from urllib.parse import quote

from models.errors import RefusedInputError

APPLICATION_ID = 1414547540
HOUR_MS = 3_600_000
BUSY_TIMEOUT_S = 5.0


class HistoryError(RefusedInputError):
    """The store cannot be used as it is; the text is fit for an operator."""


def schema_scripts() -> list[tuple[int, str]]:
    """Return the numbered SQL files of the schema in order."""
    folder = resources.files("daemon.history") / "schema"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".sql")), key=lambda f: f.name)
    return [(int(f.name.partition("_")[0]), f.read_text(encoding="utf-8")) for f in files]


def schema_version() -> int:
    """Return the number of the newest schema that this version knows."""
    return schema_scripts()[-1][0]


class OlderStoreError(HistoryError):
    """The store has an older schema, which only a writer may bring up to date."""


class WriterLock:
    """Keeps a second writer away from a store, in this and in other processes."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock, or raise HistoryError naming who holds it."""
        lock_path = Path(f"{self._path}.lock")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT, 0o660)
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

    def release(self) -> None:
        """Let another writer in; without effect when the lock is not held."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def connect_writer(path: Path) -> sqlite3.Connection:
    """Open the one connection that writes, bringing the schema up to date.

    Raises HistoryError when the file is no store or is of a newer version, and sqlite3.Error
    when the disk does not let it open (which may pass).
    """
    connection = sqlite3.connect(path, isolation_level=None, timeout=BUSY_TIMEOUT_S)
    try:
        connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
        _migrate(connection, path)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute(f"PRAGMA journal_size_limit={16 * 2**20}")
    except sqlite3.DatabaseError as error:
        connection.close()
        _refuse_foreign(error, path)
        raise
    except HistoryError:
        connection.close()
        raise
    return connection


def connect_reader(path: Path) -> sqlite3.Connection:
    """Open a connection that cannot write. Raises HistoryError with what to do."""
    try:
        there = path.is_file()
    except OSError as error:
        raise HistoryError(
            f"{path}: cannot be read ({error.strerror}); the state of the installed service is for root alone: use sudo"
        ) from error
    if not there:
        raise HistoryError(f"{path}: there is no history store; give the path that the daemon writes to")
    connection = _open_read_only(path)
    try:
        version = _checked_version(connection, path)
        if version < schema_version():
            raise OlderStoreError(
                f"{path}: the store has schema {version}, this version reads {schema_version()}; "
                "start the daemon once, which migrates it"
            )
    except sqlite3.DatabaseError as error:
        connection.close()
        _refuse_foreign(error, path)
        raise HistoryError(f"{path}: the store cannot be read ({error})") from error
    except HistoryError:
        connection.close()
        raise
    return connection


def _open_read_only(path: Path) -> sqlite3.Connection:
    uri = f"file:{quote(str(path.absolute()))}?mode=ro"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_S)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        connection.close()
        if Path(f"{path}-wal").exists():
            raise HistoryError(
                f"{path}: cannot be read ({error}); reading beside the daemon needs read and write permission "
                "on the -shm file beside the store: join the store's group"
            ) from error
        # Without a -wal file nobody writes; a reader that may not create one reads the file as it is.
        connection = sqlite3.connect(f"{uri}&immutable=1", uri=True, isolation_level=None)
    except sqlite3.DatabaseError as error:
        connection.close()
        _refuse_foreign(error, path)
        raise HistoryError(f"{path}: the store cannot be read ({error})") from error
    return connection


def _checked_version(connection: sqlite3.Connection, path: Path) -> int:
    """Return the schema version of a store, 0 for an empty file; refuse what is not ours or newer."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (objects,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if objects and application != APPLICATION_ID:
        raise HistoryError(f"{path}: this SQLite file belongs to another program; give another history.path")
    if version > schema_version():
        raise HistoryError(
            f"{path}: the store has schema {version}, this version of toolpoint knows up to {schema_version()}; "
            "install the newer version again, or give another history.path"
        )
    return int(version)


def _migrate(connection: sqlite3.Connection, path: Path) -> None:
    version = _checked_version(connection, path)
    for number, script in schema_scripts():
        if number <= version:
            continue
        try:
            connection.executescript(f"BEGIN IMMEDIATE;\n{script}\nPRAGMA user_version={number};\nCOMMIT;")
        except sqlite3.Error:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def _refuse_foreign(error: sqlite3.DatabaseError, path: Path) -> None:
    if getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB":
        raise HistoryError(f"{path}: this file is not a SQLite database; give another history.path") from error
