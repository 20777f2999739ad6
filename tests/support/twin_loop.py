"""A whole loop that hears real frames, and what may happen to them: judged by a twin to which nothing happens."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from control_rig import SENSOR_IDS
from whole_loop import MOMENT_S, WholeLoop

from config.schema import Configuration
from drivers.latsis.cycle import CycleAssembler
from drivers.latsis.frames import sum8
from models.control.state import OperatorRequest
from models.records import CncRun, FloatArray, OutputState
from models.thermal.family import ThermalModel
from models.units import TMP102_DEGC_PER_LSB

CHAIN = {"spindle": (0, 1, 2), "column": (3, 4)}
"""Index of each sensor by line, in the order of the chain."""
BEFORE = 96
"""Moments before anything happens."""

Frames = list[bytes]
Disturbance = Callable[["TwinLoop", int, str, Frames, np.random.Generator], Frames]
"""Loop, moment, line, its frames in the order of the wire -> what arrives."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """How the temperature of a sensor's place goes: a warm-up with its own height and time constant."""

    rise_k: FloatArray
    constant_s: FloatArray

    def degc(self, elapsed_s: float) -> FloatArray:
        """Return the temperatures [degC]."""
        return 20.0 + self.rise_k * (1.0 - np.exp(-elapsed_s / self.constant_s))


def some_places(rng: np.random.Generator) -> Place:
    """The head warms by up to eight kelvin, the column by less and later."""
    return Place(
        rise_k=np.concatenate([rng.uniform(4.0, 8.0, 3), rng.uniform(1.0, 3.0, 2)]),
        constant_s=np.concatenate([rng.uniform(900.0, 1800.0, 3), rng.uniform(1800.0, 3600.0, 2)]),
    )


@dataclass
class TwinLoop:
    """Everything between the bytes of two lines and the tool, on the clock of the test."""

    directory: Path
    model: ThermalModel
    places: Place
    profile: str
    disturbance: Disturbance | None = None
    seed: int = 0
    pauses: tuple[int, ...] = ()
    """Moments before which `pause_s` pass in which nobody does anything."""
    pause_s: float = 20.0
    """After less than 15 s the reference is taken up again: no positioning can have been missed."""
    reads_past: bool = False
    """The model's past may be read again: ten seconds on, all that was handed to the store is in it, however fast this
    computer plays them."""
    restarting: bool = False
    """In every pause the daemon dies, and starts again."""
    first: int = 0
    """Moment in which the daemon starts, before it is switched on in moment 60; the machine warms since moment 0."""
    configuration: Configuration | None = None
    """Another machine with the same lines."""
    before: int = BEFORE
    """Moments before anything happens; the daemon is switched on in the 36th of them from the end."""
    positionings: tuple[int, ...] = ()
    """Moments after these in which the work is positioned again."""
    loop: WholeLoop = field(init=False)
    begun_s: float = field(init=False)
    applied_um: list[FloatArray] = field(init=False, default_factory=list)
    states: list[OutputState] = field(init=False, default_factory=list)
    silent: dict[int, int] = field(init=False, default_factory=dict)
    """Sensor -> the moment until which it is silent."""
    offset_k: FloatArray = field(init=False, default_factory=lambda: np.zeros(len(SENSOR_IDS)))

    def __post_init__(self) -> None:
        self.directory.mkdir()
        self.rng = np.random.default_rng(self.seed)
        self.loop = WholeLoop(self.directory, self.model, configuration=self.configuration)
        self.begun_s = self.loop.clock.monotonic_s
        temperatures = self.loop.configuration.temperatures
        lines = [line.model_copy(update={"profile": self.profile}) for line in temperatures.lines]
        self.loop.configuration = self.loop.configuration.model_copy(
            update={"temperatures": temperatures.model_copy(update={"lines": lines})}
        )
        self.loop._speak = self._speak  # type: ignore[method-assign]
        self._listen()

    def _listen(self) -> None:
        temperatures = self.loop.configuration.temperatures
        self.assemblers = {line.name: CycleAssembler(line, temperatures.sensors) for line in temperatures.lines}

    async def _speak(self, line: str, _part: slice) -> None:
        loop, count = self.loop, len(CHAIN[line])
        degc = self.true_degc() + self.offset_k
        frames = []
        for place in reversed(range(count)):
            sensor = CHAIN[line][place]
            if self.silent.get(sensor, -1) <= self.moment:
                frames.append(self.frame(place + 1, round(degc[sensor] / TMP102_DEGC_PER_LSB)))
        if self.disturbance is not None and self.moment >= self.before:
            frames = self.disturbance(self, self.moment - self.before, line, frames, self.rng)
        now = loop.clock.now()
        assembler = self.assemblers[line]
        cycles = assembler.feed(b"".join(frames), now)
        later = replace(now, monotonic_s=now.monotonic_s + 0.6 * MOMENT_S, real_s=now.real_s + 0.6 * MOMENT_S)
        for cycle in (*cycles, *assembler.poll(later)):
            await loop.thermal._take(cycle)

    def true_degc(self) -> FloatArray:
        """Return the temperature of each sensor's place [degC]."""
        return self.places.degc(self.loop.clock.monotonic_s - self.begun_s + self.first * MOMENT_S)

    def frame(self, wire_id: int, code: int) -> bytes:
        """Return a node's frame."""
        if self.profile == "bare":
            return b"%02X%03X\r\n" % (wire_id, code & 0xFFF)
        body = b"%03X,%03X,00" % (wire_id, code & 0xFFF)
        return b":%b*%02X\r\n" % (body, sum8(body))

    async def run(self, moments: int) -> None:
        """Warm up, position the work, and go on for so many moments."""
        loop = self.loop
        self.moment = self.first
        await self._start()
        try:
            for moment in range(self.first, self.before + moments):
                self.moment = moment
                await self._program()
                if self.moment - self.before in self.pauses:
                    await self._pause()
                if self.reads_past:
                    await loop.rig.history.flushed()
                await loop.moment()
                loop.nc.safe_point()
                if self.moment >= self.before:
                    self.applied_um.append(loop.applied_um.copy())
                    memory = loop.rig.control.memory
                    self.states.append(OutputState.OFF if memory is None else memory.state)
        finally:
            await loop.end()

    async def _program(self) -> None:
        nc, control = self.loop.nc, self.loop.rig.control
        moment = self.moment - self.before
        if moment == -36:
            control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
        if moment in (-26, *self.positionings):
            nc.run, nc.sequence_number = CncRun.START, 100
        if moment - 2 in (-26, *self.positionings):
            nc.run, nc.sequence_number = CncRun.STOP, 900

    async def _pause(self) -> None:
        if self.restarting:
            await self.loop.rig.history.flushed()
            await self.loop.end()
        self.loop.clock.monotonic_s += self.pause_s
        if self.restarting:
            self._listen()
            await self._start()

    async def _start(self) -> None:
        """Start the daemon as `ThermalTask.run` does."""
        await self.loop.start()
        thermal = self.loop.thermal
        await thermal.recall()
        await thermal._prepare()
