"""The part program of a random history of a control, and the judge that knows where the tool truly is.

The judge shares nothing with the daemon: it takes the thermal error that the history has made up, and the control's
register of the external offset less what a hand has put there. What their sum has gone by since the work was positioned
is how far the tool stands from where it was.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cnc_machines import RETREATS, Machine, farthest_um, from_pivot_m
from cnc_wire import COUNTED
from memory_cnc import MemoryNc
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, PROBE, REFERENCE, TOOL_CHANGE, VALUE

from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.safe_point import SafePointApplication
from models.records import CncRun

if TYPE_CHECKING:
    from cnc_histories import Shop

BEFORE, ATTACKED, CALM = 40, 80, 90
"""Turns of half a second until the output follows, in which things go wrong, and after them."""
NAMES, PROBES, CHANGES, SETS, OTHER_WORK = 55, 60, 70, 80, 90
"""N numbers of the blocks at which the tool is named, the work is measured, another tool comes, it is set, and the work
offset changes."""
WORKS = (54, 55)
"""Work offsets of the program that has two."""
TOOLS = (1, 2, 3)
ECHO_SLOPED = (512, 513)
"""Macros of what is applied of Z and of its slope [mm]."""
STANDS_MM = (0.0, 100.0, 400.0, 500.0)
"""Where Z stands when the guard is called, on a machine with a slope."""
WAITS = 24
"""Turns for which the program waits for an answer."""
LONGEST_RETREAT = 90
"""Turns after which it no longer waits for the offset to be out."""


@dataclass(slots=True)
class Judge:
    """Where the tool stands; all in um by axis, of a slope in um/m."""

    machine: Machine
    error: dict[str, float] = field(default_factory=dict)
    """Thermal error, tool against work."""
    by_hand: dict[str, float] = field(default_factory=dict)
    """What an operator has put into the external offset."""
    then: dict[float, dict[str, float]] = field(default_factory=dict)
    """Where it stood when the work was positioned, by work offset."""
    set: dict[int, dict[str, float]] = field(default_factory=dict)
    """Where each tool stood when it was set, on the axes that it was set on."""
    degc: float = 20.0
    """Of the spindle's nose, and of the tool in it."""
    cold_degc: float = 20.0
    """The same when that tool came, was set or stood where the work was positioned."""
    slope_um: float = 0.0
    """What the guard has put into the offset at a metre from the pivot, of a control that has no slopes [um/m]."""
    moves: int = 0
    largest: float = 0.0
    _stood: dict[str, float] = field(default_factory=dict)
    _counted: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        self.error, self.by_hand = dict.fromkeys(self.machine.places, 0.0), dict.fromkeys(self.machine.places, 0.0)

    def tool(self, guard: SafePointApplication) -> dict[str, float]:
        """Return where the tool stands, from the control's registers."""
        return {
            axis: self.error[axis] + factor * (self._register_um(guard, axis) - self.by_hand[axis])
            for axis, factor in self.machine.factors.items()
        }

    def grown(self) -> dict[str, float]:
        """Return how far the tool in the spindle has expanded, by axis."""
        return {axis: um * (self.degc - self.cold_degc) for axis, um in self.machine.grows_um_per_k.items()}

    def positioned(self, nc: MemoryNc) -> None:
        """The program has just positioned the work of the active work offset, and so the tool in the spindle."""
        self.cold_degc = self.degc
        now = self.then[nc.work_offset] = self.tool(nc.guard)
        if (here := self.set.get(nc.tool_number)) is not None:
            self.set[nc.tool_number] = {axis: now[axis] for axis in here}

    def ended(self, counted: Iterable[int]) -> None:
        """Take the tools whose settings count: of the others the daemon has said that they are to be set again."""
        now = frozenset(counted)
        for number in self._counted - now:
            self.set.pop(number, None)
        self._counted = now

    def gone(self, nc: MemoryNc) -> dict[str, float] | None:
        """Return how far the tool stands from where it stood when the work was positioned; None: it never was."""
        now, then = self.tool(nc.guard), self.then.get(nc.work_offset)
        if then is None:
            return None
        then = then | self.set.get(nc.tool_number, {})
        grown = self.grown()
        return {axis: now[axis] - then[axis] + grown.get(axis, 0.0) for axis in self.machine.places}

    def off_um(self, nc: MemoryNc, axes: Sequence[str]) -> float:
        """Return the same without sign, of the worst of these axes."""
        gone = self.gone(nc)
        return math.inf if gone is None else farthest_um(self.machine, gone, list(axes))

    def look(self, guard: SafePointApplication) -> None:
        """Count a motion."""
        register = {axis: self._register_um(guard, axis) for axis in self.machine.places}
        self.moves += bool(self._stood) and register != self._stood
        self._stood = register

    def called(self, nc: MemoryNc) -> None:
        """Take the slope that a guard says it has put into the offset, when the register says so too."""
        macros, guard = nc.macros, nc.guard
        echo_z, echo_slope = (1000.0 * (macros.get(number) or 0.0) for number in ECHO_SLOPED)
        applied_um = 1000.0 * guard.control.external_mm[self.machine.places["z"]] - self.by_hand["z"]
        if abs(echo_z + echo_slope * from_pivot_m(guard) - applied_um) < 0.25:
            self.slope_um = echo_slope

    def _register_um(self, guard: SafePointApplication, axis: str) -> float:
        return self.machine.register_um(guard, axis, self.slope_um)


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
        self.set_at: dict[str, float] = {}
        """Where the tool that is being set stood when the program asked, on the axis that it is set on."""
        self.set_degc = 20.0
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
        retreat = [Block(RETREATS, LONGEST_RETREAT)] if self.shop.zero_first else []
        names = [Block(NAMES, 1)] if self.shop.tells_latest_t and self.shop.tools_differ else []
        return [*names, *retreat, *([Block(900, 2)] if self.shop.placed else []), Block(100, 5), *self._cuts()]

    def _cuts(self) -> list[Block]:
        cuts = (Block(self.rng.choice((20, 30, 40)), self.rng.randrange(1, 5)) for _ in range(self.rng.randrange(3, 9)))
        blocks = [each for cut in cuts for each in (cut, Block(900, 2))]
        if self.shop.many_tools:
            for number, share in ((SETS, 0.7), (CHANGES, 0.9)):
                if self.rng.random() < share:
                    blocks.insert(self.rng.randrange(0, len(blocks), 2), Block(number, 1))
        if self.shop.many_works and self.rng.random() < 0.2:
            blocks.insert(self.rng.randrange(0, len(blocks), 2), Block(OTHER_WORK, 2))
        return blocks

    async def go_on(self) -> None:
        """Half a second of the program."""
        nc = self.shop.nc
        if nc.run is not CncRun.START or nc.program != 1000:
            return
        self.block.turns -= 1
        if self.block.number == RETREATS:
            await self._retreat()
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
        elif self.block.number in (CHANGES, NAMES):
            self._change_tool(nc.tool_number if self.block.number == NAMES else self.rng.choice(TOOLS))
        elif self.block.number == SETS:
            self._set_tool()
        elif self.block.number == OTHER_WORK:
            nc.work_offset = self.rng.choice([each for each in WORKS if each in self.shop.judge.then])

    async def _retreat(self) -> None:
        """Call the guard until nothing is applied, and go on then."""
        if self.block.turns % 2 == 0:
            await self._call_guard()
        nothing = all(abs(um) < 0.01 for um in self.shop.nc.guard.applied_um.values())
        if nothing and self.block.turns < LONGEST_RETREAT - 4:
            self.block.turns = 0

    def _position(self) -> None:
        shop, macros = self.shop, self.shop.nc.macros
        if shop.tells == "counter":
            macros.set(COUNTED, (macros.get(COUNTED) or 0.0) + 1.0)
        if shop.many_works:
            shop.nc.work_offset = self.rng.choice(WORKS)
        shop.judge.positioned(shop.nc)
        shop.said.append((shop.turn_number, f"positioned {shop.applied()}"))
        if shop.tells == "handshake":
            self._ask(REFERENCE)

    def _probe(self) -> None:
        """Measure how far the tool stands from where it was, along one axis, and hand it over."""
        machine = self.shop.machine
        axis = self.rng.choice(machine.offsets)
        if (now := self.shop.judge.gone(self.shop.nc)) is not None:
            self._ask(PROBE, machine.numbers[axis] + 1, now[axis] / 1000.0)

    def _change_tool(self, number: int) -> None:
        """Another tool comes into the spindle; where the program hands over what it does, it names it."""
        nc = self.shop.nc
        self.shop.change_tool(number, named=self.shop.tells == "handshake")
        self.shop.said.append((self.shop.turn_number, f"T{nc.tool_number} comes"))
        if self.shop.tells == "handshake":
            self._ask(TOOL_CHANGE, value_mm=float(nc.tool_number))

    def _set_tool(self) -> None:
        """Measure the tool in the spindle along one axis: from now on it is right where it stands."""
        machine = self.shop.machine
        axis = self.rng.choice(machine.offsets)
        self.set_at = {axis: self.shop.judge.tool(self.shop.nc.guard)[axis]}
        self.set_degc = self.shop.judge.degc
        self._ask(REFERENCE, machine.numbers[axis] + 1)

    def _ask(self, kind: int, axis: int = 0, value_mm: float = 0.0) -> None:
        macros = self.shop.nc.macros
        self.asked = int(abs(macros.get(COUNTER) or 0.0)) % 9999 + 1
        for number, value in ((KIND, kind), (AXIS, axis), (VALUE, value_mm), (COUNTER, self.asked)):
            macros.set(number, float(value))
        self.block.turns = WAITS

    def answered(self) -> None:
        """Look for the answer, as the request program does, which gives up after a while."""
        if not self.asked or self.block.number not in (100, NAMES, PROBES, CHANGES, SETS):
            return
        macros, judge = self.shop.nc.macros, self.shop.judge
        answer = macros.get(ACKNOWLEDGE) or 0.0
        if abs(answer) == self.asked:
            if self.block.number == SETS and answer > 0.0:
                number = self.shop.nc.tool_number
                judge.set[number] = judge.set.get(number, {}) | self.set_at
                if self.set_at.keys() & judge.machine.grows_um_per_k.keys():
                    judge.cold_degc = self.set_degc
                self.shop.said.append((self.shop.turn_number, f"T{number} set {self.set_at}"))
            self.asked, self.block.turns = 0, 1
        elif self.block.turns <= 1:
            macros.set(KIND, 0.0)
            self.asked = 0

    async def _call_guard(self) -> None:
        """Call the guard, where there is a slope at another place now and then; go there only with what it needs."""
        nc, control = self.shop.nc, self.shop.nc.guard.control
        if self.shop.placed and isinstance(control, MacroControl) and self.rng.random() < 0.5:
            stood_mm, held_mm = control.positions_mm[2], control.external_mm[2]
            control.positions_mm[2] = self.rng.choice(STANDS_MM)
            await self._run_guard()
            if control.external_mm[2] == held_mm:
                control.positions_mm[2] = stood_mm
        await self._run_guard()
        if self.shop.placed:
            self.shop.judge.called(nc)

    async def _run_guard(self) -> None:
        nc = self.shop.nc
        if nc.run is CncRun.RESET:
            return
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
