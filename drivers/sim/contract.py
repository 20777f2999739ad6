"""What the faces of a simulated machine (wires, the CNC's server, in-process) need of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisTruth:
    """True position of the tool point relative to the work on one axis, since work positioning."""

    uncompensated_um: float
    """What the error would be without any compensation [um]."""
    compensated_um: float
    """What it is, with what the NC has applied [um]."""
    cutting: bool
    """The tool is in the work (only then the error reaches the part)."""


class Macros(Protocol):
    """Macro variables of a simulated NC."""

    def get(self, number: int) -> float | None:
        """Return the variable, None where it is vacant; raises KeyError for a number that does not exist."""

    def set(self, number: int, value: float | None) -> None:
        """Set the variable (None: vacant); raises KeyError for a number that does not exist."""


class SimulatedNc(Protocol):
    """The state of a simulated NC. Codes are FANUC's (mode: aut, run: run)."""

    mode: int
    run: int
    alarm: int
    program: int
    sequence_number: int
    spindle_speed_rpm: float
    motor_temperature_degc: float
    clock_s: float
    power_on_count: int
    work_offset: int
    tool_number: int
    macros: Macros
    positions_mm: dict[str, float]
    """Machine positions by the axis' letter [mm]."""
    external_mm: Sequence[float]
    """External work offset of axis 1, 2, .. [mm]."""


NC_STATE = tuple(name for name in SimulatedNc.__annotations__ if name not in ("macros", "positions_mm", "external_mm"))
"""What a simulated NC shows besides its macro variables, its axis positions and its external work offset."""


class SimulatedMachine(Protocol):
    """A simulated machine, moved on by its owner."""

    @property
    def time_s(self) -> float:
        """Simulated seconds since its start."""

    @property
    def nc(self) -> SimulatedNc: ...

    def advance(self, to_s: float) -> None:
        """Move physics and NC on to the simulated time `to_s` [s]; a past time is ignored."""

    def register_codes(self, sensor_ids: Sequence[int]) -> list[int]:
        """Return the register contents that the sensors' nodes read now, in the order asked for."""

    def displacement_um(self) -> dict[str, float]:
        """Return the displacement sensors' readings by channel [um]."""

    def truth(self) -> dict[str, AxisTruth]:
        """Return the true error per axis; empty before the first work positioning."""
