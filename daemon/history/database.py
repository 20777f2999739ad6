"""Opens the store: creates or migrates its schema, or refuses it."""

import sqlite3
from functools import cache
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from models.errors import RefusedInputError

APPLICATION_ID = 1414547540
HOUR_MS = 3_600_000
BUSY_TIMEOUT_S = 5.0
CACHE_KIB = 512
"""Pages that a connection keeps: records are appended; SQLite's own 2 MiB fill within hours and help nobody."""


class HistoryError(RefusedInputError):
    """The store cannot be used as it is; the text is fit for an operator."""


@cache
def schema_scripts() -> tuple[tuple[int, str], ...]:
    """Return the numbered SQL files of the schema in order."""
    folder = resources.files("daemon.history") / "schema"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".sql")), key=lambda f: f.name)
    return tuple((int(f.name.partition("_")[0]), f.read_text(encoding="utf-8")) for f in files)


def schema_version() -> int:
    """Return the number of the newest schema that this version knows."""
    return schema_scripts()[-1][0]


class OlderStoreError(HistoryError):
    """The store has an older schema, which only a writer may bring up to date."""


def connect_writer(path: Path) -> sqlite3.Connection:
    """Open the one connection that writes, its schema brought up to date; raises HistoryError, sqlite3.Error."""
    connection = sqlite3.connect(path, isolation_level=None, timeout=BUSY_TIMEOUT_S)
    try:
        connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
        _migrate(connection, path)
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute(f"PRAGMA cache_size=-{CACHE_KIB}")
        connection.execute(f"PRAGMA journal_size_limit={16 * 2**20}")
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        connection.close()
        _refuse_foreign(error, path)
        raise
    except HistoryError:
        connection.close()
        raise
    return connection


def connect_reader(path: Path, *, also_on_full_disk: bool = False) -> sqlite3.Connection:
    """Open a connection that cannot write. Raises HistoryError with what to do.

    Whoever holds the store's lock may read it `also_on_full_disk`: after a power cut or a kill SQLite wants a new -shm
    file, for which there is no space; then the index of the log is kept in memory, which locks the store meanwhile.
    """
    try:
        there = path.is_file()
    except OSError as error:
        raise HistoryError(
            f"{path}: cannot be read ({error.strerror}); the state of the installed service is for root alone: use sudo"
        ) from error
    if not there:
        raise HistoryError(f"{path}: there is no history store; give the path that the daemon writes to")
    connection = _open_read_only(path, also_on_full_disk)
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


def _open_read_only(path: Path, also_on_full_disk: bool) -> sqlite3.Connection:
    uri = f"file:{quote(str(path.absolute()))}?mode=ro"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_S)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        connection.close()
        if Path(f"{path}-wal").exists():
            if also_on_full_disk and _is_of_the_disk(error):
                return _open_with_index_in_memory(path)
            raise _unreadable(path, error) from error
        # Without a -wal file there is no writer; a reader that may not create one reads the file as it is.
        connection = sqlite3.connect(f"{uri}&immutable=1", uri=True, isolation_level=None)
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        connection.close()
        _refuse_foreign(error, path)
        raise HistoryError(f"{path}: the store cannot be read ({error})") from error
    return connection


def _open_with_index_in_memory(path: Path) -> sqlite3.Connection:
    uri = f"file:{quote(str(path.absolute()))}?mode=rw"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_S)
    try:
        connection.execute("PRAGMA locking_mode=EXCLUSIVE")
        connection.execute("PRAGMA query_only=ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.DatabaseError as error:
        connection.close()
        raise _unreadable(path, error) from error
    return connection


def _is_of_the_disk(error: sqlite3.OperationalError) -> bool:
    return getattr(error, "sqlite_errorname", "").startswith(("SQLITE_IOERR", "SQLITE_FULL"))


def _unreadable(path: Path, error: sqlite3.DatabaseError) -> HistoryError:
    if isinstance(error, sqlite3.OperationalError) and _is_of_the_disk(error):
        return HistoryError(f"{path}: cannot be read ({error}): free space on its disk, or look at the kernel's log")
    if getattr(error, "sqlite_errorname", "").startswith("SQLITE_BUSY"):
        return HistoryError(f"{path}: cannot be read ({error}): another program holds it, try again when it has ended")
    return HistoryError(
        f"{path}: cannot be read ({error}); reading beside the daemon needs read and write permission "
        "on the -shm file beside the store: join the store's group"
    )


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


def _refuse_foreign(error: sqlite3.DatabaseError | UnicodeDecodeError, path: Path) -> None:
    if isinstance(error, UnicodeDecodeError):  # SQLite's own sentence holds a byte of the file
        raise HistoryError(f"{path}: the store is damaged (its schema cannot be read); restore a back-up") from error
    if getattr(error, "sqlite_errorname", "") == "SQLITE_NOTADB":
        raise HistoryError(f"{path}: this file is not a SQLite database; give another history.path") from error
