"""The macros of the spindle speed: decodes calls and block, encodes what is to be written."""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass

from config.schema.spindle_speed import SpeedMacrosConfig
from daemon.cnc.macro_block import LAST_SEQUENCE, begun_after, sequence_of, status_of
from drivers.guard.check import PER_SECOND, whole

MacroValues = Mapping[int, float | None]
Groups = tuple[tuple[tuple[int, float], ...], ...]


SPEED_PARTS = {
    "valid_until": (1, PER_SECOND),
    "for_tool": (2, 1),
    "for_speed": (3, 10),
    "for_feed": (2, 100),
    "for_depth": (5, 1000),
    "for_radial": (6, 1000),
    "for_kind": (7, 1000),
    "speed": (4, 10),
    "feed": (3, 100),
}
"""What counts in the check of the speed's block: how often, and how many whole numbers a unit has."""


def speed_check(macros: SpeedMacrosConfig, held: Mapping[int, float | None]) -> float:
    """Return the check that fits what the macros of the spindle speed hold, as `block_check` does for the others.

    With speeds and feeds up to 100000, depths and K up to 1000 and tools up to T99999 the sum stays below 1e8; no two
    parts count alike, so that two values that are exchanged change it too.
    """

    def value(name: str) -> float:
        return held.get(getattr(macros, name)) or 0.0

    parts = (times * whole(value(name) * per_unit) for name, (times, per_unit) in SPEED_PARTS.items())
    return value("sequence_b") + value("enable") + sum(parts)


@dataclass(frozen=True, slots=True)
class OperationKey:
    """What a pair is made for: the operation as the NC program calls it, in the order of the macros."""

    tool_number: float
    speed_rpm: float
    feed_mm_min: float
    depth_mm: float
    """0: the configured one."""
    radial_mm: float
    """0: that of the case."""
    kind: float
    """K of the call; 0: not to be tuned."""

    def __str__(self) -> str:
        words = [f"T{self.tool_number:g} S{self.speed_rpm:g} F{self.feed_mm_min:g}"]
        words += [f"D{self.depth_mm:g}"] if self.depth_mm else []
        words += [f"E{self.radial_mm:g}"] if self.radial_mm else []
        words += [f"K{self.kind:g}"] if self.kind != 1.0 else []
        return " ".join(words)


NOTHING = OperationKey(tool_number=0.0, speed_rpm=0.0, feed_mm_min=0.0, depth_mm=0.0, radial_mm=0.0, kind=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedCall:
    count: int
    operation: OperationKey
    text: float
    """Number of the text that the control runs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedPair:
    """What the block says: speed and feed for one operation, or nothing."""

    made_for: OperationKey
    speed_rpm: float
    feed_mm_min: float
    enable: bool


DISABLED = SpeedPair(made_for=NOTHING, speed_rpm=0.0, feed_mm_min=0.0, enable=False)


class SpeedBlock:
    """Layout of the block for one machine."""

    def __init__(self, macros: SpeedMacrosConfig) -> None:
        self._map = macros
        self.numbers = macros.numbers
        self.ours = macros.ours

    def call(self, found: MacroValues) -> SpeedCall | None:
        """Return the latest call of the NC program; None before the first, and while one is being written."""
        told = self._map
        values = [found.get(number) for number in (told.calls, *self._called, told.called_text)]
        numbers = [value for value in values if value is not None and math.isfinite(value)]
        if len(numbers) < len(values):
            return None
        count, tool_number, speed_rpm, feed_mm_min, *_, text = numbers
        if count <= 0.0 or speed_rpm <= 0.0 or feed_mm_min <= 0.0:
            return None
        if not (count.is_integer() and tool_number.is_integer()):
            return None
        return SpeedCall(count=int(count), operation=OperationKey(*numbers[1:-1]), text=text)

    def made_for(self, found: MacroValues) -> OperationKey | None:
        """Return the operation that the NC program has called last; None as for `call`."""
        call = self.call(found)
        return None if call is None else call.operation

    @property
    def _called(self) -> tuple[int, ...]:
        nc = self._map
        return (nc.called_tool, nc.called_speed, nc.called_feed, nc.called_depth, nc.called_radial, nc.called_kind)

    @property
    def _made_for(self) -> tuple[int, ...]:
        ours = self._map
        return (ours.for_tool, ours.for_speed, ours.for_feed, ours.for_depth, ours.for_radial, ours.for_kind)

    def pair(self, found: MacroValues) -> SpeedPair:
        if found.get(self._map.enable) != 1.0:
            return DISABLED
        return SpeedPair(
            made_for=OperationKey(*(found.get(number) or 0.0 for number in self._made_for)),
            speed_rpm=found.get(self._map.speed) or 0.0,
            feed_mm_min=found.get(self._map.feed) or 0.0,
            enable=True,
        )

    def applied_rpm(self, found: MacroValues) -> float | None:
        """Return the speed that the NC has taken [1/min]."""
        return found.get(self._map.echo_speed)

    def status(self, found: MacroValues) -> int | None:
        return status_of(found.get(self._map.echo_status))

    def sequence(self, found: MacroValues) -> int:
        """Return the sequence number in the CNC, 0 where there is none."""
        return sequence_of(found.get(self._map.sequence_b))

    def whole(self, found: MacroValues) -> bool:
        """Whether the sequence numbers are there and equal."""
        first = found.get(self._map.sequence_a)
        return first is not None and first == found.get(self._map.sequence_b)

    def unrecorded(self, known: Mapping[int, tuple[float, ...]], found: MacroValues) -> bool:
        """Say whether this is a block that was written here, which a power cut kept from the disk."""
        return begun_after(known, found, self._map.sequence_a, self._map.sequence_b)

    def enabled(self, found: MacroValues, clock_s: float) -> bool:
        """Whether the NC may take the pair at this time of its clock [s]."""
        return found.get(self._map.enable) != 0.0 and self.remaining_s(found, clock_s) > 0.0

    def remaining_s(self, found: MacroValues, clock_s: float) -> float:
        """Return for how long the pair is valid from this time of the NC's clock [s], -inf when nothing says so."""
        valid_until_s = found.get(self._map.valid_until)
        return -math.inf if valid_until_s is None else valid_until_s - clock_s

    def encode(self, pair: SpeedPair, *, after: int, valid_until_s: float) -> Groups:
        """Return the groups to write, sequence_a, content with its check, sequence_b."""
        sequence = float(after % LAST_SEQUENCE + 1)
        tenths = math.floor(valid_until_s * PER_SECOND) if pair.enable else 0
        content = (
            *zip(self._made_for, astuple(pair.made_for), strict=True),
            (self._map.speed, pair.speed_rpm),
            (self._map.feed, pair.feed_mm_min),
            (self._map.valid_until, tenths / PER_SECOND),
            (self._map.enable, float(pair.enable)),
        )
        if self._map.check is not None:
            held = {**dict(content), self._map.sequence_b: sequence}
            content = (*content, (self._map.check, speed_check(self._map, held)))
        return ((self._map.sequence_a, sequence),), content, ((self._map.sequence_b, sequence),)

    def vacant(self, found: MacroValues) -> str:
        """Return which of our macros are vacant, in words; power-off clears valid_until, so that one may be."""
        vacant = [f"#{n}" for n in self.ours if found.get(n) is None and n != self._map.valid_until]
        if not vacant:
            return ""
        return f"macro {', '.join(vacant)} vacant; `toolpoint commission --initialise-only` initialises it"

    def foreign(self, known: Mapping[int, tuple[float, ...]], found: MacroValues) -> str:
        """Return what holds none of the values that are known, in words."""
        problems = []
        for number, values in known.items():
            now = found.get(number)
            if now is not None and not any(abs(now - value) <= max(1e-6, 1e-9 * abs(value)) for value in values):
                expected = " or ".join(f"{value:g}" for value in values) or "nothing"
                problems.append(f"macro #{number} holds {now:g}, we wrote {expected}")
        return "; ".join(problems)
