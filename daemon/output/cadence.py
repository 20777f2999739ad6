"""When something falls due again, and waiting that an event may end."""

import asyncio
import contextlib


class Cadence:
    """Falls due every period; what was late is not made up for."""

    def __init__(self, period_s: float, start_s: float) -> None:
        self.period_s = period_s
        self.next_s = start_s

    def due(self, now_s: float) -> bool:
        """Return whether it is due at `now_s` [s]; if so, it is due again one period later, not much sooner."""
        if now_s < self.next_s:
            return False
        self.next_s = max(self.next_s + self.period_s, now_s + self.period_s / 4)
        return True


async def woken(event: asyncio.Event, within_s: float) -> None:
    """Return when the event is set or the time is over [s of the wall clock]."""
    if within_s > 0:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await event.wait()
