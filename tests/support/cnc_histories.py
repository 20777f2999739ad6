"""Random histories of a control, its wire, its operator and the daemon, and a verdict of where the tool truly is.

The part program positions the work, cuts and calls the shipped guard (`cnc_program.py`, where the judge is too); the
driver of the dialect talks to its server over a wire (`cnc_wire.py`); what goes wrong stands in `cnc_events.py`.
"""

import asyncio
import contextlib
import math
import random
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from cnc_events import EVENTS, ONLY
from cnc_machines import PROVED, RETREATS, bench_of, some_machine
from cnc_program import ATTACKED, BEFORE, CALM, Block, Judge, PartProgram
from cnc_wire import COUNTED, OF_THE_BUILDER, TOOLS_COUNTED, Served, serving
from control_rig import SENSOR_IDS, TURN_S, Rig, record_for, running
from guard_bench import KeptTable
from memory_cnc import MemoryNc
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, VALUE

from config.schema.cnc_drivers import LATEST_T
from daemon.messages import ReferenceRequest
from drivers.contract import Cnc
from drivers.registry import open_cnc
from drivers.sim.nc.nc import ModeCode
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.sinumerik import SinumerikControl
from models.control.state import OperatorRequest
from models.records import CncRun, Reference

FIRST_FASTER = 12.0
"""The thermal error goes so much faster while nothing is wrong yet, so that some um are applied."""
NOSE_FIRST_FASTER = 20.0
NOSE_HELD_S = 20.0
"""The last temperature of the nose counts for so long when no other comes [s]."""
WRONG_UM = 1.0
LONGEST_WRONG = 45
"""So many turns the output may need for the way back, at its slew, while it says that it follows."""
TELLS = ("numbers", "counter", "handshake")
"""How the program tells that the work is positioned."""


class Shop:
    """One history: a machine, its daemon, and what goes wrong."""

    def __init__(self, served: Served, directory: Path, seed: int, *, attacked: bool = True) -> None:
        self.rng = random.Random(f"{served.dialect} {seed}")
        self.served, self.wire, self.attacked = served, served.wire, attacked
        self.tells = self.rng.choice(TELLS)
        self.to_zero = self.rng.random() < 0.25
        self.person_returns = self.rng.random() < 0.6
        self.zero_first = self.rng.random() < 0.25
        self.many_tools, self.many_works = self.rng.random() < 0.4, self.rng.random() < 0.3
        self.siemens = served.dialect == "sinumerik"
        self.machine = some_machine(self.rng, slopes=served.dialect != "haas")
        self.placed = "z_slope" in self.machine.places and not self.siemens
        tools = random.Random(f"{served.dialect} {seed} tools")
        self.tools_expand = tools.random() < 0.5
        self.counts_tools = self.tools_expand and (self.tells != "handshake" or tools.random() < 0.5)
        if self.tools_expand:
            self.machine = replace(self.machine, grows_um_per_k={"z": tools.choice((-3.3, 3.3))})
            self.many_tools |= tools.random() < 0.6
        self.tells_latest_t = served.dialect == "focas" and self.tells == "handshake"
        """The control tells the latest T word, and the program names its tool; else the builder's variable is read."""
        self.warms_k = tools.choice((-1, 1)) * tools.uniform(0.001, 0.005)
        """By how much the nose warms in a turn."""
        reference: dict[str, Any] = {"positioning_counter": COUNTED} if self.tells == "counter" else {}
        if self.counts_tools:
            reference["tool_counter"] = TOOLS_COUNTED
        if self.zero_first:
            reference |= {"policy": "zero_first", "retreat_sequence_numbers": [RETREATS]}
        bench = self.bench = bench_of(self.machine, directory, **reference)
        expiry = "zero" if self.to_zero else "keep"
        reached = served.section(bench, served.wire.port, expiry, self.machine)
        if reached.focas is not None:
            macro = LATEST_T if self.tells_latest_t else OF_THE_BUILDER
            focas = reached.focas.model_copy(update={"tool_macro": macro})
            reached, served.server.responder.tool_macro = reached.model_copy(update={"focas": focas}), macro
        compensation = bench.configuration.compensation
        bench.configuration = bench.configuration.model_copy(update={"cnc": reached})
        nc = self.nc = bench.nc = MemoryNc(bench.configuration, bench.clock)
        if not self.siemens:
            nc.guard = SafePointApplication(reached.macros, compensation.outputs, reached.guard)
        nc.macros = KeptTable() if self.siemens else nc.macros
        for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE, COUNTED, TOOLS_COUNTED):
            nc.macros.set(number, 0.0)
        nc.guard.initialise(nc.macros, nc.clock_s)
        self._begin_timer(nc.clock_s)
        served.face.nc, served.face.alarm, served.face.mode, served.face.prepared = nc, 0, ModeCode.MEM, None

        def open_driver() -> Cnc:
            return open_cnc(bench.configuration, bench.clock)

        nc.open = open_driver  # type: ignore[method-assign, assignment]
        self.judge = Judge(self.machine)
        self.program = PartProgram(self)
        self.rig: Rig | None = None
        self.at_reference: dict[str, dict[str, float]] = {}
        """Thermal error at each reference [um]."""
        self.degc_at_reference: dict[str, float] = {}
        self.nose_silent = 0
        """Turns for which no sensor of the nose will be heard."""
        self.nose_heard = (0, self.judge.degc)
        """Turn and temperature when one was heard last."""
        self.answers: list[tuple[int, ReferenceRequest]] = []
        """References that the estimation sets, each with its turn."""
        self.slow = 0
        """Turns that the estimation takes to set one."""
        self.heard = 0
        self.asleep = 0
        """Turns in which the daemon's computer does nothing."""
        self.turn_number = 0
        self.restarts = False
        self.put_back: Callable[[], None] | None = None
        """What happens to the store before the next start of the daemon."""
        self.said: list[tuple[int, str]] = []
        self.states: Counter[str] = Counter()
        self.wrong_for = self.longest_wrong = 0
        most = {"y": 0.025, "z": 0.035, "x": 0.025, "z_slope": 0.06}
        self.slopes = {
            axis: self.rng.choice((-1, 1)) * self.rng.uniform(0.01, most[axis]) for axis in self.machine.places
        }
        self.undo: list[tuple[int, Callable[[], None]]] = []
        self.kept: dict[int, float | None] = {}
        self.old_answer = b""

    def _begin_timer(self, value: float) -> None:
        if self.siemens:
            nc, control = self.nc, self.nc.guard.control
            assert isinstance(control, SinumerikControl) and nc.guard.programs.start is not None
            nc.guard.at(nc.macros, nc.clock_s).run(nc.guard.programs.start)
            control.start_timer(self.bench.configuration.cnc.guard.timer, value)
            nc.guard.show(nc.macros, nc.clock_s)

    @property
    def tools_differ(self) -> bool:
        """It matters to the daemon which tool is in the spindle."""
        return self.tools_expand or self.many_tools

    def then(self, turn: int, event: "Callable[[Shop], None]") -> None:
        """Let something happen at a turn."""
        self.undo.append((turn, lambda: event(self)))

    @property
    def traits(self) -> str:
        """What kind of shop this is, in words."""
        named = {
            "zero first": self.zero_first,
            "many tools": self.many_tools,
            "many works": self.many_works,
            "tools expand": self.tools_expand,
            "slope by place": self.placed,
        }
        return f"{dict(self.machine.factors)} {[name for name, is_so in named.items() if is_so]}"

    def change_tool(self, number: int, *, named: bool = False) -> None:
        """Another tool comes into the spindle, at the temperature at which it is as long as it was measured.

        `named`: the program names it, and would not name one that had stayed.
        """
        if number == self.nc.tool_number and not named:
            return
        self.nc.tool_number, self.judge.cold_degc, self.served.face.prepared = number, self.judge.degc, None
        self.nc.macros.set(TOOLS_COUNTED, (self.nc.macros.get(TOOLS_COUNTED) or 0.0) + 1.0)

    def applied(self) -> dict[str, float]:
        return {axis: round(self.nc.guard.applied_um[axis], 2) for axis in self.machine.places}

    def power_cycle(self, *, counted: bool = True) -> None:
        nc = self.nc
        if not self.siemens:
            nc.macros.power_off()
        nc.power_on_count += counted
        nc.clock_zero_s = -nc.clock.now().monotonic_s
        nc.guard.power_cycle()
        self._begin_timer(0.001)
        self.wire.reset()
        nc.run = CncRun.RESET

    @property
    def silent(self) -> bool:
        """The output says that it follows, and nothing against it."""
        rig = self.rig
        return (
            rig is not None and rig.state == "ACTIVE" and rig.link.session is not None and not rig.control.journal.alarm
        )

    @property
    def followed(self) -> list[str]:
        """Axes that are switched on."""
        memory = None if self.rig is None else self.rig.control.memory
        numbers = self.machine.numbers
        return [] if memory is None else [axis for axis, number in numbers.items() if memory.wanted[number]]

    async def look(self) -> None:
        """One turn of the daemon, without time passing."""
        if self.rig is None or self.asleep:
            return
        rig = self.rig
        nc = self.nc
        nc.guard.show(nc.macros, nc.clock_s)
        due = [asked for at, asked in self.answers if at <= self.turn_number]
        self.answers = [(at, asked) for at, asked in self.answers if at > self.turn_number]
        for asked in due:
            rig.control.deliver(self._reference(asked))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(5.0):
                await rig.turn(self._estimate(rig), after_s=0.0, safe=False)
        for message in rig.asked[self.heard :]:
            if isinstance(message, ReferenceRequest):
                self.at_reference[message.reference_id] = dict(self.judge.error)
                self.degc_at_reference[message.reference_id] = self.judge.degc
                self.answers.append((self.turn_number + self.slow, message))
        self.heard = len(rig.asked)
        rig.alive()

    def _reference(self, asked: ReferenceRequest) -> Reference:
        return Reference(
            reference_id=asked.reference_id,
            time=self.nc.clock.now(),
            source=asked.source,
            degc=np.full(len(SENSOR_IDS), 20.0),
            program=asked.program,
            work_offset=asked.work_offset,
            power_on_count=asked.power_on_count,
        )

    def _estimate(self, rig: Rig) -> Any:
        """What a perfect estimation says, since the reference in force or the one that tools still count from."""
        kept_id = rig.control._references.kept_id
        then = self.at_reference.get(kept_id or "")
        if then is None:
            return rig.estimate(math.nan, math.nan, reference_id=None, channels=self.machine.channels)
        gone = (self.judge.error[axis] - then[axis] for axis in self.machine.places)
        heard, degc = self.nose_heard
        silent_s = TURN_S * (self.turn_number - heard)
        nose = {"A": degc - self.degc_at_reference[kept_id or ""]} if silent_s <= NOSE_HELD_S else {}
        return rig.estimate(
            *gone,
            reference_id=kept_id,
            channels=self.machine.channels,
            label_increment_degc=nose,
            held_s=silent_s if nose else 0.0,
        )

    async def turn(self) -> None:
        """Half a second."""
        self.turn_number += 1
        now = self.turn_number
        self.bench.clock.monotonic_s += TURN_S
        if BEFORE // 2 <= now < BEFORE + ATTACKED + CALM // 2:
            times = FIRST_FASTER if now < BEFORE else 1.0
            for axis, um in self.slopes.items():
                self.judge.error[axis] += um * times
            self.judge.degc += self.warms_k * (NOSE_FIRST_FASTER if now < BEFORE else 1.0)
            if self.rng.random() < 0.02:
                axis = self.rng.choice(list(self.machine.places))
                self.slopes[axis] = -self.slopes[axis]
        self.nose_silent = max(self.nose_silent - 1, 0)
        if not self.nose_silent:
            self.nose_heard = (now, self.judge.degc)
        await self.program.go_on()
        self._go_wrong(now)
        if self.asleep:
            self.asleep -= 1
        else:
            await self._reconnect()
            await self.look()
        self.program.answered()
        self.judge.look(self.nc.guard)
        if self.rig is not None and self.rig.control.memory is not None and self.rig.control.memory.error_reference_id:
            self.judge.ended(self.rig.control.memory.tools)
        self._watch()

    def _watch(self) -> None:
        assert self.rig is not None
        self.states[self.rig.state] += 1
        off = self.judge.off_um(self.nc, self.followed)
        wrong = self.silent and not self.asleep and off > WRONG_UM
        self.wrong_for = self.wrong_for + 1 if wrong else 0
        if self.wrong_for > self.longest_wrong:
            self.longest_wrong, self.judge.largest = self.wrong_for, max(self.judge.largest, off)

    async def _reconnect(self) -> None:
        for _ in range(40):
            if self.rig is None or self.rig.link.session is not None:
                return
            await asyncio.sleep(0.001)

    def _go_wrong(self, now: int) -> None:
        if self.attacked and now in self.plan:
            for _ in range(self.plan.count(now)):
                name = self.rng.choice(list(EVENTS))
                if self.served.dialect in ONLY.get(name, (self.served.dialect,)) and (
                    not name.startswith("another tool") or self.counts_tools or not self.tools_expand
                ):
                    self.said.append((now, name))
                    EVENTS[name](self)
        for at, undo in list(self.undo):
            if at <= now:
                undo()
                self.undo.remove((at, undo))
        if now == BEFORE + ATTACKED:
            self.wire.calm()
            self.program.broken_after = self.program.watched_after = None
            if self.nc.run is not CncRun.START:
                self.program.restart(from_the_top=self.rng.random() < 0.5)
        rig = self.rig
        if self.person_returns and now > BEFORE + ATTACKED and now % 9 == 0 and rig is not None:
            if rig.state == "FAULT":
                said = rig.acknowledge("a person")
                self.said.append((now, f"acknowledged {rig.control.journal.fault} {said}"[:160]))
            elif rig.state in ("OFF", "RETREAT") or (rig.state == "HOLD" and not self.followed):
                rig.control.request(OperatorRequest(enable=frozenset(self.machine.places)), "a person")

    @property
    def goes_on(self) -> bool:
        """It is not at its end, or stands wrong there, which may be the way back."""
        return self.turn_number < BEFORE + ATTACKED + CALM or 0 < self.wrong_for <= LONGEST_WRONG

    async def play(self) -> None:
        """Play the history to its end."""
        spread = range(BEFORE, BEFORE + ATTACKED)
        self.plan = [self.rng.choice(spread) for _ in range(self.rng.choice((1, 2, 3, 4, 5, 6)))]
        self.program.restart(from_the_top=True)
        self.program.block = Block(10, 6)
        while self.goes_on:
            async with running(self._rig(), connect=self.turn_number == 0) as rig:
                self.rig, self.heard, self.restarts = rig, 0, False
                while self.goes_on and not self.restarts:
                    await self.turn()
                    if self.turn_number == 20:
                        assert (
                            rig.control.request(OperatorRequest(enable=frozenset(self.machine.places)), "a person")
                            == ""
                        )
                await rig.history.flushed()
                rig.alive()
            if self.put_back is not None:
                self.put_back()
                self.put_back = None
        self.ends = rig.state

    def _rig(self) -> Rig:
        configuration = self.bench.configuration
        unmoved = {"x": PROVED} if "y" in self.machine.places else {}
        record = record_for(configuration, axes=unmoved | self.machine.commissioned())
        return Rig(configuration, self.nc, self.bench.clock, record=record)

    def verdict(self) -> str:
        """Return what was wrong, '' where nothing was."""
        if self.longest_wrong > LONGEST_WRONG:
            um = self.judge.largest
            return f"stood up to {um:.1f} um off for {self.longest_wrong} turns in ACTIVE without a word"
        return ""


@dataclass(slots=True, kw_only=True)
class Tally:
    """What many histories came to."""

    histories: int = 0
    motions: int = 0
    happened: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    """Histories by the state in which they ended."""
    wrong: list[str] = field(default_factory=list)
    """A sentence for each that moved the tool wrongly without a word."""


async def played(dialect: str, seeds: Sequence[int], directory: Path) -> Tally:
    """Play a history for each seed."""
    tally = Tally()
    async with serving(dialect, directory) as served:
        for seed in seeds:
            with tempfile.TemporaryDirectory(dir=directory) as folder:
                served.calm()
                shop = Shop(served, Path(folder), seed)
                await shop.play()
            tally.histories += 1
            tally.motions += shop.judge.moves
            tally.ends[shop.ends] += 1
            tally.happened.update(what for _, what in shop.said if what in EVENTS)
            if wrong := shop.verdict():
                tally.wrong.append(f"{dialect}, seed {seed}: {wrong}; {shop.tells}, {shop.traits}, {shop.said}")
    return tally
