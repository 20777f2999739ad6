"""Restores a back-up: checks all of it, overwrites nothing, and leaves the machine at rest until a person acknowledges.

An archive may come from anywhere, and the person who restores it is root. What it says about places is compared, never
followed; it is unpacked into a folder that is held open and that only root can change.

What a restored store says of the CNC is old. It therefore forgets what was switched on, the reference and all that a
start would take up again, and the daemon starts in FAULT until a person has compared and acknowledged.
"""

import dataclasses
import filecmp
import hashlib
import itertools
import json
import os
import shutil
import sqlite3
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from config.files import sync_folder, write_whole
from config.loader import ConfigurationError, load_configuration, parse_yaml_model, with_absolute_paths
from config.machine.spindle import load_spindle
from config.machine.stability_case import load_stability_case
from config.records.commissioning import CommissioningError, load_commissioning
from config.records.release_record import ReleaseRecordError, load_release_record
from config.schema import Configuration
from config.schema.service import SignaturesConfig
from config.signing import TrustedKeys, signature_beside
from daemon.backup.archive import MIB, Archive
from daemon.backup.manifest import (
    BEARING_RELEASES_NAME,
    BEARINGS_NAME,
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    MODEL_NAME,
    PLANNED_WITH,
    RELEASES_NAME,
    STORE_NAME,
    BackupError,
    Manifest,
    last_block_beside,
)
from daemon.backup.places import Places, agreed_places, installed_places, places_of_plans, targets
from daemon.history.database import HistoryError, connect_reader, connect_writer
from daemon.history.store_lock import RESTORATION_BEGUN, WriterLock
from daemon.state_store.documents import OutputFault, SensorLevelsDocument, SpindleSpeedSwitch
from daemon.state_store.store import KEYS, document_json

BESIDE_STORE = ("-wal", "-shm")
"""Files of SQLite that belong to a store."""
UNPACKED = ".toolpoint-restore-unpacked-"
PLAN_NAME = "plan.json"
"""What is exchanged, in a folder that only the restoring account can write in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Restored:
    """What a restoration did, or would do."""

    manifest: Manifest
    placed: tuple[Path, ...]
    kept: tuple[Path, ...]
    """What was there before, under its new name."""
    left: tuple[Path, ...] = ()
    """A commissioning record in its place that is not older than that of the back-up."""
    unplaced: tuple[str, ...] = ()
    """Spindle and case files in the back-up for which nobody has named a place: name there, and whence it came."""


def read_manifest(archive_path: Path) -> Manifest:
    """Return the manifest of a back-up after proving every file in it; raises BackupError."""
    try:
        with Archive(archive_path) as archive:
            archive.prove()
            return archive.manifest
    except OSError as error:
        raise BackupError(f"{archive_path}: this is no whole back-up ({error}); take another one") from error


def restore(
    archive_path: Path,
    config_path: Path,
    *,
    person: str,
    replace: bool,
    given: Places | None = None,
    keep_configuration: bool = False,
    accept_unsigned: bool = False,
) -> Restored:
    """Restore a back-up to the places of the installed configuration; raises BackupError with nothing changed.

    `given`: places that a person has named. What is there is refused, or moved aside with `replace`. Where keys count,
    one must have signed the back-up, unless a person accepts it without.
    """
    try:
        with Archive(archive_path) as archive:
            manifest = archive.manifest
            archived = _configuration(archive, config_path)
            wanted = installed_places(config_path, given or Places())
            places = agreed_places(manifest, Places.of(archived), wanted, keep_configuration=keep_configuration)
            store = places.store
            assert store is not None, "every back-up holds a store"
            _undo_broken_off(store)
            if not accept_unsigned:
                archive.signer(_trusted(config_path))
            _refuse_another_machine(archive_path, manifest, config_path)
            _refuse_small_disk(archive, store)
            archive.prove()
            with _stopped(store), _private_folder(store.parent) as folder:
                archive.extract(folder)
                left = _commissioned_since(folder, places)
                _check_releases(folder, manifest)
                disarm(folder / STORE_NAME, manifest, person)
                pieces = list(targets(places, None if keep_configuration else config_path))
                taken = {path: name for name, path in pieces}
                plans = places_of_plans(archived, config_path, taken, keep_configuration=keep_configuration)
                plans = {name: path for name, path in plans.items() if _is_plan(folder / name)}
                pieces = [(name, path) for name, path in (*pieces, *plans.items()) if path not in left]
                done = _put_in_place(folder, manifest, pieces, store, replace=replace)
                return dataclasses.replace(done, left=left[:1], unplaced=tuple(_unplaced(manifest, plans)))
    except OSError as error:
        raise BackupError(f"the back-up cannot be restored: {error}") from error


def _refuse_another_machine(archive_path: Path, manifest: Manifest, config_path: Path) -> None:
    """Refuse a back-up of another machine: the places are the same in a whole plant."""
    try:
        installed = load_configuration(config_path).machine
    except ConfigurationError:  # there is none, or a person names the places
        return
    if manifest.machine != installed:
        raise BackupError(
            f"{archive_path}: is of machine {manifest.machine!r}, and the installed configuration is that of "
            f"{installed!r} (machine): take that one's own back-up; where this is the same machine, give it its name "
            f"back, and where this computer takes the other's place, move {config_path} away first"
        )


def _trusted(config_path: Path) -> TrustedKeys:
    """Return the keys that count by the installed configuration, or that lie where it would look."""
    try:
        folder = load_configuration(config_path).signatures.public_keys
    except ConfigurationError:
        folder = config_path.absolute().parent / SignaturesConfig().public_keys
    return TrustedKeys.read(folder)


def _refuse_small_disk(archive: Archive, store: Path) -> None:
    """Refuse what the disk cannot hold twice: unpacked, and in its place."""
    there = next(folder for folder in store.absolute().parents if folder.is_dir())
    free = shutil.disk_usage(there).free
    if 2 * archive.size_bytes > free:
        raise BackupError(
            f"{there}: {2 * archive.size_bytes / MIB:.0f} MiB must be free to restore this back-up, "
            f"{free / MIB:.0f} MiB are; free space on the disk"
        )


@contextmanager
def _private_folder(parent: Path) -> Iterator[Path]:
    """Yield a folder of our own that stays the same one, even if another process renames it."""
    with tempfile.TemporaryDirectory(prefix=UNPACKED, dir=parent) as work, _held(Path(work)) as folder:
        yield folder


@contextmanager
def _held(work: Path) -> Iterator[Path]:
    """Yield a way to a folder that only this account can write in."""
    descriptor = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(descriptor)
        if found.st_uid != os.geteuid() or found.st_mode & 0o077:
            raise BackupError(f"{work}: somebody else has put a folder in this place; find out who")
        yield Path(f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)


def _undo_broken_off(store: Path) -> None:
    """Put back what a restoration that a kill or a power cut ended had moved aside, and remove what it unpacked."""
    begun, left = store.with_name(RESTORATION_BEGUN), list(store.parent.glob(f"{UNPACKED}*"))
    if not left and not os.path.lexists(begun):
        return
    with _stopped(store):
        if os.path.lexists(begun):
            with _held(begun) as folder:
                if (folder / PLAN_NAME).exists():
                    exchanged = json.loads((folder / PLAN_NAME).read_text("utf-8"))
                    before = {Path(path): Path(aside) for path, aside in exchanged["kept"]}
                    kept = {path: aside for path, aside in before.items() if os.path.lexists(aside)}
                    _undo([path for path in map(Path, exchanged["placed"]) if path in kept or path not in before], kept)
            _forget_plan(begun)
        for work in left:
            with _held(work):
                shutil.rmtree(work)


def _write_plan(begun: Path, placed: Iterable[Path], kept: Iterable[tuple[Path, Path]]) -> None:
    """Write down what is about to be exchanged, so that it can be undone after a power cut."""
    plan = {"placed": [str(path) for path in placed], "kept": [(str(path), str(aside)) for path, aside in kept]}
    begun.mkdir(mode=0o700)
    try:
        with _held(begun) as folder:
            write_whole(folder / PLAN_NAME, json.dumps(plan))
        sync_folder(begun.parent)
    except BaseException:  # nothing is exchanged yet: a full disk must not keep the daemon from its store
        shutil.rmtree(begun)
        raise


def _forget_plan(begun: Path) -> None:
    with _held(begun) as folder:
        (folder / PLAN_NAME).unlink(missing_ok=True)
    shutil.rmtree(begun)


def _configuration(archive: Archive, config_path: Path) -> Configuration:
    """Return the configuration of the back-up as it will be read from its new place."""
    try:
        text = archive.content(CONFIGURATION_NAME).decode("utf-8")
        section = parse_yaml_model(text, Configuration, CONFIGURATION_NAME)
    except UnicodeDecodeError as error:
        raise BackupError(f"the configuration in the back-up is not UTF-8 text (byte {error.start})") from error
    except ConfigurationError as error:
        raise BackupError(
            f"the configuration in the back-up is refused by this version; install {archive.manifest.toolpoint}, which "
            f"made it:\n{error}"
        ) from error
    return with_absolute_paths(section, config_path.absolute().parent)


class _stopped:
    """Keep the daemon out for as long as its files are exchanged."""

    def __init__(self, store: Path) -> None:
        self._store = store
        self._lock = WriterLock(store, restores=True)

    def __enter__(self) -> None:
        try:
            self._lock.acquire()
        except HistoryError as error:
            raise BackupError(f"{error} (`systemctl stop toolpoint`)") from error
        give_to_owner_of_folder(Path(f"{self._store}.lock"))

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def disarm(store: Path, manifest: Manifest, person: str) -> None:
    """Check the store in the back-up, bring it up to date, and clear what a start would take up again."""
    said = (
        f"the history was restored from the back-up of {manifest.created}, so what the CNC holds is unknown here: "
        "compare the macro variables with the machine, then acknowledge"
    )
    try:
        with closing(sqlite3.connect(store, isolation_level=None)) as connection:
            connection.execute("PRAGMA trusted_schema=OFF")
            _refuse_foreign_schema(connection)
        connect_writer(store).close()
        with closing(sqlite3.connect(store, isolation_level=None)) as connection:
            (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
            if verdict != "ok":
                raise BackupError(f"the store in the back-up is damaged ({verdict}); take another one")
            now_ms = time.time_ns() // 1_000_000
            connection.execute("BEGIN IMMEDIATE")
            about_history = (KEYS[SensorLevelsDocument],)  # without it, what a sensor said while it was wrong counts
            connection.execute("DELETE FROM state WHERE key != ?", about_history)
            connection.execute("UPDATE generation SET text = lower(hex(randomblob(16)))")  # sinks begin again
            for document in (OutputFault(reasons=(said,)), SpindleSpeedSwitch(off_by="the restoration of a back-up")):
                connection.execute(
                    "INSERT INTO state (key, json, utc_ms) VALUES (?, ?, ?)",
                    (KEYS[type(document)], json.dumps(document_json(document)), now_ms),
                )
            connection.execute(
                "INSERT INTO events (utc_ms, monotonic_ms, kind, text, person) VALUES (?, 0, 'restored', ?, ?)",
                (now_ms, said, person),
            )
            connection.execute("COMMIT")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connect_reader(store).close()
    except (HistoryError, sqlite3.Error, UnicodeDecodeError) as error:
        raise BackupError(f"the store in the back-up cannot be used: {error}") from error


def _refuse_foreign_schema(connection: sqlite3.Connection) -> None:
    """Refuse a store that would do more than store: foreign triggers and views act when it is changed."""
    active = "SELECT type, name FROM sqlite_master WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'"
    if (found := connection.execute(active).fetchone()) is not None:
        raise BackupError(f"the store in the back-up holds a {ascii(found[0])[1:-1]}, which none has; take another one")


def _commissioned_since(folder: Path, places: Places) -> tuple[Path, ...]:
    """Return the record in its place and its signature, where the machine may have been commissioned since the back-up.

    What a person has seen last counts: signs and scales of before would double an error.
    """
    there = places.commissioning_file
    if not (path := folder / COMMISSIONING_NAME).exists():
        return ()
    try:
        archived = load_commissioning(path)
    except CommissioningError as error:
        raise BackupError(f"the commissioning record in the back-up cannot be read: {error}") from error
    try:
        newer = there is not None and load_commissioning(there).date >= archived.date
    except CommissioningError:
        return ()
    if there is None or not newer or _is_there_already(path, there):
        return ()
    return there, signature_beside(there)


def _is_plan(path: Path) -> bool:
    """Say whether a file is there and describes a spindle or a case, as nothing else is put beside a configuration."""
    try:
        return path.exists() and bool(load_stability_case(path) if path.name == "case.yaml" else load_spindle(path))
    except ConfigurationError:
        return False


def _unplaced(manifest: Manifest, plans: Mapping[str, Path]) -> Iterator[str]:
    came_from = {file.name: file.came_from for file in manifest.files}
    for name in manifest.files_in(PLANNED_WITH):
        if name not in plans:
            yield f"{came_from[name]}: in the back-up as {name}; put it there by hand"


def _check_releases(folder: Path, manifest: Manifest) -> None:
    """Check that every release in the back-up is the file that its record names."""
    names = manifest.files_in(RELEASES_NAME, BEARING_RELEASES_NAME)
    for name in names:
        if not name.endswith("/release.json"):
            continue
        try:
            record = load_release_record(folder / name)
        except ReleaseRecordError as error:
            raise BackupError(f"a release in the back-up cannot be read: {error}") from error
        if (model := name.replace("release.json", "model.json")) not in names:
            continue  # an old one, of which the record alone is kept
        with (folder / model).open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != record.sha256:
                raise BackupError(f"{name}: the model beside it is not the one that {record.person} released")


def _put_in_place(
    folder: Path, manifest: Manifest, pieces: Sequence[tuple[str, Path]], store: Path, *, replace: bool
) -> Restored:
    to_place = [
        (name, path) for name, path in pieces if (folder / name).exists() and not _is_there_already(folder / name, path)
    ]
    in_the_way = [path for _, path in to_place if os.path.lexists(path)]
    if in_the_way and not replace:
        listed = ", ".join(map(str, in_the_way))
        raise BackupError(f"there is already {listed}; --replace moves what is there aside, nothing is deleted")
    # without a configuration nothing can be begun again: it is exchanged last, and at once
    to_place.sort(key=lambda piece: piece[0] == CONFIGURATION_NAME)
    aside, begun = dict(_aside(store, in_the_way)), store.with_name(RESTORATION_BEGUN)
    last = {path for name, path in to_place if name == CONFIGURATION_NAME and path in aside}
    kept: dict[Path, Path] = {}
    placed: list[Path] = []
    links = {MODEL_NAME: RELEASES_NAME, BEARINGS_NAME: BEARING_RELEASES_NAME}
    where = dict(pieces)
    _write_plan(begun, [path for _, path in to_place], aside.items())
    try:
        for path in aside.keys() - last:
            path.rename(aside[path])
            kept[path] = aside[path]
        for name, path in to_place:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path in last:
                path.rename(aside[path])
                kept[path] = aside[path]
            placed.append(path)
            if (number := manifest.active_releases.get(links.get(name, ""))) is not None:
                path.symlink_to(Path(where[links[name]].name) / f"{number:04d}" / "model.json")
            else:
                # who may write in the folder of the models may do so in that of its releases
                _place(folder / name, path, stat.S_IMODE(path.parent.stat().st_mode))
        for each in {path.parent for path in placed}:
            sync_folder(each)
    except BaseException:  # also when a person breaks it off: half a store must not stand in the place of a whole one
        _undo(placed, kept)
        _forget_plan(begun)
        raise
    _forget_plan(begun)
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


def _aside(store: Path, in_the_way: list[Path]) -> list[tuple[Path, Path]]:
    """Return what is there with its new name, which nothing has; a store goes with the files that belong to it."""
    here = [path for path in (*in_the_way, last_block_beside(store)) if os.path.lexists(path)]
    stamp = f"before-restore-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    for number in itertools.count(2):
        aside = [(path, path.with_name(f"{path.name}.{stamp}")) for path in here]
        for suffix in BESIDE_STORE:  # SQLite finds them by the store's name
            if (path := Path(f"{store}{suffix}")).exists():
                aside.append((path, Path(f"{store}.{stamp}{suffix}")))
        if not any(os.path.lexists(name) for _, name in aside):
            break
        stamp = f"{stamp.partition('Z')[0]}Z-{number}"
    return aside


def _place(source: Path, path: Path, folder_mode: int = 0o755) -> None:
    """Copy a file or folder to its place, owned by the account that owns the folder there; never through a link."""
    if source.is_dir():
        path.mkdir()
        _make_readable(path, folder_mode)
        for each in sorted(source.iterdir()):
            _place(each, path / each.name)
        sync_folder(path)
        return
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as target, source.open("rb") as content:
        shutil.copyfileobj(content, target)
        target.flush()
        os.fsync(target.fileno())
    _make_readable(path, 0o640 if source.name == Path(STORE_NAME).name else 0o644)


def _make_readable(path: Path, mode: int) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        os.fchmod(descriptor, mode)
        if os.geteuid() == 0:
            owner = path.parent.stat()
            os.fchown(descriptor, owner.st_uid, owner.st_gid)
    finally:
        os.close(descriptor)


def give_to_owner_of_folder(path: Path) -> None:
    """Give a file that root has made to the account that owns its folder: the daemon's user must write its store."""
    if os.geteuid() == 0:
        owner = path.parent.stat()
        os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)
