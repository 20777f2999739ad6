"""Reads and writes whole files, and computes the digest of their content."""

import errno
import hashlib
import os
import stat
from pathlib import Path

LARGEST_FILE = 64 * 2**20
"""No model, record, key or certificate is larger [byte]."""


def read_whole(path: Path, most: int = LARGEST_FILE) -> bytes:
    """Return what a file holds; raises OSError, also for a larger one, and for a pipe or a device without an end."""
    with open(path, "rb", opener=without_waiting) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, no file", str(path))
        content = b"" if found.st_size > most else file.read(most + 1)
    if max(found.st_size, len(content)) > most:
        raise OSError(errno.EFBIG, f"it is longer than {most} byte, more than any such file", str(path))
    return content


def read_closed(path: Path) -> bytes:
    """Return what a file with a secret holds; raises OSError, also where every user of this computer may read it.

    The group may: systemd gives a service its credentials by an access list, which shows as the group's.
    """
    content, mode = read_whole(path), stat.S_IMODE(path.stat().st_mode)
    if mode & stat.S_IRWXO:
        open_to_all = f"it is open to every user of this computer (mode {mode:o}); run: chmod o-rwx {path}"
        raise OSError(errno.EACCES, open_to_all, str(path))
    return content


def without_waiting(path: str, flags: int) -> int:
    """Open a file for `open`; a pipe that nobody writes to is opened at once too, as an empty one."""
    return os.open(path, flags | os.O_NONBLOCK)


def write_whole(path: Path, content: str | bytes, mode: int | None = None) -> None:
    """Put a file in its place in one step that outlasts a power failure; raises OSError, and the old one then stands.

    Without a `mode` the file has the permissions of a new one.
    """
    if mode is None and path.exists() and not (path.is_file() or path.is_dir()):
        path.write_bytes(content.encode() if isinstance(content, str) else content)  # /dev/stdout stays what it is
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC  # a link that is put there is not followed
        with os.fdopen(os.open(temporary, flags, 0o666 if mode is None else mode), "wb") as file:
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


def stamp_of(*paths: Path) -> tuple[tuple[int, int, int], ...]:
    """Return what changes when one of the files is replaced or written; empty where one cannot be looked at."""
    try:
        return tuple((each.st_ino, each.st_size, each.st_mtime_ns) for each in (path.stat() for path in paths))
    except OSError:
        return ()
