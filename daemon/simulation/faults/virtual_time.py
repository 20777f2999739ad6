"""Time that passes only when there is nothing left to do: an event loop for days in minutes.

The loop's clock stands still while callbacks, sockets or threads have work. When all are idle the loop
asks the world that it lives in to move time on to its next timer, or to the next event before it.
"""

import asyncio
import math
import selectors
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any, Protocol, TypeVar

from models.records import Instant

THREAD_PATIENCE_S = 0.05
"""While a thread works, sockets are looked at this often [s of the wall clock]; its end wakes the loop at once."""

ROUNDS_PER_LOOK = 8
"""While callbacks wait for their turn, sockets are looked at once in so many rounds of the loop."""

T = TypeVar("T")


class VirtualClock:
    """Implements `drivers.clock.Clock`; moved on by the world, and its calendar may be set both ways."""

    speed = 1.0

    def __init__(self, *, epoch_utc_s: float, monotonic_s: float = 0.0) -> None:
        self.epoch_utc_s = epoch_utc_s
        self.monotonic_s = monotonic_s
        self.utc_step_s = 0.0
        """By how much the calendar clock was set forward [s]."""
        self._now = Instant(monotonic_s=math.nan, utc_s=math.nan, real_s=math.nan)

    def now(self) -> Instant:
        """Return the moment; what would be the computer's own monotonic clock is virtual too."""
        utc_s = self.epoch_utc_s + self.utc_step_s + self.monotonic_s
        if self._now.monotonic_s != self.monotonic_s or self._now.utc_s != utc_s:  # asked many times a moment
            self._now = Instant(monotonic_s=self.monotonic_s, utc_s=utc_s, real_s=self.monotonic_s)
        return self._now

    async def sleep(self, duration_s: float) -> None:
        await asyncio.sleep(max(0.0, duration_s))


class World(Protocol):
    """What moves time on."""

    def pass_time(self, timeout_s: float | None) -> None:
        """Move the clock on by at most `timeout_s` (None: to whatever comes next) and deliver what happens then."""

    def hold(self) -> bool:
        """Tell whether time must wait for the computer (a disk that is behind, for instance)."""


class _VirtualSelector(selectors.DefaultSelector):
    """Looks at sockets without waiting; where a loop would wait, virtual time passes."""

    def __init__(self) -> None:
        super().__init__()
        self.world: World | None = None
        self.threads_busy = 0
        self._rounds = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return sockets that are ready; pass time when none is and nothing else is to be done."""
        if timeout is not None and timeout <= 0:
            self._rounds = (self._rounds + 1) % ROUNDS_PER_LOOK
            return [] if self._rounds else super().select(0)
        if ready := super().select(0):
            return ready
        if self.world is None or self.threads_busy:
            return super().select(THREAD_PATIENCE_S)
        if self.world.hold():
            return super().select(THREAD_PATIENCE_S / 10)
        self.world.pass_time(timeout)
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on a virtual clock. Work given to threads stops time until it is done."""

    def __init__(self, clock: VirtualClock) -> None:
        self._virtual_clock = clock
        self._virtual_selector = _VirtualSelector()
        super().__init__(self._virtual_selector)

    def inhabit(self, world: World | None) -> None:
        """Let time be moved on by this world; without one none passes."""
        self._virtual_selector.world = world

    def time(self) -> float:
        """Return the loop's time [s]: the clock's monotonic one."""
        return self._virtual_clock.monotonic_s

    def run_in_executor(  # type: ignore[override]
        self, executor: Executor | None, func: Callable[..., T], *args: Any
    ) -> asyncio.Future[T]:
        """Run a function in a thread; no time passes meanwhile."""
        self._virtual_selector.threads_busy += 1
        future: asyncio.Future[T] = super().run_in_executor(executor, func, *args)
        future.add_done_callback(self._on_thread_done)
        return future

    def _on_thread_done(self, _: object) -> None:
        self._virtual_selector.threads_busy -= 1
