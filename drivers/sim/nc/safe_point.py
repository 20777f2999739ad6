"""The NC programs as the simulated NC runs them: the very text that `toolpoint guard` prints.

What is applied is the external work offset (G10, or SD43900) minus the operator's own, whatever the echo says.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import SHARED_MEMORY, AxisLetter, GuardAxisConfig, GuardConfig
from config.schema.spindle_speed import SpeedMacrosConfig
from drivers.guard.programs import guard_text
from drivers.guard.text import GUARD_VERSION, GuardPrograms, GuardStatus, guard_axes
from drivers.sim.contract import Macros
from drivers.sim.nc.custom_macro import Interpreter, MacroControl, MacroProgram, compile_programs
from drivers.sim.nc.sinumerik import SinumerikControl, SinumerikInterpreter, SinumerikProgram, compile_archive

LETTERS: tuple[AxisLetter, ...] = ("X", "Y", "Z", "U", "V", "W", "A", "B", "C")
MM_PER_M = 1000.0
SIMULATED_INCREMENT_MM = 0.0001
"""Offsets of the simulated control, where no configuration says otherwise (IS-C) [mm]."""


@lru_cache(maxsize=8)
def _compiled(text: str) -> dict[int, MacroProgram]:
    return compile_programs(text)


@lru_cache(maxsize=8)
def _compiled_archive(text: str) -> dict[str, SinumerikProgram]:
    return compile_archive(text)


def simulated_guard(axes: Mapping[str, AxisConfig]) -> GuardConfig:
    """Return the guard's settings for a control that exists only here: its axes are numbered in their order."""
    offsets = [name for name, axis in axes.items() if axis.slope is None]
    if {name.lower() for name in offsets} <= {"x", "y", "z"}:
        return GuardConfig(increment_mm=SIMULATED_INCREMENT_MM)
    numbered = {
        name: GuardAxisConfig(letter=letter, number=number)
        for number, (name, letter) in enumerate(zip(offsets, LETTERS, strict=False), start=1)
    }
    return GuardConfig(increment_mm=SIMULATED_INCREMENT_MM, axes=numbered)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedProgram:
    """The NC program that takes the spindle speed, as `toolpoint guard --speed` prints it."""

    number: int
    text: str
    macros: SpeedMacrosConfig


class SafePointApplication:
    """The NC programs of one machine on a simulated control."""

    def __init__(
        self,
        macro_map: MacroMapConfig,
        axes: Mapping[str, AxisConfig],
        guard: GuardConfig | None = None,
        speed_program: SpeedProgram | None = None,
    ) -> None:
        guard = guard or simulated_guard(axes)
        self.speed_program = speed_program
        cleared = () if speed_program is None else (speed_program.macros.valid_until,)
        self._map = macro_map
        self._axes = guard_axes(axes, guard)
        self._places = {axis: settings.number - 1 for axis, settings in self._axes.items()}
        slopes = {name: axis.slope for name, axis in axes.items() if axis.slope is not None}
        self.slopes = slopes
        memory = guard.memory_of(len(axes), len(slopes))[SHARED_MEMORY:]
        self._memory, self._slope_places = memory[: len(axes)], memory[len(axes) + 1 :]
        self.programs = GuardPrograms.of(macro_map, guard)
        self.text = guard_text(macro_map, axes, guard, cleared=cleared)
        """What the NC runs, beside the speed program."""
        speed_text = "" if speed_program is None else speed_program.text
        letters = {axis.number: axis.letter for axis in self._axes.values()}
        addresses = [letters.get(number, "") for number in range(1, max(letters) + 1)]
        self.control: MacroControl | SinumerikControl
        self.interpreter: Interpreter | SinumerikInterpreter
        if guard.dialect == "sinumerik":
            siemens = SinumerikControl(_NoMacros(), addresses=addresses, increment_mm=guard.increment_mm)
            for name, slope in slopes.items():
                siemens.pivots_mm[self._places[name]] = slope.pivot_mm
                siemens.compensation_types[self._axes[name].letter] = 3
            self.control = siemens
            archives = _compiled_archive(self.text) | (_compiled_archive(speed_text) if speed_text else {})
            self.interpreter = SinumerikInterpreter(archives, siemens)
        else:
            fanuc = MacroControl(_NoMacros(), addresses=addresses, increment_mm=guard.increment_mm)
            if guard.read_ahead_stop.startswith("M"):
                fanuc.waiting_m_codes = frozenset({int(guard.read_ahead_stop[1:])})
            for name, slope in slopes.items():
                fanuc.positions_mm[self._places[name]] = slope.pivot_mm
            self.control = fanuc
            programs = _compiled(self.text) | (_compiled(speed_text) if speed_text else {})
            self.interpreter = Interpreter(programs, fanuc)
        self._remembered = frozenset() if guard.dialect == "sinumerik" else frozenset(slopes)
        """Slopes that only the guard's memory knows: this control has offsets alone."""
        self._own_mm = dict.fromkeys(axes, 0.0)
        self.axes = tuple(axes)

    @property
    def applied_um(self) -> dict[str, float]:
        """What the NC adds to the tool point's position now, per axis: external offset minus the operator's [um].

        Of a slope what it adds at one metre from its pivot; where the guard puts it into the offset, what its memory
        says, and the offset holds what that makes where the axis stood.
        """
        return {axis: round((self._external_mm(axis) - own) * 1000.0, 6) for axis, own in self._own_mm.items()}

    @property
    def offsets_um(self) -> dict[str, float]:
        """The same without slopes: the simulated axes stand at their pivots."""
        return {axis: um for axis, um in self.applied_um.items() if axis not in self.slopes}

    def moved_um(self, applied_um: Mapping[str, float], positions_mm: Mapping[str, float]) -> dict[str, float]:
        """Return how far values of `applied_um` move each axis that stands somewhere [um]; at its pivot if not told."""
        moved = {axis: um for axis, um in applied_um.items() if axis not in self.slopes}
        for name in set(self.slopes) - self._remembered:
            slope = self.slopes[name]
            moved[slope.of] += 1e-3 * applied_um[name] * (positions_mm.get(slope.of, slope.pivot_mm) - slope.pivot_mm)
        return moved

    def stand(self, positions_mm: Mapping[str, float]) -> None:
        """Tell a control whose programs ask for it where its axes stand [mm]."""
        if isinstance(self.control, MacroControl):
            for axis in positions_mm.keys() & self._places.keys():
                self.control.positions_mm[self._places[axis]] = positions_mm[axis]

    def by_letter(self, positions_mm: Mapping[str, float]) -> dict[str, float]:
        """Return positions of axes by their letters on the control [mm]."""
        letters = {axis: each.letter for axis, each in self._axes.items()}
        return {letters.get(axis, axis.upper()): mm for axis, mm in positions_mm.items()}

    def change_own_offset(self, axis: str, by_um: float) -> None:
        """Let the operator add to the own offset by hand [um]; ValueError for a slope that the control has not."""
        if axis in self._remembered:
            raise ValueError(f"{axis}: this control has offsets alone")
        self._own_mm[axis] += by_um / 1000.0
        self._set_external_mm(axis, self._external_mm(axis) + by_um / 1000.0)

    def place(self, macros: Macros, applied_um: Mapping[str, float]) -> None:
        """Make the control one that applies these offsets [um] and remembers it."""
        for place, axis in enumerate(self._axes):
            if axis in applied_um:
                mm = applied_um[axis] / 1000.0
                self._set_external_mm(axis, self._own_mm[axis] + mm)
                macros.set(self._map.echo_applied[axis], mm * 1000.0 / self._map.unit_um)
                macros.set(self._memory[place], mm)
        for number in self._slope_places:
            macros.set(number, 0.0)

    def initialise(self, macros: Macros, clock_s: float) -> None:
        """Bring block, echo and memory to what commissioning leaves in a machine that compensates nothing."""
        block = self._map
        for number in (block.sequence_a, *block.values.values(), block.enable, block.check, block.sequence_b):
            if number is not None:
                macros.set(number, 0.0)
        macros.set(self._map.valid_until, None)
        if self.speed_program is not None:
            for number in self.speed_program.macros.ours:
                macros.set(number, None if number == self.speed_program.macros.valid_until else 0.0)
        if self._map.request is not None:
            macros.set(self._map.request.acknowledge, 0.0)
        self._own_mm = {axis: 0.0 if axis in self._remembered else self._external_mm(axis) for axis in self._axes}
        self.at(macros, clock_s).run(self.programs.initialise, A=1.0)

    def run(self, macros: Macros, clock_s: float) -> GuardStatus:
        """Call the guard once, as a part program does at a safe point; return the status that it echoes."""
        self.at(macros, clock_s).run(self.programs.guard)
        return GuardStatus(round(macros.get(self._map.echo_status) or 0.0))

    @property
    def keeps_all(self) -> bool:
        """Power-off clears no macro variable of this control."""
        return isinstance(self.control, SinumerikControl)

    def show(self, macros: Macros, clock_s: float) -> None:
        """Let the control do what it does all the time, whatever runs: a SINUMERIK's synchronised actions."""
        if isinstance(self.control, SinumerikControl):
            self.control.common, self.control.clock_s = macros, clock_s
            self.control.cycle()

    def at(self, macros: Macros, clock_s: float) -> Interpreter | SinumerikInterpreter:
        """Return the interpreter with these macro variables, at this time of the NC's clock [s]."""
        self.control.common = macros
        self.control.clock_s = clock_s
        return self.interpreter

    def power_cycle(self) -> None:
        """Switch the control off and on: what ran is gone, offsets stay."""
        self.interpreter.reset()
        self.control.power_on()

    def _external_mm(self, axis: str) -> float:
        place = self._places[axis]
        if axis in self._remembered:
            return self.control.common.get(self._memory[self.axes.index(axis)]) or 0.0
        if axis in self.slopes and isinstance(self.control, SinumerikControl):
            return self.control.slopes[place] * MM_PER_M
        return self.control.external_mm[place]

    def _set_external_mm(self, axis: str, mm: float) -> None:
        place = self._places[axis]
        if axis in self.slopes and isinstance(self.control, SinumerikControl):
            self.control.slopes[place] = mm / MM_PER_M
        elif axis not in self._remembered:
            self.control.external_mm[place] = mm


class _NoMacros:
    """A control before its first call has no macro variables."""

    def get(self, number: int) -> float | None:
        raise KeyError(f"macro variable #{number} is not there yet")

    def set(self, number: int, value: float | None) -> None:
        raise KeyError(f"macro variable #{number} is not there yet")


__all__ = ["GUARD_VERSION", "GuardStatus", "SafePointApplication", "simulated_guard"]
