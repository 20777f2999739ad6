"""Writes the pair of the spindle speed, and keeps what its macros may hold; owned by the control task."""

import math
from collections.abc import Mapping
from pathlib import Path

from config.schema.spindle_speed import SpeedOperationConfig, SpindleSpeedConfig
from daemon.cnc.session import CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.spindle_speed.macro_block import DISABLED, Groups, MacroValues, SpeedBlock, SpeedPair
from drivers.contract import FatalDriverError
from models.records import WriteOutcome

SPEED_CAUSE = "spindle speed"
RENEW_SHARE = 1.0 / 3.0
"""The pair is written again after this share of its validity."""
ROUNDING_RPM = 0.5
"""Speeds are whole, so bounds are this much wider [1/min]."""
FEED_SLACK = 0.01
"""Share by which the feed may be off what belongs to the speed; the NC allows the same."""
CLOCK_SLACK_S = 2.0
"""The NC's clock is known from the latest poll to about this [s]."""


class SpeedWriteError(Exception):
    """A write was refused or did not stay; the text says what to record as the FAULT."""


class SpeedWriter:
    """The block of one CNC over every connection, and over a restart of the daemon."""

    def __init__(
        self,
        tuning: SpindleSpeedConfig,
        block: SpeedBlock,
        store: Path,
        audit: Mapping[int, tuple[float, ...]] | None = None,
        last_write_id: int | None = None,
    ) -> None:
        """`audit` is what the block may hold by the audit, whose newest write has this number."""
        self._tuning, self._block = tuning, block
        self._last = WriteAheadRecord.of_speed(store)
        kept, _ = self._last.newer_of(audit, last_write_id)
        self._known: Mapping[int, tuple[float, ...]] | None = kept if set(kept or ()) == set(block.ours) else None
        self._adopted = self._certain = False
        self._written_s = -math.inf
        self.pair = DISABLED
        """What the block says, or is to say once more after a write with an unknown outcome."""

    def close(self) -> None:
        self._last.close()

    def mismatch(self, found: MacroValues, clock_s: float, now_s: float) -> str:
        """Return what is vacant or foreign in the block, in words; take over at the first contact what may be.

        That is what was written here, by this run or the one before, or a whole block which the NC does not follow.
        """
        if vacant := self._block.vacant(found):
            return vacant
        foreign = "" if self._known is None else self._block.foreign(self._known, found)
        if not self._adopted and (self._known is None or foreign):
            if self._known is None or not self._block.unrecorded(self._known, found):
                if not self._block.whole(found):
                    return f"{foreign or 'the daemon has not written the block, and'}; its sequence numbers differ"
                if self._block.enabled(found, clock_s):
                    return f"{foreign or 'the daemon has not written the block'}, and it is enabled and valid"
            foreign = ""
        if not foreign and not self._adopted:
            self._adopt(found, clock_s, now_s)
        if not 0.0 < self._block.remaining_s(found, clock_s) <= self._tuning.validity_s + CLOCK_SLACK_S:
            self._written_s = -math.inf  # the control was switched off and on, or its clock has begun again
        return foreign

    def acknowledge(self, found: MacroValues) -> None:
        """Take what the CNC holds now as known: a person has acknowledged."""
        self._known = {n: (value,) for n in self._block.ours if (value := found.get(n)) is not None}
        self._adopted, self._certain = True, False

    def write_again(self) -> None:
        """Count what was written as unknown, so that it is written once more: the connection is another one."""
        self._certain = False

    def _adopt(self, found: MacroValues, clock_s: float, now_s: float) -> None:
        self.acknowledge(found)
        self._certain = self._block.whole(found)
        if self._certain:
            self.pair = self._block.pair(found)
        if self.pair.enable and self._block.enabled(found, clock_s):
            self._written_s = now_s

    def valid(self, now_s: float) -> bool:
        """Whether the NC follows the pair as it was written last."""
        return self.pair.enable and self._certain and now_s - self._written_s <= self._tuning.validity_s

    def due(self, pair: SpeedPair, now_s: float) -> bool:
        """Whether a pair has to be written: it is another one, its validity runs out, or what is there is unknown."""
        stale = pair.enable and now_s - self._written_s > RENEW_SHARE * self._tuning.validity_s
        return stale or pair != self.pair or not self._certain

    async def write(
        self,
        session: CncSession,
        pair: SpeedPair,
        operation: SpeedOperationConfig | None,
        found: MacroValues,
        *,
        clock_s: float,
        now_s: float,
    ) -> None:
        """Write a pair; raises SpeedWriteError, and DriverError on a lost link. What is known then is old or new."""
        if problem := self._out_of_bounds(pair, operation):
            raise SpeedWriteError(problem)
        groups = self._block.encode(
            pair, after=self._block.sequence(found), valid_until_s=clock_s + self._tuning.validity_s
        )
        standing = {number: (found.get(number),) for group in groups for number, _ in group}
        self._expect(groups, found)
        verified = False
        try:
            receipt = await session.write_apart(groups, cause=SPEED_CAUSE, expected=standing)
            verified = receipt.outcome is WriteOutcome.VERIFIED
        except FatalDriverError as error:
            raise SpeedWriteError(f"a write of the spindle speed was refused: {error}") from error
        finally:
            self._certain = verified
        if not verified:
            raise SpeedWriteError(f"read-back of the spindle speed differs: {receipt.detail}")
        self._known = {number: (value,) for group in groups for number, value in group}
        self.pair, self._written_s = pair, now_s

    def _expect(self, groups: Groups, found: MacroValues) -> None:
        """Know before anything is sent that a macro holds what it did, or what it is to hold."""
        known: dict[int, tuple[float, ...]] = {}
        for number, value in (each for group in groups for each in group):
            before = found.get(number)
            known[number] = (value,) if before is None else (before, value)
        self._known = known
        self._last.keep(known)

    def _out_of_bounds(self, pair: SpeedPair, operation: SpeedOperationConfig | None) -> str:
        """Return why a pair must not be sent: the machine's and the tool's limits, the change, the feed; '' if none."""
        if not pair.enable:
            return ""
        tuning, programmed_rpm = self._tuning, pair.made_for.speed_rpm
        share = pair.speed_rpm / programmed_rpm if tuning.keep_feed_per_tooth else 1.0
        feed_mm_min = pair.made_for.feed_mm_min * share
        in_feed = abs(pair.feed_mm_min - feed_mm_min) <= FEED_SLACK * feed_mm_min
        if in_feed and abs(pair.speed_rpm - programmed_rpm) <= ROUNDING_RPM:
            return ""
        highest_rpm = tuning.highest_of(operation) + ROUNDING_RPM
        in_range = tuning.lowest_rpm - ROUNDING_RPM <= pair.speed_rpm <= highest_rpm
        change_rpm = tuning.max_change_percent / 100.0 * programmed_rpm + ROUNDING_RPM
        if in_feed and in_range and abs(pair.speed_rpm - programmed_rpm) <= change_rpm:
            return ""
        return (
            f"S{pair.speed_rpm:g} F{pair.feed_mm_min:g} for {pair.made_for} is out of bounds "
            f"({tuning.lowest_rpm:g} to {highest_rpm - ROUNDING_RPM:g} 1/min, at most "
            f"{tuning.max_change_percent:g} % of change, the feed that belongs to it); nothing was sent"
        )
