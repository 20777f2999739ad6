"""What our macros may hold, kept beside the store from before a write is sent.

The audit's commit takes a disk's time and the write does not wait for it, so a daemon that is
killed in between would find a block in the CNC that its audit does not know. These few bytes are
handed to the operating system before the first macro goes out: they survive the process.
"""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path

import structlog

log = structlog.get_logger(__name__)

LONGEST_LINE = 4096
"""The file is one line of at most so many bytes, written by one call."""


class WriteAheadRecord:
    """One small file, overwritten in place with every write to the CNC."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    @classmethod
    def beside(cls, store: Path) -> "WriteAheadRecord":
        """Return the file that belongs to a store."""
        return cls(store.with_name(store.name + ".last-block"))

    @classmethod
    def of_speed(cls, store: Path) -> "WriteAheadRecord":
        """Return the file for the block of the spindle speed, which is written apart."""
        return cls(store.with_name(store.name + ".last-speed"))

    def keep(self, possible: Mapping[int, tuple[float, ...]]) -> None:
        """Hand what the macros may hold to the operating system; a failure is logged, the audit then stands alone."""
        content = json.dumps({str(number): values for number, values in possible.items()}).encode()
        line = f"{zlib.crc32(content):08x} ".encode() + content + b"\n"
        try:
            if len(line) > LONGEST_LINE:
                raise OSError(f"{len(line)} bytes are more than {LONGEST_LINE}")
            if self._descriptor is None:
                self._descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o640)
            os.pwrite(self._descriptor, line, 0)
        except OSError as error:
            log.error("last_block.unwritten", path=str(self._path), problem=str(error))

    def load(self) -> dict[int, tuple[float, ...]] | None:
        """Return what was kept last; None where there is no whole line."""
        try:
            with self._path.open("rb") as file:
                checksum, _, content = file.readline(LONGEST_LINE).rstrip(b"\n").partition(b" ")
        except OSError:
            return None
        if checksum != f"{zlib.crc32(content):08x}".encode():
            return None
        return {int(number): tuple(values) for number, values in json.loads(content).items()}

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
