"""Fills the template of the speed program in for one machine."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from enum import IntEnum

from config.schema import Configuration
from config.schema.spindle_speed import SpindleSpeedConfig
from drivers.guard.text import LONGEST_LINE, RETRIES, RETRY_MS, GuardPrograms, GuardTextError, decimal, filled

SPEED_PROGRAM_VERSION = 5
SPEED_CHECK_MISSING = (
    "spindle_speed.macros.check names no variable, so the speed program cannot recognise a foreign value in its block, "
    "and no speed is tuned: name one within `cnc.macros.writable` that nothing else uses, and load the text that "
    "`toolpoint guard --speed` prints"
)
"""What is wrong with `spindle_speed.macros.check` where it is not given."""
TEXT_NUMBERS = 1_000_000
"""The text is identified by a number below this, which the program reports with every call."""
ROUNDING_RPM = 0.5
"""The NC takes whole speeds, so limits are this much wider in its text [1/min]."""
Rows = list[dict[str, str]]
_TEXT = re.compile(r"^[(;]TEXT (\d+)", re.MULTILINE)


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
    """The pair was made for another tool or operation."""
    EXPIRED = 5
    """valid_until is vacant, has passed, or lies further ahead than the limit."""
    OUT_OF_BOUNDS = 6
    """The pair is vacant, outside the limits, or its feed does not belong to its speed."""
    CHECK = 7
    """The check does not fit what the block holds: one of its macros was written by another program."""


def speed_program(configuration: Configuration) -> str:
    """Return the text of the speed program for this machine; raises GuardTextError."""
    tuning, guard = configuration.spindle_speed, configuration.cnc.guard
    if tuning is None:
        raise GuardTextError("there is no section spindle_speed, so the machine has no speed program")
    if guard.dialect == "linuxcnc":
        raise GuardTextError(
            "spindle_speed: there is no speed program for LinuxCNC, only for FANUC and SINUMERIK; leave the section out"
        )
    if tuning.macros.check is None:
        raise GuardTextError(SPEED_CHECK_MISSING)
    is_sinumerik = guard.dialect == "sinumerik"
    if tuning.program in guard.programs:
        letters = "TP" if is_sinumerik else "O"
        raise GuardTextError(
            f"spindle_speed.program: {letters}{tuning.program} is one of the guard's, {letters}{guard.program} to "
            f"{letters}{guard.programs[-1]}; choose another number"
        )
    fields = _fields(configuration, tuning)
    if is_sinumerik:
        from drivers.guard.sinumerik import speed_archive, speed_fields

        fields = speed_fields(fields, GuardPrograms.of(configuration.cnc.macros, guard), guard)
        return speed_archive(tuning.program, _numbered(tuning, fields, "sinumerik_speed"))
    lines = _numbered(tuning, fields, "speed")
    if long := [line for line in lines if len(line) > LONGEST_LINE]:
        raise GuardTextError(f"the line {long[0]!r} is longer than {LONGEST_LINE} characters")
    return "\n".join(lines) + "\n"


def speed_text_number(configuration: Configuration) -> int:
    """Return the number by which the text of this configuration is known; raises GuardTextError."""
    found = _TEXT.search(speed_program(configuration))
    assert found is not None
    return int(found[1])


def _fields(configuration: Configuration, tuning: SpindleSpeedConfig) -> dict[str, str]:
    guard = configuration.cnc.guard
    return {
        **{name: str(number) for name, number in tuning.macros.model_dump().items()},
        "program": str(tuning.program),
        "version": str(SPEED_PROGRAM_VERSION),
        "tool_variable": str(tuning.tool_variable),
        "stop": guard.read_ahead_stop,
        "tries": str(RETRIES),
        "retry_ms": str(RETRY_MS),
        "look_ahead": decimal(max(guard.max_validity_s, 2.0 * tuning.validity_s)),
        "lowest": decimal(tuning.lowest_rpm - ROUNDING_RPM),
        "highest": decimal(tuning.highest_rpm + ROUNDING_RPM),
        "within": decimal(tuning.max_change_percent / 100.0),
        "rounding": decimal(ROUNDING_RPM),
    }


def _tools(tuning: SpindleSpeedConfig) -> Rows:
    """Return the highest speed of every tool that has one of its own, the lowest where operations differ."""
    highest: dict[int, float] = {}
    for operation in tuning.operations:
        if operation.highest_rpm is not None:
            tool, limit_rpm = operation.tool_number, tuning.highest_of(operation)
            highest[tool] = min(limit_rpm, highest.get(tool, limit_rpm))
    return [{"tool": str(tool), "tool_highest": decimal(rpm + ROUNDING_RPM)} for tool, rpm in sorted(highest.items())]


def _numbered(tuning: SpindleSpeedConfig, fields: Mapping[str, str], template: str) -> list[str]:
    """Return the lines of the text, which hold the number that is made from them."""
    number = _number(_filled(tuning, {**fields, "text": "0"}, template))
    return _filled(tuning, {**fields, "text": str(number)}, template)


def _filled(tuning: SpindleSpeedConfig, fields: Mapping[str, str], template: str) -> list[str]:
    keep = tuning.keep_feed_per_tooth
    once: Rows = [{}]
    sections: dict[str, Rows] = {
        "@keep": once if keep else [],
        "@plain": [] if keep else once,
        "@tools": _tools(tuning),
    }
    return filled(template, fields, sections)


def _number(lines: Sequence[str]) -> int:
    digest = hashlib.sha256("\n".join(lines).encode("ascii")).digest()
    return int.from_bytes(digest[:8], "big") % (TEXT_NUMBERS - 1) + 1
