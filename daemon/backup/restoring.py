"""Restore a back-up: verify all of it, put nothing over what is there, and let nothing move by itself afterwards.

What a restored store says of the CNC is old: somebody has written to the macros since. Therefore the
restored store forgets what was switched on, the reference and everything else that a start would
take up again, the last block is not put back, and the daemon starts in FAULT until a person has
compared and acknowledged.
"""

import filecmp
import json
import os
import shutil
import sqlite3
import tarfile
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from config.files import sha256_of_stream
from config.loader import ConfigurationError, load_yaml_model, with_absolute_paths
from config.records.release_record import ReleaseRecordError, load_release_record
from config.schema import Configuration
from daemon.backup.manifest import (
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    MANIFEST_NAME,
    MODEL_NAME,
    RELEASES_NAME,
    STORE_NAME,
    BackupError,
    Manifest,
    last_block_beside,
)
from daemon.history.database import HistoryError, connect_reader, connect_writer
from daemon.history.store_lock import WriterLock
from daemon.state_store.documents import OutputFault
from daemon.state_store.store import KEYS, document_json

LARGEST_MANIFEST = 16 * 2**20
BESIDE_STORE = ("-wal", "-shm")
"""Files of SQLite that belong to a store."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Restored:
    """What a restoration did, or would do."""

    manifest: Manifest
    placed: tuple[Path, ...]
    kept: tuple[Path, ...]
    """What was there before, under its new name."""


def read_manifest(archive_path: Path) -> Manifest:
    """Return the manifest of a back-up after proving every file in it; raises BackupError."""
    try:
        with tarfile.open(archive_path, mode="r:") as archive:
            return _proved(archive, archive_path)
    except (OSError, tarfile.TarError) as error:
        raise BackupError(f"{archive_path}: this is no whole back-up ({error}); take another one") from error


def _proved(archive: tarfile.TarFile, path: Path) -> Manifest:
    members = archive.getmembers()
    if not members or members[0].name != MANIFEST_NAME or members[0].size > LARGEST_MANIFEST:
        raise BackupError(f"{path}: this is no back-up of Toolpoint: it does not begin with {MANIFEST_NAME}")
    stream = archive.extractfile(members[0])
    try:
        manifest = Manifest.model_validate_json(stream.read() if stream is not None else b"")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise BackupError(f"{path}: {MANIFEST_NAME}: {where}: {first['msg']}; another version made it") from error
    expected = {item.name: item for item in manifest.files}
    names = [member.name for member in members[1:]]
    if sorted(names) != sorted(expected) or len(expected) != len(manifest.files):
        raise BackupError(f"{path}: holds other files than its manifest names; take another back-up")
    for member in members[1:]:
        item, stream = expected[member.name], archive.extractfile(member) if member.isfile() else None
        if stream is None or ".." in Path(member.name).parts:
            raise BackupError(f"{path}: {member.name} is no plain file; take another back-up")
        with stream:
            if member.size != item.size_bytes or sha256_of_stream(stream) != item.sha256:
                raise BackupError(f"{path}: {member.name} was damaged after the back-up was made; take another one")
    wanted = [STORE_NAME, CONFIGURATION_NAME]
    if manifest.active_release is not None:
        wanted.append(f"{RELEASES_NAME}/{manifest.active_release:04d}/model.json")
    if missing := [name for name in wanted if name not in expected]:
        raise BackupError(f"{path}: has no {missing[0]}; take another back-up")
    return manifest


def restore(archive_path: Path, config_path: Path, *, person: str, replace: bool) -> Restored:
    """Restore a back-up to the places that its configuration names; raises BackupError with nothing changed.

    `config_path` is where its configuration goes. What is there already is refused, or moved aside
    when `replace` is set.
    """
    manifest = read_manifest(archive_path)
    try:
        configuration = _configuration(archive_path, manifest, config_path)
        store = configuration.history.path
        with _stopped(store), tempfile.TemporaryDirectory(prefix=".toolpoint-restore-", dir=store.parent) as work:
            folder = Path(work)
            _extract(archive_path, [item.name for item in manifest.files], folder)
            disarm(folder / STORE_NAME, manifest, person)
            _check_releases(folder, manifest)
            return _put_in_place(folder, manifest, configuration, config_path, replace=replace)
    except OSError as error:
        raise BackupError(f"the back-up cannot be restored: {error}") from error


def _extract(archive_path: Path, names: Iterable[str], folder: Path) -> None:
    with tarfile.open(archive_path, mode="r:") as archive:
        for name in names:
            stream = archive.extractfile(name)
            assert stream is not None, "the manifest was proved"
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with stream, path.open("xb") as file:
                shutil.copyfileobj(stream, file)


def _configuration(archive_path: Path, manifest: Manifest, config_path: Path) -> Configuration:
    """Return the configuration of the back-up as it will be read from its new place."""
    with tempfile.TemporaryDirectory(prefix="toolpoint-restore-") as work:
        _extract(archive_path, [CONFIGURATION_NAME], Path(work))
        try:
            section = load_yaml_model(Path(work) / CONFIGURATION_NAME, Configuration)
        except ConfigurationError as error:
            raise BackupError(
                f"the configuration in the back-up is refused by this version; install {manifest.toolpoint}, which "
                f"made it:\n{error}"
            ) from error
    return with_absolute_paths(section, config_path.absolute().parent)


class _stopped:
    """Keep the daemon out for as long as its files are exchanged."""

    def __init__(self, store: Path) -> None:
        self._store = store
        self._lock = WriterLock(store)

    def __enter__(self) -> None:
        try:
            self._lock.acquire()
        except HistoryError as error:
            raise BackupError(f"{error} (`systemctl stop toolpoint`)") from error
        give_to_owner_of_folder(Path(f"{self._store}.lock"))

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def disarm(store: Path, manifest: Manifest, person: str) -> None:
    """Check the store in the back-up, bring it up to date, and make it forget what a start would take up again."""
    said = (
        f"the history was restored from the back-up of {manifest.created}, so what the CNC holds is unknown here: "
        "compare the macro variables with the machine, then acknowledge"
    )
    try:
        connect_writer(store).close()
        with closing(sqlite3.connect(store, isolation_level=None)) as connection:
            (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
            if verdict != "ok":
                raise BackupError(f"the store in the back-up is damaged ({verdict}); take another one")
            now_ms = time.time_ns() // 1_000_000
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("DELETE FROM state")
            fault = json.dumps(document_json(OutputFault(reasons=(said,))))
            connection.execute(
                "INSERT INTO state (key, json, utc_ms) VALUES (?, ?, ?)", (KEYS[OutputFault], fault, now_ms)
            )
            connection.execute(
                "INSERT INTO events (utc_ms, monotonic_ms, kind, text, person) VALUES (?, 0, 'restored', ?, ?)",
                (now_ms, said, person),
            )
            connection.execute("COMMIT")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connect_reader(store).close()
    except (HistoryError, sqlite3.Error) as error:
        raise BackupError(f"the store in the back-up cannot be used: {error}") from error


def _check_releases(folder: Path, manifest: Manifest) -> None:
    """Check that every release in the back-up is the file that its record names."""
    for name in manifest.release_files:
        if not name.endswith("/release.json"):
            continue
        try:
            record = load_release_record(folder / name)
        except ReleaseRecordError as error:
            raise BackupError(f"a release in the back-up cannot be read: {error}") from error
        with (folder / name).with_name("model.json").open("rb") as file:
            if sha256_of_stream(file) != record.sha256:
                raise BackupError(f"{name}: the model beside it is not the one that {record.person} released")


def _targets(configuration: Configuration, config_path: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name in the back-up and the new place of what is restored as one piece."""
    yield CONFIGURATION_NAME, config_path.absolute()
    yield STORE_NAME, configuration.history.path
    if (record := configuration.compensation.commissioning_file) is not None:
        yield COMMISSIONING_NAME, record
    if (model_file := configuration.compensation.model_file) is not None:
        yield RELEASES_NAME, model_file.parent / "releases"
        yield MODEL_NAME, model_file


def _put_in_place(
    folder: Path, manifest: Manifest, configuration: Configuration, config_path: Path, *, replace: bool
) -> Restored:
    targets = [
        (name, path)
        for name, path in _targets(configuration, config_path)
        if (folder / name).exists() and not _is_there_already(folder / name, path)
    ]
    in_the_way = [path for _, path in targets if os.path.lexists(path)]
    if in_the_way and not replace:
        listed = ", ".join(map(str, in_the_way))
        raise BackupError(f"there is already {listed}; --replace moves what is there aside, nothing is deleted")
    kept: dict[Path, Path] = {}
    placed: list[Path] = []
    try:
        for path, aside in _aside(configuration.history.path, in_the_way):
            path.rename(aside)
            kept[path] = aside
        for name, path in targets:
            path.parent.mkdir(parents=True, exist_ok=True)
            placed.append(path)
            if name == MODEL_NAME and manifest.active_release is not None:
                path.symlink_to(Path("releases") / f"{manifest.active_release:04d}" / "model.json")
            else:
                _place(folder / name, path)
    except OSError:
        _undo(placed, kept)
        raise
    return Restored(manifest=manifest, placed=tuple(placed), kept=tuple(kept.values()))


def _is_there_already(source: Path, path: Path) -> bool:
    """Say whether a single file stands in its place already, so that it is best left alone."""
    if source.is_dir() or path.is_symlink() or not path.is_file():
        return False
    return filecmp.cmp(source, path, shallow=False)


def _undo(placed: Iterable[Path], kept: dict[Path, Path]) -> None:
    """Take out again what was placed, and give what was there its name back."""
    for path in placed:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    for path, aside in kept.items():
        aside.rename(path)


def _aside(store: Path, in_the_way: list[Path]) -> Iterator[tuple[Path, Path]]:
    """Yield what is there with its new name; a store goes together with the files that belong to it."""
    stamp = f"before-restore-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    for path in (*in_the_way, last_block_beside(store)):
        if os.path.lexists(path):
            yield path, path.with_name(f"{path.name}.{stamp}")
    for suffix in BESIDE_STORE:  # SQLite finds them by the store's name
        if (path := Path(f"{store}{suffix}")).exists():
            yield path, Path(f"{store}.{stamp}{suffix}")


def _place(source: Path, path: Path) -> None:
    """Copy a file or folder to its place, as the property of whoever owns the folder there."""
    if source.is_dir():
        shutil.copytree(source, path)
    else:
        shutil.copyfile(source, path)
    for place in (path, *(path.rglob("*") if path.is_dir() else ())):
        place.chmod(0o755 if place.is_dir() else 0o644)
        give_to_owner_of_folder(place)
    if source.name == Path(STORE_NAME).name:
        path.chmod(0o640)


def give_to_owner_of_folder(path: Path) -> None:
    """Let a file that root has made belong to whoever owns its folder: the daemon's user must write its store."""
    if os.geteuid() == 0:
        owner = path.parent.stat()
        os.chown(path, owner.st_uid, owner.st_gid)
