"""The simulated NC: its state in FANUC's codes, its clock and its macro variables."""

import math
from collections.abc import Sequence
from enum import IntEnum

from drivers.sim.contract import Macros

VOLATILE = range(100, 200)
"""Common variables that power-off clears."""
PERSISTENT = range(500, 1000)
"""Common variables that survive power-off."""
CLOCK_WRAP_S = 2_147_483.648
"""The clock is the control's millisecond timer, which begins again from 0 here (after 24.9 days) [s]."""


class ModeCode(IntEnum):
    MDI = 0
    MEM = 1
    EDIT = 3
    HANDLE = 4
    JOG = 5
    REMOTE = 10


class RunCode(IntEnum):
    """State of automatic operation."""

    RESET = 0
    STOP = 1
    HOLD = 2
    START = 3


class MacroTable:
    """Common macro variables: #100-#199 (cleared at power-off), #500-#999 (kept), #0 (always vacant)."""

    def __init__(self) -> None:
        self._values: dict[int, float | None] = dict.fromkeys((*VOLATILE, *PERSISTENT))

    def get(self, number: int) -> float | None:
        """Return the variable, None where it is vacant; raises KeyError where there is none."""
        if number == 0:
            return None
        if number not in self._values:
            raise KeyError(f"macro variable #{number} does not exist: there are #0, #100-#199 and #500-#999")
        return self._values[number]

    def set(self, number: int, value: float | None) -> None:
        """Set the variable (None: vacant); raises KeyError where there is none, ValueError for NaN or infinity."""
        if number not in self._values:
            raise KeyError(f"macro variable #{number} cannot be written: #100-#199 and #500-#999 can")
        if value is not None and not math.isfinite(value):
            raise ValueError(f"macro variable #{number} cannot hold {value}")
        self._values[number] = None if value is None else float(value)

    def power_off(self) -> None:
        for number in VOLATILE:
            self._values[number] = None


class NumericalControl:
    """State of the NC; the owner of the machine moves it on."""

    def __init__(
        self, *, program: int, clock_s: float, clock_ppm: float, power_on_count: int, tool_number: int
    ) -> None:
        self.mode: int = ModeCode.MEM
        self.run: int = RunCode.RESET
        self.alarm: int = 0
        self.program = program
        self.sequence_number = 0
        self.spindle_speed_rpm = 0.0
        self.motor_temperature_degc = 0.0
        self.clock_s = clock_s
        self.power_on_count = power_on_count
        self.work_offset = 54
        self.tool_number = tool_number
        self.positions_mm = dict.fromkeys("XYZ", 0.0)
        self.external_mm: Sequence[float] = ()
        self._table = MacroTable()
        self.macros: Macros = self._table
        self.keeps_all = False
        """Power-off clears no macro variable of this control."""
        self._clock_rate = 1.0 + clock_ppm * 1e-6
        self._clock_zero_s = clock_s
        self._powered_at_s = 0.0

    def clock_at(self, time_s: float) -> float:
        """Return the NC's own clock [s] at the simulated time `time_s` [s]."""
        return (self._clock_zero_s + (time_s - self._powered_at_s) * self._clock_rate) % CLOCK_WRAP_S

    def power_cycle(self, time_s: float) -> None:
        """Switch off and on: volatile variables vacant, clock from 0, one more power-on, program at its head."""
        if not self.keeps_all:
            self._table.power_off()
        self.power_on_count += 1
        self._powered_at_s = time_s
        self._clock_zero_s = 0.0
        self.clock_s = 0.0
        self.mode, self.run, self.alarm = ModeCode.MEM, RunCode.RESET, 0
        self.sequence_number = 0
        self.spindle_speed_rpm = 0.0
