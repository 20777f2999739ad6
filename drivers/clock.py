"""Clocks that are handed to whatever needs the time, so that a simulated day can run in seconds."""

import asyncio
import time
from typing import Protocol

from models.records import Instant


class Clock(Protocol):
    """Time and waiting. Durations are seconds of this clock unless a name says `real`."""

    speed: float
    """Seconds of this clock per second of the computer's own."""

    def now(self) -> Instant: ...

    async def sleep(self, duration_s: float) -> None: ...


class SystemClock:
    speed = 1.0

    def now(self) -> Instant:
        monotonic_s = time.monotonic()
        return Instant(monotonic_s=monotonic_s, utc_s=time.time(), real_s=monotonic_s)

    async def sleep(self, duration_s: float) -> None:
        await asyncio.sleep(max(0.0, duration_s))


class ScaledClock:
    """A clock for simulated machines that runs `speed` times as fast as the computer's.

    Before its epoch it runs at the computer's own pace, so that what waits for the beginning
    waits as on a real machine. Two processes that are given the same epoch agree on the time,
    because CLOCK_MONOTONIC is one clock for the whole computer.
    """

    def __init__(self, *, epoch_real_s: float, epoch_utc_s: float, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"speed must be positive, got {speed}")
        self.epoch_real_s = epoch_real_s
        self.epoch_utc_s = epoch_utc_s
        self.speed = speed

    def now(self) -> Instant:
        real_s = time.monotonic()
        elapsed_s = real_s - self.epoch_real_s
        if elapsed_s > 0:
            elapsed_s *= self.speed
        return Instant(monotonic_s=elapsed_s, utc_s=self.epoch_utc_s + elapsed_s, real_s=real_s)

    async def sleep(self, duration_s: float) -> None:
        await asyncio.sleep(max(0.0, duration_s / self.speed))
