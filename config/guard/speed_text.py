"""Fills the template of the speed program in for one machine."""

from enum import IntEnum
from importlib.resources import files

from config.guard.text import LONGEST_LINE, RETRIES, RETRY_MS, GuardTextError, decimal
from config.schema import Configuration
from config.schema.guard import PROGRAMS

SPEED_PROGRAM_VERSION = 1


class SpeedStatus(IntEnum):
    """What the speed program's last run did; only APPLIED takes the daemon's pair, all others the programmed one."""

    APPLIED = 0
    """The pair of the block was taken."""
    NOT_WANTED = 1
    """The call said K0."""
    DISABLED = 2
    """The daemon has not enabled a pair."""
    TORN = 3
    """A sequence number is vacant, or the two differ."""
    ANOTHER = 4
    """The pair belongs to another programmed speed."""
    EXPIRED = 5
    """valid_until is vacant, has passed, or lies further ahead than the limit."""
    OUT_OF_BOUNDS = 6
    """The pair is vacant, outside the limits, or its feed does not belong to its speed."""


def speed_program(configuration: Configuration) -> str:
    """Return the text of the speed program for this machine; raises GuardTextError."""
    tuning, guard = configuration.spindle_speed, configuration.cnc.guard
    if tuning is None:
        raise GuardTextError("there is no section spindle_speed, so the machine has no speed program")
    if guard.program <= tuning.program < guard.program + PROGRAMS:
        raise GuardTextError(
            f"spindle_speed.program: O{tuning.program} is one of the guard's, O{guard.program} to "
            f"O{guard.program + PROGRAMS - 1}; choose another number"
        )
    fields = {
        **{name: str(number) for name, number in tuning.macros.model_dump().items()},
        "program": str(tuning.program),
        "version": str(SPEED_PROGRAM_VERSION),
        "stop": guard.read_ahead_stop,
        "tries": str(RETRIES),
        "retry_ms": str(RETRY_MS),
        "look_ahead": decimal(max(guard.look_ahead_s, 2.0 * tuning.validity_s)),
        "lowest": decimal(tuning.lowest_rpm - 0.5),
        "highest": decimal(tuning.highest_rpm + 0.5),
        "within": decimal(tuning.within_percent / 100.0 + 1e-4),
    }
    dropped = "@plain" if tuning.keep_feed_per_tooth else "@keep"
    lines: list[str] = []
    kept = True
    for line in files("config.guard").joinpath("speed.nc").read_text(encoding="ascii").splitlines():
        if line.startswith("@"):
            kept = line != dropped if line != "@end" else True
        elif kept:
            lines.append(line.format_map(fields))
    if long := [line for line in lines if len(line) > LONGEST_LINE]:
        raise GuardTextError(f"the line {long[0]!r} is longer than {LONGEST_LINE} characters")
    return "\n".join(lines) + "\n"
