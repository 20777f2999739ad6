"""The simulated machine without its control: programme, spindle, heat, sensors and shape over time.

The physics moves from knot to knot: multiples of 10 s and the boundaries of program blocks. What is looked at in
between is worked out from the last knot and not kept, so that a run does not depend on looking.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.machine.heat import INDEX, Drive
from drivers.sim.machine.plant import MAX_STEP_S, Plant
from drivers.sim.machine.sensors import CodeVector, RotationJump, SensorArray, displacement_reading_um
from drivers.sim.machine.structure import CHANNELS, Structure
from drivers.sim.machine.travel import AxisTravel, Travel
from drivers.sim.nc.program import Block, PartProgram
from drivers.sim.nc.wiring import AXES
from models.records import FloatArray

AXIS_OF_CHANNEL = np.array([AXES.index(channel[0].lower()) for channel in CHANNELS])
"""Place of the axis along which each displacement channel measures."""
SPINDLE_RPM_PER_S = 6000.0
"""Acceleration of the spindle (chosen: 2 s to full speed)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ramp:
    """Spindle speed over time since a change of the command."""

    start_s: float
    from_rpm: float
    to_rpm: float

    def at(self, time_s: float) -> float:
        """Return the actual spindle speed [1/min]."""
        change_rpm = self.to_rpm - self.from_rpm
        limit_rpm = SPINDLE_RPM_PER_S * max(time_s - self.start_s, 0.0)
        return self.from_rpm + min(max(change_rpm, -limit_rpm), limit_rpm)

    def mean(self, from_s: float, to_s: float) -> float:
        """Return the mean speed over an interval after the change [1/min]."""
        if to_s <= from_s:
            return self.at(from_s)
        end_s = self.start_s + abs(self.to_rpm - self.from_rpm) / SPINDLE_RPM_PER_S
        turn_s = min(max(end_s, from_s), to_s)
        ramped = 0.5 * (self.at(from_s) + self.at(turn_s)) * (turn_s - from_s)
        return (ramped + self.to_rpm * (to_s - turn_s)) / (to_s - from_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Thermal:
    """Temperatures of nodes and sensors at one time [degC]."""

    time_s: float
    nodes: FloatArray
    sensors: FloatArray


class MachineBody:
    """Heat, sensors and deformation of the machine that runs a part program."""

    def __init__(
        self,
        day: Day,
        program: PartProgram,
        sensors: Sequence[SensorConfig],
        *,
        machine_seed: int = 1,
        rotation_jump: RotationJump | None = None,
        travels: Mapping[str, AxisTravel] | None = None,
    ) -> None:
        self.program = program
        self.travel = Travel(travels or {})
        self.structure = Structure.on(day)
        self.sensors = SensorArray(sensors, machine_seed=machine_seed, noise_seed=day.seed)
        self.time_s = 0.0
        self._seed = day.seed
        self._jump = rotation_jump or RotationJump(um={})
        self._plant = Plant(day)
        nodes = warm_temperatures(self._plant) if day.start == "warm" else self._plant.cold()
        self._knot = _Thermal(time_s=0.0, nodes=nodes, sensors=self.sensors.settled(nodes))
        self._now = self._knot
        self._zero_um = self.structure.displacement_um(nodes)
        self._index = 0
        self._block_start_s = 0.0
        self._held_until_s = 0.0
        self._taken: tuple[float, float] | None = None
        """Programmed speed, and what was taken in its place [1/min]."""
        self._ramp = _Ramp(start_s=0.0, from_rpm=0.0, to_rpm=self.block.spindle_speed_rpm)
        self.travel.enter(self.block.kind, 0.0)

    @property
    def block(self) -> Block:
        return self.program.blocks[self._index]

    @property
    def block_end_s(self) -> float:
        """When it will end [s]."""
        return max(self._block_start_s + self.block.duration_s, self._held_until_s)

    @property
    def spindle_speed_rpm(self) -> float:
        """Actual spindle speed now [1/min]."""
        return self._ramp.at(self.time_s)

    @property
    def motor_degc(self) -> float:
        """Temperature of the spindle motor's winding [degC]."""
        return float(self.thermal_nodes()[INDEX["stator"]])

    def advance(self, to_s: float, *, leaving: Callable[[float], None], entered: Callable[[], None]) -> None:
        """Move on to `to_s`: `leaving(end_s)` may hold the block that still runs; `entered` follows each change."""
        while (end_s := self.block_end_s) <= to_s:
            leaving(end_s)
            if self.block_end_s > end_s:
                continue
            self._commit(end_s)
            self._enter(self.program.following(self._index))
            entered()
        if to_s > self.time_s:
            leaving(to_s)
            self.time_s = to_s
            self._pass_knots()

    def hold(self, until_s: float) -> None:
        """Keep the present block running at least until then [s]."""
        self._held_until_s = max(self._held_until_s, float(until_s))

    def turn(self, time_s: float, programmed_rpm: float, taken_rpm: float) -> None:
        """Turn at a speed that was taken in place of the programmed one, until a block has another [1/min].

        A spindle that stands goes on standing until the next block.
        """
        self._taken = (programmed_rpm, taken_rpm)
        if self.block.spindle_speed_rpm > 0.0:
            self._commit(max(time_s, self.time_s))
            self._ramp = _Ramp(start_s=self.time_s, from_rpm=self.spindle_speed_rpm, to_rpm=taken_rpm)

    def restart_program(self) -> None:
        """Begin the program again from its first block, now."""
        self._commit(self.time_s)
        self._enter(0)

    def thermal_nodes(self) -> FloatArray:
        """Return the temperatures of all nodes now [degC]."""
        return self._present().nodes

    def register_codes(self) -> CodeVector:
        """Return what the sensors' registers hold now, in the order of the sensor list."""
        return self.sensors.codes(self._present().sensors, self.time_s)

    def displacement_um(self) -> dict[str, float]:
        """Return the displacement readings by channel, zero at the start of the simulation [um]."""
        grown_um = self.travel.grown_um(self.thermal_nodes(), self.time_s)
        true_um = self.structure.displacement_um(self.thermal_nodes()) - self._zero_um + grown_um[AXIS_OF_CHANNEL]
        speed_rpm = self.spindle_speed_rpm
        jump_um = np.array([self._jump.at(channel, speed_rpm) for channel in CHANNELS])
        reading = displacement_reading_um(true_um + jump_um, self.time_s, self._seed)
        return dict(zip(CHANNELS, reading.tolist(), strict=True))

    def _enter(self, index: int) -> None:
        speed_rpm = self.spindle_speed_rpm
        self._index = index
        self._block_start_s = self.time_s
        self.travel.enter(self.block.kind, self.time_s)
        programmed_rpm = self.block.spindle_speed_rpm
        if self._taken is not None and self._taken[0] != programmed_rpm:
            self._taken = None
        commanded_rpm = programmed_rpm if self._taken is None else self._taken[1]
        self._ramp = _Ramp(start_s=self.time_s, from_rpm=speed_rpm, to_rpm=commanded_rpm)

    def _commit(self, to_s: float) -> None:
        self.time_s = to_s
        self._pass_knots()
        self._knot = self._now = self._step(self._knot, to_s)

    def _pass_knots(self) -> None:
        while (knot_s := (self._knot.time_s // MAX_STEP_S + 1.0) * MAX_STEP_S) <= self.time_s:
            self._knot = self._now = self._step(self._knot, knot_s)

    def _present(self) -> _Thermal:
        if self._now.time_s != self.time_s:
            self._now = self._step(self._knot, self.time_s)
        return self._now

    def _step(self, start: _Thermal, to_s: float) -> _Thermal:
        duration_s = to_s - start.time_s
        if duration_s <= 0.0:
            return start
        drive = Drive(
            spindle_speed_rpm=self._ramp.mean(start.time_s, to_s),
            chiller=self.block.chiller,
            feeding=self.block.feeding,
        )
        nodes = self._plant.advance(start.nodes, time_s=start.time_s, duration_s=duration_s, drive=drive)
        return _Thermal(time_s=to_s, nodes=nodes, sensors=self.sensors.advance(start.sensors, nodes, duration_s))


def warm_temperatures(plant: Plant) -> FloatArray:
    """Return the temperatures [degC] after two cycles of 2 h at full speed and 3 h of standby."""
    degc = plant.cold()
    time_s = -36000.0
    for speed_rpm, hours in ((12000.0, 2), (0.0, 3)) * 2:
        drive = Drive(spindle_speed_rpm=speed_rpm, chiller=True, feeding=False)
        for _ in range(round(hours * 3600 / MAX_STEP_S)):
            degc = plant.advance(degc, time_s=time_s, duration_s=MAX_STEP_S, drive=drive)
            time_s += MAX_STEP_S
    return degc
