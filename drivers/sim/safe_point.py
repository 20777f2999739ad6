"""How the simulated NC takes the compensation over: only at safe points, and only a block it believes."""

from collections.abc import Mapping
from enum import IntEnum

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from drivers.sim.contract import Macros

LOOK_AHEAD_LIMIT_S = 120.0
"""A block that claims to be valid for longer than this is not believed [s of the NC's clock]."""
GUARD_VERSION = 1


class GuardStatus(IntEnum):
    """What the last run at a safe point did; anything but APPLIED moved nothing."""

    APPLIED = 0
    """The enabled axes were moved towards their values, each by at most its step."""
    DISABLED = 1
    """All enable bits are 0: nothing added, what is applied stays, no look at valid_until."""
    TORN = 2
    """A sequence number is vacant, or the two differ: the block was being written."""
    EXPIRED = 3
    """valid_until is vacant, has passed, or lies further ahead than the limit."""
    VACANT = 4
    """The value of an enabled axis, or the enable word itself, is vacant."""
    OVERSIZE = 5
    """The value of an enabled axis lies outside its absolute bound."""


class SafePointApplication:
    """Reads the block of macro variables at a safe point, moves the tool point, and fills the echo."""

    def __init__(self, macro_map: MacroMapConfig, axes: Mapping[str, AxisConfig]) -> None:
        self._map = macro_map
        self._axes = dict(axes)
        self.applied_um: dict[str, float] = dict.fromkeys(axes, 0.0)
        """What the NC adds to the tool point's position now, per axis [um]."""

    def initialise(self, macros: Macros, clock_s: float) -> None:
        """Write the block and the echo as they stand in a commissioned machine that compensates nothing."""
        for number in (self._map.sequence_a, self._map.sequence_b, self._map.enable, *self._map.values.values()):
            macros.set(number, 0.0)
        macros.set(self._map.valid_until, None)
        self._echo(macros, clock_s, GuardStatus.APPLIED)

    def run(self, macros: Macros, clock_s: float) -> GuardStatus:
        """Take over what the block asks for, as far as it may be believed, and echo what was done."""
        status, wanted_um = self._read(macros, clock_s)
        for axis, target_um in wanted_um.items():
            step_um = self._axes[axis].step_um
            change_um = min(max(target_um - self.applied_um[axis], -step_um), step_um)
            self.applied_um[axis] += change_um
        self._echo(macros, clock_s, status)
        return status

    def _read(self, macros: Macros, clock_s: float) -> tuple[GuardStatus, dict[str, float]]:
        """Return the status, and for APPLIED the value of every enabled axis [um]; sequence_b is read first."""
        sequence_b = macros.get(self._map.sequence_b)
        values = {axis: macros.get(number) for axis, number in self._map.values.items()}
        valid_until = macros.get(self._map.valid_until)
        enable = macros.get(self._map.enable)
        if sequence_b is None or macros.get(self._map.sequence_a) != sequence_b:
            return GuardStatus.TORN, {}
        if enable is None:
            return GuardStatus.VACANT, {}
        enabled = [axis for bit, axis in enumerate(self._axes) if int(enable) >> bit & 1]
        if not enabled:
            return GuardStatus.DISABLED, {}
        if valid_until is None or not clock_s < valid_until <= clock_s + LOOK_AHEAD_LIMIT_S:
            return GuardStatus.EXPIRED, {}
        wanted_um: dict[str, float] = {}
        for axis in enabled:
            value = values[axis]
            if value is None:
                return GuardStatus.VACANT, {}
            wanted_um[axis] = value * self._map.unit_um
            if abs(wanted_um[axis]) > self._axes[axis].absolute_bound_um + self._map.tolerance * self._map.unit_um:
                return GuardStatus.OVERSIZE, {}
        return GuardStatus.APPLIED, wanted_um

    def _echo(self, macros: Macros, clock_s: float, status: GuardStatus) -> None:
        for axis, number in self._map.echo_applied.items():
            macros.set(number, self.applied_um[axis] / self._map.unit_um)
        macros.set(self._map.echo_time, clock_s)
        macros.set(self._map.echo_status, float(status))
        macros.set(self._map.echo_guard_version, float(GUARD_VERSION))
