"""What the interpreter's programs find on the simulated SINUMERIK: R parameters, timers, data, actions, alarms."""

import math
from collections import deque
from collections.abc import Callable, Sequence

from config.schema.guard import VACANT_R
from drivers.sim.contract import Macros
from drivers.sim.nc.blocks import NcError

CLOCK_WRAP_S = 2_147_483.648
"""The simulated NC's clock begins again from 0 here; timers do not."""
MESSAGES_KEPT = 20
METRIC, INCHES = 2, 1
"""Active function of G group 13: G71, G70."""
ALL_METRIC = 4
"""Active function of G group 13: G710, which holds for setting data too."""
MM_PER_INCH = 25.4
PER_MINUTE = 2
"""Active function of G group 15: G94."""
DEFAULT_GROUPS = {7: 1, 13: METRIC, 15: PER_MINUTE}
"""Active function of each G group after power-on: G40, G71, G94."""
NOT_MACHINING = ("$P_SEARCH", "$P_SIM", "$P_ISTEST")
"""TRUE in a block search, a simulation and a program test: the program is run through, and the axes do not follow."""
Action = Callable[["SinumerikControl"], None]


class SinumerikControl:
    """State that outlives a program. R parameters are the NC's macro variables; a number stands for a vacant one.

    `clock_s` is the time since power-on. R parameters and setting data survive power-off; timers and actions do not.
    """

    def __init__(self, common: Macros, *, addresses: Sequence[str], increment_mm: float) -> None:
        self.common = common
        self.addresses = tuple(addresses)
        """Names of the axes, axis 1 first."""
        self.increment_mm = increment_mm
        """The control keeps compensation values in steps of this [mm]."""
        self.clock_s = 0.0
        self.tool_number = 0
        self.spindle_rpm = 0.0
        self.feed_mm_min = 0.0
        """What the latest S and F words say."""
        self.external_mm = [0.0] * len(self.addresses)
        """What each axis is moved by [mm]: SD43900, the operator's own and what a program has added."""
        self.slopes = [0.0] * len(self.addresses)
        """SD43910 of each axis [mm per mm]."""
        self.pivots_mm = [0.0] * len(self.addresses)
        """SD43920 of each axis [mm]."""
        self.groups = dict(DEFAULT_GROUPS)
        """Active function by G group."""
        self.basic_metric = True
        """MD10240: setting data are in mm, else in inches."""
        self.compensation_types = dict.fromkeys(self.addresses, 1)
        """MD32750 by axis."""
        self.velocity_factors = dict.fromkeys(self.addresses, 0.01)
        """MD32760 by axis."""
        self.not_machining: set[str] = set()
        """Those of `NOT_MACHINING` that are TRUE."""
        self.actions: dict[int, Action] = {}
        self.alarm: tuple[int, str] | None = None
        """Number and text of the alarm that has stopped the program."""
        self.messages: deque[str] = deque(maxlen=MESSAGES_KEPT)
        """Latest texts with which the program has stopped for the operator."""
        self.messages_shown = 0
        self._timers: dict[int, tuple[float, float]] = {}

    def parameter(self, number: int) -> float:
        try:
            value = self.common.get(number)
        except KeyError as error:
            raise NcError(f"there is no R{number}") from error
        return VACANT_R if value is None else value

    def set_parameter(self, number: int, value: float) -> None:
        if not math.isfinite(value):
            raise NcError(f"R{number} cannot hold {value}")
        try:
            self.common.set(number, None if value == VACANT_R else value)
        except KeyError as error:
            raise NcError(f"there is no R{number}") from error

    def timer(self, number: int) -> float:
        """Return an $AC_TIMER [s]; 0 until a program has started it."""
        if number not in self._timers:
            return 0.0
        value, at_s = self._timers[number]
        return value + (self.clock_s - at_s) % CLOCK_WRAP_S

    def start_timer(self, number: int, value: float) -> None:
        """Let a timer run from a value on [s]."""
        if value < 0.0:
            raise NcError("stopping a timer is not known here")
        self._timers[number] = (value, self.clock_s)

    def axis(self, name: str) -> int:
        if name not in self.addresses:
            raise NcError(f"this control has the axes {' '.join(self.addresses)}, not {name}")
        return self.addresses.index(name)

    @property
    def datum_mm(self) -> float:
        """Millimetres per unit of a length in setting data."""
        return 1.0 if self.basic_metric or self.groups[13] == ALL_METRIC else MM_PER_INCH

    def set_compensation(self, name: str, value: float) -> None:
        """Write SD43900 of an axis, which moves by it at once."""
        axis, value_mm = self.axis(name), value * self.datum_mm
        if self.compensation_types[name] & 1 and self.velocity_factors[name] > 0.0:
            self.external_mm[axis] = round(value_mm / self.increment_mm) * self.increment_mm

    def set_slope(self, name: str, mm_per_mm: float) -> None:
        """Write SD43910 of an axis."""
        axis = self.axis(name)
        if self.compensation_types[name] & 2 and self.velocity_factors[name] > 0.0:
            self.slopes[axis] = mm_per_mm

    def moved_mm(self, name: str, position_mm: float) -> float:
        """Return by how much an axis that stands at a machine position is moved [mm]."""
        axis = self.axis(name)
        return self.external_mm[axis] + self.slopes[axis] * (position_mm - self.pivots_mm[axis])

    def cycle(self) -> None:
        for action in self.actions.values():
            action(self)

    def power_on(self) -> None:
        """Do what power-off and power-on do: no timer runs, no action is left; R parameters and data stay."""
        self._timers.clear()
        self.actions.clear()
        self.groups = dict(DEFAULT_GROUPS)
        self.alarm = None

    def show(self, text: str) -> None:
        """Show a message, before which the program stops; this operator presses cycle start at once."""
        if text:
            self.messages.append(text)
            self.messages_shown += 1
