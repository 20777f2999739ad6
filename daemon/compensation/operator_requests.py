"""What people have asked for and nobody has decided on yet."""

import asyncio
import contextlib

from models.control.state import NO_REQUEST, OperatorRequest


class Requests:
    """A queue of people's requests, and a way to wait until they are decided on; owned by the control task."""

    def __init__(self) -> None:
        self._waiting: list[tuple[OperatorRequest, str]] = []
        self._acted = asyncio.Event()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, request: OperatorRequest, person: str) -> None:
        """Queue a request."""
        self._waiting.append((request, person))

    def take(self) -> tuple[OperatorRequest, str]:
        """Return the oldest request and who made it; an empty one and '' when there is none."""
        return self._waiting.pop(0) if self._waiting else (NO_REQUEST, "")

    def decided(self) -> None:
        """Say that the output has decided on everything that was taken."""
        self._acted.set()

    async def carried_out(self) -> None:
        """Wait until everything that was queued before has been decided on."""
        while True:
            self._acted.clear()
            await self._acted.wait()
            if not self._waiting:
                return


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
