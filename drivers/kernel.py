"""Sensors and analog inputs that the kernel of this computer reads: 1-Wire, hwmon, IIO."""

import asyncio
import contextlib
import re
import threading
from collections.abc import Callable
from pathlib import Path

from config.schema.source_drivers import SourceEntry
from config.schema.source_sections import KernelFiles, is_one_wire
from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.polling import PolledSource
from drivers.readings import NoReading, Readings
from models.quality import Reason

MOST_BYTES = 64
"""A file of one number holds no more; of more is not quoted."""
_NUMBER = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,9})?")
_W1_SLAVE = re.compile(r" crc=[0-9a-f]{2} YES\s.* t=-?[0-9]+$", re.DOTALL)
BULK = "therm_bulk_read"
"""File of a 1-Wire bus that has all its sensors convert at once."""


class KernelSource(PolledSource):
    """Reads each sensor's file in a thread of its own, because a 1-Wire sensor converts for most of a second."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        super().__init__(source, clock)
        assert isinstance(source.connection, KernelFiles)
        self._config = source.connection
        self._busy: set[Path] = set()

    async def open(self) -> None:
        """Nothing is held open."""

    async def read(self) -> Readings:
        """Return the number of each sensor; raises LinkError when none of the files can be read."""
        paths = [each.path for each in self._config.every_input]
        one_wire = next((path for path in paths if is_one_wire(path)), None)
        if one_wire is not None:  # on a second bus each sensor converts when it is read
            await self._in_thread(one_wire, convert_all)
        found = await asyncio.gather(*(self._in_thread(path, number_in) for path in paths))
        if all(isinstance(each, NoReading) and each.reason == Reason.NOT_RECEIVED for each in found):
            assert isinstance(found[0], NoReading)
            raise LinkError(f"source {self.name}: no sensor can be read; the first one {found[0].why}")
        return {each.key: number for each, number in zip(self._config.every_input, found, strict=True)}

    async def release(self) -> None:
        """Nothing is held open; a thread that waits for the kernel ends with it."""

    async def _in_thread(self, path: Path, work: Callable[[Path], float | NoReading]) -> float | NoReading:
        """Return what a file holds; a file whose last reader still waits has none."""
        if path in self._busy:
            return NoReading(reason=Reason.NOT_RECEIVED, why=f"has not answered since it was last read: {path}")
        self._busy.add(path)
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[float | NoReading] = loop.create_future()

        def settle(result: float | NoReading) -> None:
            self._busy.discard(path)
            if not answer.done():
                answer.set_result(result)

        def read() -> None:
            result = work(path)
            with contextlib.suppress(RuntimeError):  # the loop has been closed meanwhile
                loop.call_soon_threadsafe(settle, result)

        threading.Thread(target=read, name=f"kernel-{self.name}", daemon=True).start()
        done, _ = await asyncio.wait({answer}, timeout=self._config.timeout_s)
        if not done:
            return NoReading(
                reason=Reason.NOT_RECEIVED,
                why=f"has not answered within {self._config.timeout_s:g} s: {path}; check the bus and its wires",
            )
        return answer.result()


def number_in(path: Path) -> float | NoReading:
    """Return the number that a file of the kernel holds; blocks while the sensor converts."""
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES * 4).decode("ascii", errors="replace").strip()
    except OSError as error:
        why = f"cannot be read: {path}: {error.strerror or error}; check that it is plugged in, and `path`"
        return NoReading(reason=Reason.NOT_RECEIVED, why=why)
    return number_of(text, path)


def number_of(text: str, path: Path) -> float | NoReading:
    """Return the number in the text of such a file: the number alone, or what w1_slave says with its check."""
    if " crc=" in text:
        if not _W1_SLAVE.search(text):
            why = f"sent a value whose check does not fit: {path}; check the wires, their length and the pull-up"
            return NoReading(reason=Reason.DEVICE_ERROR, why=why)
        text = text.rpartition("t=")[2]
    if not _NUMBER.fullmatch(text):
        why = f"gives no number but {text[:MOST_BYTES]!r}: {path}; check the wires"
        return NoReading(reason=Reason.UNREADABLE, why=why)
    return float(text)


def convert_all(path: Path) -> float:
    """Have all sensors of a 1-Wire bus convert at once, where the daemon's account may and the bus can."""
    with contextlib.suppress(OSError):
        (path.resolve().parent.parent / BULK).write_text("trigger\n", encoding="ascii")
    return 0.0
