"""A pseudo-terminal that stands for a USB serial adapter: it has a stable name, and it can be pulled out.

A pty carries bytes only: there is no baud rate, parity or break on it. As with a real UART, what is
sent while nobody has the port open is lost.
"""

import contextlib
import os
import pty
import select
import termios
import tty
from pathlib import Path

MAX_BACKLOG_BYTES = 1 << 18
"""More than this waiting for a slow reader is an overrun: it is dropped."""


class PtyPort:
    """The far end of a simulated serial port; the near end is opened under the name `link`."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.bytes_dropped = 0
        """Bytes lost to a reader that was absent or too slow."""
        self._master: int | None = None
        self._device = ""
        self._backlog = bytearray()
        self._poll = select.poll()

    @property
    def plugged(self) -> bool:
        return self._master is not None

    @property
    def descriptor(self) -> int:
        """The far end, while the port exists."""
        assert self._master is not None
        return self._master

    def plug(self) -> None:
        """Make the port appear under its name."""
        if self._master is not None:
            return
        self._master, near = pty.openpty()
        tty.setraw(near)
        self._device = os.ttyname(near)
        os.close(near)
        os.set_blocking(self._master, False)
        self._poll.register(self._master, select.POLLOUT)
        fresh = self.link.with_name(f".{self.link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._device)
        fresh.replace(self.link)

    def unplug(self) -> None:
        """Make the port vanish; a reader gets a hang-up. Does nothing when it is not there."""
        if self._master is None:
            return
        with contextlib.suppress(OSError):
            if self.link.readlink() == Path(self._device):
                self.link.unlink()
        self._poll.unregister(self._master)
        os.close(self._master)
        self._master = None
        self._drop()

    def write(self, data: bytes) -> None:
        """Send bytes without ever waiting; what a present reader cannot take yet is kept for the next call."""
        self._backlog += data
        if self._master is None:
            self._drop()
        elif not self._reader_present():
            termios.tcflush(self._master, termios.TCOFLUSH)
            self._drop()
        elif self._backlog:
            self._send(self._master)

    def _send(self, master: int) -> None:
        with contextlib.suppress(BlockingIOError):
            del self._backlog[: os.write(master, self._backlog)]
        if len(self._backlog) > MAX_BACKLOG_BYTES:
            self._drop()

    def _reader_present(self) -> bool:
        return not any(events & select.POLLHUP for _, events in self._poll.poll(0))

    def _drop(self) -> None:
        self.bytes_dropped += len(self._backlog)
        self._backlog.clear()
