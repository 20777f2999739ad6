"""Keeps the speed that each operation has come to, so that it goes on in steps when the operation comes again."""

import math
from dataclasses import replace

from daemon.cnc.events import Journal
from daemon.spindle_speed.calls import SpeedOperation
from daemon.state_store.documents import OperationSpeed, SpindleSpeeds, SpindleSpeedSwitch
from drivers.clock import Clock
from models.spindle_speed.tuning import SpeedTuningMemory, initial_memory

KEPT_S = 3600.0
"""A speed this old says nothing about the spindle of now: the operation then begins anew [s]."""
MOST_OPERATIONS = 50
"""So many are kept, the latest."""
Key = tuple[float, ...]


class OperationMemories:
    """The memory of every operation of the last hour, kept over a restart; owned by the control task."""

    def __init__(self, journal: Journal, clock: Clock) -> None:
        self._journal, self._clock = journal, clock
        self._kept: dict[Key, tuple[SpeedTuningMemory, bool]] = {}
        now = clock.now()
        kept = journal.kept(SpindleSpeeds)
        for entry in () if kept is None else kept.operations:
            age_s = now.utc_s - entry.utc_s
            memory = initial_memory(entry.programmed_rpm)
            if 0.0 <= age_s <= KEPT_S:
                memory = replace(memory, commanded_rpm=entry.commanded_rpm, begun=True, last_s=now.monotonic_s - age_s)
                self._kept[entry.key] = memory, entry.moved

    def begin(self, operation: SpeedOperation, lowest_rpm: float, highest_rpm: float) -> tuple[SpeedTuningMemory, bool]:
        """Return the memory with which an operation begins, or begins again, and whether the NC has yet to take it.

        What the target has done meanwhile counts as having lasted; a speed out of the bounds of now does not count.
        """
        programmed_rpm = operation.made_for.speed_rpm
        kept, moved = self._kept.get(_key(operation), (initial_memory(programmed_rpm), False))
        if not kept.begun or self._clock.now().monotonic_s - kept.last_s > KEPT_S:
            return initial_memory(programmed_rpm), False
        if kept.commanded_rpm != programmed_rpm and not lowest_rpm <= kept.commanded_rpm <= highest_rpm:
            return initial_memory(programmed_rpm), False
        since_s = kept.off_since_s if math.isfinite(kept.off_since_s) else kept.last_s
        return replace(kept, target_rpm=math.nan, off_since_s=since_s), moved

    def keep(self, operation: SpeedOperation, memory: SpeedTuningMemory, moved: bool) -> None:
        """Keep what an operation has come to, and whether the NC has yet to take that."""
        key = _key(operation)
        before = self._kept.pop(key, None)
        self._kept[key] = memory, moved
        for old in list(self._kept)[:-MOST_OPERATIONS]:
            del self._kept[old]
        if memory.begun and (before is None or (before[0].commanded_rpm, before[1]) != (memory.commanded_rpm, moved)):
            begun = tuple(self._entry(*kept) for kept in self._kept.items() if kept[1][0].begun)
            self._journal.keep(SpindleSpeeds(operations=begun))

    def _entry(self, key: Key, kept: tuple[SpeedTuningMemory, bool]) -> OperationSpeed:
        memory, moved = kept
        now = self._clock.now()
        age_s = now.monotonic_s - memory.last_s if math.isfinite(memory.last_s) else 0.0
        return OperationSpeed(
            key=key,
            programmed_rpm=memory.programmed_rpm,
            commanded_rpm=memory.commanded_rpm,
            moved=moved,
            utc_s=now.utc_s - age_s,
        )


def _key(operation: SpeedOperation) -> Key:
    made_for = operation.made_for
    return (
        made_for.tool_number,
        made_for.speed_rpm,
        made_for.feed_mm_min,
        made_for.depth_mm,
        made_for.radial_mm,
        made_for.kind,
        -1.0 if operation.place is None else float(operation.place),
    )


class SpeedSwitch:
    """On, until a person says otherwise; owned by the control task."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        kept = journal.kept(SpindleSpeedSwitch)
        self._off_by = "" if kept is None else kept.off_by

    @property
    def inhibit(self) -> str:
        """Who has switched it off, in words; '' while it is on."""
        if not self._off_by:
            return ""
        return f"switched off by {self._off_by}; `toolpoint enable --spindle-speed` switches it on"

    def turn(self, *, on: bool, person: str) -> None:
        """Switch on or off; nothing moves by that, the NC takes what follows from it with its next call."""
        self._off_by = "" if on else person
        self._journal.keep(SpindleSpeedSwitch(off_by=self._off_by))
        self._journal.event("request", f"{'enable' if on else 'disable'} the tuning of the spindle speed", person)
