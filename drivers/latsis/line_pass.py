"""The frames of one pass over a LATSIS line, put in order, and whether their IDs still hold. No I/O, no clock.

IDs descend from N to 1. A frame out of place either has a damaged ID (the pass goes on below, and that ID is not
believed in it), or begins the next pass; the frame that follows tells which.
"""

import math
from dataclasses import dataclass
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


RENUMBERED_AFTER_CYCLES = 2
"""So many consecutive passes with the same wrong numbering quarantine the line."""
EXPLAINED_CYCLES = 30
"""In so many consecutive passes with the same wrong numbering rejected bytes may explain it: then it is one."""
RELEASED_AFTER_CYCLES = 3
"""So many consecutive passes with the expected numbering end the quarantine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbering:
    """What one pass says about the numbering of its line."""

    announced: int
    explained: bool
    """Bytes were rejected before it, enough to hold the frames that are missing above it."""
    below: frozenset[int] = frozenset()
    """IDs below the chain's lowest, at the end of the pass or after it."""
    displaced_kinds: frozenset[int] = frozenset()
    """IDs that sent a wider value than the sensor that should be there."""


class NumberingWatch:
    """Decides, pass by pass, whether values may be assigned to sensors.

    The nodes agree on their IDs among themselves, N..1, so the first ID of a pass announces how many they
    are. After a break, a repair or a restart with another number of nodes the same ID may belong to another
    sensor. A pass that announces another number is therefore not assigned to sensors at once, and when the
    next one says the same the whole line is quarantined, until the expected number is back for good.
    """

    def __init__(self, line: str, lowest: int, highest: int) -> None:
        self._line = line
        self._lowest = lowest
        self._highest = highest
        self._suspect: tuple[int, frozenset[int], frozenset[int]] | None = None
        self._suspected = 0
        self._as_expected = 0
        self._announced = self._explained = 0
        self.quarantined = False
        self.alarm: str | None = None

    def judge(self, numbering: Numbering) -> bool:
        """Take one pass; return whether its values belong to the sensors that the chain says."""
        again = numbering.explained and numbering.announced == self._announced
        self._announced, self._explained = numbering.announced, self._explained + 1 if again else 0
        lasts = self._explained >= EXPLAINED_CYCLES
        moved = numbering.announced != self._highest and (lasts or not numbering.explained)
        if moved or numbering.below or numbering.displaced_kinds:
            self._suspicion(numbering, numbering.announced if moved else self._highest)
            return not (self.quarantined or moved or numbering.displaced_kinds)
        if numbering.announced == self._highest:
            self._agreement()
        return not self.quarantined

    def describe(self, numbering: Numbering) -> str:
        """Return in words what is wrong with the numbering of a pass."""
        expected = self._highest - self._lowest + 1
        otherwise = numbering.below or numbering.displaced_kinds
        if numbering.announced != self._highest and not (numbering.explained and otherwise):
            count = numbering.announced - self._lowest + 1
            what = (
                f"its IDs announce {count} sensors where the chain has {expected} "
                f"(first ID {numbering.announced:03X}h instead of {self._highest:03X}h)"
            )
        elif numbering.displaced_kinds:
            ids = ", ".join(f"{i:03X}h" for i in sorted(numbering.displaced_kinds, reverse=True))
            what = f"values of another kind of sensor come under the IDs {ids}"
        else:
            ids = ", ".join(f"{i:03X}h" for i in sorted(numbering.below, reverse=True))
            what = f"IDs below the chain's lowest, {self._lowest:03X}h, arrive: {ids}"
        return f"line {self._line}: {what}"

    def _suspicion(self, numbering: Numbering, announced: int) -> None:
        suspect = (announced, numbering.below, numbering.displaced_kinds)
        self._suspected = self._suspected + 1 if suspect == self._suspect else 1
        self._suspect = suspect
        self._as_expected = 0
        if self._suspected >= RENUMBERED_AFTER_CYCLES:
            self.quarantined = True
        if self.quarantined:
            self.alarm = (
                f"{self.describe(numbering)}: the nodes have been renumbered or the chain is broken. "
                "The line is quarantined and none of its values is used. Restore the chain, or correct "
                f"`chain` of this line in the configuration and restart; the values count again after "
                f"{RELEASED_AFTER_CYCLES} cycles with all {self._highest - self._lowest + 1} sensors"
            )

    def _agreement(self) -> None:
        self._suspect = None
        self._suspected = 0
        if not self.quarantined:
            return
        self._as_expected += 1
        if self._as_expected >= RELEASED_AFTER_CYCLES:
            self.quarantined = False
            self.alarm = None
            self._as_expected = 0
