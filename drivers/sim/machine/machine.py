"""The simulated machine as its faces see it: body, NC, and the truth about the tool point.

Everything is the tool point relative to the work along the axis. At work positioning both series of the truth are 0:
compensated = uncompensated + applied - applied at positioning. What is applied moves the tool point through the
machine's wiring, which may be wrong on purpose, and the displacement sensors see it move.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from config.schema.temperatures import SensorConfig
from drivers.sim.contract import AxisTruth
from drivers.sim.machine.body import MachineBody
from drivers.sim.machine.day import Day
from drivers.sim.machine.structure import CHANNELS
from drivers.sim.machine.travel import AxisTravel
from drivers.sim.nc.nc import NumericalControl, RunCode
from drivers.sim.nc.nc_programs import NcPrograms
from drivers.sim.nc.program import PartProgram
from drivers.sim.nc.safe_point import SafePointApplication
from drivers.sim.nc.wiring import AXES, STRAIGHT, Wiring
from models.records import FloatArray

CHANNEL_AXES = {channel: channel[0].lower() for channel in CHANNELS}
"""Axis along which each displacement channel measures."""
TOOL_LENGTH_M = 0.15
MOTOR_PERIOD_S = 5.0
"""The control looks at the spindle motor's temperature this often [s]."""
TOOL_EXPANSION_UM_PER_M_K = 11.0
"""Tool and holder of the shipped programs: steel, from the spindle nose to the tip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Zero:
    """What the truth since a work positioning counts from."""

    tool_point_um: FloatArray
    degc: FloatArray
    applied_um: Mapping[str, float]


class CfrpMachine:
    """The machine of the published work, simulated; implements `drivers.sim.contract.SimulatedMachine`."""

    def __init__(
        self,
        day: Day,
        program: PartProgram,
        sensors: Sequence[SensorConfig],
        application: SafePointApplication,
        *,
        wiring: Wiring = STRAIGHT,
        travels: Mapping[str, AxisTravel] | None = None,
    ) -> None:
        if unknown := sorted(set(application.axes) - set(application.slopes) - set(AXES)):
            raise ValueError(f"the simulated machine has the axes {', '.join(AXES)}, not {', '.join(unknown)}")
        self.body = MachineBody(day, program, sensors, travels=travels)
        self.time_s = 0.0
        rng = np.random.default_rng([1, 31])
        self._nc = NumericalControl(
            program=program.number,
            clock_s=float(rng.uniform(2000.0, 50000.0)),
            clock_ppm=float(rng.uniform(-30.0, 30.0)),
            power_on_count=int(rng.integers(100, 1000)),
            tool_number=1,
        )
        self.guard = application
        self._nc.keeps_all, self._nc.external_mm = self.guard.keeps_all, self.guard.control.external_mm
        self._programs = NcPrograms(self.guard, self._nc, self.body.turn)
        self._motor_due_s = 0.0
        self._wiring = wiring
        self._zero: _Zero | None = None
        self.initialise_macros()
        self._entered()
        self._show()

    @property
    def nc(self) -> NumericalControl:
        return self._nc

    def initialise_macros(self) -> None:
        """Set block and echo as the commissioning of this machine left them."""
        self.guard.initialise(self._nc.macros, self._nc.clock_at(self.time_s))

    def advance(self, to_s: float) -> None:
        """Move physics and NC on to the simulated time `to_s` [s]; a past time is ignored."""
        if to_s <= self.time_s:
            return
        self.body.advance(to_s, leaving=self._run_programs_until, entered=self._entered)
        self._show()

    def power_cycle(self) -> None:
        """Switch the NC off and on; the program begins again with its first block, started by a person."""
        self._nc.power_cycle(self.time_s)
        self._programs.power_cycle()
        self.body.restart_program()
        self._entered()
        self._show()

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        """Return the register contents of these sensors now; raises KeyError for an unknown sensor."""
        return self.body.sensors.pick(self.body.register_codes(), sensor_ids)

    def displacement_um(self) -> dict[str, float]:
        """Return the displacement sensors' readings by channel [um]; they see what the compensation does."""
        moved_um = self._moved_um(self.guard.applied_um)
        return {channel: um + moved_um[CHANNEL_AXES[channel]] for channel, um in self.body.displacement_um().items()}

    def truth(self) -> dict[str, AxisTruth]:
        """Return the tool point's true error per axis; empty before the first work positioning."""
        if self._zero is None:
            return {}
        now, zero = self._now(), self._zero
        moved_um, moved_then_um = self._moved_um(now.applied_um), self._moved_um(zero.applied_um)
        grown_um = [self.body.travel.grown_um(each.degc, self.body.time_s) for each in (now, zero)]
        error_um = now.tool_point_um - zero.tool_point_um + grown_um[0] - grown_um[1]
        cutting = self.body.block.kind == "cut"
        truth: dict[str, AxisTruth] = {}
        for axis, uncompensated_um in zip(AXES, error_um.tolist(), strict=True):
            change_um = moved_um[axis] - moved_then_um[axis]
            truth[axis] = AxisTruth(
                uncompensated_um=uncompensated_um, compensated_um=uncompensated_um + change_um, cutting=cutting
            )
        return truth

    def _now(self) -> "_Zero":
        degc = self.body.thermal_nodes()
        tool_point_um = self.body.structure.tool_point_um(degc, TOOL_LENGTH_M, TOOL_EXPANSION_UM_PER_M_K)
        return _Zero(tool_point_um=tool_point_um, degc=degc, applied_um=self.guard.applied_um)

    def _moved_um(self, applied_um: Mapping[str, float]) -> dict[str, float]:
        """Return how far what is applied moves each axis where it stands now [um]."""
        positions_mm = self.body.travel.positions_mm(self.body.time_s)
        return self._wiring.moved_um(self.guard.moved_um(applied_um, positions_mm))

    def _entered(self) -> None:
        block = self.body.block
        self._nc.sequence_number = block.sequence_number
        if block.kind != "idle":
            self._nc.run = RunCode.START
        elif self._nc.run != RunCode.RESET:
            self._nc.run = RunCode.STOP
        if block.kind == "positioning":
            self._zero = self._now()
        if block.tool_number is not None:
            self._nc.tool_number = block.tool_number
        measured = self.truth().get(block.probe or "")
        self._programs.enter(block, self.body.time_s, probed_um=measured.compensated_um if measured else None)
        self._run_programs_until(np.nextafter(self.body.time_s, np.inf))

    def _run_programs_until(self, end_s: float) -> None:
        """Let the NC's programs do what falls due before `end_s` [s]; one that waits holds its block."""
        self.guard.stand(self.body.travel.positions_mm(self.body.time_s))
        self._programs.run_until(end_s)
        if (resumes_s := self._programs.waits_until_s) is not None:
            self.body.hold(np.nextafter(resumes_s, np.inf))

    def _show(self) -> None:
        self.time_s = self.body.time_s
        self._nc.positions_mm.update(self.guard.by_letter(self.body.travel.positions_mm(self.time_s)))
        self._nc.clock_s = self._nc.clock_at(self.time_s)
        self.guard.show(self._nc.macros, self._nc.clock_s)
        self._nc.spindle_speed_rpm = self.body.spindle_speed_rpm
        if self.time_s >= self._motor_due_s:
            self._motor_due_s = self.time_s + MOTOR_PERIOD_S
            self._nc.motor_temperature_degc = float(round(self.body.motor_degc))
