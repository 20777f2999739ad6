"""The guard as a subroutine for LinuxCNC: M66 reads the daemon's pins, M68 sets the echo, G10 L2 P1 moves G54."""

from collections.abc import Iterator, Mapping, Sequence

from config.records.commissioning import macro_map_digest
from config.schema.cnc import CncConfig
from config.schema.compensation import AxisConfig
from config.schema.guard import GuardConfig
from drivers.guard import text as fanuc
from drivers.guard.check import PER_SECOND
from drivers.guard.text import GuardStatus, GuardTextError, decimal
from drivers.linuxcnc_pins import VACANT, Pins

LETTERS = "XYZABCUVW"
"""Of axes 1 to 9."""
FIRST_OFFSET = 5220
"""#5221.. hold G54 of axis 1.. [mm]."""
MAGIC = 20_261
"""Stands in the memory once it has been initialised: a parameter that was never written is 0."""
WORDS: Mapping[GuardStatus, str] = {
    GuardStatus.EXPIRED: "TOOLPOINT EXPIRED",
    GuardStatus.VACANT: "TOOLPOINT VACANT MACRO",
    GuardStatus.OVERSIZE: "TOOLPOINT OVERSIZE VALUE",
    GuardStatus.INCH: "TOOLPOINT INCH MODE",
    GuardStatus.MODAL: "TOOLPOINT NOT G8 G40 G80 G54",
    GuardStatus.MEMORY: "TOOLPOINT MEMORY DAMAGED",
    GuardStatus.UNSETTLED: "TOOLPOINT OFFSET UNSETTLED",
    GuardStatus.CHECK: "TOOLPOINT CHECK DIFFERS",
    GuardStatus.PLACE: "TOOLPOINT OUTSIDE TRAVEL",
}


def memory_of(guard: GuardConfig, axes: Mapping[str, AxisConfig]) -> range:
    """Return the parameters that the guard keeps: as elsewhere, then the magic number and the count of requests."""
    memory = guard.memory_of(len(axes), sum(axis.slope is not None for axis in axes.values()))
    return range(memory.start, memory.stop + 2)


def linuxcnc_text(cnc: CncConfig, axes: Mapping[str, AxisConfig], *, machine: str = "") -> str:
    """Return the text of toolpoint.ngc; raises GuardTextError."""
    if cnc.driver != "linuxcnc":
        raise GuardTextError("cnc.guard.dialect linuxcnc is for cnc.driver linuxcnc")
    macros, guard, pins = cnc.macros, cnc.guard, Pins.of(cnc)
    pin = {**pins.inputs, **pins.outputs}
    memory = memory_of(guard, axes)
    for name, found in fanuc.guard_axes(axes, guard).items():
        if (number := LETTERS.find(found.letter) + 1) != found.number:
            raise GuardTextError(
                f"cnc.guard.axes.{name}.number: axis {found.letter} of LinuxCNC is {number}, not {found.number}"
            )
    rows = [
        row
        | {
            "value": str(pin[macros.values[name]]),
            "echo": str(pin[macros.echo_applied[name]]),
            "offset": str(FIRST_OFFSET + int(row["offset"]) - 5200),
            "position": f"#<_abs_{row['letter'].lower()}>",
            "keep_place": f"\n#{row['place']}=#{fanuc.planned_place(guard, len(axes))}" if "place" in row else "",
        }
        for name, row in zip(axes, fanuc.placed_rows(macros, axes, guard), strict=True)
    ]
    block = ("sequence_a", "sequence_b", "valid_until", "enable", "check")
    named = (*block, "echo_time", "echo_status", "echo_guard_version")
    fields = {
        **{name: str(pin[getattr(macros, name)]) for name in named},
        **{name: str(pin[number]) for name, number in macros.request_macros.items()},
        **({} if macros.safe_flag is None else {"safe_flag": str(pin[macros.safe_flag])}),
        **{name: str(memory[place]) for place, name in enumerate(("pending", "planned", "before", "after"))},
        "planned_place": str(fanuc.planned_place(guard, len(axes))),
        "magic": str(memory[-2]),
        "counted": str(memory[-1]),
        "first": str(memory[0]),
        "last": str(memory[-1]),
        "magic_value": str(MAGIC),
        "version": str(fanuc.GUARD_VERSION),
        "unfinished": f"{GuardStatus.UNFINISHED:d}",
        "clock": str(pins.clock),
        "tries": str(fanuc.RETRIES),
        "retry_s": decimal(fanuc.RETRY_MS / 1000.0),
        "vacant": decimal(VACANT * 0.9),
        "look_ahead": decimal(guard.max_validity_s),
        "increment": decimal(guard.increment_mm),
        "half": decimal(guard.increment_mm / 2.0),
        "per_second": str(PER_SECOND),
        "nm_per_mm": str(fanuc.NM_PER_MM),
        "all_bits": str((1 << len(rows)) - 1),
        "axis_count": str(len(rows)),
        "zero": str(int(guard.on_expiry == "zero")),
        "timeout_s": decimal(guard.request_timeout_s),
        "timed_out": _stop(guard.on_timeout, "TOOLPOINT GIVES NO ANSWER"),
        "refused": _stop(guard.alarm, "TOOLPOINT REFUSES REQUEST"),
        "alarms": "\n".join(
            f"o9{status:d} if [#<status> EQ {status:d}]\n{_stop(guard.alarm, words)}\no9{status:d} endif"
            for status, words in WORDS.items()
        ),
    }
    one: Sequence[Mapping[str, str]] = [{}]
    sections: dict[str, Sequence[Mapping[str, str]]] = {
        **fanuc.axis_sections(rows),
        "@zero": one if guard.on_expiry == "zero" else [],
        "@zero_axes": rows if guard.on_expiry == "zero" else [],
        "@request": one if macros.request is not None else [],
        "@flag": one if macros.safe_flag is not None else [],
    }
    body = "\n".join(fanuc.filled("linuxcnc", fields, sections)) + "\n"
    return "\n".join(_head(cnc, axes, machine, body)) + "\n" + body


def _head(cnc: CncConfig, axes: Mapping[str, AxisConfig], machine: str, body: str) -> Iterator[str]:
    """Yield the comments that say which machine, map and limits the text was made for."""
    yield f"(MACHINE {fanuc.comment(machine)})" if machine else "(MACHINE NOT NAMED)"
    yield f"(TEXT {fanuc.guard_digest(body)[:16].upper()} MAP {macro_map_digest(cnc.macros)[:16].upper()})"
    yield from fanuc.axis_comments(axes)
    yield f"(EXPIRED {cnc.guard.on_expiry.upper()}, AHEAD AT MOST {decimal(cnc.guard.max_validity_s)} S)"


def _stop(means: str, words: str) -> str:
    """Return the lines of a stop with a message, of an end of the program, or of neither."""
    return {"message": f"(MSG, {words})\nM0", "stop": f"(ABORT, {words})", "continue": f"(MSG, {words})"}[means]
