"""Energy efficiency and productivity of a process (equations 1-1 and 1-2 of the dissertation)."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """Energy and time that one part takes."""

    cut_kwh: float
    """Energy that the removal of material takes [kWh]."""
    motor_kwh: float
    """Energy of the motors [kWh]."""
    time_h: float
    """Time of the process [h]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be; raises ValueError."""
        if not (0.0 <= self.cut_kwh <= self.motor_kwh and self.motor_kwh > 0.0 and self.time_h > 0.0):
            raise ValueError(
                f"a process needs 0 <= cut <= motor energy and a time above 0, got {self.cut_kwh:g} kWh, "
                f"{self.motor_kwh:g} kWh, {self.time_h:g} h; the motors bring the cutting energy"
            )


def energy_efficiency(process: Process, *, chiller_kw: float, chiller_h: float) -> float:
    """Return the share of the whole energy that cuts (equation 1-1).

    Result: 0..1. Raises ValueError when power or time is negative, or the chiller runs longer than the process.

    `process`: energy and time of the part. `chiller_kw`: power of the chiller while it runs [kW]. `chiller_h`: how long
    it runs during the process [h]: all of it, or less with idle reduction or switched off.
    """
    if not (chiller_kw >= 0.0 and 0.0 <= chiller_h <= process.time_h * (1.0 + 1e-9)):
        raise ValueError(f"a chiller of {chiller_kw:g} kW cannot run {chiller_h:g} h of {process.time_h:g} h")
    return process.cut_kwh / (process.motor_kwh + chiller_kw * chiller_h)


def productivity_per_h(process: Process) -> float:
    """Return parts per hour (equation 1-2)."""
    return 1.0 / process.time_h
