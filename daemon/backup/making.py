"""Makes a back-up, also while the daemon writes its store."""

import hashlib
import io
import os
import shutil
import sqlite3
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from config.files import read_whole
from config.schema import Configuration
from config.schema.source_drivers import SourceEntry
from config.signing import SIGNATURE_SUFFIX, SigningError, TrustedKeys, signature_beside
from config.signing_key import SigningKey
from daemon.backup.manifest import (
    BEARING_RELEASES_NAME,
    BEARINGS_NAME,
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    LAST_BLOCK_NAME,
    LEFT_OUT,
    MANIFEST_NAME,
    MODEL_NAME,
    RELEASES_NAME,
    SIGNATURE_NAME,
    STORE_NAME,
    BackedUpFile,
    BackupError,
    Manifest,
    last_block_beside,
    signature_name,
)
from daemon.backup.names import backup_name, existing_backups
from daemon.backup.places import planned_with
from daemon.history.database import HistoryError, connect_reader, schema_version
from daemon.model_release.active import released
from daemon.model_release.repository import bearing_releases

BACKUP_MODE = 0o640
MOUNT_TABLE = Path("/etc/fstab")
MISSING = "there is no such file, and a spindle speed is planned with it"
PAGES_AT_ONCE, STEPS_AT_ONCE = 2048, 10_000_000
"""Of the copy, and of its check."""
LEFT_BEHIND_S = 86_400.0
"""No back-up takes so long [s]."""


def make_folder(folder: Path) -> None:
    """Make a folder for back-ups in one that is there; raises BackupError also where a share or stick is not mounted.

    What is written below a mount point without its mount fills the disk of the system, and the next mount hides it.
    """
    try:
        table = MOUNT_TABLE.read_text("utf-8", "replace").splitlines()
    except OSError:
        table = []
    lines = [line.split() for line in table if not line.lstrip().startswith("#")]
    listed = {words[1].replace("\\040", " ") for words in lines if len(words) > 1}
    absolute = folder.absolute()
    for each in (absolute, *absolute.parents):
        if str(each) in listed and not each.is_mount():
            raise BackupError(f"{each}: is not mounted, and {MOUNT_TABLE} says that it is a mount point; mount it")
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError as error:
        raise BackupError(f"{folder.parent}: there is no such folder; mount it or make it") from error
    except OSError as error:
        raise BackupError(f"{folder}: this folder for back-ups cannot be made ({error.strerror})") from error


def remove_old(folder: Path, machine: str, keep: int, spare: Path | None = None) -> list[Path]:
    """Remove all but the newest `keep` of the machine's back-ups in a folder; return what was removed.

    `spare` stays in any case: after a step of the clock the one just made may not be the newest by name. One from the
    future was made while the clock was ahead, and counts as older than those of a clock that is right.
    """
    now = backup_name(machine, datetime.now(UTC))
    by_age = sorted(existing_backups(folder, machine), key=lambda path: (path.name <= now, path.name))
    old = [path for path in by_age[:-keep] if path != spare]
    for path in old:
        path.unlink(missing_ok=True)
    return old


def make_backup(configuration: Configuration, config_path: Path, destination: Path) -> Manifest:
    """Write a back-up to a new file that is complete or not there; raises BackupError."""
    if destination.exists():
        raise BackupError(f"{destination} exists already and is left as it is; name a new file")
    partial = destination.with_name(f".{destination.name}.partial")
    make_folder(destination.parent)
    try:
        with tempfile.TemporaryDirectory(prefix=".toolpoint-backup-", dir=destination.parent) as work:
            _remove_left_behind(Path(work))
            store = Path(work) / "history.sqlite"
            copy_store(configuration.history.path, store)
            sources = list(_sources(configuration, config_path, store))
            key, unsigned = _key(configuration)
            manifest = _manifest(configuration, sources, unsigned)
            write_archive(partial, manifest, sources, key)
        partial.replace(destination)
    except HistoryError as error:
        raise BackupError(str(error)) from error
    except OSError as error:
        raise BackupError(f"{destination}: the back-up cannot be made: {error}") from error
    finally:
        partial.unlink(missing_ok=True)
    return manifest


def _remove_left_behind(work: Path) -> None:
    """Remove what back-ups left that were killed in the middle: each has the size of the store."""
    now_s = work.stat().st_mtime  # by the clock of the folder's server, as the others
    for left in (*work.parent.glob(".toolpoint-backup-*"), *work.parent.glob(".toolpoint-*.tar.partial")):
        with suppress(OSError):  # of another account, or removed by another back-up
            if abs(left.lstat().st_mtime - now_s) > LEFT_BEHIND_S:
                shutil.rmtree(left) if left.is_dir() else left.unlink()


def answer_signals(*_: object) -> None:
    """Let what ends a back-up end it within seconds: SQLite alone would go on to the end of a store of any size."""


def copy_store(path: Path, destination: Path) -> None:
    """Copy a store, also one that is being written, to a file that is complete or not there."""
    partial = Path(f"{destination}.partial")
    partial.unlink(missing_ok=True)
    try:
        with closing(connect_reader(path)) as source, closing(sqlite3.connect(partial)) as target:
            source.execute("BEGIN")  # one view of the store: else each commit of the daemon would begin the copy anew
            source.execute("SELECT count(*) FROM sqlite_master").fetchone()
            source.backup(target, pages=PAGES_AT_ONCE, progress=answer_signals)
            target.set_progress_handler(answer_signals, STEPS_AT_ONCE)
            (verdict,) = target.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.Error as error:
        partial.unlink(missing_ok=True)
        raise HistoryError(f"{destination}: the back-up failed ({error}); check the space on that disk") from error
    if verdict != "ok":
        partial.unlink(missing_ok=True)
        raise HistoryError(f"{path}: the store is damaged ({verdict}); restore an older back-up")
    partial.replace(destination)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """One file for the back-up: one that nobody changes, or what was read of it once, as the daemon goes on writing."""

    name: str
    came_from: Path
    unchanged: Path | None = None
    content: bytes = b""

    def open(self) -> io.BufferedReader | io.BytesIO:
        """Return the file's content as a stream."""
        return self.unchanged.open("rb") if self.unchanged is not None else io.BytesIO(self.content)

    def described(self) -> BackedUpFile:
        with self.open() as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        size_bytes = self.unchanged.stat().st_size if self.unchanged is not None else len(self.content)
        return BackedUpFile(name=self.name, sha256=digest, size_bytes=size_bytes, came_from=str(self.came_from))


def _sources(configuration: Configuration, config_path: Path, store: Path) -> Iterator[Source]:
    yield Source(name=STORE_NAME, came_from=configuration.history.path, unchanged=store)
    for name, path in _files_beside(configuration, config_path):
        yield Source(name=name, came_from=path, content=read_whole(path))
    for name, path in _releases(configuration):
        yield Source(name=name, came_from=path, unchanged=path)  # years of them are more than the service's memory


def _files_beside(configuration: Configuration, config_path: Path) -> Iterator[tuple[str, Path]]:
    """Yield the name in the back-up and the place of every file beside the store."""
    yield CONFIGURATION_NAME, config_path
    if (last_block := last_block_beside(configuration.history.path)).is_file():
        yield LAST_BLOCK_NAME, last_block
    record = configuration.compensation.commissioning_file
    if record is not None and record.is_file():
        yield COMMISSIONING_NAME, record
        if (signature := signature_beside(record)).is_file():
            yield signature_name(COMMISSIONING_NAME), signature
    model_file = configuration.compensation.model_file
    if model_file is not None and model_file.is_file():
        yield MODEL_NAME, Path(os.path.realpath(model_file))
    bearings = _bearings(configuration)
    if bearings is not None and bearings.is_file():
        yield BEARINGS_NAME, Path(os.path.realpath(bearings))
    yield from ((name, path) for name, path in planned_with(configuration).items() if path.is_file())


def _bearings(configuration: Configuration) -> Path | None:
    tuning = configuration.spindle_speed
    return None if tuning is None else tuning.thermomechanical_model


def _releases(configuration: Configuration) -> Iterator[tuple[str, Path]]:
    """Yield the name in the back-up and the place of every file of the released models, which nobody writes again."""
    folders = {}
    if (model_file := configuration.compensation.model_file) is not None:
        folders[RELEASES_NAME] = model_file.parent / "releases"
    if (bearings := _bearings(configuration)) is not None:
        folders[BEARING_RELEASES_NAME] = bearings.parent / bearing_releases(bearings)
    for name, releases in folders.items():
        for path in sorted((*releases.glob("[0-9]*/*.json"), *releases.glob(f"[0-9]*/*{SIGNATURE_SUFFIX}"))):
            if path.is_file():
                yield f"{name}/{path.parent.name}/{path.name}", path


def _key(configuration: Configuration) -> tuple[SigningKey | None, list[str]]:
    """Return the key of this account, or why the back-up is made without a signature: it is better than none."""
    try:
        return SigningKey.of_this_account(TrustedKeys.read(configuration.signatures.public_keys), "back-up"), []
    except SigningError as error:
        return None, [f"a signature: {error}"]


def _manifest(configuration: Configuration, sources: Sequence[Source], unsigned: Sequence[str]) -> Manifest:
    cnc = configuration.cnc
    secrets = [f"cnc.{cnc.driver}.{key}: {path}" for key, path in cnc.connection.secrets.items()]
    displacements = configuration.displacements
    beside: dict[str, Sequence[SourceEntry]] = {
        "temperatures": configuration.temperatures.sources or (),
        "displacements": (displacements.sources if displacements is not None else None) or (),
    }
    for key_of, sources_of in beside.items():
        for index, each in enumerate(sources_of):
            at = f"{key_of}.sources[{index}].{each.driver}"
            secrets += [f"{at}.{key}: {path}" for key, path in each.connection.secrets.items()]
    for index, sink in enumerate(configuration.sinks or ()):
        secrets += [f"sinks[{index}].{sink.driver}.{key}: {path}" for key, path in sink.secrets.items()]
    missing = [f"{path}: {MISSING}" for path in planned_with(configuration).values() if not path.is_file()]
    return Manifest(
        toolpoint=version("toolpoint"),
        machine=configuration.machine,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        store_schema=schema_version(),
        active_release=_active(configuration.compensation.model_file),
        active_bearing_release=_active(_bearings(configuration)),
        files=[source.described() for source in sources],
        left_out=[*LEFT_OUT, *unsigned, *secrets, *missing],
    )


def _active(model_file: Path | None) -> int | None:
    record = None if model_file is None else released(model_file)[0]
    return None if record is None else record.number


def write_archive(partial: Path, manifest: Manifest, sources: Sequence[Source], key: SigningKey | None = None) -> None:
    """Write the tar, the manifest first, and hand it to the disk."""
    content = manifest.to_json().encode() + b"\n"
    partial.unlink(missing_ok=True)
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, BACKUP_MODE)
    with os.fdopen(descriptor, "wb") as file:
        with tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as archive:
            archive.addfile(_entry(MANIFEST_NAME, len(content)), io.BytesIO(content))
            if key is not None:
                signature = key.signature("back-up", content)
                archive.addfile(_entry(SIGNATURE_NAME, len(signature)), io.BytesIO(signature))
            for source, item in zip(sources, manifest.files, strict=True):
                with source.open() as stream:
                    archive.addfile(_entry(item.name, item.size_bytes), stream)
        file.flush()
        os.fsync(file.fileno())


def _entry(name: str, size_bytes: int) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size, entry.mode = size_bytes, 0o644
    entry.mtime = int(datetime.now(UTC).timestamp())
    return entry
