"""The macros of the spindle speed: what the NC program says, what the block holds, what is to be written."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from config.schema.spindle_speed import SpeedMacrosConfig
from daemon.output.macro_block import LAST_SEQUENCE
from daemon.stability.tool_points import CalledOperation
from models.records import CncSample

Found = Mapping[int, float | None]
Groups = tuple[tuple[tuple[int, float], ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedPair:
    """What the block says: speed and feed for one programmed speed, or nothing."""

    for_rpm: float
    speed_rpm: float
    feed_mm_min: float
    enable: bool


DISABLED = SpeedPair(for_rpm=0.0, speed_rpm=0.0, feed_mm_min=0.0, enable=False)


class SpeedBlock:
    """Layout of the block for one machine."""

    def __init__(self, macros: SpeedMacrosConfig) -> None:
        self._map = macros
        self.numbers = macros.numbers
        self.ours = macros.ours

    def called(self, found: Found, sample: CncSample) -> CalledOperation | None:
        """Return the operation that the NC program has begun; None before its first call."""
        speed_rpm, feed_mm_min = self._number(found, self._map.called_speed), self._number(found, self._map.called_feed)
        if self._number(found, self._map.calls) <= 0.0 or speed_rpm <= 0.0 or feed_mm_min <= 0.0:
            return None
        return CalledOperation(
            tool_number=sample.tool_number,
            program=sample.program,
            speed_rpm=speed_rpm,
            feed_mm_min=feed_mm_min,
            depth_mm=self._number(found, self._map.called_depth),
            radial_mm=self._number(found, self._map.called_radial),
        )

    def wanted(self, found: Found) -> bool:
        """Whether the NC program wants its operation tuned."""
        return found.get(self._map.wanted) == 1.0

    def applied_rpm(self, found: Found) -> float | None:
        """Return the speed that the NC has taken [1/min]."""
        return found.get(self._map.echo_speed)

    def status(self, found: Found) -> int | None:
        """Return what the speed program did last."""
        status = found.get(self._map.echo_status)
        return None if status is None else round(status)

    def sequence(self, found: Found) -> int:
        """Return the sequence number in the CNC, 0 when vacant."""
        return round(found.get(self._map.sequence_b) or 0.0)

    def encode(self, pair: SpeedPair, *, after: int, valid_until_s: float) -> Groups:
        """Return the groups to write, strictly one after another: sequence_a, content, sequence_b."""
        sequence = float(after % LAST_SEQUENCE + 1)
        content = (
            (self._map.for_speed, pair.for_rpm),
            (self._map.speed, pair.speed_rpm),
            (self._map.feed, pair.feed_mm_min),
            (self._map.valid_until, round(valid_until_s, 3) if pair.enable else 0.0),
            (self._map.enable, float(pair.enable)),
        )
        return ((self._map.sequence_a, sequence),), content, ((self._map.sequence_b, sequence),)

    def foreign(self, written: Mapping[int, float], found: Found) -> str:
        """Return what is not as it was written, in words; power-off clears valid_until, so that one may be vacant."""
        problems = []
        for number, value in written.items():
            now = found.get(number)
            if now is None and number == self._map.valid_until:
                continue
            if now is None or abs(now - value) > max(1e-6, 1e-9 * abs(value)):
                problems.append(f"macro #{number} holds {'nothing' if now is None else f'{now:g}'}, we wrote {value:g}")
        return "; ".join(problems)

    def _number(self, found: Found, number: int) -> float:
        value = found.get(number)
        return value if value is not None and math.isfinite(value) else 0.0
