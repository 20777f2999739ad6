"""Fills the templates of the NC programs in for one machine."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib.resources import files

from config.files import sha256_of
from config.records.commissioning import CHECKING_GUARD, macro_map_digest
from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import PROGRAM_LABELS, PROGRAMS, SHARED_MEMORY, USUAL_AXES, GuardAxisConfig, GuardConfig
from drivers.guard.check import PER_SECOND, pivot_check
from models.errors import RefusedInputError

GUARD_VERSION = CHECKING_GUARD
"""Echoed by the guard; raised when what the text does changes."""
UNCHECKED_GUARD_VERSION = 1
"""The text without a check, which a control of version 0.1.0 still runs; no axis is enabled on it."""
LONGEST_LINE = 76
POLL_MS = 50
"""The request program looks for its answer once in this time [ms]."""
RETRIES, RETRY_MS = 3, 200
"""A block that is being written is read again so often, after so long [ms]."""
NM_PER_MM = 1_000_000
"""A value counts to a nanometre."""
_COMMENT = re.compile(r"\(([^()]*)\)")
_ALLOWED = re.compile(r"[A-Z0-9 .,\-=/#+]*")
_FOREIGN = re.compile(r"[^A-Z0-9 .,\-=/#+]+")


class GuardStatus(IntEnum):
    """What the guard's last run did; only APPLIED, and EXPIRED under the policy zero, move anything."""

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
    """The value of an enabled axis lies outside its absolute bound, or the enable word has bits of no axis."""
    INCH = 6
    """The control is in inch mode (G20)."""
    MODAL = 7
    """Cutter compensation or a canned cycle is active: this is no safe point."""
    MEMORY = 8
    """The guard's memory of the applied offset is vacant, contradictory or outside the bound."""
    UNSETTLED = 9
    """The external offset is neither what it was before the guard's change nor what it was to become."""
    CHECK = 10
    """The check does not fit what the block holds: another program has written one of its macros."""
    SWITCHED_OFF = 11
    """A SINUMERIK whose machine data let no temperature compensation act on an axis."""
    PLACE = 12
    """A slope that counts for where its axis stands: the position is vacant or outside the travel; nothing moved."""
    NEARING = 13
    """Applied, but a slope's axis stands further from the place it was applied for than a step reaches: call again."""
    UNFINISHED = 14
    """A run that applies has begun and not ended: where it was broken off, the echo may lack what it had applied."""


class GuardTextError(RefusedInputError, ValueError):
    """The programs cannot be made for this configuration; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardPrograms:
    """O numbers of the programs; those that the macro map has no macros for are None."""

    guard: int
    initialise: int
    request: int | None
    enter: int | None
    leave: int | None
    start: int | None = None
    """Only a SINUMERIK has it: lets the clock run and finds out that the control was switched on."""

    @classmethod
    def of(cls, macros: MacroMapConfig, guard: GuardConfig) -> "GuardPrograms":
        first, flag = guard.program, macros.safe_flag is not None
        return cls(
            guard=first,
            initialise=first + 1,
            request=first + 2 if macros.request is not None else None,
            enter=first + 3 if flag else None,
            leave=first + 4 if flag else None,
            start=first + PROGRAMS if guard.dialect == "sinumerik" else None,
        )


def guard_digest(text: str) -> str:
    """Return the SHA-256 of a text of NC programs, as the commissioning record names it."""
    return sha256_of(text.encode("ascii"))


def alarm_number(status: GuardStatus) -> int:
    """Return the number with which #3000 stops for a status; 110 to 112 are the initialising program's."""
    return {GuardStatus.CHECK: 114, GuardStatus.PLACE: 113}.get(status, 100 + status)


def guard_axes(axes: Mapping[str, AxisConfig], guard: GuardConfig) -> dict[str, GuardAxisConfig]:
    """Return letter and number of every axis, of a slope those of the axis that it acts on; raises GuardTextError."""
    found: dict[str, GuardAxisConfig] = {}
    for name in (each for each in axes if axes[each].slope is None):
        usual = USUAL_AXES.get(name.lower())
        if name in guard.axes:
            found[name] = guard.axes[name]
        elif usual is not None:
            found[name] = GuardAxisConfig(letter=usual[0], number=usual[1])
        else:
            raise GuardTextError(
                f"cnc.guard.axes: {name} is not x, y or z; say its letter and axis number, "
                f"such as {{{name}: {{letter: Z, number: 3}}}}"
            )
    for part in ("letter", "number"):
        taken = [getattr(axis, part) for axis in found.values()]
        if twice := sorted({str(value) for value in taken if taken.count(value) > 1}):
            raise GuardTextError(f"cnc.guard.axes: {part} {twice[0]} stands for more than one axis")
    return {name: found[name if axis.slope is None else axis.slope.of] for name, axis in axes.items()}


def fanuc_text(macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig, *, machine: str = "") -> str:
    """Return the text of all NC programs in custom macro B that the map has macros for; raises GuardTextError."""
    programs = GuardPrograms.of(macros, guard)
    rows = placed_rows(macros, axes, guard)
    fields = common_fields(macros, guard, len(rows))
    numbers = {
        "guard": programs.guard,
        "initialise": programs.initialise,
        "request": programs.request,
        "enter": programs.enter,
        "leave": programs.leave,
    }
    parts = [
        filled_program(name, number, fields, rows, guard) for name, number in numbers.items() if number is not None
    ]
    body = "\n".join(parts) + "\n"
    first, rest = body.split("\n", 1)
    text = "%\n" + first + "\n" + "\n".join(_head(macros, axes, guard, machine, body)) + "\n" + rest + "%\n"
    _check(text)
    return text


def decimal(value: float) -> str:
    """Return a number as custom macro text: no exponent, always a decimal point."""
    text = f"{value:.7f}".rstrip("0")
    return text if text != "-0." else "0."


def _head(
    macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig, machine: str, body: str
) -> Iterator[str]:
    """Yield the comments that say which machine, map and limits the text was made for."""
    yield f"(MACHINE {comment(machine)})" if machine else "(MACHINE NOT NAMED)"
    yield f"(TEXT {guard_digest(body)[:16].upper()} MAP {macro_map_digest(macros)[:16].upper()})"
    yield from axis_comments(axes)
    stop = "MESSAGE" if guard.alarm == "message" else "ALARM"
    yield f"(EXPIRED {guard.on_expiry.upper()} AND {stop}, AHEAD AT MOST {decimal(guard.max_validity_s)} S)"


def axis_comments(axes: Mapping[str, AxisConfig]) -> Iterator[str]:
    """Yield the comments that say what each axis may do, and of a slope where."""
    for name, axis in axes.items():
        bound, step = decimal(axis.absolute_bound_um / 1000.0), decimal(axis.step_um / 1000.0)
        yield f"(AXIS {comment(name)} BOUND {bound} STEP {step} MM{'' if axis.slope is None else ' PER M'})"
        if axis.slope is not None:
            lowest, highest = axis.slope.travel_mm
            yield f"(  0 AT {decimal(axis.slope.pivot_mm)}, TRAVEL {decimal(lowest)} TO {decimal(highest)} MM)"


def comment(text: str) -> str:
    """Return a text with nothing but what a control takes in comments."""
    return _FOREIGN.sub(" ", text.upper()).strip()[:40]


def axis_rows(macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig) -> Iterator[dict[str, str]]:
    """Yield the fields of every axis, in the order of the enable bits."""
    controlled = guard_axes(axes, guard)
    increment, to_mm = guard.increment_mm, macros.unit_um / 1000.0
    factor = "" if math.isclose(to_mm, 1.0) else decimal(to_mm)
    for bit, (name, axis) in enumerate(axes.items()):
        bound_mm, step_mm = axis.absolute_bound_um / 1000.0, axis.step_um / 1000.0
        if step_mm < increment * (1.0 - 1e-9):
            raise GuardTextError(
                f"compensation.axes.{name}.step_um: {axis.step_um:g} um is less than the control's least increment "
                f"of {increment * 1000.0:g} um (cnc.guard.increment_mm), so nothing could ever be applied"
            )
        yield {
            "letter": controlled[name].letter,
            "offset": str(5200 + controlled[name].number),
            "number": str(bit + 1),
            "bit": str(1 << bit),
            "local": str(11 + bit),
            "value": str(macros.values[name]),
            "echo": str(macros.echo_applied[name]),
            "mirror": str(guard.memory + SHARED_MEMORY + bit),
            "settle": str(PROGRAM_LABELS.start + 101 + bit),
            "settled": str(PROGRAM_LABELS.start + 121 + bit),
            "judged": str(PROGRAM_LABELS.start + 331 + bit),
            "applied": str(PROGRAM_LABELS.start + 601 + bit),
            "bound": decimal(_down(bound_mm, increment)),
            "bound_slack": decimal(bound_mm + increment / 2.0),
            "bound_tolerance": decimal(bound_mm + macros.tolerance * to_mm),
            "step": decimal(_down(step_mm, increment)),
            "pivot_check": "" if axis.slope is None else f"{pivot_check(bit + 1, axis.slope.pivot_mm):+d}",
            "to_mm": f"*{factor}" if factor else "",
            "per_unit": f"/{factor}" if factor else "",
        }


def placed_rows(macros: MacroMapConfig, axes: Mapping[str, AxisConfig], guard: GuardConfig) -> list[dict[str, str]]:
    """Return the fields of every axis for a control that takes offsets alone: a slope counts for a place there."""
    rows = list(axis_rows(macros, axes, guard))
    slopes = [(row, name, axis) for row, (name, axis) in zip(rows, axes.items(), strict=True) if axis.slope is not None]
    for place, (row, name, axis) in enumerate(slopes, start=1):
        row.update(
            _placed(name, axis, guard.increment_mm),
            place=str(planned_place(guard, len(axes)) + place),
            position=str(5020 + int(row["offset"]) - 5200),
            undone=str(int(row["settled"]) + 20),
            placed=str(int(row["judged"]) + 20),
            there=str(int(row["applied"]) + 20),
        )
    return rows


def planned_place(guard: GuardConfig, axes: int) -> int:
    """Return the macro of the place that is planned; those of the slopes follow, in their order."""
    return guard.memory + SHARED_MEMORY + axes


def axis_sections(rows: Sequence[Mapping[str, str]]) -> dict[str, Sequence[Mapping[str, str]]]:
    """Return the sections of a template that stand there once for each axis, offset or slope, or for any slope."""
    return {
        "@axes": rows,
        "@offsets": [row for row in rows if "pivot" not in row],
        "@slopes": [row for row in rows if "pivot" in row],
        "@placed": [{}] if any("place" in row for row in rows) else [],
    }


def _placed(name: str, axis: AxisConfig, increment: float) -> dict[str, str]:
    """Return the limits of a slope that moves an offset in whole increments, together never more than the slope may.

    Rounding the offset may move it by up to one increment more than the slope alone would: so much of the step is left.
    """
    slope = axis.slope
    assert slope is not None
    bound_mm, step_mm = (um / 1000.0 * slope.reach_m for um in (axis.absolute_bound_um, axis.step_um))
    step = _down(axis.step_um / 1000.0 - increment / slope.reach_m, increment)
    if step < increment * (1.0 - 1e-9) or _down(bound_mm, increment) < increment * (1.0 - 1e-9):
        raise GuardTextError(
            f"compensation.axes.{name}.step_um: {axis.step_um:g} um/m move the far end of the travel by "
            f"{step_mm * 1000.0:g} um, which must be more than the control's least increment of "
            f"{increment * 1000.0:g} um (cnc.guard.increment_mm), and the bound at least as much: nothing could ever "
            "be applied"
        )
    return {
        "pivot": decimal(slope.pivot_mm),
        "lowest": decimal(slope.travel_mm[0] - increment / 2.0),
        "highest": decimal(slope.travel_mm[1] + increment / 2.0),
        "reach_slack": decimal(slope.reach_m * 1000.0 + increment),
        "most": decimal(_down(bound_mm, increment)),
        "step": decimal(step),
        "place_step": decimal(step_mm - increment),
    }


def _down(value: float, increment: float) -> float:
    """Return a limit as whole increments, never more than it was."""
    return math.floor(value / increment + 1e-6) * increment


def common_fields(macros: MacroMapConfig, guard: GuardConfig, axes: int) -> dict[str, str]:
    block = ("sequence_a", "sequence_b", "valid_until", "enable", *(("check",) if macros.check is not None else ()))
    echo = ("echo_time", "echo_status", "echo_guard_version")
    flag = {"safe_flag": str(macros.safe_flag)} if macros.safe_flag is not None else {}
    alarms = {f"alarm{status}": _stop(guard.alarm, alarm_number(status)) for status in GuardStatus if status >= 3}
    return {
        **{name: str(getattr(macros, name)) for name in (*block, *echo)},
        **{name: str(guard.memory + place) for place, name in enumerate(("pending", "planned", "before", "after"))},
        "planned_place": str(planned_place(guard, axes)),
        **alarms,
        **flag,
        **(_request_fields(macros, guard) if macros.request is not None else {}),
        "guard": str(guard.program),
        "unfinished": f"{GuardStatus.UNFINISHED:d}",
        "version": str(GUARD_VERSION if macros.check is not None else UNCHECKED_GUARD_VERSION),
        "tries": str(RETRIES),
        "retry_ms": str(RETRY_MS),
        "stop": guard.read_ahead_stop,
        "look_ahead": decimal(guard.max_validity_s),
        "increment": decimal(guard.increment_mm),
        "half": decimal(guard.increment_mm / 2.0),
        "per_second": str(PER_SECOND),
        "nm_per_mm": str(NM_PER_MM),
        "all_bits": str((1 << axes) - 1),
        "axis_count": str(axes),
    }


def _request_fields(macros: MacroMapConfig, guard: GuardConfig) -> dict[str, str]:
    return {
        **{name: str(number) for name, number in macros.request_macros.items()},
        "timeout_ms": str(round(guard.request_timeout_s * 1000.0)),
        "poll_ms": str(POLL_MS),
        "timed_out": _stop(guard.on_timeout, 122),
        "refused": _stop(guard.alarm, 123),
    }


def _stop(means: str, number: int) -> str:
    """Return the beginning of an alarm, a message, or nothing."""
    return {"message": "#3006=1", "stop": f"#3000={number}", "continue": ""}[means]


def filled_program(
    name: str, program: int, common: Mapping[str, str], rows: list[dict[str, str]], guard: GuardConfig
) -> str:
    fields = {**common, "program": str(program)}
    sections: dict[str, Sequence[Mapping[str, str]]] = {
        **axis_sections(rows),
        "@keep": [{}] if guard.on_expiry == "keep" else [],
        "@zero": [{}] if guard.on_expiry == "zero" else [],
        "@zero_axes": rows if guard.on_expiry == "zero" else [],
        "@check": [{}] if "check" in common else [],
        "@check_axes": rows if "check" in common else [],
        "@request": [{}] if "counter" in common else [],
        "@flag": [{}] if "safe_flag" in common else [],
    }
    return "\n".join(filled(name, fields, sections))


def filled(name: str, fields: Mapping[str, str], sections: Mapping[str, Sequence[Mapping[str, str]]]) -> list[str]:
    """Return the lines of a template with its fields; a section up to @end stands there once for each of its rows."""
    lines: list[str] = []
    section: list[str] = []
    rows: Sequence[Mapping[str, str]] | None = None
    for line in files("drivers.guard").joinpath(f"{name}.nc").read_text(encoding="ascii").splitlines():
        if line in sections:
            rows, section = sections[line], []
        elif line == "@end" and rows is not None:
            lines += [entry.format_map({**fields, **row}) for row in rows for entry in section]
            rows = None
        elif rows is not None:
            section.append(line)
        else:
            lines.append(line.format_map(fields))
    return lines


def _check(text: str) -> None:
    """Refuse what a control would not take."""
    for line in text.splitlines():
        if len(line) > LONGEST_LINE:
            raise GuardTextError(f"the line {line!r} is longer than {LONGEST_LINE} characters")
        for comment in _COMMENT.findall(line):
            if not _ALLOWED.fullmatch(comment):
                raise GuardTextError(f"the comment ({comment}) holds characters that a control does not take")
