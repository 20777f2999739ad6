"""What a sink does, and how it says that it cannot."""

import random
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from daemon.history.cursors import Cursor, Position
from daemon.sinks.outbox import Batch, Outbox


class SinkError(Exception):
    """Nothing can be sent now; the text says why and what to do. It is tried again."""


class SinkWaitsError(SinkError):
    """The connection stands, and what is sent now would reach nobody; the text says what is waited for."""


RETRY_FIRST_S, RETRY_LONGEST_S = 0.2, 60.0
RETRY_GROWTH = 1.25
"""What was away for a while is tried again within a quarter of that while."""
LASTED_S = 10.0
"""After a connection that lasted so long the next loss is tried again at once."""


class Retry:
    """How long to wait before something is tried again: little after the first failure, more with each that follows."""

    def __init__(self) -> None:
        self._wait_s = RETRY_FIRST_S
        self._works_since_s: float | None = None

    def works(self) -> None:
        """Note that the connection stands."""
        if self._works_since_s is None:
            self._works_since_s = time.monotonic()

    def after_failure(self) -> float:
        """Return how long to wait now [s]; not the same for all, so that a plant does not come back at one moment."""
        if self._works_since_s is not None and time.monotonic() - self._works_since_s >= LASTED_S:
            self._wait_s = RETRY_FIRST_S
        wait_s, self._works_since_s = self._wait_s, None
        self._wait_s = min(RETRY_GROWTH * wait_s, RETRY_LONGEST_S)
        return wait_s * random.uniform(0.8, 1.2)


class Sink(Protocol):
    """One system that takes rows. A new one is made after every SinkError but a SinkWaitsError."""

    def open(self, cursor: Cursor) -> Mapping[str, Position]:
        """Connect; return how far each stream was taken: as the system says or, where it cannot, the cursor."""

    def needs_rows(self) -> bool:
        """Return whether it may wait some seconds for new rows; raises SinkError after a loss that it knows."""

    def transfer(self, outbox: Outbox, progress: "Progress") -> bool:
        """Send one piece of what waits and note what was acknowledged; True while there may be more."""

    def close(self) -> None:
        """Let go of the system."""


@runtime_checkable
class Watch(Sink, Protocol):
    """A sink that has something to tell without the store too."""

    def look_on(self) -> None:
        """Look and tell while the store cannot be read; raises SinkError."""


@dataclass(slots=True, kw_only=True)
class Progress:
    """The cursor of a sink as it moves; `save` puts it into its file."""

    cursor: Cursor
    save: Callable[[Cursor], None]

    def position(self, stream: str) -> Position:
        return self.cursor.positions.get(stream, Position())

    def acknowledged(self, stream: str, after: Position, newest_utc_s: float | None, *, sent: int, stored: int) -> None:
        """Note that the sink has taken everything up to a position; None: no newer row was among it."""
        before, newest = self.cursor, dict(self.cursor.newest_utc_s)
        if newest_utc_s is not None:
            newest[stream] = max(newest_utc_s, newest.get(stream, newest_utc_s))
        self.cursor = replace(
            before,
            positions={**before.positions, stream: after},
            newest_utc_s=newest,
            sent_rows=before.sent_rows + sent,
            stored_rows=before.stored_rows + stored,
        )
        self.save(self.cursor)

    def took(self, batch: Batch, stored: int) -> None:
        """Note that the sink has taken a batch, of which it had not had `stored` rows before."""
        self.acknowledged(batch.stream.name, batch.after, batch.newest_utc_s, sent=len(batch.rows), stored=stored)
