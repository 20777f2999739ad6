"""Fills the templates of the NC programs in for a SINUMERIK: R parameters as macro variables, SD43900 as the offset.

What the programs do is line by line what they do on a FANUC. R parameters are never vacant and survive power-off: a
number stands for vacant, and the program `start`, which all others call, finds by a timer that stands still that the
control was switched on, and then makes the valid_until of before vacant.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from config.records.commissioning import macro_map_digest
from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import VACANT_R, GuardConfig
from drivers.guard import text as fanuc

LONGEST_LINE = 120
MM_PER_M = 1000.0
"""A slope is in mm per m in the block and in the guard's memory, SD43910 in mm per mm."""
FIRST_ALARM = 65_000
"""User's alarms from here on stop the interpreter until RESET."""
_POINT = re.compile(r"(?<=\d)\.(?!\d)")
WORDS = {
    3: "EXPIRED",
    4: "VACANT MACRO",
    5: "OVERSIZE VALUE",
    6: "INCH MODE",
    7: "NOT G40",
    8: "MEMORY DAMAGED",
    9: "OFFSET UNSETTLED",
    10: "CHECK DIFFERS",
    11: "MD32750 OR MD32760 OFF",
    110: "SWITCH OFF FIRST",
    111: "OFFSET APPLIED",
    112: "A IS NOT 1",
    120: "REQUEST WRONG",
    121: "REQUEST IN INCH",
}
"""What the programs stop with, by status or number."""
ALARMS = {10: 130, 11: 131}
"""Numbers of the statuses whose 100 + n is another alarm already."""


SPEED_WORDS = {
    "alarm_wrong": (140, "SPEED S F D E OR K WRONG"),
    "alarm_inch": (141, "SPEED IN INCH"),
    "alarm_feed": (142, "SPEED NEEDS G94"),
}
"""What the speed program stops with."""
OWN_TOOL_NUMBER = 4120
"""`tool_variable` of a FANUC, whose place $P_TOOLNO takes here."""


def sinumerik_text(
    macros: MacroMapConfig,
    axes: Mapping[str, AxisConfig],
    guard: GuardConfig,
    *,
    machine: str = "",
    cleared: Sequence[int] = (),
) -> str:
    """Return the archive with all NC programs; `cleared` are R parameters that power-on makes vacant as well."""
    programs = fanuc.GuardPrograms.of(macros, guard)
    rows = [
        _decimals(row | _datum(axes[name]))
        for name, row in zip(axes, fanuc.axis_rows(macros, axes, guard), strict=True)
    ]
    words = WORDS | ({11: "MD32750 MD32760 SD43920"} if any("pivot" in row for row in rows) else {})
    fields = _decimals(_fields(macros, guard, len(rows), words))
    fields["cleared"] = "".join(f"\nR{number}={round(VACANT_R)}" for number in cleared)
    numbers = {name: getattr(programs, name) for name in ("start", "guard", "initialise", "request", "enter", "leave")}
    parts = [
        _file_head(number) + fanuc.filled_program(f"sinumerik_{name}", number, fields, rows, guard)
        for name, number in numbers.items()
        if number is not None
    ]
    body = "\n".join(parts) + "\n"
    first, path, proc, rest = body.split("\n", 3)
    head = _head(macros, axes, guard, machine, body)
    return _taken("\n".join([first, path, proc, *head, rest]))


def speed_fields(fields: Mapping[str, str], programs: fanuc.GuardPrograms, guard: GuardConfig) -> dict[str, str]:
    """Return the fields of the speed program as the template for a SINUMERIK has them."""
    tool = fields["tool_variable"]
    return {
        **fields,
        **{name: _stop("stop", number, words) for name, (number, words) in SPEED_WORDS.items()},
        "start": str(programs.start),
        "retry_s": fanuc.decimal(fanuc.RETRY_MS / 1000.0),
        "vacant": str(round(VACANT_R)),
        "timer": str(guard.timer),
        "tool_in_spindle": "$P_TOOLNO" if tool == str(OWN_TOOL_NUMBER) else f"R{tool}",
    }


def speed_archive(number: int, lines: Iterable[str]) -> str:
    """Return the archive that holds the speed program alone; raises GuardTextError."""
    return _taken(_file_head(number) + _POINT.sub(".0", "\n".join(lines)) + "\n")


def _file_head(number: int) -> str:
    return f"%_N_TP{number}_SPF\n;$PATH=/_N_CUS_DIR\n"


def _taken(text: str) -> str:
    """Return a text that a control takes; raises GuardTextError for one that it would not."""
    for line in text.splitlines():
        if len(line) > LONGEST_LINE or not line.isascii():
            raise fanuc.GuardTextError(f"the line {line!r} is longer than {LONGEST_LINE} characters or not plain ASCII")
    return text


def _head(
    macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig, machine: str, body: str
) -> Iterator[str]:
    yield f";MACHINE {fanuc.comment(machine)}" if machine else ";MACHINE NOT NAMED"
    yield f";TEXT {fanuc.guard_digest(body)[:16].upper()} MAP {macro_map_digest(macros)[:16].upper()}"
    for name, axis in axes.items():
        bound, step = fanuc.decimal(axis.absolute_bound_um / 1000.0), fanuc.decimal(axis.step_um / 1000.0)
        along = "" if axis.slope is None else f" PER M, 0 AT {fanuc.decimal(axis.slope.pivot_mm)} (SD43920)"
        yield f";AXIS {fanuc.comment(name)} BOUND {bound} STEP {step} MM{along}"
    stop = "MESSAGE" if guard.alarm == "message" else "ALARM"
    yield f";EXPIRED {guard.on_expiry.upper()} AND {stop}, AHEAD AT MOST {fanuc.decimal(guard.max_validity_s)} S"


def _datum(axis: AxisConfig) -> dict[str, str]:
    """Return what holds the value of an axis, and how it counts: SD43900 in mm, SD43910 in mm per mm from SD43920."""
    if axis.slope is None:
        return {"datum": "$SA_TEMP_COMP_ABS_VALUE", "of_datum": "", "per_datum": "", "type_bit": "1"}
    return {
        "datum": "$SA_TEMP_COMP_SLOPE",
        "of_datum": f"*{MM_PER_M}",
        "per_datum": f"/{MM_PER_M}",
        "type_bit": "2",
        "pivot": fanuc.decimal(axis.slope.pivot_mm),
    }


def _fields(macros: MacroMapConfig, guard: GuardConfig, axes: int, words: Mapping[int, str]) -> dict[str, str]:
    seconds = {"retry_s": fanuc.RETRY_MS, "poll_s": fanuc.POLL_MS, "timeout_s": guard.request_timeout_s * 1000.0}
    return {
        **fanuc.common_fields(macros, guard, axes),
        **{name: fanuc.decimal(ms / 1000.0) for name, ms in seconds.items()},
        **{
            f"alarm{n}": _stop("stop" if n >= 110 else guard.alarm, ALARMS.get(n, n if n >= 110 else 100 + n), text)
            for n, text in words.items()
        },
        "timed_out": _stop(guard.on_timeout, 122, "GIVES NO ANSWER"),
        "refused": _stop(guard.alarm, 123, "REFUSES REQUEST"),
        "start": str(fanuc.GuardPrograms.of(macros, guard).start),
        "vacant": str(round(VACANT_R)),
        "clock": str(guard.shown),
        "power_on_count": str(guard.shown + 1),
        "timer": str(guard.timer),
        "action": str(guard.synchronised_action),
    }


def _decimals(fields: Mapping[str, str]) -> dict[str, str]:
    """Return the fields with a digit behind every decimal point."""
    return {name: _POINT.sub(".0", text) for name, text in fields.items()}


def _stop(means: str, number: int, words: str) -> str:
    """Return the lines of a message that waits for cycle start, of an alarm, or nothing."""
    return {
        "message": f'MSG("TOOLPOINT {words}")\nM0\nMSG("")',
        "stop": f'SETAL({FIRST_ALARM + number},"TOOLPOINT {words}")\nSTOPRE',
        "continue": ";GOES ON",
    }[means]
