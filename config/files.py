"""Writes files whole or not at all, and computes the digest of their content."""

import hashlib
import os
from pathlib import Path
from typing import IO


def write_whole(path: Path, content: str | bytes, mode: int | None = None) -> None:
    """Put a file in its place in one step that outlasts a power failure; raises OSError, and the old one then stands.

    Without a `mode` the file has the permissions of a new one.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Let what was put into a folder outlast a power failure; raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256_of(content: bytes) -> str:
    """Return the digest by which records name the content of a file."""
    return hashlib.sha256(content).hexdigest()


def sha256_of_stream(stream: IO[bytes]) -> str:
    """Return the digest of what is left in a stream."""
    digest = hashlib.sha256()
    while chunk := stream.read(2**20):
        digest.update(chunk)
    return digest.hexdigest()
