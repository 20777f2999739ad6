"""What brings the bytes of a LATSIS line into the event loop; on a serial port, a thread."""

import asyncio
import contextlib
import threading
from typing import Protocol

from config.schema.temperatures import LineConfig
from drivers.clock import Clock
from drivers.latsis.pacing import ReadPacer
from drivers.latsis.serial_port import SerialPort, StopSignal
from models.records import Instant


class ByteInbox(Protocol):
    """Where a reader puts what it reads."""

    @property
    def earliest_end(self) -> int:
        """Byte of the stream before which the cycle under way, or the next one, cannot be complete."""
        ...

    def put(self, data: bytes, arrived: Instant) -> None:
        """Queue bytes; may be called in any thread."""
        ...

    def fail(self, error: Exception) -> None:
        """Queue the error that ended the reading; may be called in any thread."""
        ...

    def wake(self) -> None:
        """Have the queue looked at; to be called in the event loop."""
        ...


class LineReader(Protocol):
    """Reads one line, once."""

    def start(self, inbox: ByteInbox) -> None:
        """Begin to read; called in the event loop."""
        ...

    async def stop(self) -> None:
        """End reading and release the port; returns when it is released. May be called more than once."""
        ...


class PortReader:
    """A thread that opens the line's port, stamps the bytes as soon as they are read, and closes it."""

    def __init__(self, line: LineConfig, clock: Clock) -> None:
        self._line = line
        self._clock = clock
        self._ended = asyncio.Event()
        self._stop: StopSignal | None = None
        self._thread: threading.Thread | None = None

    def start(self, inbox: ByteInbox) -> None:
        """Start the thread."""
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
            inbox.put(data, arrived)
            loop.call_soon_threadsafe(inbox.wake)
            pause_s = pacer.pause_real_s(len(data), arrived, inbox.earliest_end)
            if pause_s > 0:
                stop.wait(pause_s)

    def _on_thread_end(self, inbox: ByteInbox) -> None:
        self._ended.set()
        inbox.wake()
