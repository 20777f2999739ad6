"""The inbox of the control task: messages in their order, and the event that wakes it."""

import asyncio
from collections import deque
from collections.abc import Callable

from daemon.estimation.task import Delivery
from models.records import DisplacementSample

Message = Delivery | DisplacementSample | Callable[[], None]
"""A callable is a person's word, carried out in the control task's stack."""


class Inbox:
    """Messages in the order in which they came; putting one in wakes the control task."""

    def __init__(self) -> None:
        self._waiting: deque[Message] = deque()
        self._event = asyncio.Event()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, message: Message) -> None:
        """Let a message wait, and wake the control task."""
        self._waiting.append(message)
        self._event.set()

    def take(self) -> Message:
        """Return the oldest message; it waits no longer, whatever becomes of it."""
        return self._waiting.popleft()

    def wake(self) -> None:
        """Wake the control task without a message."""
        self._event.set()

    async def woken(self, within_s: float) -> None:
        """Return when something comes or the time is over [s of the wall clock]."""
        self._event.clear()
        if within_s > 0:
            over = asyncio.get_running_loop().call_later(within_s, self._event.set)
            try:
                await self._event.wait()
            finally:
                over.cancel()
