"""The script of a fault campaign: what happens to machine and daemon, and when; random by a seed."""

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum

from config.schema.temperatures import LineConfig
from drivers.sim.faults import Fault, FaultKind

DAY_S = 86400.0
EPOCH_UTC_S = datetime(2026, 1, 5, 6, tzinfo=UTC).timestamp()
"""Every campaign begins on this Monday morning, so that the same seed gives the same days [s]."""
FIRST_S = 900.0
"""The first scripted incident; the machine has positioned its first part long before [s]."""
SPACING_S = 900.0
"""Scripted incidents follow each other so far apart that each is got over before the next [s]."""


class Incident(StrEnum):
    """What may happen beyond the faults of `FaultKind`."""

    BLIND = "blind"
    """No line sends anything."""
    CORRUPT_RETURN = "corrupt_return"
    """A line is silent, and when it returns one bit of a sensor's value is wrong in the first passes (`amount`: which
    bit, and in how many passes)."""
    CORRUPT_START = "corrupt_start"
    """The daemon is killed, and in the first passes of the next one a bit of a sensor's value is wrong."""
    SLOW_CNC = "slow_cnc"
    """Answers come late by up to `amount` [s]."""
    REFUSING_CNC = "refusing_cnc"
    """Writes of values are refused."""
    LYING_CNC = "lying_cnc"
    """A value macro holds something else than was written, and the write was accepted."""
    CUT_WRITE = "cut_write"
    """The connection is lost after `amount` groups of a block; the next group arrives all the same, or does not."""
    FOREIGN_WRITE = "foreign_write"
    """Another program writes one of our macros."""
    FOREIGN_REQUEST = "foreign_request"
    """A request of the NC program holds what is none: vacant, a fraction, something huge (`target`: which)."""
    MISSED_POSITIONING = "missed_positioning"
    """The link is frozen for longer than a program stands at its positioning, and meanwhile the work is positioned."""
    VACANT_MACRO = "vacant_macro"
    """One of our macros becomes vacant."""
    ECHO_VACANT = "echo_vacant"
    """An axis' echo is vacant until the guard runs again, or the fault ends."""
    ECHO_NONSENSE = "echo_nonsense"
    """An axis' echo says more than the guard can have applied."""
    POWER_CYCLE = "power_cycle"
    """The CNC is switched off and on; its program begins again."""
    OTHER_PROGRAM = "other_program"
    """The CNC says that another program runs."""
    WORK_OFFSET = "work_offset"
    """Another work offset is in force."""
    CLOCK_STEP = "clock_step"
    """The calendar clock of the daemon's computer is set forward by `amount` [s] (negative: back)."""
    STORE_MOVED = "store_moved"
    """Somebody moves the store away while the daemon writes it."""
    HALF_OPEN = "half_open"
    """Somebody opens connections to the local socket, sends half a request on each, and waits."""
    FULL_DISK = "full_disk"
    """Files of the daemon's computer cannot grow."""
    KILLED_DAEMON = "killed_daemon"
    """The daemon gets SIGKILL; it is started again when the duration is over."""
    KILLED_IN_WRITE = "killed_in_write"
    """The same, after `amount` groups of a block."""
    OTHER_POLICY = "other_policy"
    """The daemon is stopped, its policy at work positioning changed, and it is started again after the duration;
    `target`: zero_first when it can be divided by `POLICIES`, else bumpless."""
    MODEL_RELOAD = "model_reload"
    """Another model is released, and the daemon takes it up."""
    DAMAGED_MODEL = "damaged_model"
    """The model's file is damaged when the daemon is told to take it up, and whole again when the duration is over."""
    WRONG_SENSOR = "wrong_sensor"
    """A sensor of the model that watches its sensors drifts by `amount` [degC/h]."""
    DISABLED_AXIS = "disabled_axis"
    """A person switches one axis off, and on again when the duration is over."""
    DISABLED = "disabled"
    """A person switches every axis off, and on again when the duration is over."""
    ZEROED = "zeroed"
    """A person asks for zero, and switches on again when the duration is over."""
    HAND_REFERENCE = "hand_reference"


Kind = FaultKind | Incident

ON_LINES = (
    FaultKind.NOISE,
    FaultKind.LOST_BYTES,
    FaultKind.DEAD_LINE,
    FaultKind.RENUMBERED,
    FaultKind.RESET_BURST,
    FaultKind.UNPLUGGED,
)
ON_SENSORS = (FaultKind.STUCK_SENSOR, FaultKind.DRIFTING_SENSOR, FaultKind.FLIPPED_BIT)
RESTARTS = (Incident.KILLED_DAEMON, Incident.KILLED_IN_WRITE, Incident.CORRUPT_START, Incident.OTHER_POLICY)
"""After these a daemon is started."""
POLICIES = 3
"""Of so many changes of the policy one leads to zero_first."""
WATCHED_SENSORS = (26, 64, 72, 87, 93, 99, 102, 110, 125, 138, 180, 200, 230, 260, 290, 301)
"""The sensors of the model that watches its sensors: one or two of every component."""
CORRUPT_BITS = (3, 4, 5, 6, 7, 8)
CORRUPT_PASSES = (1, 3, 12)
CYCLE_S = 10.0
"""Time between two passes of a line [s]."""
OF_A_PERSON = (Incident.DISABLED_AXIS, Incident.DISABLED, Incident.ZEROED, Incident.HAND_REFERENCE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Happening:
    """One incident of a campaign."""

    kind: Kind
    at_s: float
    duration_s: float = 0.0
    """0: a moment."""
    target: str | int | None = None
    """A line, a sensor, or which of several macros or axes."""
    amount: float = 0.0

    @property
    def end_s(self) -> float:
        """When it is over [s]."""
        return self.at_s + self.duration_s


@dataclass(frozen=True, slots=True, kw_only=True)
class _Habit:
    """How often something happens, for how long, and how badly."""

    per_day: float
    duration_s: tuple[float, float] = (0.0, 0.0)
    amount: tuple[float, float] = (0.0, 0.0)
    whole: bool = False
    either_way: bool = False


HABITS: dict[Kind, _Habit] = {
    FaultKind.NOISE: _Habit(per_day=3, duration_s=(30, 600), amount=(0.0005, 0.05)),
    FaultKind.LOST_BYTES: _Habit(per_day=3, duration_s=(30, 600), amount=(0.0005, 0.2)),
    FaultKind.DEAD_LINE: _Habit(per_day=3, duration_s=(20, 900), amount=(0, 60), whole=True),
    FaultKind.STUCK_SENSOR: _Habit(per_day=2, duration_s=(600, 7200)),
    FaultKind.DRIFTING_SENSOR: _Habit(per_day=2, duration_s=(600, 7200), amount=(0.5, 20), either_way=True),
    FaultKind.FLIPPED_BIT: _Habit(per_day=2, duration_s=(5, 200), amount=(2, 9), whole=True),
    FaultKind.RENUMBERED: _Habit(per_day=1, duration_s=(30, 600), amount=(1, 60), whole=True),
    FaultKind.RESET_BURST: _Habit(per_day=2, duration_s=(10, 60)),
    FaultKind.UNPLUGGED: _Habit(per_day=2, duration_s=(10, 300)),
    Incident.BLIND: _Habit(per_day=1, duration_s=(90, 900)),
    Incident.CORRUPT_RETURN: _Habit(per_day=2, duration_s=(200, 400), amount=(0, 17), whole=True),
    FaultKind.FROZEN_CNC: _Habit(per_day=2, duration_s=(2, 300)),
    FaultKind.KILLED_CNC: _Habit(per_day=2, duration_s=(2, 300)),
    Incident.SLOW_CNC: _Habit(per_day=2, duration_s=(30, 600), amount=(0.05, 0.9)),
    Incident.REFUSING_CNC: _Habit(per_day=1, duration_s=(15, 60)),
    Incident.LYING_CNC: _Habit(per_day=1, duration_s=(15, 60)),
    Incident.CUT_WRITE: _Habit(per_day=2, amount=(0, 2), whole=True),
    Incident.FOREIGN_WRITE: _Habit(per_day=1),
    Incident.FOREIGN_REQUEST: _Habit(per_day=2),
    Incident.VACANT_MACRO: _Habit(per_day=1),
    Incident.ECHO_VACANT: _Habit(per_day=1, duration_s=(15, 60)),
    Incident.ECHO_NONSENSE: _Habit(per_day=1, duration_s=(15, 60)),
    Incident.POWER_CYCLE: _Habit(per_day=1),
    Incident.OTHER_PROGRAM: _Habit(per_day=0.5, duration_s=(15, 60)),
    Incident.WORK_OFFSET: _Habit(per_day=0.5, duration_s=(15, 60)),
    Incident.CLOCK_STEP: _Habit(per_day=2, amount=(0.5, 200_000), either_way=True),
    Incident.STORE_MOVED: _Habit(per_day=0.25),
    Incident.HALF_OPEN: _Habit(per_day=0.5, duration_s=(30, 300)),
    Incident.FULL_DISK: _Habit(per_day=1, duration_s=(30, 300)),
    Incident.KILLED_DAEMON: _Habit(per_day=0.25, duration_s=(2, 900)),
    Incident.KILLED_IN_WRITE: _Habit(per_day=0.25, duration_s=(2, 60), amount=(0, 2), whole=True),
    Incident.CORRUPT_START: _Habit(per_day=0.25, duration_s=(130, 250), amount=(0, 17), whole=True),
    Incident.OTHER_POLICY: _Habit(per_day=0.25, duration_s=(2, 20)),
    Incident.MODEL_RELOAD: _Habit(per_day=1),
    Incident.DAMAGED_MODEL: _Habit(per_day=0.5, duration_s=(5, 60)),
    Incident.WRONG_SENSOR: _Habit(per_day=0.5, duration_s=(2400, 5400), amount=(8, 20), either_way=True),
    FaultKind.CSV_TRUNCATED: _Habit(per_day=1),
    FaultKind.CSV_ROTATED: _Habit(per_day=1),
    FaultKind.CSV_HALF_ROW: _Habit(per_day=2, duration_s=(10, 50)),
    Incident.DISABLED_AXIS: _Habit(per_day=1, duration_s=(60, 900)),
    Incident.DISABLED: _Habit(per_day=1, duration_s=(60, 900)),
    Incident.ZEROED: _Habit(per_day=1, duration_s=(60, 900)),
    Incident.HAND_REFERENCE: _Habit(per_day=1),
    Incident.MISSED_POSITIONING: _Habit(per_day=0.5, duration_s=(10, 60)),
}
"""Rates are far above any real machine's, so that many overlaps of two faults happen in a month."""


def campaign(days: float, seed: int, lines: Sequence[LineConfig]) -> tuple[Happening, ...]:
    """Return everything that happens in a campaign, by time: each kind once in turn, and then also by chance.

    One that is too short for all kinds draws their order, so that every seed brings others.
    """
    end_s = days * DAY_S
    scripted = list(_scripted(random.Random(f"script {seed}"), lines, list(HABITS)))
    if scripted[-1].end_s >= end_s:
        order = random.Random(f"order {seed}")
        scripted = list(_scripted(random.Random(f"script {seed}"), lines, order.sample(list(HABITS), len(HABITS))))
    by_chance_s = scripted[-1].end_s + SPACING_S
    random_ones = _random(random.Random(f"chance {seed}"), lines, by_chance_s, end_s)
    happenings = [*scripted, *random_ones]
    return tuple(sorted((h for h in happenings if h.end_s < end_s), key=lambda h: h.at_s))


def wire_faults(happenings: Sequence[Happening], lines: Sequence[LineConfig]) -> tuple[Fault, ...]:
    """Return what of it the simulated lines and the logger play by themselves."""
    faults = []
    for happening in happenings:
        if happening.kind is Incident.BLIND:
            faults += [_fault(happening, FaultKind.DEAD_LINE, line.name) for line in lines]
        elif happening.kind in (Incident.CORRUPT_RETURN, Incident.CORRUPT_START):
            faults += _corrupt(happening, lines)
        elif happening.kind is Incident.WRONG_SENSOR:
            faults.append(
                replace(_fault(happening, FaultKind.DRIFTING_SENSOR, happening.target), amount=happening.amount)
            )
        elif isinstance(happening.kind, FaultKind):
            faults.append(_fault(happening, happening.kind, happening.target))
    return tuple(faults)


def corrupt_from_s(happening: Happening) -> float:
    """Return when the silence before a corrupt return or start ends [s]."""
    return happening.end_s - CYCLE_S * CORRUPT_PASSES[int(happening.amount) // len(CORRUPT_BITS)]


def _corrupt(happening: Happening, lines: Sequence[LineConfig]) -> list[Fault]:
    """Return the silence of a line and the wrong bit in the first passes after it; after a start the bit alone."""
    from_s = corrupt_from_s(happening)
    bit = CORRUPT_BITS[int(happening.amount) % len(CORRUPT_BITS)]
    sensor = int(happening.target or 0)
    flipped = Fault(
        kind=FaultKind.FLIPPED_BIT, at_s=from_s, duration_s=happening.end_s - from_s, target=sensor, amount=float(bit)
    )
    if happening.kind is Incident.CORRUPT_START:
        return [flipped]
    line = next(line.name for line in lines if sensor in line.sensor_ids)
    silent_s = from_s - happening.at_s
    return [Fault(kind=FaultKind.DEAD_LINE, at_s=happening.at_s, duration_s=silent_s, target=line), flipped]


def _fault(happening: Happening, kind: FaultKind, target: str | int | None) -> Fault:
    return Fault(
        kind=kind,
        at_s=happening.at_s,
        duration_s=happening.duration_s or None,
        target=target,
        amount=happening.amount if kind is happening.kind else 0.0,
    )


def _scripted(rng: random.Random, lines: Sequence[LineConfig], kinds: Sequence[Kind]) -> Iterator[Happening]:
    at_s = FIRST_S
    for kind in kinds:
        if kind in ON_SENSORS or kind is Incident.WRONG_SENSOR:
            continue
        happening = _drawn(rng, kind, at_s, lines)
        if kind is Incident.OTHER_POLICY:
            happening = replace(happening, target=0)
        yield happening
        at_s = happening.end_s + SPACING_S
    for kind in ON_SENSORS:
        yield _drawn(rng, kind, FIRST_S, lines)
    yield _drawn(rng, Incident.WRONG_SENSOR, at_s, lines)


def _random(rng: random.Random, lines: Sequence[LineConfig], from_s: float, to_s: float) -> Iterator[Happening]:
    for kind, habit in HABITS.items():
        at_s = from_s + rng.expovariate(habit.per_day / DAY_S)
        while at_s < to_s:
            yield _drawn(rng, kind, at_s, lines)
            at_s += rng.expovariate(habit.per_day / DAY_S)


def _drawn(rng: random.Random, kind: Kind, at_s: float, lines: Sequence[LineConfig]) -> Happening:
    habit = HABITS[kind]
    low, high = habit.amount
    amount = float(rng.randint(int(low), int(high))) if habit.whole else _log_uniform(rng, low, high)
    if habit.either_way and rng.random() < 0.5:
        amount = -amount
    target: str | int | None = rng.randrange(1000)
    if kind in ON_LINES:
        line = rng.choice(list(lines))
        target, amount = line.name, min(amount, float(len(line.sensor_ids))) if habit.whole else amount
    elif kind in ON_SENSORS:
        target = rng.choice([sensor for line in lines for sensor in line.sensor_ids])
    elif kind is Incident.WRONG_SENSOR:
        target = rng.choice(WATCHED_SENSORS)
    elif kind in (Incident.CORRUPT_RETURN, Incident.CORRUPT_START):
        target = rng.choice([sensor for line in lines for sensor in line.sensor_ids])
    elif isinstance(kind, FaultKind):
        target = None
    duration_s = _log_uniform(rng, *habit.duration_s)
    return Happening(kind=kind, at_s=at_s, duration_s=duration_s, target=target, amount=amount)


def _log_uniform(rng: random.Random, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high))) if low > 0 else rng.uniform(low, high)
