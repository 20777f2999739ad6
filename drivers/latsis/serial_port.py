"""A serial port for one reader thread: opened, read and closed there, stopped from anywhere.

Ports are opened by pyserial. Where the port has a file descriptor (serial ports, pseudo-terminals,
`socket://`) the thread waits on it and on a stop pipe at once, so that it wakes for bytes and for
nothing else; other kinds (`loop://`, `rfc2217://`) are polled.
"""

import contextlib
import errno
import io
import os
import select
import threading
from pathlib import Path

import serial

from drivers.contract import FatalDriverError, LinkError

READ_BYTES = 4096
"""Size of the kernel's buffer of a serial port, the most that one read can return."""
POLLED_WAIT_S = 0.2
"""How long a port without a file descriptor is read before the stop signal is looked at."""


class StopSignal:
    """Tells a thread to end, whatever it waits for."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._lock = threading.Lock()
        self.descriptor, self._write_end = os.pipe()
        self._open = True

    def set(self) -> None:
        """Tell the thread to end."""
        self._event.set()
        with self._lock:
            if self._open:
                os.write(self._write_end, b"x")

    def is_set(self) -> bool:
        """Return whether the thread is to end."""
        return self._event.is_set()

    def wait(self, duration_s: float) -> bool:
        """Wait for the signal, at most `duration_s`; return whether it came."""
        return self._event.wait(duration_s)

    def release(self) -> None:
        """Close the pipe; to be called by the thread when it ends."""
        with self._lock:
            if self._open:
                self._open = False
                os.close(self.descriptor)
                os.close(self._write_end)


class SerialPort:
    """One open port. Every error is a LinkError (or FatalDriverError) that names owner and port."""

    def __init__(self, port: str, baud: int, owner: str, stop: StopSignal) -> None:
        self._name = f"{owner}: port {port}"
        self._stop = stop
        # A lock is known to ports of this computer only.
        exclusive = None if "://" in port else True
        try:
            self._serial = serial.serial_for_url(port, baudrate=baud, timeout=POLLED_WAIT_S, exclusive=exclusive)
        except serial.SerialException as error:
            raise LinkError(f"{self._name} {_why_not_opened(port, error)}") from error
        except ValueError as error:
            raise FatalDriverError(f"{self._name} cannot be used: {error}") from error
        self._poll: select.poll | None = None
        with contextlib.suppress(io.UnsupportedOperation):
            self._descriptor = self._serial.fileno()
            self._poll = select.poll()
            self._poll.register(self._descriptor, select.POLLIN)
            self._poll.register(stop.descriptor, select.POLLIN)

    def read(self) -> bytes:
        """Wait for bytes and return all that are there; nothing when stopped, or sometimes for no reason."""
        try:
            return self._read_polled() if self._poll is None else self._read_descriptor(self._poll)
        except OSError as error:  # of which serial.SerialException is a kind
            raise LinkError(f"{self._name} went away (unplugged?): {error}") from error

    def _read_descriptor(self, poll: select.poll) -> bytes:
        poll.poll()
        if self._stop.is_set():
            return b""
        try:
            data = os.read(self._descriptor, READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise LinkError(f"{self._name} went away (unplugged, or the other side has hung up)")
        return data

    def _read_polled(self) -> bytes:
        data = bytes(self._serial.read(1))
        return data + bytes(self._serial.read(self._serial.in_waiting)) if data else data

    def write(self, data: bytes) -> None:
        """Send bytes (the LATSIS protocol never does; a loop-back test does)."""
        self._serial.write(data)

    def close(self) -> None:
        """Close the port. Never raises: an unplugged port raises once more when it is closed."""
        with contextlib.suppress(OSError, TypeError):
            self._serial.close()


def _why_not_opened(port: str, error: serial.SerialException) -> str:
    """Return why a port did not open and what to do about it."""
    code = error.errno
    if code in {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return (
            "does not exist: plug the adapter in, or correct `port` in the configuration "
            "(`ls -l /dev/serial/by-id /dev/serial/by-path` lists the ports that are there)"
        )
    if code in {errno.EACCES, errno.EPERM}:
        return (
            "may not be opened (permission denied): add the account that runs the daemon to the group that "
            "owns the port, usually dialout (`sudo usermod -aG dialout ACCOUNT`), and restart the daemon"
        )
    if code in {errno.EBUSY, errno.EAGAIN}:
        return f"is in use by another program: stop that program (`fuser {port}` names it)"
    if "://" not in port and Path(port).exists() and not Path(port).is_char_device():
        return "is not a serial port: correct `port` in the configuration"
    return f"cannot be opened: {error}"
