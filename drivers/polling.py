"""A source that is asked for all its sensors once in each cycle period."""

import asyncio
import contextlib
from abc import abstractmethod
from collections.abc import AsyncGenerator

from config.schema.source_drivers import SourceEntry
from drivers.clock import Clock
from drivers.readings import Readings, Row, RowMaker, RowSource
from models.records import Trace


class PolledSource(RowSource):
    """Asks at fixed times, to be used once.

    A row begins when it is asked for, because no value in it may be older; a row whose time has passed is left out.
    """

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        self.name = source.name
        self._period_s = source.cycle_period_s
        self._clock = clock
        self._maker = RowMaker(source)
        self._started = False
        self._closed = asyncio.Event()

    async def rows(self) -> AsyncGenerator[Row]:
        """Open the source and yield each row as it completes; raises LinkError when the source is lost."""
        if self._started or self._closed.is_set():
            raise RuntimeError(f"source {self.name}: it is used once; build a new one to open it again")
        self._started = True
        try:
            await self.open()
            due_s = self._clock.now().monotonic_s
            while not self._closed.is_set():
                first = self._clock.now()
                found = await self.read()
                readings = {key: self._maker.of_one_device(key, reading) for key, reading in found.items()}
                last = self._clock.now()
                if self._closed.is_set():
                    return
                yield self._maker.row(readings, Trace(first_byte=first, last_byte=last), self.problems())
                behind = (self._clock.now().monotonic_s - due_s) // self._period_s
                due_s += self._period_s * (max(behind, 0.0) + 1.0)
                await self._wait_until(due_s)
        except Exception:
            if not self._closed.is_set():  # while it was being closed an open or a read may fail in any way
                raise
        finally:
            await self.close()

    async def _wait_until(self, due_s: float) -> None:
        """Wait for a time on the clock, or until the source is closed; a scaled clock is slower before its epoch."""
        while (left_s := due_s - self._clock.now().monotonic_s) > 0 and not self._closed.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(left_s / self._clock.speed):
                    await self._closed.wait()
        await asyncio.sleep(0)

    async def close(self) -> None:
        """Release everything. May be called in any state, more than once; never raises."""
        self._closed.set()
        await self.release()

    def problems(self) -> tuple[str, ...]:
        """Return what is to be said with the row beside its sensors' faults."""
        return ()

    @abstractmethod
    async def open(self) -> None:
        """Open it; raises LinkError or FatalDriverError."""

    @abstractmethod
    async def read(self) -> Readings:
        """Return the number of each sensor; raises LinkError when the source is lost."""

    @abstractmethod
    async def release(self) -> None:
        """Release everything. May be called in any state, more than once; never raises."""
