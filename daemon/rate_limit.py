"""Lets the first of many reports pass at once and counts the rest, so that a log neither floods nor misses one."""

import asyncio
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")

BURST = 10
"""So many reports pass at once in a period."""
PERIOD_S = 60.0
"""Then the latest one comes once a period, with how many before it were left out [s of the loop's clock]."""


class RateLimit(Generic[Item]):
    """Passes reports on to `say(report, left_out)`; needs a running event loop."""

    def __init__(self, say: Callable[[Item, int], object], *, burst: int = BURST, period_s: float = PERIOD_S) -> None:
        self._say = say
        self._burst = burst
        self._period_s = period_s
        self._passed = 0
        self._held: Item | None = None
        self._held_count = 0
        self._timer: asyncio.TimerHandle | None = None

    def __call__(self, item: Item) -> None:
        """Pass a report on, or hold it until the period is over."""
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._period_s, self._period_over)
        if self._passed < self._burst:
            self._passed += 1
            self._say(item, 0)
        else:
            self._held, self._held_count = item, self._held_count + 1

    def flush(self) -> None:
        """Pass on what is held; call it when nothing more comes."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._passed = 0
        self._release()

    def _period_over(self) -> None:
        """Say the latest of what was held; while reports keep coming, one a period passes."""
        self._timer = None
        if not self._held_count:
            self._passed = 0
            return
        self._passed = self._burst
        self._timer = asyncio.get_running_loop().call_later(self._period_s, self._period_over)
        self._release()

    def _release(self) -> None:
        item, count = self._held, self._held_count
        self._held, self._held_count = None, 0
        if item is not None:
            self._say(item, count - 1)
