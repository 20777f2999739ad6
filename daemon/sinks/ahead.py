"""What a broker has taken, and may forget: it counts as taken for good a while later, if the connection lasts so long.

A broker that is killed forgets what it has acknowledged and not passed on. So the cursor follows some seconds behind,
and what it has not reached is sent again after a loss, which the keys of the rows make harmless.
"""

import time
from collections import deque
from collections.abc import Callable

from daemon.history.cursors import Position
from daemon.sinks.contract import Progress
from daemon.sinks.outbox import Batch


class Ahead:
    """How far the streams were sent, ahead of the cursor."""

    def __init__(self, resend_s: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._resend_s, self._now_s = resend_s, now_s
        self._generation = ""
        self._noted: dict[str, Position] = {}
        self._sent: dict[str, Position] = {}
        self._waiting: deque[tuple[float, str, Position, float, int]] = deque()

    def position(self, progress: Progress, stream: str) -> Position:
        """Return how far a stream was sent; the cursor's own position where that was moved by others."""
        if progress.cursor.generation != self._generation:
            self._generation = progress.cursor.generation
            self._noted, self._sent = {}, {}
            self._waiting.clear()
        noted = progress.position(stream)
        if self._noted.get(stream) != noted:
            self._noted[stream] = self._sent[stream] = noted
            self._waiting = deque(each for each in self._waiting if each[1] != stream)
        return self._sent[stream]

    def took(self, batch: Batch) -> None:
        """Note that the broker has acknowledged a batch."""
        name = batch.stream.name
        self._sent[name] = batch.after
        self._waiting.append((self._now_s() + self._resend_s, name, batch.after, batch.newest_utc_s, len(batch.rows)))

    def settle(self, progress: Progress) -> None:
        """Move the cursor over what was acknowledged long enough ago; the connection must have lasted until now."""
        while self._waiting and self._waiting[0][0] <= self._now_s():
            _, name, after, newest_utc_s, rows = self._waiting.popleft()
            self._noted[name] = after
            progress.acknowledged(name, after, newest_utc_s, sent=rows, stored=rows)
