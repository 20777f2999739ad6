"""Keeps what our macros may hold in a file beside the store, from before a write is sent.

The write does not wait for the audit's commit, so a daemon that is killed in between would find a block that its audit
does not know. These bytes survive the process, not a power cut, after which an older line may stand here than in the
audit: the line names its write, and the newer of the two counts. A last line says that the store could not be written:
nothing that such a store holds is gone on with.
"""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path

import structlog

from daemon.history.intake import Commit
from daemon.history.writer import HistoryWriter

log = structlog.get_logger(__name__)

LONGEST_LINE = 4096
"""The file's lines have together at most so many bytes, written by one call: values, the write's number, BEHIND."""
BEHIND = b"the store is behind\n"

Possible = Mapping[int, tuple[float, ...]]


class WriteAheadRecord:
    """One small file, overwritten in place with every write to the CNC."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None
        self._length = 0
        """Length of the file, as far as it is ours."""
        self._identity = (0, 0)
        """Device and number of the open file."""
        self._caught_up: Commit | None = None
        self._problem = ""
        content = self._content()
        self.behind = BEHIND in content
        """The store lacks what was to be recorded last."""
        self._lines = b"".join((*content.splitlines(keepends=True), b"\n", b"\n")[:2])

    @classmethod
    def beside(cls, store: Path) -> "WriteAheadRecord":
        """Return the file that belongs to a store."""
        return cls(store.with_name(store.name + ".last-block"))

    @classmethod
    def of_speed(cls, store: Path) -> "WriteAheadRecord":
        """Return the file for the block of the spindle speed, which is written apart."""
        return cls(store.with_name(store.name + ".last-speed"))

    def keep(self, possible: Possible, write_id: int | None = None) -> None:
        """Hand to the operating system what the macros may hold from write `write_id` on; a failure is logged."""
        content = json.dumps({str(number): values for number, values in possible.items()}).encode()
        line = _checksum(content) + b" " + content + b"\n"
        if write_id is not None:
            number = str(write_id).encode()
            line += _checksum(content + number) + b" " + number
        self._lines = line + b"\n"
        self._write()

    def follow(self, history: HistoryWriter, *, begun: bool) -> None:
        """Keep whether the store lacks anything; what it lacks of the run before counts until the output has begun."""
        behind = bool(history.problem)
        if behind:
            self._caught_up = None
        elif self.behind:
            if begun and self._caught_up is None:
                self._caught_up = history.submit(lambda _connection: None)
            behind = self._caught_up is None or not self._caught_up.done
        if behind is not self.behind:
            self.behind = behind
            self._write()

    def _write(self) -> None:
        content = self._lines + (BEHIND if self.behind else b"")
        try:
            if len(content) > LONGEST_LINE:
                raise OSError(f"{len(content)} bytes are more than {LONGEST_LINE}")
            descriptor = self._opened()
            # Never cut short: that would wait for the file system's journal.
            self._length = max(self._length, len(content))
            os.pwrite(descriptor, content.ljust(self._length, b"\n"), 0)
            self._problem = ""
        except OSError as error:
            if str(error) != self._problem:
                self._problem = str(error)
                log.error("last_block.unwritten", path=str(self._path), problem=self._problem)

    def _opened(self) -> int:
        """Return the file's descriptor; a file that was deleted or replaced meanwhile is opened anew."""
        if self._descriptor is not None:
            try:
                there = os.stat(self._path)  # noqa: PTH116 (on the way to the macro)
            except FileNotFoundError:
                there = None
            if there is None or (there.st_dev, there.st_ino) != self._identity:
                self.close()
        if self._descriptor is None:
            self._descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o640)
            opened = os.fstat(self._descriptor)
            self._length, self._identity = min(opened.st_size, LONGEST_LINE), (opened.st_dev, opened.st_ino)
        return self._descriptor

    def load(self) -> dict[int, tuple[float, ...]] | None:
        """Return what was kept last; None where there is no whole line."""
        kept = self._read()
        return None if kept is None else kept[0]

    def newer_of(
        self, audit: Possible | None, last_write_id: int | None
    ) -> tuple[dict[int, tuple[float, ...]] | None, str]:
        """Return what the macros may hold by the audit and this file, and what of it the audit does not know, in words.

        The newer of the two counts, by the numbers of their writes; where the file does not say which write it
        belongs to (version 0.1.0), both do. None where nothing was ever written.
        """
        known, kept = None if audit is None else dict(audit), self._read()
        if kept is None:
            return known, ""
        possible, write_id = kept
        if write_id is not None and last_write_id is not None and write_id <= last_write_id:
            return known, ""
        if write_id is None:
            audited = {n: tuple(v for v in (known or {}).get(n, ()) if v not in possible[n]) for n in possible}
            both = {n: (*audited[n], *values) for n, values in possible.items()}
            return {**(known or {}), **both}, _not_in(known or {}, possible)
        return {**(known or {}), **possible}, _not_in(known or {}, possible)

    def unaudited(self, last_write_id: int | None) -> tuple[int, tuple[tuple[int, float], ...]] | None:
        """Return number and macros of a write that the audit, whose newest has the given number, has not got."""
        kept = self._read()
        if kept is None or kept[1] is None or kept[1] <= (last_write_id or 0):
            return None
        return kept[1], tuple((number, values[-1]) for number, values in kept[0].items() if values)

    def _read(self) -> tuple[dict[int, tuple[float, ...]], int | None] | None:
        """Return what was kept last, and the number of its write; None where there is no whole line."""
        content, _, rest = self._content().partition(b"\n")
        checksum, _, content = content.partition(b" ")
        if checksum != _checksum(content):
            return None
        checksum, _, number = rest.partition(b"\n")[0].partition(b" ")
        write_id = int(number) if number.isdigit() and checksum == _checksum(content + number) else None
        return {int(number): tuple(values) for number, values in json.loads(content).items()}, write_id

    def _content(self) -> bytes:
        try:
            with self._path.open("rb") as file:
                return file.read(LONGEST_LINE)
        except OSError:
            return b""

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _checksum(content: bytes) -> bytes:
    return f"{zlib.crc32(content):08x}".encode()


def _not_in(known: Possible, kept: Possible) -> str:
    """Return in words the macros whose last value the audit does not know."""
    lost = {number: values[-1] for number, values in kept.items() if values and values[-1] not in known.get(number, ())}
    return ", ".join(f"#{number} {value:g}" for number, value in lost.items())
