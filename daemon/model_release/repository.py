"""The folder of released models: one folder per release, and a symbolic link that names the active one.

model.json -> releases/0003/model.json. A release folder is complete before it gets its name; later only the model in it
is ever removed, its record stays. Activating renames one link, so that nobody ever reads half of a release.
"""

import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from config.files import read_whole, sha256_of, sync_folder
from config.records.release_record import ReleaseRecord, ReleaseRecordError, load_release_record
from config.signing import signature_beside
from config.signing_key import SigningKey
from daemon.model_release.active import RECORD_NAME, released

MODEL_NAME = "model.json"
MODELS_KEPT = 100
"""A proposal every eight hours makes a thousand releases a year, of up to 10 MiB each: older models are removed."""
READABLE_FILE, READABLE_FOLDER = 0o644, 0o755
"""The daemon is another user and only reads."""


class ReleaseError(Exception):
    """A release is refused or failed; the text says why and what to do."""


def bearing_releases(model_file: Path) -> str:
    """Return the name of the folder beside a bearing model that holds its releases."""
    return f"{model_file.stem}-releases"


class ReleaseRepository:
    """The folder of releases beside a configured model file."""

    def __init__(self, model_file: Path, releases: str = "releases") -> None:
        self.model_file = model_file
        self.releases = model_file.parent / releases

    def folders(self) -> list[Path]:
        """Return the folder of every release, the oldest first; a copy that a person has made beside them is none."""
        found = (folder for folder in self.releases.glob("[0-9]*") if folder.name.isdecimal())
        return sorted(found, key=lambda folder: int(folder.name))

    def records(self) -> list[ReleaseRecord]:
        """Return every release that can be read, the oldest first."""
        found = []
        for folder in self.folders():
            try:
                found.append(load_release_record(folder / RECORD_NAME))
            except ReleaseRecordError:
                continue  # `content` says why when somebody wants this one
        return found

    def active(self) -> ReleaseRecord | None:
        """Return the record that the link leads to; raises ReleaseError when it must not be used."""
        if not self.model_file.is_symlink():
            if self.model_file.exists():
                raise ReleaseError(
                    f"{self.model_file} is a plain file, which nobody released and nobody can go back to; move it to "
                    "another folder, and release it from there with `toolpoint model release`"
                )
            return None
        record, problem = released(self.model_file)
        if record is None and problem:
            raise ReleaseError(problem)
        return record

    def content(self, number: int) -> tuple[ReleaseRecord, bytes]:
        """Return a release and its model's bytes, or raise ReleaseError when they do not belong together."""
        folder = self._folder(number)
        if not folder.exists():
            there = ", ".join(str(each.number) for each in self.records())
            raise ReleaseError(f"there is no release {number} in {self.releases}; there are: {there or 'none'}")
        try:
            record = load_release_record(folder / RECORD_NAME)
            content = read_whole(folder / MODEL_NAME)
        except ReleaseRecordError as error:
            raise ReleaseError(str(error)) from error
        except FileNotFoundError as error:
            raise ReleaseError(
                f"{folder / MODEL_NAME}: is gone, only the record of release {number} is there; the models of the "
                f"newest {MODELS_KEPT} releases are kept: release it again from its file, or from a back-up"
            ) from error
        except OSError as error:
            raise ReleaseError(f"{folder / MODEL_NAME}: cannot be read ({error.strerror})") from error
        if sha256_of(content) != record.sha256:
            raise ReleaseError(f"{folder / MODEL_NAME}: is not the file that {record.person} released; it stays unused")
        return record, content

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep a second release away until this one is done."""
        try:
            if not self.releases.is_dir():
                self.releases.mkdir(parents=True)
                self.releases.chmod(stat.S_IMODE(self.releases.parent.stat().st_mode))
            descriptor = os.open(self.releases, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise self._unwritable(error) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        except BlockingIOError as error:
            raise ReleaseError(f"{self.releases}: somebody else is releasing a model now; try again") from error
        finally:
            os.close(descriptor)

    def _outdated(self, record: ReleaseRecord) -> list[Path]:
        """Return the models that go once this release is active: none that a kept record leads back to.

        A rollback names the release that it went back to, whose record says what the next one goes back to. What
        another account has released is that one's to remove.
        """
        known = {each.number: each for each in (*self.records(), record)}
        kept = set(sorted(known)[-MODELS_KEPT:])
        for _ in range(2):
            kept |= {number for each in kept & known.keys() for number in known[each].leads_back_to}
        paths = [self._folder(number) / MODEL_NAME for number in sorted(known.keys() - kept) if self.holds(number)]
        return [path for path in paths if os.access(path.parent, os.W_OK, effective_ids=True)]

    def holds(self, number: int) -> bool:
        """Say whether the model of a release is there; of old ones the record alone is."""
        return (self._folder(number) / MODEL_NAME).exists()

    def _folder(self, number: int) -> Path:
        return self.releases / f"{number:04d}"

    def next_number(self) -> int:
        return max((int(folder.name) for folder in self.folders()), default=0) + 1

    def add(self, record: ReleaseRecord, content: bytes, key: SigningKey | None = None) -> ReleaseRecord:
        """Put a release into the folder, signed where there is a key, and make it the active one; return its record.

        That says too which older models are removed for it.
        """
        if outdated := self._outdated(record):
            numbers = ", ".join(path.parent.name.lstrip("0") for path in outdated)
            gone = f"removed the models of releases that nothing leads back to, their records stay: {numbers}"
            record = record.model_copy(update={"checks": [*record.checks, gone]})
        unsaid = {key for key in ("trained_on", "reads") if not getattr(record, key)}  # unknown to versions before
        text = record.model_dump_json(indent=2, exclude=unsaid).encode() + b"\n"
        folder = self._folder(record.number)
        try:
            made = Path(tempfile.mkdtemp(prefix=".new-", dir=self.releases))
            try:
                _write(made / MODEL_NAME, content)
                _write(made / RECORD_NAME, text)
                if key is not None:
                    _write(signature_beside(made / RECORD_NAME), key.signature("release record", text))
                made.chmod(READABLE_FOLDER)
                made.rename(folder)
            finally:
                shutil.rmtree(made, ignore_errors=True)
            sync_folder(self.releases)
            self._point_to(folder)
            for path in outdated:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error
        return record

    def _point_to(self, folder: Path) -> None:
        link = self.model_file.with_name(f".{self.model_file.name}.{os.getpid()}.link")
        link.unlink(missing_ok=True)
        link.symlink_to(Path(self.releases.name) / folder.name / MODEL_NAME)
        link.replace(self.model_file)
        sync_folder(self.model_file.parent)

    def _unwritable(self, error: OSError) -> ReleaseError:
        return ReleaseError(
            f"{self.releases}: cannot be written ({error.strerror}); a model is released by an account that may write "
            "there, which the daemon's may not"
        )


def _write(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    path.chmod(READABLE_FILE)
