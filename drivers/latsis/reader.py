"""Brings the bytes of a LATSIS line into the event loop; on a serial port, by a thread.

Ports are opened by pyserial. Where the port has a file descriptor (serial ports, pseudo-terminals, `socket://`) the
thread waits on it and on a stop pipe at once, so that it wakes for bytes and for nothing else; other kinds
(`loop://`, `rfc2217://`) are polled. In the middle of a pass nothing depends on a single byte, so the reader sleeps,
never beyond the moment at which the line, at its baud rate, can have delivered the last one.
"""

import asyncio
import contextlib
import errno
import io
import os
import select
import termios
import threading
from pathlib import Path
from typing import Protocol

import serial

from config.schema.temperatures import LineConfig
from drivers.clock import Clock
from drivers.contract import FatalDriverError, LinkError
from models.records import Instant

READ_BYTES = 4096
"""Size of the kernel's buffer of a serial port, the most that one read can return."""
POLLED_WAIT_S = 0.2
"""How long a port without a file descriptor is read before the stop signal is looked at."""


BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
LONGEST_PAUSE_REAL_S = 0.2
"""Bounds the delay where a pass ends earlier than expected (the tail of the chain sends nothing)."""
SHORTEST_PAUSE_REAL_S = 0.0003
"""A shorter sleep costs more than it saves."""
FINAL_BYTES = 4
"""The reader is awake for so many bytes before the last, should the operating system wake it late."""
LARGEST_PAUSE_BYTES = 1024
"""No sleep lets more bytes pile up: a quarter of the kernel's buffer of a serial port."""
BAUD_MARGIN = 0.95
"""The sender's clock may be this much too fast (an asynchronous receiver tolerates 5 %)."""
PACKET_BYTES = 64
"""Bytes that a USB adapter delivers together although they came one after another."""
PACKET_REAL_S = 0.02
"""How long a USB adapter may collect them (the latency timer of common ones is 16 ms)."""


class ReadPacer:
    """Decides, after each read, how long the reader sleeps.

    A sender that is faster than the baud rate (a simulated line, a network) cannot be predicted;
    its reader never sleeps.
    """

    def __init__(self, baud: int, speed: float) -> None:
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._speed = speed
        self._read = 0
        self._credit: float = PACKET_BYTES
        self._last_real_s: float | None = None
        self._pause_real_s = 0.0

    def pause_real_s(self, count: int, arrived: Instant, earliest_end: int) -> float:
        """Take a read of `count` bytes; return how long to sleep [s of this computer].

        `earliest_end` is the byte of the stream before which the cycle cannot be complete.
        """
        self._read += count
        if self._is_faster(count, arrived.real_s):
            self._pause_real_s = 0.0
            return 0.0
        awaited = min(earliest_end - self._read - FINAL_BYTES, LARGEST_PAUSE_BYTES)
        pause_s = min(awaited / self._bytes_per_s * BAUD_MARGIN / self._speed, LONGEST_PAUSE_REAL_S)
        self._pause_real_s = pause_s if pause_s >= SHORTEST_PAUSE_REAL_S else 0.0
        return self._pause_real_s

    def _is_faster(self, count: int, now_real_s: float) -> bool:
        """Return whether more bytes came than the line can have delivered since the last read.

        Only the sleep and one packet's time count: a reader that waits for bytes misses none.
        """
        elapsed_s = 0.0 if self._last_real_s is None else now_real_s - self._last_real_s
        self._last_real_s = now_real_s
        elapsed_s = min(elapsed_s, self._pause_real_s + PACKET_REAL_S)
        earned = elapsed_s * self._speed * self._bytes_per_s / BAUD_MARGIN
        self._credit = max(-PACKET_BYTES, min(PACKET_BYTES, self._credit + earned - count))
        return self._credit < 0


class StopSignal:
    """Tells a thread to end, whatever it waits for."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._lock = threading.Lock()
        self.descriptor, self._write_end = os.pipe()
        self._open = True

    def set(self) -> None:
        self._event.set()
        with self._lock:
            if self._open:
                os.write(self._write_end, b"x")

    def is_set(self) -> bool:
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
        except (serial.SerialException, termios.error) as error:
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

    def close(self) -> None:
        """Close the port. Never raises: an unplugged port raises once more when it is closed."""
        with contextlib.suppress(OSError, TypeError):
            self._serial.close()


def _why_not_opened(port: str, error: serial.SerialException | termios.error) -> str:
    """Return why a port did not open and what to do about it."""
    code = getattr(error, "errno", None)  # one that does not take its baud rate, or is unplugged just then, has none
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


OVERFLOW_PAUSE_REAL_S = 0.05
"""How long the thread leaves a line alone that brings more than is taken."""


class ByteInbox(Protocol):
    """Where a reader puts what it reads."""

    @property
    def earliest_end(self) -> int:
        """Byte of the stream before which the cycle under way, or the next one, cannot be complete."""

    def put(self, data: bytes, arrived: Instant) -> bool:
        """Queue bytes; return False when they were dropped. May be called in any thread."""

    def fail(self, error: Exception) -> None:
        """Queue the error that ended the reading; may be called in any thread."""

    def wake(self) -> None:
        """Have the queue looked at; to be called in the event loop."""


class LineReader(Protocol):
    """Reads one line, once."""

    def start(self, inbox: ByteInbox) -> None:
        """Begin to read; called in the event loop."""

    async def stop(self) -> None:
        """End reading and release the port; returns when it is released. May be called more than once."""


class PortReader:
    """A thread that opens the line's port, stamps the bytes as soon as they are read, and closes it."""

    def __init__(self, line: LineConfig, clock: Clock) -> None:
        self._line = line
        self._clock = clock
        self._ended = asyncio.Event()
        self._stop: StopSignal | None = None
        self._thread: threading.Thread | None = None

    def start(self, inbox: ByteInbox) -> None:
        self._stop = StopSignal()
        self._thread = threading.Thread(
            target=self._read_port,
            args=(asyncio.get_running_loop(), inbox, self._stop),
            name=f"latsis-{self._line.name}",
            daemon=True,
        )
        self._thread.start()

    async def stop(self) -> None:
        """End the thread and wait until it has closed the port."""
        if self._thread is None or self._stop is None:
            return
        self._stop.set()
        await self._ended.wait()
        self._thread.join()

    def _read_port(self, loop: asyncio.AbstractEventLoop, inbox: ByteInbox, stop: StopSignal) -> None:
        """Body of the reader thread."""
        port: SerialPort | None = None
        try:
            port = SerialPort(self._line.port, self._line.baud, f"line {self._line.name}", stop)
            self._read_until(loop, inbox, port, stop)
        except Exception as error:
            # Whatever it is, the consumer gets it: it is raised again in `cycles`.
            inbox.fail(error)
        finally:
            if port is not None:
                port.close()
            stop.release()
            with contextlib.suppress(RuntimeError):  # the loop has been closed meanwhile
                loop.call_soon_threadsafe(self._on_thread_end, inbox)

    def _read_until(
        self, loop: asyncio.AbstractEventLoop, inbox: ByteInbox, port: SerialPort, stop: StopSignal
    ) -> None:
        pacer = ReadPacer(self._line.baud, self._clock.speed)
        while not stop.is_set():
            data = port.read()
            arrived = self._clock.now()
            if not data:
                continue
            if not inbox.put(data, arrived):
                stop.wait(OVERFLOW_PAUSE_REAL_S)
                continue
            loop.call_soon_threadsafe(inbox.wake)
            pause_s = pacer.pause_real_s(len(data), arrived, inbox.earliest_end)
            if pause_s > 0:
                stop.wait(pause_s)

    def _on_thread_end(self, inbox: ByteInbox) -> None:
        self._ended.set()
        inbox.wake()
