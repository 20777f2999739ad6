"""The operator's own part of the external offset, to which the guard adds.

Whoever else changes the register moves the work's zero while an offset is compensated: a restored back-up of the
control holds what was compensated when it was made. So a change ends the reference, as another work offset does.
"""

from collections.abc import Mapping

from config.schema import Configuration
from daemon.state_store.documents import UNREADABLE, OwnOffsets
from daemon.state_store.store import StateStore
from drivers.contract import Cnc
from models.units import um_from_mm

EXTERNAL_OFFSET = 5200
"""#5201.. hold the external offset of axis 1.., in the unit of the program."""
UNIT_CODE, METRIC = 4006, 21
SLACK = 0.51
"""Of an increment: less is no change."""


def watched_offsets(configuration: Configuration) -> dict[str, int]:
    """Return the macro of the external offset by axis; of one with a slope the register does not tell its own part."""
    cnc, slopes = configuration.cnc, configuration.compensation.slopes
    if not cnc.watches_offset:
        return {}
    sloped = {*slopes, *(slope.of for slope in slopes.values())}
    numbers = {axis: cnc.guard.number_of(axis) for axis in configuration.compensation.axes if axis not in sloped}
    return {axis: EXTERNAL_OFFSET + number for axis, number in numbers.items() if number is not None}


def offset_macros(configuration: Configuration) -> tuple[int, ...]:
    """Return what is polled for it: unit, the guard's change that is under way, the registers."""
    registers = watched_offsets(configuration).values()
    return (UNIT_CODE, configuration.cnc.guard.memory, *registers) if registers else ()


class OwnOffsetWatch:
    """Compares the operator's own part with what it was; what is known outlives sessions and restarts."""

    def __init__(self, configuration: Configuration, store: StateStore) -> None:
        self._registers = watched_offsets(configuration)
        self._store = store
        self._guard = configuration.cnc.guard
        macros = configuration.cnc.macros
        self._echo = macros.echo_applied
        self._mm_per_unit = macros.unit_um / 1000.0
        self._known = dict(kept.mm) if self._registers and (kept := store.get(OwnOffsets)) is not None else {}

    async def changed(self, cnc: Cnc, found: Mapping[int, float | None]) -> str:
        """Return who was moved by how much since the last poll, '' when nobody; reads once more before it says so."""
        if not self._changes(self._own_mm(found)):
            return ""
        echoes = (self._echo[axis] for axis in self._registers)
        read = UNIT_CODE, self._guard.memory, *self._registers.values(), *echoes
        own_mm = self._own_mm(await cnc.read_macros(read))
        if not (changes := self._changes(own_mm)):  # the guard had been at it
            return ""
        words = [f"axis {n} by {um_from_mm(own_mm[n] - self._known[n]):+.1f} um" for n in changes if n in self._known]
        lost = UNREADABLE in self._known
        self._known = own_mm if lost else self._known | own_mm
        self._store.put(OwnOffsets(mm=dict(self._known)))
        if lost:
            return "what the external offset was cannot be read from the store, so it may have been changed meanwhile"
        return f"the external offset was changed beside the guard, {', '.join(words)}" if words else ""

    def _own_mm(self, found: Mapping[int, float | None]) -> dict[str, float]:
        """Return register minus what is applied, by axis [mm]; nothing in inches, and while the guard changes it."""
        if found.get(UNIT_CODE) != METRIC or found.get(self._guard.memory) != 0.0:
            return {}
        told = {axis: (found.get(number), found.get(self._echo[axis])) for axis, number in self._registers.items()}
        return {
            axis: register - echo * self._mm_per_unit
            for axis, (register, echo) in told.items()
            if register is not None and echo is not None
        }

    def _changes(self, own_mm: Mapping[str, float]) -> list[str]:
        """Return the axes whose own part is another than is known, or not known yet."""
        slack_mm = SLACK * self._guard.increment_mm
        return [axis for axis, mm in own_mm.items() if not abs(mm - self._known.get(axis, float("inf"))) <= slack_mm]
