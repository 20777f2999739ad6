"""Part programs of the simulated NC, as data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

BlockKind = Literal["positioning", "cut", "safe", "idle", "spindle"]
MINUTE_S = 60.0
HOUR_S = 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedCall:
    """A call of the speed program before a cut, where the NC has one."""

    speed_rpm: float
    """As programmed, as are the others [1/min]."""
    feed_mm_min: float
    depth_mm: float
    radial_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One stretch of a part program."""

    sequence_number: int
    kind: BlockKind
    """positioning: the part zero is set here; cut: the tool is in the work; safe: it is away from
    it; idle: the program is stopped; spindle: the spindle turns and nothing else happens."""
    duration_s: float
    spindle_speed_rpm: float = 0.0
    chiller: bool = True
    tool_number: int | None = None
    """A tool change at the block's beginning: this tool comes into the spindle."""
    tool_setting: str | None = None
    """The tool in the spindle is set on this axis at the block's beginning."""
    probe: str | None = None
    """A probe measures the deviation of this axis at the block's beginning."""
    speed_call: SpeedCall | None = None
    """Made at the block's beginning; what follows at the same programmed speed turns as it says."""

    def __post_init__(self) -> None:
        if not self.duration_s > 0:
            raise ValueError(f"block N{self.sequence_number}: duration_s must be positive, got {self.duration_s}")
        if not 0 <= self.spindle_speed_rpm <= RATED_SPEED_RPM:
            raise ValueError(
                f"block N{self.sequence_number}: {self.spindle_speed_rpm} 1/min is outside 0..{RATED_SPEED_RPM:.0f}"
            )

    @property
    def feeding(self) -> bool:
        """The axes move in this block."""
        return self.kind in ("positioning", "cut", "safe")


@dataclass(frozen=True, slots=True, kw_only=True)
class PartProgram:
    """Blocks that run one after the other; after the last it goes on at `repeat_from`."""

    number: int
    """O number."""
    blocks: tuple[Block, ...]
    repeat_from: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.repeat_from < len(self.blocks):
            raise ValueError(f"program O{self.number}: repeat_from {self.repeat_from} is not one of its blocks")

    def following(self, index: int) -> int:
        """Return the index of the block after block `index`."""
        return index + 1 if index + 1 < len(self.blocks) else self.repeat_from


POSITIONING, FIRST_CUT, SAFE, STANDSTILL, ROTATION, RETREAT = 100, 200, 900, 10, 300, 90
"""Sequence numbers of the shipped programs."""
DEPTH_MM = {12000.0: 2.0, 10000.0: 3.5, 8000.0: 3.0}
RADIAL_MM = 8.0
"""Of the cuts of the shipped program, by their speed [1/min]."""
FEED_MM = 0.2
"""Feed for each turn of the spindle [mm]."""
SHIFT_PARTS = 19
"""Parts that are made before the night."""


def demo_program() -> PartProgram:
    """Return O1000: standstill, then for ever work positioning (N100), 48 min of cuts (N200 ..), a short stop.

    A minute is a cut of 55 s and a safe point (N900) of 5 s; the spindle goes on turning there. The speed program is
    called before each cut.
    """
    speeds = [12000.0] * 20 + [10000.0] * 10 + [8000.0] * 8 + [12000.0] * 10
    calls = [_speed_call(speed_rpm) for speed_rpm in speeds]
    blocks = [
        Block(sequence_number=STANDSTILL, kind="idle", duration_s=150.0),
        Block(sequence_number=POSITIONING, kind="positioning", duration_s=20.0, speed_call=calls[0]),
    ]
    for number, (speed_rpm, next_call) in enumerate(zip(speeds, [*calls[1:], None], strict=True)):
        sequence_number = FIRST_CUT + 10 * number
        blocks.append(Block(sequence_number=sequence_number, kind="cut", duration_s=55.0, spindle_speed_rpm=speed_rpm))
        blocks.append(
            Block(sequence_number=SAFE, kind="safe", duration_s=5.0, spindle_speed_rpm=speed_rpm, speed_call=next_call)
        )
    blocks.append(Block(sequence_number=STANDSTILL + 10, kind="idle", duration_s=100.0))
    return PartProgram(number=1000, blocks=tuple(blocks), repeat_from=1)


def _speed_call(speed_rpm: float) -> SpeedCall:
    return SpeedCall(
        speed_rpm=speed_rpm,
        feed_mm_min=FEED_MM * speed_rpm,
        depth_mm=DEPTH_MM[speed_rpm],
        radial_mm=RADIAL_MM,
    )


def standing_program() -> PartProgram:
    """Return O9100: stands at a safe point (N900) for ever, spindle off, and has the guard run again and again."""
    return PartProgram(number=9100, blocks=(Block(sequence_number=SAFE, kind="safe", duration_s=HOUR_S),))


WORKS: dict[int, tuple[int | None, str | None, str | None]] = {
    6: (None, None, "z"),
    12: (2, None, None),
    13: (None, "z", None),
    20: (None, None, "y"),
    24: (3, None, None),
    30: (None, None, "z"),
    36: (2, None, None),
    44: (1, None, None),
}
"""What happens at which safe point of a part: tool into the spindle, axis of a tool setting, axis of a probe."""
RETREAT_S = 300.0


def campaign_program() -> PartProgram:
    """Return O1000 over whole days: parts with all that an NC program may ask of the daemon, then a night's standstill.

    Before each positioning the program waits at a retreat block (N90), where the guard may take the offset out; tools
    change, one is set again, and probes measure.
    """
    start, *part = demo_program().blocks
    safe_points = [index for index, block in enumerate(part) if block.kind == "safe"]
    for number, (tool, setting, probe) in WORKS.items():
        index = safe_points[number]
        part[index] = replace(part[index], tool_number=tool, tool_setting=setting, probe=probe)
    part.append(Block(sequence_number=RETREAT, kind="safe", duration_s=RETREAT_S))
    parts = int(SHIFT_PARTS * sum(block.duration_s for block in demo_program().blocks[1:]) // _total_s(part))
    night = Block(sequence_number=STANDSTILL + 20, kind="idle", duration_s=24 * HOUR_S - parts * _total_s(part))
    return PartProgram(number=1000, blocks=(start, *part * parts, night), repeat_from=1)


def _total_s(blocks: Sequence[Block]) -> float:
    return sum(block.duration_s for block in blocks)


def rotation_program(
    *, speed_rpm: float = 12000.0, hours: float = 2.0, idle_hours: float = 3.0, idle_reduction: bool = False
) -> PartProgram:
    """Return O2000: constant rotation, then idle with (standby) or without (idle reduction) the chiller."""
    return PartProgram(number=2000, blocks=tuple(_rotation(speed_rpm, hours, idle_hours, idle_reduction)))


def stepwise_program(
    speeds_rpm: Sequence[float], *, minutes_each: float = 20.0, idle_hours: float = 3.0, idle_reduction: bool = False
) -> PartProgram:
    """Return O2100: the speeds one after the other, then idle."""
    blocks = [
        Block(sequence_number=ROTATION, kind="spindle", duration_s=minutes_each * MINUTE_S, spindle_speed_rpm=speed)
        for speed in speeds_rpm
    ]
    blocks.append(_idle(idle_hours * HOUR_S, idle_reduction))
    return PartProgram(number=2100, blocks=tuple(blocks))


def alternating_program(
    speeds_rpm: Sequence[float],
    *,
    hours: float = 2.0,
    idle_hours: float = 3.0,
    idle_reduction: Sequence[bool] = (False,),
) -> PartProgram:
    """Return O2200: rotation and idle for each speed; `idle_reduction` is used in turn."""
    blocks: list[Block] = []
    for number, speed_rpm in enumerate(speeds_rpm):
        blocks.extend(_rotation(speed_rpm, hours, idle_hours, idle_reduction[number % len(idle_reduction)]))
    return PartProgram(number=2200, blocks=tuple(blocks))


def switching_program(
    *,
    speed_rpm: float = 12000.0,
    rotation_min: Sequence[float] = (5, 10, 15, 20),
    idle_min: Sequence[float] = (5, 10, 15),
) -> PartProgram:
    """Return O2300: short rotations and stops without the chiller in turn, each pair of durations once."""
    blocks: list[Block] = []
    for rotating in rotation_min:
        for resting in idle_min:
            blocks.extend(_rotation(speed_rpm, rotating / 60.0, resting / 60.0, True))
    return PartProgram(number=2300, blocks=tuple(blocks))


def _rotation(speed_rpm: float, hours: float, idle_hours: float, idle_reduction: bool) -> list[Block]:
    turning = Block(sequence_number=ROTATION, kind="spindle", duration_s=hours * HOUR_S, spindle_speed_rpm=speed_rpm)
    return [turning, _idle(idle_hours * HOUR_S, idle_reduction)]


def _idle(duration_s: float, idle_reduction: bool) -> Block:
    return Block(sequence_number=STANDSTILL, kind="idle", duration_s=duration_s, chiller=not idle_reduction)


RATED_SPEED_RPM = 12000.0
"""Highest spindle speed of the machine [1/min]; the laws are written relative to it."""
