"""Are the IDs of a LATSIS line still those of its chain? No I/O, no clock.

The nodes agree on their IDs among themselves, N..1, so the first ID of a pass announces how many they
are. After a break, a repair or a restart with another number of nodes the same ID may belong to another
sensor. A pass that announces another number is therefore not assigned to sensors at once, and when the
next one says the same the whole line is quarantined, until the expected number is back for good.
"""

from dataclasses import dataclass

RENUMBERED_AFTER_CYCLES = 2
"""So many consecutive passes with the same wrong numbering quarantine the line."""
RELEASED_AFTER_CYCLES = 3
"""So many consecutive passes with the expected numbering end the quarantine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbering:
    """What one pass says about the numbering of its line."""

    announced: int
    """The first ID of the pass."""
    explained: bool
    """Bytes were rejected before it, enough to hold the frames that are missing above it."""
    below: frozenset[int] = frozenset()
    """IDs below the chain's lowest, at the end of the pass or after it."""
    displaced_kinds: frozenset[int] = frozenset()
    """IDs that sent a wider value than the sensor that should be there."""


class NumberingWatch:
    """Decides, pass by pass, whether values may be assigned to sensors."""

    def __init__(self, line: str, lowest: int, highest: int) -> None:
        self._line = line
        self._lowest = lowest
        self._highest = highest
        self._suspect: tuple[int, frozenset[int], frozenset[int]] | None = None
        self._suspected = 0
        self._as_expected = 0
        self.quarantined = False
        self.alarm: str | None = None

    def judge(self, numbering: Numbering) -> bool:
        """Take one pass; return whether its values belong to the sensors that the chain says."""
        moved = numbering.announced != self._highest and not numbering.explained
        if moved or numbering.below or numbering.displaced_kinds:
            self._suspicion(numbering, numbering.announced if moved else self._highest)
            return not (self.quarantined or moved or numbering.displaced_kinds)
        if numbering.announced == self._highest:
            self._agreement()
        return not self.quarantined

    def describe(self, numbering: Numbering) -> str:
        """Return in words what is wrong with the numbering of a pass."""
        expected = self._highest - self._lowest + 1
        if numbering.announced != self._highest and not numbering.explained:
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
