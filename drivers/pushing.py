"""A source that brings its sensors' numbers unasked: rows of all of them, or one number at a time."""

import asyncio
import contextlib
import math
from abc import abstractmethod
from collections import deque
from collections.abc import AsyncGenerator

from config.schema.source_drivers import SourceEntry
from drivers.clock import Clock
from drivers.contract import LinkError
from drivers.readings import NoReading, Readings, Row, RowMaker, RowSource
from models.records import Instant, Trace

MOST_WAITING = 64
"""Rows that may wait for the consumer; of more the oldest are dropped, and told."""
FEWEST_PERIODS = 0.5
"""A row that is measured sooner after the one before it is left out."""
GOING_ON_PERIODS = 2.0
"""After a longer silence a set of single numbers that is whole waits for half a period, and after the one before it as
long: a device that was cut off sends first what it has kept meanwhile."""
GOING_ON_REAL_S = 1.0
"""But a shorter silence is none, even on a fast simulated clock."""
SILENT_PERIODS = 3.0
"""Without anything for so many cycle periods the source is given up, to be opened anew."""
MIN_SILENT_REAL_S = 2.0
"""But never sooner than this, even on a fast simulated clock."""


class PushedSource(RowSource):
    """Follows in a task of its own, to be used once."""

    def __init__(self, source: SourceEntry, clock: Clock) -> None:
        self.name = source.name
        self._source = source
        self._clock = clock
        self._maker = RowMaker(source)
        self._rows: deque[tuple[Readings, Instant]] = deque(maxlen=MOST_WAITING)
        self._row_s = -math.inf
        self._dropped = 0
        self._single: dict[int | str, float | NoReading] = {}
        self.lacking: dict[int | str, NoReading] = {}
        """Why what came for a sensor held none of its numbers; said where nothing else came for it."""
        self._set: Readings | None = None
        self._single_since: Instant | None = None
        self._single_from_s = self._newest_s = -math.inf
        self._problems: deque[str] = deque(maxlen=MOST_WAITING)
        self._came_s = 0.0
        self._wake = asyncio.Event()
        self._started = False
        self._closed = False
        self._task: asyncio.Task[None] | None = None

    # --- what the driver calls ----------------------------------------------------------

    def put_row(self, readings: Readings, measured: Instant) -> None:
        """Take one number of each sensor that has one; a row too soon after another is left out."""
        self.came()
        if measured.monotonic_s - self._row_s < FEWEST_PERIODS * self._source.cycle_period_s:
            return
        self._row_s = measured.monotonic_s
        self._dropped += len(self._rows) == MOST_WAITING
        self._rows.append((self._of_one_device(readings), measured))

    def put(self, key: int | str, reading: float | NoReading) -> None:
        """Take one sensor's number; those of one cycle period make a cycle, the newest of each sensor.

        Many at once make one cycle too: their age is not known, but for that of the newest.
        """
        self._begin_set()
        self._single[key] = self._maker.of_one_device(key, reading)

    def put_set(self, readings: Readings) -> None:
        """Take one number of each sensor that has one, of unknown age: of many at once the newest count."""
        self._begin_set()
        self._set = readings

    def _begin_set(self) -> None:
        """Note when the first number of a set comes, and from when on the set counts once it is whole."""
        now = self._clock.now()
        if self._single_since is None:
            self._single_since, apart_s = now, FEWEST_PERIODS * self._source.cycle_period_s
            going_on_s = max(GOING_ON_PERIODS * self._source.cycle_period_s, GOING_ON_REAL_S * self._clock.speed)
            silent = now.monotonic_s - self._newest_s > going_on_s
            self._single_from_s = max(now.monotonic_s + silent * apart_s, self._row_s + apart_s)
        self._newest_s = now.monotonic_s
        self.came()

    def _of_one_device(self, readings: Readings) -> Readings:
        return {key: self._maker.of_one_device(key, reading) for key, reading in readings.items()}

    def came(self) -> None:
        self._came_s = self._clock.now().real_s
        self._wake.set()

    def report(self, problem: str) -> None:
        """Take what could not be read; it is said with the next row."""
        self._problems.append(problem)

    @abstractmethod
    async def follow(self) -> None:
        """Open the source and bring what comes, until it is cancelled; raises LinkError or FatalDriverError."""

    @abstractmethod
    def silent(self) -> str:
        """Return what to say and to check when nothing comes."""

    # --- what the daemon calls ----------------------------------------------------------

    async def rows(self) -> AsyncGenerator[Row]:
        """Open the source and yield each row as it completes; raises LinkError when the source is lost."""
        if self._started or self._closed:
            raise RuntimeError(f"source {self.name}: it is used once; build a new one to open it again")
        self._started = True
        self.came()
        self._task = asyncio.create_task(self.follow(), name=f"source {self.name}")
        self._task.add_done_callback(lambda _: self._wake.set())
        try:
            while not self._closed:
                ended = self._task.done()
                for row in self._due(ended=ended):
                    yield row
                if self._closed:
                    return
                if ended:
                    self._task.result()
                    raise LinkError(f"source {self.name}: {self.silent()}")
                await self._wait()
        finally:
            await self.close()

    def _due(self, *, ended: bool = False) -> list[Row]:
        """Return the rows whose time has come; of a source that has ended also a set that is whole."""
        rows = []
        while self._rows:
            readings, measured = self._rows.popleft()
            rows.append(self._row(readings, measured))
        since = self._single_since
        if since is not None and (self._left_of_single_real_s(since) <= 0 or (ended and self._whole)):
            single = self.lacking | self._single if self._set is None else self._of_one_device(self._set)
            self._single, self.lacking, self._set, self._single_since = {}, {}, None, None
            self._row_s = max(since.monotonic_s, self._single_from_s)
            rows.append(self._row(single, since))
        return rows

    @property
    def _whole(self) -> bool:
        return self._set is not None or len(self._single) == len(self._source.inputs)

    def _left_of_single_real_s(self, since: Instant) -> float:
        """Return how long what has come since then may still wait for the rest of it [s]: its period when not whole."""
        periods = (self._single_from_s - since.monotonic_s) / self._source.cycle_period_s if self._whole else 1.0
        return self._left_real_s(since.real_s, periods)

    def _row(self, readings: Readings, measured: Instant) -> Row:
        problems, lost = tuple(self._problems), self._dropped
        self._problems.clear()
        self._dropped = 0
        if lost:
            words = f"source {self.name}: {lost} rows dropped, more came than can be taken: check what sends them"
            problems = (words, *problems)
        return self._maker.row(readings, Trace(first_byte=measured, last_byte=self._clock.now()), problems)

    def _left_real_s(self, since_real_s: float, periods: float) -> float:
        period_s = periods * self._source.cycle_period_s / self._clock.speed
        return since_real_s + period_s - self._clock.now().real_s

    async def _wait(self) -> None:
        """Wait for something new, for the end of a cycle period, or until the source has been silent for too long."""
        silent_s = max(self._left_real_s(self._came_s, SILENT_PERIODS), self._came_s + MIN_SILENT_REAL_S - self._now())
        if silent_s <= 0:
            raise LinkError(f"source {self.name}: {self.silent()}")
        since = self._single_since
        wait_s = silent_s if since is None else min(silent_s, self._left_of_single_real_s(since))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(wait_s, 0.0)):
                await self._wake.wait()
        self._wake.clear()

    def _now(self) -> float:
        return self._clock.now().real_s

    async def close(self) -> None:
        """End following. May be called in any state, more than once; never raises."""
        self._closed = True
        self._wake.set()
        task = self._task
        if task is not None and not task.done() and task is not asyncio.current_task():
            task.cancel()
            await asyncio.wait({task})
