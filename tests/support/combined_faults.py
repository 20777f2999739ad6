"""Random histories in which faults fall together, and a judge that knows the true temperatures and nothing else.

The judge is written from the law alone. What the work was positioned with, and the true thermal error then, are what
everything counts from: while the output follows, and nothing has gone wrong for ten minutes, what the NC has taken must
be that value less what the true thermal error has gone since. All models have the same weights, so that a release, a
restart or a probe that measures what is really there changes nothing of the truth.
"""

from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from control_rig import EPOCH_S, SENSOR_IDS, HandClock
from nc_requests import ACKNOWLEDGE, PROBE, REFERENCE, TOOL_CHANGE, Z_AXIS, ask
from small_model import model
from twin_loop import CHAIN, Frames, TwinLoop, some_places
from whole_loop import MOMENT_S, WholeLoop

from drivers.sim.nc.safe_point import SafePointApplication, simulated_guard
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, Instant, OutputState
from models.thermal.features import BoolArray
from models.units import TMP102_DEGC_PER_LSB

MODELS = {name: model(name) for name in ("first", "second")}
WEIGHTS = np.vstack([np.full(len(SENSOR_IDS), 0.5), np.full(len(SENSOR_IDS), 1.0)])
"""Of both models, for y and z [um/K]."""
CALM = 60
"""Moments of ten seconds without anything bad after which is judged."""
OWN_AXES = slice(1, 3)
"""y and z among x, y and z."""
COUNTER = 560
"""Macro that the program raises before every positioning."""
HELD_MOMENTS = 3
"""A hold may take so many moments until the guard has what was written last."""
PRELUDE = 96
"""Moments until the output follows."""
OFF_MOMENTS = 6
"""After so many moments of an output that is off for good a history is over: nothing moves, and nothing is judged."""


class SteppedClock(HandClock):
    """A clock whose calendar a test sets."""

    set_by_s = 0.0

    def now(self) -> Instant:
        return Instant(
            monotonic_s=self.monotonic_s, utc_s=EPOCH_S + self.monotonic_s + self.set_by_s, real_s=self.monotonic_s
        )


@dataclass(slots=True)
class Truth:
    """What y and z are to be, worked out from true temperatures and what the program did."""

    recent: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=round(60.0 / MOMENT_S)))
    work: tuple[FloatArray, FloatArray] | None = None
    """What was applied when the work was positioned and the true error then [um]."""
    tools: dict[int, tuple[float, float]] = field(default_factory=dict)
    """The same for z at each tool's setting."""
    why: str = "nothing was positioned yet"
    """Why nothing may be followed while `work` is None."""

    def error_um(self) -> FloatArray:
        return np.asarray(WEIGHTS @ np.mean(self.recent, axis=0))

    def positioned(self, applied_um: FloatArray, tool: int) -> None:
        error_um = self.error_um()
        self.work = (applied_um.copy(), error_um)
        if tool in self.tools:
            self.tools[tool] = (float(applied_um[1]), float(error_um[1]))

    def ended(self, why: str) -> None:
        self.work, self.why = None, why

    def request_um(self, tool: int) -> FloatArray | None:
        if self.work is None:
            return None
        applied_um, error_um = self.work
        now_um = self.error_um()
        wanted_um = applied_um - (now_um - error_um)
        if tool in self.tools:
            then_um, of_then_um = self.tools[tool]
            wanted_um[1] = then_um - (now_um[1] - of_then_um)
        return np.asarray(wanted_um)


class Attack(TwinLoop):
    """A shop in which several things go wrong at the same time.

    `wider`: faults also meet restarts, and a guard that takes an expired offset out. `first`: see `TwinLoop`.
    """

    def __init__(self, directory: Path, seed: int, profile: str, *, wider: bool = False, first: int = 0) -> None:
        rng = np.random.default_rng(seed)
        super().__init__(directory, MODELS["first"], some_places(rng), profile, seed=seed, first=first)
        self.loop.clock = self.loop.nc.clock = SteppedClock()
        compensation = self.loop.configuration.compensation
        counted = compensation.reference.model_copy(update={"positioning_counter": COUNTER})
        self.loop.configuration = self.loop.configuration.model_copy(
            update={"compensation": compensation.model_copy(update={"reference": counted})}
        )
        self.loop.nc.macros.set(COUNTER, 0.0)
        self.events = EVENTS | WIDER if wider else EVENTS
        if wider:
            expires_to_zero(self.loop)
        self.soon: dict[int, list[Callable[[Attack], Awaitable[None]]]] = {}
        self.held = 0
        self.held_um: FloatArray = np.zeros(len(WEIGHTS))
        self.truth = Truth()
        self.said: list[str] = []
        """What happened, for a person who looks for the cause."""
        self.wrong_k: FloatArray = np.zeros(len(SENSOR_IDS))
        self.mute: BoolArray = np.zeros(len(SENSOR_IDS), dtype=bool)
        self.swapped = False
        self.bad_until = 0
        self.counter = 0
        self.requested: tuple[int, Callable[[], None]] | None = None
        self.positioning_left = 0
        self.undo: dict[int, list[Callable[[], None]]] = {}
        self.model_name = "first"
        self.reference_seen: str | None = None
        self.by_hand = False
        self.down_left = 0
        self.findings: list[str] = []
        self.righted = False
        self.worst_um = 0.0
        self.followed = 0
        self.off = 0
        """For so many moments everything has been right and the output off."""

    # --- what is heard ----------------------------------------------------------------------

    async def _speak(self, line: str, _part: slice) -> None:
        degc = self.true_degc()
        if line == "spindle":
            self.truth.recent.append(degc)
        source = {"spindle": "column", "column": "spindle"}[line] if self.swapped else line
        frames: Frames = []
        for place in reversed(range(len(CHAIN[source]))):
            sensor = CHAIN[source][place]
            if not self.mute[sensor]:
                code = round((degc[sensor] + self.wrong_k[sensor]) / TMP102_DEGC_PER_LSB)
                frames.append(self.frame(place + 1, code))
        now = self.loop.clock.now()
        assembler = self.assemblers[line]
        cycles = assembler.feed(b"".join(frames), now)
        later = Instant(
            monotonic_s=now.monotonic_s + 0.6 * MOMENT_S, utc_s=now.utc_s, real_s=now.real_s + 0.6 * MOMENT_S
        )
        for cycle in (*cycles, *assembler.poll(later)):
            await self.loop.thermal._take(cycle)

    # --- one history ------------------------------------------------------------------------

    @property
    def applied_now_um(self) -> FloatArray:
        return self.loop.applied_um[OWN_AXES]

    def say(self, what: str) -> None:
        self.said.append(f"{self.moment - PRELUDE}: {what}")

    async def history(self, length: int) -> None:
        """Warm up and follow; let things go wrong for `length` moments; then set everything right and judge."""
        self.moment = self.first
        await self._start()
        try:
            for moment in range(self.first, PRELUDE + length + 2 * CALM):
                self.moment = moment
                if self.moment == 70:
                    self.position()
                if self.moment == 60:
                    self.ask_for(OperatorRequest(enable=frozenset({"y", "z"})))
                for undo in self.undo.pop(self.moment, ()):
                    undo()
                for follows in self.soon.pop(self.moment, ()):
                    if not self.down_left and not self.righted:
                        await follows(self)
                if PRELUDE <= self.moment < PRELUDE + length and self.rng.random() < 0.25:
                    await self.something()
                if self.moment == PRELUDE + length:
                    self.set_right()
                if self.moment == PRELUDE + length + CALM and self.rng.random() < 0.5:
                    await self.use(str(self.rng.choice(list(MODELS))))
                await self.one_moment()
                if self.off > OFF_MOMENTS:
                    break
        finally:
            if not self.down_left:
                await self.loop.end()

    async def one_moment(self) -> None:
        loop = self.loop
        if self.down_left:
            self.down_left -= 1
            loop.clock.monotonic_s += MOMENT_S
            self.truth.recent.append(self.true_degc())
            if not self.down_left:
                self._listen()
                await self._start()
        else:
            await loop.moment()
        self.program()
        if loop.nc.sequence_number == 900:
            loop.nc.safe_point()
        if not self.down_left:
            self.follow_daemon()
            self.judge()
        self.off = self.off + 1 if self.is_off() else 0

    def is_off(self) -> bool:
        """Return whether the output is off after everything was set right, and nobody is going to switch it on."""
        memory = None if self.down_left else self.loop.rig.control.memory
        return self.righted and memory is not None and memory.state in (OutputState.OFF, OutputState.FAULT)

    def program(self) -> None:
        """Take the program a step on: what was applied when its positioning ended is what the work stands with."""
        nc = self.loop.nc
        if self.positioning_left:
            self.positioning_left -= 1
            if not self.positioning_left:
                nc.run, nc.sequence_number = CncRun.STOP, 900
        if self.requested is not None:
            counter, then = self.requested
            answer = nc.macros.get(ACKNOWLEDGE)
            if answer is not None and answer == counter:
                then()
                self.requested = None
            elif answer is not None and answer == -counter:
                self.requested = None

    def follow_daemon(self) -> None:
        """A reference by hand counts when the daemon has taken it."""
        reference = self.loop.rig.control.reference
        if reference is None or reference.reference_id == self.reference_seen:
            return
        self.reference_seen = reference.reference_id
        if reference.source.startswith("hand"):
            self.say("reference by hand in force")
            self.truth.positioned(self.applied_now_um, self.loop.nc.tool_number)

    def judge(self) -> None:
        control = self.loop.rig.control
        memory = control.memory
        self.judge_hold()
        if memory is None or self.moment < PRELUDE or memory.state is not OutputState.ACTIVE:
            return
        wanted_um = self.truth.request_um(self.loop.nc.tool_number)
        calm = self.moment - self.bad_until
        if wanted_um is None:
            if calm > 3:
                self.findings.append(f"{self.moment - PRELUDE}: ACTIVE although {self.truth.why}")
            return
        if calm < CALM or self.loop.nc.sequence_number != 900:
            return
        self.followed += self.righted
        off_um = np.abs(self.applied_now_um - wanted_um)[np.array(memory.wanted[OWN_AXES])]
        worst_um = float(off_um.max(initial=0.0))
        self.worst_um = max(self.worst_um, worst_um)
        if worst_um > 1.3:
            self.findings.append(
                f"{self.moment - PRELUDE}: applied {self.applied_now_um.round(2)} um, true {wanted_um.round(2)} um, "
                f"weight {memory.weight:.2f}, tools {sorted(memory.tools)}"
            )

    def judge_hold(self) -> None:
        """A hold moves nothing away from zero; what the guard takes out of an expired block stays out."""
        memory, now_um = self.loop.rig.control.memory, self.applied_now_um
        if memory is None or memory.state is not OutputState.HOLD:
            self.held = 0
            return
        if self.loop.nc.sequence_number != 900 or not self.loop.nc.reachable:
            self.held = 0  # the guard is not called, or its block is torn: what was decided before the hold waits
        self.held += 1
        if self.held > HELD_MOMENTS:
            away_um = (np.abs(now_um) - np.abs(self.held_um))[np.array(memory.wanted[OWN_AXES])]
            if away_um.max(initial=0.0) > 0.3:
                self.findings.append(f"{self.moment - PRELUDE}: HOLD moved {self.held_um} to {now_um} um")
        self.held_um = now_um.copy()

    # --- what the shop does ------------------------------------------------------------------

    def ask_for(self, request: OperatorRequest) -> None:
        self.loop.rig.control.request(request, "a person")

    def position(self) -> None:
        nc = self.loop.nc
        nc.run, nc.sequence_number = CncRun.START, 100
        nc.macros.set(COUNTER, (nc.macros.get(COUNTER) or 0.0) + 1.0)
        self.positioning_left = 3
        self.say("the work is positioned")
        self.truth.positioned(self.applied_now_um, nc.tool_number)

    async def use(self, name: str) -> None:
        if self.down_left:
            return
        self.say(f"model {name} is released")
        await self.loop.use_model(MODELS[name])

    def bad(self, moments: int) -> None:
        self.bad_until = max(self.bad_until, self.moment + moments)

    def later(self, moments: int, undo: Callable[[], None]) -> None:
        self.undo.setdefault(self.moment + moments, []).append(undo)
        self.bad(moments)

    async def something(self) -> None:
        """One thing that happens, good or bad; most bad things last."""
        if self.down_left:
            return
        name = str(self.rng.choice(sorted(self.events)))
        if name not in ENDING or self.rng.random() < 0.15:
            await self.events[name](self)

    def set_right(self) -> None:
        """What a person does at the end: everything mended, acknowledged, switched on, nothing positioned."""
        self.say("everything is set right")
        self.righted = True
        for moment in sorted(self.undo):
            for undo in self.undo.pop(moment):
                undo()
        self.mute[:] = False
        self.wrong_k[:] = 0.0
        self.swapped = False
        self.loop.nc.reachable = True
        self.loop.nc.groups_until_lost = None
        self.bad(0)
        if not self.down_left:
            if self.loop.rig.control.journal.fault is not None:
                self.loop.rig.acknowledge("a person")
            self.ask_for(OperatorRequest(enable=frozenset({"y", "z"})))


# --- events --------------------------------------------------------------------------------


async def silence(shop: Attack) -> None:
    gone = shop.rng.choice(len(SENSOR_IDS), int(shop.rng.integers(1, 6)), replace=False)
    moments = int(shop.rng.integers(1, 40))
    shop.mute[gone] = True
    shop.say(f"sensors {gone.tolist()} silent for {moments}")

    def back() -> None:
        shop.mute[gone] = False

    shop.later(moments, back)


async def lie(shop: Attack) -> None:
    """A sensor says something else; often just as it returns from silence."""
    sensor, moments = int(shop.rng.integers(len(SENSOR_IDS))), int(shop.rng.integers(1, 20))
    shop.wrong_k[sensor] = float(shop.rng.choice([-1, 1]) * shop.rng.uniform(0.5, 8.0))
    was_mute = bool(shop.mute[sensor])
    shop.mute[sensor] = False
    shop.say(f"sensor {sensor} lies by {shop.wrong_k[sensor]:.2f} K for {moments}{' as it returns' * was_mute}")

    def honest() -> None:
        shop.wrong_k[sensor] = 0.0

    shop.later(moments, honest)


async def lie_at_the_return(shop: Attack) -> None:
    sensor, gone, moments = (int(shop.rng.integers(a, b)) for a, b in ((0, len(SENSOR_IDS)), (2, 25), (1, 15)))
    wrong_k = float(shop.rng.choice([-1, 1]) * shop.rng.uniform(0.5, 8.0))
    shop.mute[sensor] = True
    shop.say(f"sensor {sensor} silent for {gone}, then wrong by {wrong_k:.2f} K for {moments}")

    def returns() -> None:
        shop.mute[sensor] = False
        shop.wrong_k[sensor] = wrong_k

    def honest() -> None:
        shop.wrong_k[sensor] = 0.0

    shop.later(gone, returns)
    shop.later(gone + moments, honest)


async def position(shop: Attack) -> None:
    if shop.loop.nc.sequence_number == 900 and shop.requested is None:
        shop.position()


async def reference_by_hand(shop: Attack) -> None:
    shop.say("reference by hand is asked for")
    shop.loop.rig.control.requests.put_reference("a person")


async def probe(shop: Attack) -> None:
    """The program measures what is really there; its value is in error by nothing."""
    nc = shop.loop.nc
    wanted_um = shop.truth.request_um(nc.tool_number)
    if shop.requested is not None or wanted_um is None or nc.sequence_number != 900:
        return
    residual_um = float(shop.applied_now_um[1] - wanted_um[1])
    shop.counter += 1
    ask(shop.loop, shop.counter, PROBE, Z_AXIS, residual_um * 1e-3)
    number = shop.counter
    shop.say(f"request {number}: probe {residual_um:.2f} um")
    shop.requested = (number, lambda: shop.say(f"request {number}: taken"))


async def nonsense(shop: Attack) -> None:
    """The program asks with values that are none."""
    if shop.requested is not None:
        return
    shop.counter += 1
    value = float(shop.rng.choice([1e9, -1e9, 0.3333333, -5.0]))
    kind = float(shop.rng.choice([PROBE, 2.5, 7.0]))
    axis = float(shop.rng.choice([Z_AXIS, 3.4, 9.0]))
    if kind == PROBE and axis == Z_AXIS and abs(value) < 1.0:
        axis = 3.4
    shop.say(f"request {shop.counter}: kind {kind}, axis {axis}, value {value}")
    ask(shop.loop, shop.counter, kind, axis, value)  # type: ignore[arg-type]
    shop.requested = (shop.counter, lambda: shop.findings.append("nonsense was taken"))


async def tool_set(shop: Attack) -> None:
    nc = shop.loop.nc
    if shop.requested is not None or nc.sequence_number != 900:
        return
    shop.counter += 1
    ask(shop.loop, shop.counter, REFERENCE, Z_AXIS)
    number, tool = shop.counter, nc.tool_number
    shop.say(f"request {number}: T{tool} is set on z")

    def taken() -> None:
        shop.say(f"request {number}: T{tool} counts from {shop.applied_now_um[1]:.2f}")
        shop.truth.tools[tool] = (float(shop.applied_now_um[1]), float(shop.truth.error_um()[1]))

    shop.requested = (number, taken)


async def tool_change(shop: Attack) -> None:
    """Another tool; perhaps named by a request, perhaps beside a request that names a tool that is none."""
    if shop.requested is not None:
        return
    tool = int(shop.rng.integers(1, 4))
    shop.loop.nc.tool_number = tool
    shop.say(f"T{tool} in the spindle")
    if shop.rng.random() < 0.5:
        shop.counter += 1
        ask(shop.loop, shop.counter, TOOL_CHANGE, 0, float(tool))
        shop.requested = (shop.counter, lambda: None)


async def release(shop: Attack) -> None:
    await shop.use(str(shop.rng.choice(sorted(MODELS))))


async def link_lost(shop: Attack) -> None:
    moments = int(shop.rng.integers(1, 12))
    shop.loop.nc.reachable = False
    shop.say(f"the CNC is away for {moments}")

    def back() -> None:
        shop.loop.nc.reachable = True

    shop.later(moments, back)


async def write_torn(shop: Attack) -> None:
    shop.loop.nc.groups_until_lost = int(shop.rng.integers(0, 3))
    shop.say("the next write is torn")

    def whole() -> None:
        shop.loop.nc.groups_until_lost = None

    shop.later(2, whole)


async def killed(shop: Attack) -> None:
    """The daemon dies; it is away for seconds, minutes, or longer than an outage that is resumed."""
    moments = int(shop.rng.choice([1, 2, 5, 40]))
    shop.say(f"the daemon is killed and away for {moments}")
    if shop.rng.random() < 0.7:
        await shop.loop.rig.history.flushed()
    await shop.loop.end()
    shop.down_left = moments
    shop.bad(moments)


async def calendar_set(shop: Attack) -> None:
    assert isinstance(shop.loop.clock, SteppedClock)
    step_s = float(shop.rng.choice([-7200.0, -90.0, -5.0, 5.0, 90.0, 3600.0, 86400.0]))
    shop.loop.clock.set_by_s += step_s
    shop.say(f"the calendar is set by {step_s:g} s")
    shop.bad(1)


async def cnc_clock_set(shop: Attack) -> None:
    step_s = float(shop.rng.choice([-600.0, -20.0, 20.0, 3600.0]))
    shop.loop.nc.clock_zero_s += step_s
    shop.say(f"the CNC's clock is set by {step_s:g} s")
    shop.bad(1)


async def swap(shop: Attack) -> None:
    moments = int(shop.rng.integers(1, 30))
    shop.swapped = True
    shop.say(f"the lines are swapped for {moments}")

    def back() -> None:
        shop.swapped = False

    shop.later(moments, back)


async def foreign(shop: Attack) -> None:
    """Somebody writes into our block and, minutes later, sets it right and acknowledges."""
    number = int(shop.rng.choice([500, 502, 503, 504, 506, 505]))
    value = float(shop.rng.choice([0.0, 0.004, -0.02, 1e9]))
    if shop.loop.nc.macros.get(number) == value:
        return
    was = shop.loop.nc.macros.get(number)
    shop.loop.nc.macros.set(number, value)
    shop.say(f"#{number} = {value:g} (was {was})")

    def acknowledged() -> None:
        if shop.loop.nc.macros.get(number) == value:
            shop.loop.nc.macros.set(number, was)
        if not shop.down_left:
            shop.loop.rig.acknowledge("a person")
            shop.ask_for(OperatorRequest(enable=frozenset({"y", "z"})))
            shop.say("acknowledged")

    shop.later(int(shop.rng.integers(2, 12)), acknowledged)


async def switched_off(shop: Attack) -> None:
    """A person switches off, perhaps to zero, and on again, perhaps within the retreat."""
    moments, zero = int(shop.rng.integers(1, 12)), bool(shop.rng.random() < 0.4)
    axes = frozenset(shop.rng.choice(["y", "z"], int(shop.rng.integers(1, 3)), replace=False).tolist())
    shop.ask_for(OperatorRequest(disable=axes, zero=zero))
    shop.say(f"{sorted(axes)} off{' to zero' * zero} for {moments}")

    def on() -> None:
        if not shop.down_left:
            shop.ask_for(OperatorRequest(enable=frozenset({"y", "z"})))

    shop.later(moments, on)


async def cut(shop: Attack) -> None:
    nc = shop.loop.nc
    if nc.sequence_number != 900 or shop.requested is not None:
        return
    moments = int(shop.rng.integers(1, 15))
    nc.run, nc.sequence_number = CncRun.START, 500
    shop.say(f"a cut of {moments}")

    def ends() -> None:
        if nc.sequence_number == 500:
            nc.run, nc.sequence_number = CncRun.STOP, 900

    shop.later(moments, ends)


async def power_cycle(shop: Attack) -> None:
    shop.loop.nc.power_cycle()
    shop.loop.nc.guard.power_cycle()
    shop.say("the control is switched off and on")
    shop.truth.ended("the control was switched off")
    shop.truth.tools.clear()
    shop.bad(2)


async def another_offset(shop: Attack) -> None:
    shop.loop.nc.work_offset = 55 if shop.loop.nc.work_offset == 54 else 54
    shop.say("another work offset")
    shop.truth.ended("the work offset is another one")
    shop.bad(1)


async def fault_and_restart(shop: Attack) -> None:
    """The daemon dies moments after something else has begun, whatever that is."""
    name = str(shop.rng.choice(sorted(EVENTS.keys() - {"killed", *ENDING})))
    await EVENTS[name](shop)
    shop.soon.setdefault(shop.moment + int(shop.rng.integers(1, 4)), []).append(killed)


async def probe_at_a_restart(shop: Attack) -> None:
    """The program probes while the daemon is away, and the next one finds the request."""
    await killed(shop)
    await probe(shop)


async def release_while_away(shop: Attack) -> None:
    """The CNC is away for so long that the guard takes the offset out; meanwhile, or soon after, a model comes."""
    if not shop.loop.nc.reachable:
        return
    moments = int(shop.rng.integers(4, 14))
    shop.loop.nc.reachable = False
    shop.say(f"the CNC is away for {moments}, and a model is released")

    def back() -> None:
        shop.loop.nc.reachable = True

    shop.later(moments, back)
    shop.soon.setdefault(shop.moment + int(shop.rng.integers(1, moments + 3)), []).append(release)


async def hold_while_away(shop: Attack) -> None:
    """So many sensors are silent that the output holds, and then the CNC is away until the block has expired."""
    gone, moments = shop.rng.choice(len(SENSOR_IDS), 4, replace=False), int(shop.rng.integers(12, 24))
    shop.mute[gone] = True
    shop.say(f"sensors {gone.tolist()} silent for {moments}, and the CNC away")

    def back() -> None:
        shop.mute[gone] = False

    def reached() -> None:
        shop.loop.nc.reachable = True

    async def away(_shop: Attack) -> None:
        shop.loop.nc.reachable = False

    shop.later(moments, back)
    shop.soon.setdefault(shop.moment + 8, []).append(away)
    shop.later(int(shop.rng.integers(9, moments)), reached)


def expires_to_zero(loop: WholeLoop) -> None:
    """Load a guard that takes the offset of an expired block out."""
    axes, macros = loop.configuration.compensation.axes, loop.configuration.cnc.macros
    guard = simulated_guard(axes).model_copy(update={"on_expiry": "zero"})
    cnc = loop.configuration.cnc.model_copy(update={"guard": guard})
    loop.configuration = loop.configuration.model_copy(update={"cnc": cnc})
    loop.nc.guard = SafePointApplication(macros, axes, guard)
    loop.nc.guard.initialise(loop.nc.macros, loop.nc.clock_s)


WIDER = {one.__name__: one for one in (fault_and_restart, probe_at_a_restart, release_while_away, hold_while_away)}
"""Beside the others, in histories of their own: what is drawn for the others stays as it was."""

EVENTS = {
    one.__name__: one
    for one in (
        silence,
        lie,
        lie_at_the_return,
        position,
        reference_by_hand,
        probe,
        nonsense,
        tool_set,
        tool_change,
        release,
        link_lost,
        write_torn,
        killed,
        calendar_set,
        cnc_clock_set,
        swap,
        foreign,
        switched_off,
        cut,
        power_cycle,
        another_offset,
    )
}

ENDING = ("power_cycle", "another_offset")
"""End every reference, and with it what could be wrong: rare."""
