"""The frames of one pass over a LATSIS line, put in order. No I/O, no clock.

IDs descend from N to 1. A frame whose ID does not is out of place: either its ID was damaged on the way
(then the pass goes on below, and the ID it shows is not believed in this pass at all), or the next pass
has begun (then the following frame continues it). One frame more tells which.
"""

import math
from typing import NamedTuple

from drivers.latsis.frames import Frame
from models.records import Instant


class Arrival(NamedTuple):
    """A frame and when its first and last byte arrived."""

    frame: Frame
    first_byte: Instant
    last_byte: Instant


class LinePass:
    """Collects the frames of one pass."""

    def __init__(self, first: Arrival, *, announced: int, rejected_bytes: int) -> None:
        self.frames: dict[int, Frame] = {first.frame.wire_id: first.frame}
        self.displaced: dict[int, list[int]] = {}
        """Offsets of the frames that were out of place, by the ID they show."""
        self.announced = announced
        """The first ID of the pass."""
        self.rejected_bytes = rejected_bytes
        """Bytes that were rejected between the previous pass and the first ID."""
        self.first_byte = first.first_byte
        self.last_byte = first.last_byte
        self.lowest = first.frame.wire_id
        """Where the pass has come to."""
        self.before: float = math.inf
        """Where it was one frame earlier."""
        self.rejects_since = 0
        """Rejected pieces since the last frame."""
        self.rejects_in_last_step = 0
        self._pending: Arrival | None = None

    def go_on(self, frame: Frame, arrived: Instant) -> bool:
        """Take a frame below its predecessor while nothing waits to be judged; False when it is not such a one."""
        if self._pending is not None or frame.wire_id >= self.lowest:
            return False
        self.before = self.lowest
        self.lowest = frame.wire_id
        self.frames[frame.wire_id] = frame
        self.last_byte = arrived
        self.rejects_in_last_step, self.rejects_since = self.rejects_since, 0
        return True

    def take(self, arrival: Arrival) -> tuple[Arrival, ...]:
        """Put one frame in its place; return the frames of the next pass once two of them show that it began."""
        wire_id = arrival.frame.wire_id
        pending, self._pending = self._pending, None
        if wire_id < self.lowest:
            self._displace(pending)
            self._place(arrival, self.lowest)
        elif pending is not None:
            if wire_id < pending.frame.wire_id:
                return pending, arrival
            self._displace(pending)
            self._pending = arrival
        elif wire_id < self.before:
            self._replace_last(arrival)
        else:
            self._pending = arrival
        return ()

    def finish(self) -> None:
        """Settle the frame that still waits for its successor: it was out of place."""
        self._displace(self._pending)
        self._pending = None

    def _place(self, arrival: Arrival, before: float) -> None:
        self.before = before
        self.lowest = arrival.frame.wire_id
        self.frames[self.lowest] = arrival.frame
        self.last_byte = arrival.last_byte
        self.rejects_in_last_step, self.rejects_since = self.rejects_since, 0

    def _replace_last(self, arrival: Arrival) -> None:
        """The last frame was lower than this one and its predecessor was not: it was the one out of place."""
        last = self.frames.pop(self.lowest)
        self.displaced.setdefault(last.wire_id, []).append(last.offset)
        if self.before == math.inf:
            self.announced = arrival.frame.wire_id
            self.rejected_bytes += last.end - last.offset
        self._place(arrival, self.before)

    def _displace(self, arrival: Arrival | None) -> None:
        if arrival is not None:
            self.displaced.setdefault(arrival.frame.wire_id, []).append(arrival.frame.offset)
