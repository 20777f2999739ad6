"""Reads a back-up of unknown origin: all of it is checked before anything is written.

A plain tar: regular files one after another, each named in the manifest. Every header is read here, so that links,
devices and sparse files are refused by their first block, before a name or a byte of content is used.
"""

import hashlib
import os
import re
import tarfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

from pydantic import ValidationError

from config.files import without_waiting
from config.schema.base import first_fault
from config.signing import SigningError, TrustedKeys
from daemon.backup.manifest import (
    BEARING_RELEASES_NAME,
    BEARINGS_NAME,
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    LAST_BLOCK_NAME,
    MANIFEST_NAME,
    MODEL_NAME,
    PLANNED_WITH,
    RELEASES_NAME,
    SIGNATURE_NAME,
    STORE_NAME,
    BackupError,
    Manifest,
    signature_name,
)

KIB, MIB = 2**10, 2**20
BLOCK = tarfile.BLOCKSIZE
READ_BYTES = MIB
LARGEST_EXTENSION = KIB
"""An extended header only says the size of a file that a plain one cannot, of 8 GiB and more."""
MOST_MEMBERS = 60_000
"""With a release every eight hours, as proposals come, a back-up has three thousand more each year."""
LARGEST = (
    (re.escape(MANIFEST_NAME), 20 * MIB),
    (re.escape(SIGNATURE_NAME), 64 * KIB),
    (re.escape(CONFIGURATION_NAME), MIB),
    (re.escape(COMMISSIONING_NAME), MIB),
    (re.escape(signature_name(COMMISSIONING_NAME)), 64 * KIB),
    (re.escape(LAST_BLOCK_NAME), 64 * KIB),
    (rf"{MODEL_NAME}|{BEARINGS_NAME}", 64 * MIB),
    (rf"({RELEASES_NAME}|{BEARING_RELEASES_NAME})/[0-9]{{4,6}}/model\.json", 64 * MIB),
    (rf"({RELEASES_NAME}|{BEARING_RELEASES_NAME})/[0-9]{{4,6}}/release\.json", MIB),
    (rf"({RELEASES_NAME}|{BEARING_RELEASES_NAME})/[0-9]{{4,6}}/release\.json\.sig", 64 * KIB),
    (rf"{PLANNED_WITH}/[0-9]{{1,4}}/(case|spindle-[xy])\.yaml", MIB),
    (re.escape(STORE_NAME), None),
)
"""What a back-up may hold, and how large it may be [bytes]; the store is as large as the disk allows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """One file of the archive."""

    name: str
    offset: int
    size_bytes: int


class Archive:
    """An open back-up, whose structure is in order; raises BackupError."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = open(path, "rb", opener=without_waiting)  # noqa: SIM115 (closed with the archive)
        except OSError as error:
            raise self._refused(f"cannot be read ({error.strerror})") from error
        try:
            self._members = {member.name: member for member in self._read_members()}
            self.manifest = self._read_manifest()
            self._sha256 = {item.name: item.sha256 for item in self.manifest.files}
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def size_bytes(self) -> int:
        """Everything in it together."""
        return sum(member.size_bytes for member in self._members.values())

    def signer(self, trusted: TrustedKeys) -> str:
        """Return who has signed the manifest, and with it every file, '' where no key counts; raises BackupError."""
        told = self._members.get(SIGNATURE_NAME)
        content = b"".join(self._pieces(self._members[MANIFEST_NAME]))
        try:
            signature = None if told is None else b"".join(self._pieces(told))
            return trusted.signer("back-up", content, signature, f"{self._path}")
        except SigningError as error:
            raise BackupError(f"{error}; --accept-unsigned restores it all the same, on your word") from error

    def prove(self) -> None:
        """Read every file and compare it with the manifest."""
        for item in self.manifest.files:
            for _ in self._proved(item.name):
                pass

    def content(self, name: str) -> bytes:
        """Return a file of the back-up, as the manifest describes it; not for the store."""
        return b"".join(self._proved(name))

    def extract(self, folder: Path) -> None:
        """Write every file but the manifest into a folder that no other account can change, as the manifest says."""
        for item in self.manifest.files:
            path = folder / item.name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as file:
                for piece in self._proved(item.name):
                    file.write(piece)

    def _proved(self, name: str) -> Iterator[bytes]:
        digest = hashlib.sha256()
        for piece in self._pieces(self._members[name]):
            digest.update(piece)
            yield piece
        if digest.hexdigest() != self._sha256[name]:
            raise self._refused(f"{name} was damaged after the back-up was made; take another one")

    def _pieces(self, member: Member) -> Iterator[bytes]:
        left = member.size_bytes
        self._file.seek(member.offset)
        while left and (piece := self._file.read(min(left, READ_BYTES))):
            left -= len(piece)
            yield piece
        if left:
            raise self._refused(f"this is no whole back-up ({member.name} is cut off); take another one")

    # --- structure -----------------------------------------------------------------------

    def _read_members(self) -> Iterator[Member]:
        end = os.fstat(self._file.fileno()).st_size
        names: set[str] = set()
        try:
            for member in _members(self._file):
                if not names and member.name != MANIFEST_NAME:
                    raise self._refused(f"this is no back-up of Toolpoint: it does not begin with {MANIFEST_NAME}")
                if member.name in names or len(names) == MOST_MEMBERS:
                    raise self._refused(f"holds {_shown(member.name)} twice, or too many files; take another back-up")
                if member.offset + member.size_bytes > end:
                    raise self._refused(f"this is no whole back-up ({member.name} is cut off); take another one")
                self._refuse_size(member)
                names.add(member.name)
                yield member
        except BackupError as error:
            raise error if str(error).startswith(str(self._path)) else self._refused(str(error)) from error
        except (tarfile.TarError, OSError, ValueError, OverflowError) as error:
            if names or isinstance(error, OSError):
                raise self._refused(f"this is no whole back-up ({error}); take another one") from error
        if not names:
            raise self._refused(f"this is no back-up of Toolpoint: it does not begin with {MANIFEST_NAME}")

    def _refuse_size(self, member: Member) -> None:
        for pattern, largest in LARGEST:
            if re.fullmatch(pattern, member.name):
                if largest is not None and member.size_bytes > largest:
                    raise self._refused(
                        f"{member.name} has {member.size_bytes} bytes, a back-up has at most {largest} there"
                    )
                return
        raise self._refused(f"{_shown(member.name)} is nothing that a back-up holds; take another back-up")

    def _read_manifest(self) -> Manifest:
        content = b"".join(self._pieces(self._members[MANIFEST_NAME]))
        try:
            manifest = Manifest.model_validate_json(content)
        except ValidationError as error:
            raise self._refused(f"{MANIFEST_NAME}: {first_fault(error)}; another version made it") from error
        expected = {item.name: item for item in manifest.files}
        names = self._members.keys() - {MANIFEST_NAME, SIGNATURE_NAME}
        if names != expected.keys() or len(expected) != len(manifest.files):
            raise self._refused("holds other files than its manifest names; take another back-up")
        for name, item in expected.items():
            if self._members[name].size_bytes != item.size_bytes:
                raise self._refused(f"{name} was damaged after the back-up was made; take another one")
        wanted = [STORE_NAME, CONFIGURATION_NAME]
        wanted += [f"{folder}/{number:04d}/model.json" for folder, number in manifest.active_releases.items()]
        if missing := [name for name in wanted if name not in expected]:
            raise self._refused(f"has no {missing[0]}; take another back-up")
        return manifest

    def _refused(self, words: str) -> BackupError:
        return BackupError(f"{self._path}: {words}")


def _members(file: BinaryIO) -> Iterator[Member]:
    """Yield the files of a tar that holds plain files only; raises tarfile.TarError for everything else."""
    file.seek(0)
    while any(block := _block(file)):
        header = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
        size_bytes = None
        if header.type == tarfile.XHDTYPE and 0 <= header.size <= LARGEST_EXTENSION:
            said = file.read(-(-header.size // BLOCK) * BLOCK)[: header.size]
            if (found := re.fullmatch(rb"\d{1,3} size=(\d{1,18})\n", said)) is None:
                raise BackupError(f"{_shown(header.name)} has an extended header, which no back-up needs")
            size_bytes = int(found[1])
            header = tarfile.TarInfo.frombuf(_block(file), "utf-8", "strict")
        if header.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or header.size < 0:
            raise BackupError(f"{_shown(header.name)} is no plain file; take another back-up")
        size_bytes = header.size if size_bytes is None else size_bytes
        yield Member(name=header.name, offset=(offset := file.tell()), size_bytes=size_bytes)
        file.seek(offset - (-size_bytes // BLOCK) * BLOCK)


def _shown(name: str) -> str:
    """Return a name that anybody may have chosen, fit for a terminal."""
    return ascii(name)[1:-1]


def _block(file: BinaryIO) -> bytes:
    block = file.read(BLOCK)
    if len(block) != BLOCK:
        raise tarfile.ReadError("it ends in the middle")
    return block
