"""Follows growing files that another program writes, by looking from time to time. Blocking I/O, no asyncio.

Files are closed after every look, and lines consumed up to the last newline. A file is new when it is smaller than what
has been read of it, or when its first 256 bytes, or the last ones that were read, have changed.
"""

import copy
import glob
import os
from dataclasses import dataclass
from pathlib import Path

from config.files import without_waiting

HEAD_BYTES = 256
"""Bytes at the beginning of a file by which it is known again."""
LOOK_BYTES = 65536
"""Bytes that one look reads at most, so that a long file comes in pieces."""
CATCH_UP_FILES = 32
"""How many files before the newest are read again after a restart, for rows that were missed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What one look at a file found."""

    path: Path
    lines: tuple[tuple[int, bytes], ...] = ()
    """New lines with their numbers from 1."""
    restarted: bool = False
    """The file is another than at the last look; its lines count from 1 again."""
    overlong: tuple[int, ...] = ()
    """Numbers of lines that were longer than allowed and have been skipped."""
    more: bool = False
    """There is more to read at once."""
    encoding: str | None = None
    """What the file's first bytes say of it, whatever it should be."""


MARKS = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}
"""Byte order marks at the beginning of a file -> its encoding."""


def line_ends(head: bytes) -> tuple[bytes, str | None]:
    """Return what ends a line of a file that begins so, and what that says of its encoding."""
    if encoding := MARKS.get(head[:2]):
        return "\n".encode(encoding), encoding
    return (b"\r" if b"\n" not in head and b"\r" in head[:-1] else b"\n"), None


class FileTail:
    def __init__(self, path: Path, max_line_bytes: int) -> None:
        self.path = path
        self._max_line_bytes = max_line_bytes
        self._look_bytes = max(LOOK_BYTES, max_line_bytes + 2) // 2 * 2
        self._seen: tuple[int, int] | None = None
        self._head = b""
        self._restart()

    def _restart(self) -> None:
        self._offset = 0
        self._number = 0
        self._last = b""
        self._skipping = False

    def look(self) -> Look:
        """Return what is new; raises OSError when the file cannot be read now."""
        state = self.path.stat()
        now = (state.st_size, state.st_mtime_ns)
        if now == self._seen:
            return Look(path=self.path)
        with open(self.path, "rb", buffering=0, opener=without_waiting) as file:
            restarted = self._is_another(file.fileno())
            if restarted:
                self._restart()
            self._head = os.pread(file.fileno(), HEAD_BYTES, 0)
            data = os.pread(file.fileno(), self._look_bytes, self._offset)
        more = len(data) == self._look_bytes
        self._seen = None if more else now
        newline, encoding = line_ends(self._head)
        lines, overlong = self._consume(data, newline)
        return Look(path=self.path, lines=lines, restarted=restarted, overlong=overlong, more=more, encoding=encoding)

    def _is_another(self, descriptor: int) -> bool:
        if os.fstat(descriptor).st_size < self._offset:
            return True
        if os.pread(descriptor, len(self._head), 0) != self._head:
            return True
        return os.pread(descriptor, len(self._last), self._offset - len(self._last)) != self._last

    def _consume(self, data: bytes, newline: bytes) -> tuple[tuple[tuple[int, bytes], ...], tuple[int, ...]]:
        lines: list[tuple[int, bytes]] = []
        overlong: list[int] = []
        at = 0
        while (end := _line_end(data, at, newline)) > 0:
            self._number += 1
            if self._skipping or end - at > self._max_line_bytes:
                overlong.append(self._number)
                self._skipping = False
            else:
                lines.append((self._number, data[at:end]))
            at = end
        if len(data) - at > self._max_line_bytes or (self._skipping and at < len(data)):
            self._skipping = True
            at = len(data) - len(data) % len(newline)
        self._offset += at
        self._last = (self._last + data[:at])[-HEAD_BYTES:]
        return tuple(lines), tuple(overlong)


def _line_end(data: bytes, at: int, newline: bytes) -> int:
    """Return where the line that begins at `at` ends, 0 where it does not end yet."""
    end = data.find(newline, at)
    while end >= 0 and (end - at) % len(newline):  # half of one character and half of the next
        end = data.find(newline, end + 1)
    return end + len(newline) if end >= 0 else 0


class FileFollower:
    """A file, or all files that match a pattern, oldest first."""

    def __init__(self, pattern: Path, max_line_bytes: int, *, catch_up: bool) -> None:
        self._pattern = str(pattern)
        self._is_pattern = glob.has_magic(self._pattern)
        self._max_line_bytes = max_line_bytes
        self._before = CATCH_UP_FILES if catch_up else 0
        self._tails: dict[Path, FileTail] = {}
        self._ignored: dict[Path, tuple[int, int]] | None = None

    def look(self) -> tuple[Look | None, str | None]:
        """Return the first file with something new, and why nothing could be read if that is so."""
        paths = self._paths()
        if not paths:
            return None, "no file matches the pattern"
        cause: str | None = None
        for path in paths:
            tail = self._tails.get(path)
            if tail is None:
                tail = self._tails[path] = FileTail(path, self._max_line_bytes)
            before = copy.copy(tail)
            try:
                look = tail.look()
            except OSError as error:
                cause = f"{path.name} cannot be read now: {error.strerror or error}"
                continue
            if look.restarted and not set(self._paths()) <= set(paths):
                self._tails[path] = before  # what it was has another name now, and what was not read of it comes first
                return self.look()
            cause = None
            if look.lines or look.restarted or look.overlong or look.more:
                return look, None
        return None, cause

    def _paths(self) -> list[Path]:
        """Return the files to look at, oldest first; at first those before the newest are left out."""
        if not self._is_pattern:
            return [Path(self._pattern)]
        states: dict[Path, tuple[int, int]] = {}
        for name in glob.glob(self._pattern):  # noqa: PTH207 - the pattern may span folders
            try:
                state = Path(name).stat()
            except OSError:
                continue  # it went away between the two calls, or its share did; the next look sees it again
            states[Path(name)] = (state.st_size, state.st_mtime_ns)
        ordered = sorted(states, key=lambda path: (states[path][1], path))
        if self._ignored is None:
            if not ordered:
                return []
            self._ignored = {path: states[path] for path in ordered[: -1 - self._before]}
        self._ignored = {path: state for path, state in self._ignored.items() if states.get(path, state) == state}
        return [path for path in ordered if path not in self._ignored]
