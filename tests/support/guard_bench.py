"""The shipped text of the guard on a simulated control, with everything a test may want to disturb."""

from collections.abc import Callable, Iterator
from typing import Any

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import GuardConfig
from drivers.guard.check import block_check
from drivers.sim.nc.nc import MacroTable
from drivers.sim.nc.safe_point import GuardStatus, SafePointApplication

MAP = MacroMapConfig(
    writable=["120", "500-529"],
    sequence_a=500,
    values={"x": 501, "y": 502, "z": 503},
    valid_until=120,
    enable=504,
    sequence_b=505,
    check=506,
    echo_applied={"x": 511, "y": 512, "z": 513},
    echo_time=514,
    echo_status=515,
    echo_guard_version=516,
)
AXES = {
    "x": AxisConfig(absolute_bound_um=30.0, slew_um_per_min=2.0, step_um=5.0),
    "y": AxisConfig(absolute_bound_um=60.0, slew_um_per_min=2.0, step_um=5.0),
    "z": AxisConfig(absolute_bound_um=80.0, slew_um_per_min=4.0, step_um=10.0),
}
CLOCK_S = 1000.0
INCREMENT_UM = 0.1
NOISE_UM = 1e-5
"""Rounding of floating-point numbers in offsets [um]."""


DIALECT = "fanuc"
"""Whose text a bench runs where a test says nothing."""
GROUP_7 = {40: 1, 41: 2, 42: 3}


class KeptTable(MacroTable):
    """R parameters survive power-off."""

    def power_off(self) -> None:
        pass


class GuardBench:
    """A control that has been initialised at CLOCK_S; nothing is applied."""

    def __init__(self, own_um: dict[str, float] | None = None, **guard: Any) -> None:
        settings = GuardConfig(**({"increment_mm": INCREMENT_UM / 1000.0, "dialect": DIALECT} | guard))
        self.siemens = settings.dialect == "sinumerik"
        self.macros = KeptTable() if self.siemens else MacroTable()
        self._modal: dict[int, int] = {3: 90}
        self.clock_s = CLOCK_S
        self.nc = SafePointApplication(MAP, AXES, settings)
        for axis, um in (own_um or {}).items():
            self.nc.change_own_offset(axis, um)
        self.nc.initialise(self.macros, self.clock_s)
        if self.siemens:
            self.nc.control.start_timer(1, CLOCK_S)
        self.sequence = 0.0
        self.waits = 0
        """Dwells of the guard in the latest run by `steps`."""

    # --- the daemon ----------------------------------------------------------------------

    def block(self, *, enable: float = 7.0, valid_for_s: float | None = 30.0, **um: float) -> list[tuple[int, float]]:
        """Return the next block in the order in which the daemon writes it."""
        self.sequence += 1.0
        valid_until = 0.0 if valid_for_s is None else self.clock_s + valid_for_s
        held = {
            **{number: um.get(axis, 0.0) / 1000.0 for axis, number in MAP.values.items()},
            MAP.valid_until: valid_until,
            MAP.enable: enable,
            MAP.sequence_b: self.sequence,
        }
        return [
            (MAP.sequence_a, self.sequence),
            *((number, um.get(axis, 0.0) / 1000.0) for axis, number in MAP.values.items()),
            (MAP.valid_until, valid_until),
            (MAP.enable, enable),
            (MAP.check, block_check(MAP, AXES, held)),
            (MAP.sequence_b, self.sequence),
        ]

    def write(self, **block: Any) -> None:
        """Write a whole block."""
        for number, value in self.block(**block):
            self.macros.set(number, value)

    def power_cycle(self) -> None:
        """Switch the control off and on; its clock goes on where it was, so that what is written counts on it."""
        self.macros.power_off()
        self.nc.power_cycle()
        if self.siemens:
            self.nc.at(self.macros, self.clock_s).run(self.nc.programs.start)
            self.nc.control.start_timer(1, self.clock_s)

    # --- the part program ----------------------------------------------------------------

    def call(self, *, later_s: float = 0.0) -> GuardStatus:
        """Call the guard at a safe point; it always says when and what."""
        self.clock_s += later_s
        status = self.nc.run(self.macros, self.clock_s)
        assert self.macros.get(MAP.echo_status) == float(status)
        clock_s = self.nc.control.timer(1) if self.siemens else self.clock_s % 2147483.648
        assert abs((self.macros.get(MAP.echo_time) or 0.0) - clock_s) < 0.0011
        assert not self.nc.interpreter.running
        return status

    def steps(self) -> Iterator[int]:
        """Run the guard block by block; yield the number of blocks run, before each one."""
        interpreter = self.nc.at(self.macros, self.clock_s)
        interpreter.start(self.nc.programs.guard)
        count = self.waits = 0
        while interpreter.running:
            yield count
            interpreter.step()
            count += 1
            self.waits += interpreter.dwell_s > 0.0

    def interrupted(self, after: int) -> bool:
        """Call the guard and press RESET after so many blocks; return False when it had ended before."""
        for count in self.steps():
            if count == after:
                self.nc.interpreter.reset()
                self.modal(3, 90)
                return True
        return False

    def with_interference(self, at: int, work: Callable[[], None]) -> GuardStatus:
        """Call the guard; something else happens after so many of its blocks."""
        for count in self.steps():
            if count == at:
                work()
        return GuardStatus(round(self.macros.get(MAP.echo_status) or 0.0))

    def modal(self, group: int, code: int | None = None) -> int:
        """Make a G code active, by FANUC's group, or only return the active one."""
        if not self.siemens:
            found: dict[int, int] = self.nc.control.modal
            if code is not None:
                found[group] = code
            return found[group]
        if code is not None:
            self._modal[group] = code
            if group == 6:
                self.nc.control.groups[13] = 1 if code == 20 else 2
            elif group == 7:
                self.nc.control.groups[7] = GROUP_7[code]
        return self._modal[group]

    # --- the truth -----------------------------------------------------------------------

    @property
    def applied_um(self) -> dict[str, float]:
        """What the offset holds beyond the operator's own."""
        return self.nc.applied_um

    @property
    def echo_um(self) -> dict[str, float]:
        """What the echo says."""
        return {axis: (self.macros.get(number) or 0.0) * 1000.0 for axis, number in MAP.echo_applied.items()}

    def settled(self) -> bool:
        """The echo says what is applied."""
        echo = self.echo_um
        return all(abs(um - echo[axis]) < NOISE_UM for axis, um in self.applied_um.items())

    @property
    def message(self) -> str:
        """The latest text at which the program stopped for the operator."""
        return self.nc.control.messages[-1] if self.nc.control.messages else ""
