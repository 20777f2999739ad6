"""What the interpreter's programs find on the simulated control: variables, modals, offsets, alarms."""

import math
from collections import deque
from collections.abc import Sequence

from drivers.sim.contract import Macros
from drivers.sim.nc.blocks import NcError

LOCALS = 34
"""Local variables are #1 to #33."""
EXTERNAL_OFFSET = 5200
"""#5201.. hold the external work offset of axis 1.. [mm, or inches in G20]."""
MACHINE_POSITION = 5020
"""#5021.. hold the machine position of axis 1.. while it stands [mm, or inches in G20]."""
TOOL = 4120
"""The control's own number of the tool (modal T)."""
TIMER_WRAP_MS = 2_147_483_648
"""#3001 begins again from 0 here."""
MM_PER_INCH = 25.4
MESSAGES_KEPT = 20
DEFAULT_MODALS = {2: 17, 3: 90, 5: 94, 6: 21, 7: 40, 9: 80, 13: 97}
"""G code that is active in each modal group after power-on and reset."""


class MacroControl:
    """State that outlives a program: common and system variables, modal codes, external offset, alarms."""

    def __init__(self, common: Macros, *, addresses: Sequence[str], increment_mm: float) -> None:
        self.common = common
        self.addresses = tuple(addresses)
        """Address letters of the controlled axes, axis 1 first."""
        self.increment_mm = increment_mm
        """The control keeps offsets in steps of this [mm]."""
        self.clock_s = 0.0
        self.tool_number = 0
        self.timer_zero_ms = 0.0
        self.external_mm = [0.0] * len(self.addresses)
        """External work offset of each axis [mm]: the operator's own, and what a program has added."""
        self.positions_mm: list[float | None] = [0.0] * len(self.addresses)
        """Where each axis stands in machine coordinates [mm]; None: the control does not know."""
        self.modal: dict[int, int] = dict(DEFAULT_MODALS)
        """Active G code by modal group."""
        self.waiting_m_codes: frozenset[int] = frozenset()
        """M codes that end the reading ahead on this control and do nothing else."""
        self.alarm: tuple[int, str] | None = None
        """Number and text of the alarm that has stopped the program, by #3000."""
        self.spindle_rpm = 0.0
        """Commanded by S [1/min]."""
        self.feed_mm_min = 0.0
        """Commanded by F [mm/min]."""
        self.messages: deque[str] = deque(maxlen=MESSAGES_KEPT)
        """Latest texts at which the program has stopped for the operator, by #3006."""
        self.messages_shown = 0

    def get(self, number: int) -> float | None:
        """Return a variable outside the local ones; None: vacant."""
        if number == 0 or 100 <= number <= 999:
            try:
                return self.common.get(number)
            except KeyError as error:
                raise NcError(str(error.args[0])) from error
        if number == 3001:
            return float(math.floor(self.clock_s * 1000.0 - self.timer_zero_ms + 1e-6) % TIMER_WRAP_MS)
        if number == TOOL:
            return float(self.tool_number)
        if number - 4000 in self.modal:
            return float(self.modal[number - 4000])
        if (axis := number - EXTERNAL_OFFSET - 1) in range(len(self.external_mm)):
            return self.external_mm[axis] / self._unit_mm()
        if (axis := number - MACHINE_POSITION - 1) in range(len(self.positions_mm)):
            position_mm = self.positions_mm[axis]
            return None if position_mm is None else position_mm / self._unit_mm()
        raise NcError(f"variable #{number} cannot be read here")

    def set(self, number: int, value: float | None) -> None:
        """Write a variable outside the local ones."""
        if 100 <= number <= 999:
            try:
                self.common.set(number, value)
            except (KeyError, ValueError) as error:
                raise NcError(str(error.args[0])) from error
        elif number == 3001:
            self.timer_zero_ms = self.clock_s * 1000.0 - (value or 0.0)
        else:
            raise NcError(f"variable #{number} cannot be written here")

    def set_external(self, letter: str, value: float) -> None:
        """Do `G10 L2 P0` for one axis: absolute in G90, added in G91, in the unit of G20 or G21."""
        if letter not in self.addresses:
            raise NcError(f"this control has the axes {' '.join(self.addresses)}, not {letter}")
        axis = self.addresses.index(letter)
        wanted_mm = value * self._unit_mm() + (self.external_mm[axis] if self.modal[3] == 91 else 0.0)
        self.external_mm[axis] = round(wanted_mm / self.increment_mm) * self.increment_mm

    def set_modal(self, code: int) -> None:
        """Make a modal G code the active one of its group."""
        group = {90: 3, 91: 3, 93: 5, 94: 5, 95: 5, 20: 6, 21: 6, 96: 13, 97: 13}.get(code)
        if group is None:
            raise NcError(f"G{code} is not known here")
        self.modal[group] = code

    def power_on(self) -> None:
        """Do what power-off and power-on do here: modals as after power-on, no alarm; offsets stay."""
        self.modal = dict(DEFAULT_MODALS)
        self.alarm = None
        self.timer_zero_ms = 0.0

    def show(self, text: str) -> None:
        """Stop for the operator with a message (#3006); this operator presses cycle start at once."""
        self.messages.append(text)
        self.messages_shown += 1

    def _unit_mm(self) -> float:
        return MM_PER_INCH if self.modal[6] == 20 else 1.0
