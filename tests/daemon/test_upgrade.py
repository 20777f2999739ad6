"""A store of an earlier version: brought up to date, readable as before, and the way back."""

import sqlite3
import tarfile
from contextlib import closing
from pathlib import Path

import pytest
from history_records import EPOCH_S, SMALL, StillClock

from config.files import sha256_of
from daemon.backup import making
from daemon.backup.manifest import BackupError
from daemon.backup.restoring import disarm, read_manifest
from daemon.history import database
from daemon.history.columns.kinds import TEMPERATURES
from daemon.history.database import HistoryError, schema_version
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from models.records import WriteOutcome

OLDEST = Path(__file__).with_name("store_schema_1.sql")
EVER = (0.0, 1e11)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store as version 0.1.0 left it, in the middle of a write."""
    path = tmp_path / "history.sqlite"
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(OLDEST.read_text(encoding="utf-8"))
        connection.execute("PRAGMA journal_mode=WAL")
    return path


def version_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def test_there_is_something_to_migrate(store: Path) -> None:
    assert version_of(store) == 1 < schema_version()
    with pytest.raises(HistoryError, match="start the daemon once, which migrates it"):
        HistoryReader(store)


def test_the_first_start_brings_it_up_to_date_and_loses_nothing(store: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(EPOCH_S + 100.0), machine=SMALL)
    assert writer.get_state("wanted") == {"X": False, "Y": False, "Z": True}, (
        "asked before the start, as the daemon does"
    )
    writer.start()
    number = int(writer.write_intent(None, ((500, 1.0),), "tick"))
    writer.event("daemon", "started", "daemon")
    writer.close()
    assert version_of(store) == schema_version()
    with HistoryReader(store) as reader:
        assert [event.text for event in reader.events(*EVER)] == ["started", "enable Z", "started"]
        writes = reader.writes(*EVER)
        temperatures = reader.temperatures(None, *EVER)
        assert reader.last_displacement_utc_s() == EPOCH_S + 30.0
        assert reader.extent(TEMPERATURES) is not None
    assert [write.outcome for write in writes[:6]] == 5 * [WriteOutcome.VERIFIED] + [WriteOutcome.INTENDED]
    assert writes[5].compensation_um["Z"] == -6.0
    assert number == 7, "numbers of writes go on where they were"
    assert temperatures.degc.shape[1] == 5 and len(temperatures.degc) == 12
    with closing(sqlite3.connect(store)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_a_migration_that_breaks_off_leaves_the_old_store(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scripts = [
        *database.schema_scripts(),
        (schema_version() + 1, "CREATE TABLE more (x); INSERT INTO nowhere VALUES (1);"),
    ]
    monkeypatch.setattr(database, "schema_scripts", lambda: scripts)
    monkeypatch.setattr(database, "schema_version", lambda: scripts[-1][0])
    with pytest.raises(sqlite3.OperationalError, match="nowhere"):
        database.connect_writer(store)
    assert version_of(store) == scripts[-2][0]
    with closing(sqlite3.connect(store)) as connection:
        assert connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'more'").fetchone() == (0,)
        assert connection.execute("SELECT count(*) FROM writes").fetchone() == (6,)


def test_a_start_that_cannot_bring_it_up_to_date_says_why(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as on a full disk; the service is started again until it can."""
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.01)
    writer = HistoryWriter(store, clock=StillClock(EPOCH_S + 100.0), machine=SMALL)
    with closing(sqlite3.connect(store, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(HistoryError, match=r"history\.sqlite: another program has locked it; close that program"):
            writer.get_state("wanted")
    assert writer.get_state("wanted") == {"X": False, "Y": False, "Z": True}
    writer.close()


def test_an_older_program_refuses_a_newer_store_and_leaves_it_alone(store: Path) -> None:
    newer = schema_version() + 1
    with closing(sqlite3.connect(store)) as connection:
        connection.execute(f"PRAGMA user_version={newer}")
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    with pytest.raises(HistoryError, match=f"has schema {newer}, this version of toolpoint knows up to"):
        writer.start()
    writer.close()
    assert version_of(store) == newer


def old_backup(folder: Path, store: Path) -> Path:
    """Return a back-up as the earlier version made it: its store has the older tables."""
    configuration = b"machine: none\n"
    sources = [
        making.Source(name="store/history.sqlite", came_from=store, unchanged=store),
        making.Source(name="configuration/toolpoint.yaml", came_from=folder / "toolpoint.yaml", content=configuration),
    ]
    manifest = making.Manifest(
        toolpoint="0.1.0",
        machine="none",
        created="2026-01-01T00:00:00+00:00",
        store_schema=1,
        files=[source.described() for source in sources],
        left_out=[],
    )
    path = folder / "old.tar"
    making.write_archive(path, manifest, sources)
    return path


def test_a_backup_of_an_earlier_version_is_brought_up_to_date_when_restored(store: Path, tmp_path: Path) -> None:
    manifest = read_manifest(old_backup(tmp_path, store))
    assert manifest.store_schema == 1
    with tarfile.open(tmp_path / "old.tar") as archive:
        stream = archive.extractfile("store/history.sqlite")
        assert stream is not None
        content = stream.read()
    assert sha256_of(content) == manifest.files[0].sha256
    restored = tmp_path / "restored.sqlite"
    restored.write_bytes(content)
    disarm(restored, manifest, "anna")
    with HistoryReader(restored) as reader:
        assert [event.kind for event in reader.events(*EVER)] == ["daemon", "request", "restored"]
        assert reader.get_state("wanted") is None and "acknowledge" in str(reader.get_state("fault"))


def test_a_backup_of_a_newer_version_is_refused(store: Path, tmp_path: Path) -> None:
    manifest = read_manifest(old_backup(tmp_path, store))
    with closing(sqlite3.connect(store)) as connection:
        connection.execute(f"PRAGMA user_version={schema_version() + 1}")
    with pytest.raises(BackupError, match="install the newer version again"):
        disarm(store, manifest, "anna")
