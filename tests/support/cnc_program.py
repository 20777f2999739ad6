"""The part program of a random history of a control, and the judge that knows where the tool truly is.

The judge shares nothing with the daemon: it takes the thermal error that the history has made up, and the control's
register of the external offset less what a hand has put there. What their sum has gone by since the work was positioned
is how far the tool stands from where it was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cnc_wire import COUNTED
from memory_cnc import MemoryNc
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, PROBE, REFERENCE, VALUE

from drivers.sim.nc.safe_point import SafePointApplication
from models.records import CncRun

if TYPE_CHECKING:
    from cnc_histories import Shop

BEFORE, ATTACKED, CALM = 40, 80, 90
"""Turns of half a second until the output follows, in which things go wrong, and after them."""
AXES = {"y": 1, "z": 2}
"""Axes with a model, and their place on the control."""
PROBES = 60
"""N number of the block at which the work is measured."""
WAITS = 24
"""Turns for which the program waits for an answer."""


@dataclass(slots=True)
class Judge:
    """Where the tool stands; all in um by axis."""

    error: dict[str, float] = field(default_factory=lambda: dict.fromkeys(AXES, 0.0))
    """Thermal error, tool against work."""
    by_hand: dict[str, float] = field(default_factory=lambda: dict.fromkeys(AXES, 0.0))
    """What an operator has put into the external offset."""
    factors: dict[str, float] = field(default_factory=lambda: dict.fromkeys(AXES, 1.0))
    """How far the tool goes along the axis for an offset of 1: half of it where diameters are programmed."""
    then: dict[float, dict[str, float]] = field(default_factory=dict)
    """Where it stood when the work was positioned, by work offset."""
    moves: int = 0
    largest: float = 0.0
    _stood: dict[str, float] = field(default_factory=dict)

    def tool(self, guard: SafePointApplication) -> dict[str, float]:
        """Return where the tool stands, from the control's registers."""
        register = guard.control.external_mm
        return {
            axis: self.error[axis] + self.factors[axis] * (1000.0 * register[place] - self.by_hand[axis])
            for axis, place in AXES.items()
        }

    def positioned(self, nc: MemoryNc) -> None:
        """The program has just positioned the work of the active work offset."""
        self.then[nc.work_offset] = self.tool(nc.guard)

    def gone(self, nc: MemoryNc) -> dict[str, float] | None:
        """Return how far the tool stands from where it stood when the work was positioned; None: it never was."""
        now, then = self.tool(nc.guard), self.then.get(nc.work_offset)
        return None if then is None else {axis: now[axis] - then[axis] for axis in AXES}

    def off_um(self, nc: MemoryNc, axes: Sequence[str]) -> float:
        """Return the same without sign, of the worst of these axes."""
        gone = self.gone(nc)
        return math.inf if gone is None else max((abs(gone[axis]) for axis in axes), default=0.0)

    def look(self, guard: SafePointApplication) -> None:
        """Count a motion."""
        register = {axis: guard.control.external_mm[place] for axis, place in AXES.items()}
        self.moves += bool(self._stood) and register != self._stood
        self._stood = register


@dataclass(slots=True)
class Block:
    """A block of the part program at which it stands for some turns."""

    number: int
    turns: int


class PartProgram:
    """Positions the work, cuts, and calls the guard where the tool is away from it."""

    def __init__(self, shop: Shop) -> None:
        self.shop, self.rng = shop, shop.rng
        self.block, self.ahead = Block(20, 1), list[Block]()
        self.asked = 0
        """Counter of the request whose answer is waited for, 0: none."""
        self.broken_after: int | None = None
        """RESET after so many blocks of the next guard."""
        self.watched_after: int | None = None
        """The daemon looks after so many blocks of it."""

    def restart(self, *, from_the_top: bool) -> None:
        """Begin again, or go on behind the positioning, where the work stands."""
        self.shop.nc.run = CncRun.START
        self.ahead = self._part() if from_the_top else self._cuts()
        self.block = Block(10, 1)
        self.shop.nc.sequence_number = 10

    def _part(self) -> list[Block]:
        return [Block(100, 5), *self._cuts()]

    def _cuts(self) -> list[Block]:
        cuts = (Block(self.rng.choice((20, 30, 40)), self.rng.randrange(1, 5)) for _ in range(self.rng.randrange(3, 9)))
        return [each for cut in cuts for each in (cut, Block(900, 2))]

    async def go_on(self) -> None:
        """Half a second of the program."""
        nc = self.shop.nc
        if nc.run is not CncRun.START or nc.program != 1000:
            return
        self.block.turns -= 1
        if self.block.turns > 0:
            return
        if not self.ahead:
            calm = self.shop.turn_number > BEFORE + ATTACKED
            self.ahead = self._part() if self.rng.random() < (0.1 if calm else 0.3) else self._cuts()
        self.block = self.ahead.pop(0)
        nc.sequence_number = self.block.number
        if self.block.number == 100:
            self._position()
        elif self.block.number == 900:
            await self._call_guard()
        elif self.block.number == PROBES:
            self._probe()

    def _position(self) -> None:
        shop, macros = self.shop, self.shop.nc.macros
        if shop.tells == "counter":
            macros.set(COUNTED, (macros.get(COUNTED) or 0.0) + 1.0)
        shop.judge.positioned(shop.nc)
        shop.said.append((shop.turn_number, f"positioned {shop.applied()}"))
        if shop.tells == "handshake":
            self._ask(REFERENCE)

    def _probe(self) -> None:
        """Measure how far the tool stands from where it was, along one axis, and hand it over."""
        axis = self.rng.choice(list(AXES))
        if (now := self.shop.judge.gone(self.shop.nc)) is not None:
            self._ask(PROBE, AXES[axis] + 1, now[axis] / 1000.0)

    def _ask(self, kind: int, axis: int = 0, value_mm: float = 0.0) -> None:
        macros = self.shop.nc.macros
        self.asked = int(abs(macros.get(COUNTER) or 0.0)) % 9999 + 1
        for number, value in ((KIND, kind), (AXIS, axis), (VALUE, value_mm), (COUNTER, self.asked)):
            macros.set(number, float(value))
        self.block.turns = WAITS

    def answered(self) -> None:
        """Look for the answer, as the request program does, which gives up after a while."""
        if not self.asked or self.block.number not in (100, PROBES):
            return
        macros = self.shop.nc.macros
        if abs(macros.get(ACKNOWLEDGE) or 0.0) == self.asked:
            self.asked, self.block.turns = 0, 1
        elif self.block.turns <= 1:
            macros.set(KIND, 0.0)
            self.asked = 0

    async def _call_guard(self) -> None:
        nc = self.shop.nc
        interpreter = nc.guard.at(nc.macros, nc.clock_s)
        interpreter.start(nc.guard.programs.guard)
        blocks = 0
        while interpreter.running:
            if blocks == self.watched_after:
                self.watched_after = None
                await self.shop.look()
                nc.guard.at(nc.macros, nc.clock_s)
            if blocks == self.broken_after:
                self.broken_after = None
                interpreter.reset()
                nc.run = CncRun.RESET
                self.shop.said.append((self.shop.turn_number, f"RESET in the guard, block {blocks}"))
                return
            interpreter.step()
            blocks += 1
