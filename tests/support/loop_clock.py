"""A clock that passes only as far as the event loop comes: a busy computer makes a test longer, and never late."""

import asyncio
import heapq
import itertools

from models.records import Instant

TURN_S = 0.005
"""Pause between two steps of the clock [s of the wall clock]."""


class LoopClock:
    """What ScaledClock is for two processes, for machine, wires and daemon in one event loop."""

    def __init__(self, speed: float, epoch_utc_s: float = 1_760_000_400.0) -> None:
        self.speed = speed
        self.epoch_utc_s = epoch_utc_s
        self.elapsed_s = 0.0
        self._sleepers: list[tuple[float, int, asyncio.Event]] = []
        self._numbers = itertools.count()

    def now(self) -> Instant:
        elapsed_s = self.elapsed_s
        return Instant(monotonic_s=elapsed_s, utc_s=self.epoch_utc_s + elapsed_s, real_s=elapsed_s / self.speed)

    async def sleep(self, duration_s: float) -> None:
        if duration_s <= 0.0:
            await asyncio.sleep(0)
            return
        woken = asyncio.Event()
        heapq.heappush(self._sleepers, (self.elapsed_s + duration_s, next(self._numbers), woken))
        await woken.wait()

    async def turn(self) -> None:
        """Let everybody work, then move on by one step and wake whose time has come."""
        await asyncio.sleep(TURN_S)
        self.elapsed_s += TURN_S * self.speed
        while self._sleepers and self._sleepers[0][0] <= self.elapsed_s:
            heapq.heappop(self._sleepers)[2].set()
