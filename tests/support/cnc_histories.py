"""Random histories of a control, its wire, its operator and the daemon, and a judge that knows where the tool truly is.

The part program positions the work, cuts and calls the shipped guard; the driver of the dialect talks to its server
over a wire that is cut, held back or repeated. The judge shares nothing with the daemon: it takes the thermal error
that the history has made up, and the control's register of the external offset less what a hand has put there. What
their sum has gone by since the work was positioned is how far the tool stands from where it was.
"""

import asyncio
import contextlib
import math
import random
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from control_rig import SENSOR_IDS, Bench, Rig, record_for, running
from guard_bench import KeptTable
from memory_cnc import MemoryNc
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, PROBE, REFERENCE, VALUE

from config.records.commissioning import CommissionedAxis
from config.schema.cnc import CncConfig
from daemon.messages import ReferenceRequest
from drivers.contract import Cnc
from drivers.registry import open_cnc
from drivers.sim.contract import SimulatedNc
from drivers.sim.nc.custom_macro import MacroControl
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.sinumerik import SinumerikControl
from drivers.sim.wires.focas_server import SimulatedFocasServer
from drivers.sim.wires.haas_server import SimulatedHaasServer
from drivers.sim.wires.opcua_server import SimulatedCncServer
from models.control.state import OperatorRequest
from models.records import CncRun, Reference

PATIENCE_S = 0.3
"""Of the driver, in real time: a wire that is held back costs so much [s]."""
BEFORE, ATTACKED, CALM = 40, 80, 90
"""Turns of half a second until the output follows, in which things go wrong, and after them."""
FIRST_FASTER = 12.0
"""The thermal error goes so much faster while nothing is wrong yet, so that some um are applied."""
WRONG_UM = 1.0
LONGEST_WRONG = 45
"""So many turns the output may need for the way back, at its slew, while it says that it follows."""
AXES = {"y": 1, "z": 2}
"""Axes with a model, and their place on the control."""
COUNTED = 560
"""Macro that the program raises before every positioning, where it counts them."""
RUN_CODES = {CncRun.RESET: 0, CncRun.STOP: 1, CncRun.HOLD: 2, CncRun.START: 3}
PROBES = 60
"""N number of the block at which the work is measured."""
FACTORS = (1.0, 1.0, -1.0, 0.5)
"""Axes as they usually are, one that goes the other way, and one of diameters."""
WAITS = 24
"""Turns for which the program waits for an answer."""
TELLS = ("numbers", "counter", "handshake")
"""How the program tells that the work is positioned."""
STATE = ("mode", "run", "alarm", "program", "sequence_number", "clock", "power_on_count", "work_offset", "tool_number")
OPC_UA: dict[str, dict[str, Any]] = {
    "opcua": {"namespace_uri": "urn:toolpoint:cnc"},
    "opcua generic": {
        "namespace_uri": "urn:own",
        "preset": "generic",
        "nodes": {name: f"s=Own.{name}" for name in STATE} | {"macro": "s=Own.Variable[{number}]"},
    },
    "sinumerik": {"preset": "sinumerik"},
}
SERVERS: dict[str, Any] = {"focas": SimulatedFocasServer, "haas": SimulatedHaasServer}
DIALECTS = (*SERVERS, *OPC_UA)
Bytes = Callable[[bytes], Sequence[bytes | None]]


def as_it_comes(data: bytes) -> Sequence[bytes | None]:
    return [data]


class Wire:
    """A relay; `answers` and `requests` make of each piece what arrives of it, None: the connection ends."""

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._writers: set[asyncio.StreamWriter] = set()
        self.held = asyncio.Event()
        self.calm()

    def calm(self) -> None:
        self.answers = self.requests = as_it_comes
        self.held.set()

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port: int = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        self._server.close()
        self.reset()

    def reset(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            control, to_control = await asyncio.open_connection("127.0.0.1", self._target_port)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, to_control}
        pumps = [
            asyncio.create_task(self._pump(reader, to_control, answers=False)),
            asyncio.create_task(self._pump(control, writer, answers=True)),
        ]
        await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
        for each in pumps:
            each.cancel()
        for end in (writer, to_control):
            end.transport.abort()
            self._writers.discard(end)

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, answers: bool) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(65_536):
                if answers:
                    await self.held.wait()
                for piece in (self.answers if answers else self.requests)(data):
                    if piece is None:
                        return
                    sink.write(piece)
                    await asyncio.sleep(0)


class Face:
    """Shows the NC of the present history as the simulated servers want it."""

    mode, motor_temperature_degc = 1, 30.0
    nc: MemoryNc

    def __init__(self) -> None:
        self.alarm = 0
        self.positions_mm: dict[str, float] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self.nc, name)

    @property
    def run(self) -> int:
        return RUN_CODES[self.nc.run]

    @property
    def external_mm(self) -> list[float]:
        return list(self.nc.guard.control.external_mm)


class Served:
    """One dialect's server and wire; histories put their NC behind them, one after the other."""

    def __init__(self, dialect: str) -> None:
        self.dialect, self.face = dialect, Face()
        self.server: Any = None

    def section(self, bench: Bench, port: int, on_expiry: str = "keep") -> CncConfig:
        """Return how the daemon reaches the control through the wire."""
        siemens = self.dialect == "sinumerik"
        content: dict[str, Any] = {
            "allow_insecure_writes": True,
            "timeout_s": PATIENCE_S,
            "stale_after_s": 30.0,
            "macros": bench.configuration.cnc.macros,
            "guard": {
                "increment_mm": 0.0001,
                "on_expiry": on_expiry,
                "dialect": "sinumerik" if siemens else "fanuc",
            },
        }
        if self.dialect in OPC_UA:
            content["opcua"] = OPC_UA[self.dialect] | {"endpoint": f"opc.tcp://127.0.0.1:{port}/cnc"}
        else:
            content |= {"driver": self.dialect, self.dialect: {"host": "127.0.0.1", "port": port}}
        return CncConfig.model_validate(content)

    def calm(self) -> None:
        """Leave nothing of the history before."""
        self.wire.calm()
        if self.dialect not in OPC_UA:
            self.server.responder.refused_macros.clear()

    async def start(self, bench: Bench) -> None:
        self.face.nc = bench.nc
        config = self.section(bench, 1)
        if self.dialect in OPC_UA:
            self.server = SimulatedCncServer(cast(SimulatedNc, self.face), config, port=0, readable=[COUNTED])
        else:
            self.server = SERVERS[self.dialect](self.face, config, port=0)
        await self.server.start()
        self.wire = Wire(self.server.port)
        await self.wire.start()

    async def stop(self) -> None:
        await self.wire.stop()
        await self.server.stop()


@contextlib.asynccontextmanager
async def serving(dialect: str, directory: Path) -> AsyncIterator[Served]:
    served = Served(dialect)
    directory.mkdir(parents=True, exist_ok=True)
    await served.start(Bench(directory))
    try:
        yield served
    finally:
        await served.stop()


# --- the truth ---------------------------------------------------------------------------


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


# --- the shop ----------------------------------------------------------------------------


@dataclass(slots=True)
class Block:
    """A block of the part program at which it stands for some turns."""

    number: int
    turns: int


class PartProgram:
    """Positions the work, cuts, and calls the guard where the tool is away from it."""

    def __init__(self, shop: "Shop") -> None:
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


class Shop:
    """One history: a machine, its daemon, and what goes wrong."""

    def __init__(self, served: Served, directory: Path, seed: int, *, attacked: bool = True) -> None:
        self.rng = random.Random(f"{served.dialect} {seed}")
        self.served, self.wire, self.attacked = served, served.wire, attacked
        self.tells = self.rng.choice(TELLS)
        self.to_zero = self.rng.random() < 0.25
        self.person_returns = self.rng.random() < 0.6
        bench = self.bench = Bench(directory)
        expiry = "zero" if self.to_zero else "keep"
        reached = served.section(bench, served.wire.port, expiry)
        reference = bench.configuration.compensation.reference
        if self.tells == "counter":
            reference = reference.model_copy(update={"positioning_counter": COUNTED})
        compensation = bench.configuration.compensation.model_copy(update={"reference": reference})
        bench.configuration = bench.configuration.model_copy(update={"cnc": reached, "compensation": compensation})
        nc = self.nc = bench.nc = MemoryNc(bench.configuration, bench.clock)
        self.siemens = served.dialect == "sinumerik"
        if not self.siemens:
            nc.guard = SafePointApplication(reached.macros, compensation.outputs, reached.guard)
        nc.macros = KeptTable() if self.siemens else nc.macros
        for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE, COUNTED):
            nc.macros.set(number, 0.0)
        nc.guard.initialise(nc.macros, nc.clock_s)
        self._begin_timer(nc.clock_s)
        served.face.nc, served.face.alarm = nc, 0

        def open_driver() -> Cnc:
            return open_cnc(bench.configuration, bench.clock)

        nc.open = open_driver  # type: ignore[method-assign, assignment]
        self.judge = Judge(factors={axis: self.rng.choice(FACTORS) for axis in AXES})
        self.program = PartProgram(self)
        self.rig: Rig | None = None
        self.at_reference: dict[str, dict[str, float]] = {}
        """Thermal error at each reference [um]."""
        self.answers: list[tuple[int, ReferenceRequest]] = []
        """References that the estimation sets, each with its turn."""
        self.slow = 0
        """Turns that the estimation takes to set one."""
        self.heard = 0
        self.asleep = 0
        """Turns in which the daemon's computer does nothing."""
        self.turn_number = 0
        self.restarts = False
        self.said: list[tuple[int, str]] = []
        self.states: Counter[str] = Counter()
        self.wrong_for = self.longest_wrong = 0
        self.slopes = {
            axis: self.rng.choice((-1, 1)) * self.rng.uniform(0.01, most) for axis, most in (("y", 0.025), ("z", 0.035))
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

    def then(self, turn: int, event: "Callable[[Shop], None]") -> None:
        """Let something happen at a turn."""
        self.undo.append((turn, lambda: event(self)))

    def applied(self) -> dict[str, float]:
        return {axis: round(self.nc.guard.applied_um[axis], 2) for axis in AXES}

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
        wanted = (False, False, False) if memory is None else memory.wanted
        return [axis for axis, place in AXES.items() if wanted[place]]

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
        """What a perfect estimation says, since the reference that is in force."""
        reference = rig.control.reference
        then = None if reference is None else self.at_reference.get(reference.reference_id)
        if then is None:
            return rig.estimate(math.nan, math.nan, reference_id=None)
        return rig.estimate(*(self.judge.error[axis] - then[axis] for axis in AXES))

    async def turn(self) -> None:
        """Half a second."""
        self.turn_number += 1
        now = self.turn_number
        self.bench.clock.monotonic_s += 0.5
        if BEFORE // 2 <= now < BEFORE + ATTACKED + CALM // 2:
            times = FIRST_FASTER if now < BEFORE else 1.0
            for axis, um in self.slopes.items():
                self.judge.error[axis] += um * times
            if self.rng.random() < 0.02:
                axis = self.rng.choice(list(AXES))
                self.slopes[axis] = -self.slopes[axis]
        await self.program.go_on()
        self._go_wrong(now)
        if self.asleep:
            self.asleep -= 1
        else:
            await self._reconnect()
            await self.look()
        self.program.answered()
        self.judge.look(self.nc.guard)
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
                if self.served.dialect in ONLY.get(name, (self.served.dialect,)):
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
            elif rig.state in ("OFF", "RETREAT"):
                rig.control.request(OperatorRequest(enable=frozenset(AXES)), "a person")

    async def play(self) -> None:
        """Play the history to its end."""
        spread = range(BEFORE, BEFORE + ATTACKED)
        self.plan = [self.rng.choice(spread) for _ in range(self.rng.choice((1, 2, 3, 4, 5, 6)))]
        self.program.restart(from_the_top=True)
        self.program.block = Block(10, 6)
        while self.turn_number < BEFORE + ATTACKED + CALM:
            async with running(self._rig(), connect=self.turn_number == 0) as rig:
                self.rig, self.heard, self.restarts = rig, 0, False
                while self.turn_number < BEFORE + ATTACKED + CALM and not self.restarts:
                    await self.turn()
                    if self.turn_number == 20:
                        assert rig.control.request(OperatorRequest(enable=frozenset(AXES)), "a person") == ""
                await rig.history.flushed()
                rig.alive()
        self.ends = rig.state

    def _rig(self) -> Rig:
        configuration = self.bench.configuration
        commissioned = {
            axis: CommissionedAxis(
                sign=1 if factor > 0 else -1, scale=abs(factor), written_um=10.0, measured_um=10.0 * factor
            )
            for axis, factor in ({"x": 1.0} | self.judge.factors).items()
        }
        record = record_for(configuration, axes=commissioned)
        return Rig(configuration, self.nc, self.bench.clock, record=record)

    def verdict(self) -> str:
        """Return what was wrong, '' where nothing was."""
        off = self.judge.off_um(self.nc, self.followed)
        if self.silent and off > WRONG_UM:
            return f"ends {off:.1f} um off in ACTIVE without a word"
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
                tally.wrong.append(f"{dialect}, seed {seed}: {wrong}; {shop.tells}, {shop.judge.factors}, {shop.said}")
    return tally


# --- what goes wrong ---------------------------------------------------------------------

BLOCK = (500, 501, 502, 503, 120, 504, 505, 506)
ECHO = (511, 512, 513, 514, 515, 516)
MEMORY = tuple(range(590, 597))
REQUESTS = (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE)


def some_value(shop: Shop) -> float | None:
    return shop.rng.choice([None, 0.0, -0.02, 0.02, 1e9, 0.005, -0.0005, 2.5, 1.0, shop.rng.uniform(-0.03, 0.03)])


def somebody_writes(numbers: Sequence[int], times: int = 1) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        for _ in range(times):
            shop.nc.macros.set(shop.rng.choice(numbers), some_value(shop))

    return event


def all_kept(value: float | None) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        for number in range(500, 580):
            shop.nc.macros.set(number, value)
        for number in range(590, 1000):
            shop.nc.macros.set(number, value)

    return event


def restored(shop: Shop) -> None:
    """The control's macro variables of a minute before come back, as from a back-up."""
    for number, value in shop.kept.items():
        shop.nc.macros.set(number, value)


def hand(shop: Shop) -> None:
    """An operator adds to the external offset."""
    axis = shop.rng.choice(list(AXES))
    um = shop.rng.choice([0.5, -5.0, 20.0])
    shop.nc.guard.change_own_offset(axis, um)
    shop.judge.by_hand[axis] += um


def reset_pressed(shop: Shop) -> None:
    shop.nc.run = CncRun.RESET
    top = shop.rng.random() < 0.5
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: shop.program.restart(from_the_top=top)))


def guard_broken(shop: Shop) -> None:
    shop.program.broken_after = shop.rng.randrange(20, 125)
    top = shop.rng.random() < 0.5
    shop.undo.append((shop.turn_number + shop.rng.randrange(6, 16), lambda: shop.program.restart(from_the_top=top)))


def guard_watched(shop: Shop) -> None:
    shop.program.watched_after = shop.rng.randrange(0, 125)


def feed_hold(shop: Shop) -> None:
    shop.nc.run = CncRun.HOLD
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: setattr(shop.nc, "run", CncRun.START)))


def switched_off(*, counted: bool) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        shop.power_cycle(counted=counted)
        top = shop.rng.random() < 0.5
        shop.undo.append((shop.turn_number + shop.rng.randrange(2, 12), lambda: shop.program.restart(from_the_top=top)))

    return event


def held_back(shop: Shop) -> None:
    shop.wire.held.clear()
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 4), shop.wire.held.set))


def answer(kind: str) -> Callable[[Shop], None]:
    """The n-th answer from now on is cut, doubled, split, lost, or comes behind or in place of an older one."""

    def event(shop: Shop) -> None:
        left, old = [shop.rng.randrange(0, 6)], [b""]

        def answers(data: bytes) -> Sequence[bytes | None]:
            left[0] -= 1
            if left[0] >= 0:
                old[0] = data
                return [data]
            shop.wire.answers = as_it_comes
            k = shop.rng.randrange(len(data) + 1)
            made: dict[str, list[bytes | None]] = {
                "cut": [data[:k], None],
                "twice": [data, data],
                "split": [data[i : i + 1] for i in range(len(data))],
                "lost": [b""],
                "late": [old[0], data],
                "instead": [old[0]],
            }
            return made[kind]

        shop.wire.answers = answers

    return event


def in_the_middle(event: Callable[[Shop], None]) -> Callable[[Shop], None]:
    """It happens between two requests of the daemon."""

    def later(shop: Shop) -> None:
        left = [shop.rng.randrange(1, 9)]

        def requests(data: bytes) -> Sequence[bytes | None]:
            left[0] -= 1
            if left[0] == 0:
                shop.wire.requests = as_it_comes
                event(shop)
            return [data]

        shop.wire.requests = requests

    return later


def request_cut(shop: Shop) -> None:
    left = [shop.rng.randrange(1, 9)]

    def requests(data: bytes) -> Sequence[bytes | None]:
        left[0] -= 1
        if left[0] > 0:
            return [data]
        shop.wire.requests = as_it_comes
        return [data[: shop.rng.randrange(len(data))], None]

    shop.wire.requests = requests


def clock_moves(shop: Shop) -> None:
    shop.nc.clock_zero_s += shop.rng.choice([-2000.0, -100.0, -3.0, -0.5, 0.5, 3.0, 100.0, 2000.0])


def inches(shop: Shop) -> None:
    """A program in inches, which calls the guard all the same."""
    control = shop.nc.guard.control
    modal, group, inch, metric = (
        (control.modal, 6, 20, 21) if isinstance(control, MacroControl) else (control.groups, 13, 1, 2)
    )
    modal[group] = inch
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 20), lambda: modal.__setitem__(group, metric)))


def shows(name: str, *values: Any) -> Callable[[Shop], None]:
    """The control shows something else for a while."""

    def event(shop: Shop) -> None:
        usual = getattr(shop.nc, name)
        setattr(shop.nc, name, shop.rng.choice(values))
        shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), lambda: setattr(shop.nc, name, usual)))

    return event


def another_offset(shop: Shop) -> None:
    values = {"focas": (55, 54.1, 54.4), "haas": (55, 110, 154)}.get(
        shop.served.dialect, (55, 505 if shop.siemens else 56)
    )
    shows("work_offset", *values)(shop)


def refuses(shop: Shop) -> None:
    """The control refuses a macro variable for a while."""
    responder = shop.served.server.responder
    number = shop.rng.choice(BLOCK)
    if shop.served.dialect == "focas":
        responder.refused_macros[number] = shop.rng.choice([-1, 5, 7])
    else:
        responder.refused_macros.add(number)
    shop.undo.append((shop.turn_number + shop.rng.randrange(1, 12), responder.refused_macros.clear))


def sleeps(shop: Shop) -> None:
    """The daemon's computer does nothing for a while; the machine goes on."""
    shop.asleep = shop.rng.randrange(1, 40)


def restarts(shop: Shop) -> None:
    shop.restarts = True


def restarts_late(shop: Shop) -> None:
    restarts(shop)
    sleeps(shop)


def estimation_is_slow(shop: Shop) -> None:
    shop.slow = shop.rng.randrange(1, 12)
    shop.undo.append((shop.turn_number + 40, lambda: setattr(shop, "slow", 0)))


def person(*requests: OperatorRequest) -> Callable[[Shop], None]:
    def event(shop: Shop) -> None:
        assert shop.rig is not None
        shop.rig.control.request(shop.rng.choice(requests), "a person")

    return event


def keep_backup(shop: Shop) -> None:
    """A back-up is taken now and comes back later."""
    shop.kept = {number: shop.nc.macros.get(number) for number in (*BLOCK, *ECHO, *MEMORY, *REQUESTS)}
    shop.undo.append((shop.turn_number + shop.rng.randrange(5, 40), lambda: restored(shop)))


def probes(shop: Shop) -> None:
    """The program measures the work at its next block, and waits until the daemon has taken it."""
    shop.program.ahead.insert(0, Block(PROBES, 1))


def jump(shop: Shop) -> None:
    """The machine grows by more than the output may follow at once."""
    shop.judge.error[shop.rng.choice(list(AXES))] += shop.rng.choice([-8.0, 8.0])


EVENTS: dict[str, Callable[[Shop], None]] = {
    "foreign block": somebody_writes(BLOCK),
    "two foreign in the block": somebody_writes(BLOCK, 2),
    "foreign echo": somebody_writes(ECHO),
    "foreign memory": somebody_writes(MEMORY),
    "foreign request": somebody_writes(REQUESTS),
    "macros zeroed": all_kept(0.0),
    "macros vacant": all_kept(None),
    "backup restored": keep_backup,
    "hand in the offset": hand,
    "reset": reset_pressed,
    "guard broken off": guard_broken,
    "guard broken off again": guard_broken,
    "guard looked at": guard_watched,
    "feed hold": feed_hold,
    "switched off": switched_off(counted=True),
    "switched off, count the same": switched_off(counted=False),
    "wire reset": lambda shop: shop.wire.reset(),
    "held back": held_back,
    **{f"answer {kind}": answer(kind) for kind in ("cut", "twice", "split", "lost", "late", "instead")},
    "request cut": request_cut,
    "foreign in the middle": in_the_middle(somebody_writes(BLOCK)),
    "switched off in the middle": in_the_middle(lambda shop: shop.power_cycle()),
    "guard in the middle": in_the_middle(lambda shop: void(shop.nc.safe_point())),
    "clock moves": clock_moves,
    "inches": inches,
    "another program": shows("program", 2000, 9010, 0),
    "another work offset": another_offset,
    "another run state": shows("run", *RUN_CODES),
    "another block": shows("sequence_number", 900, 20),
    "another tool": shows("tool_number", 5),
    "macro refused": refuses,
    **dict.fromkeys(("jump", "jump again", "jump then"), jump),
    "probe": probes,
    "probe again": probes,
    "daemon asleep": sleeps,
    "daemon restarted": restarts,
    "daemon restarted late": restarts_late,
    "estimation slow": estimation_is_slow,
    "switched": person(
        OperatorRequest(disable=frozenset(AXES)), OperatorRequest(zero=True), OperatorRequest(disable=frozenset({"z"}))
    ),
}
ONLY = {"macro refused": ("focas", "haas")}


def void(_result: object) -> None:
    pass
