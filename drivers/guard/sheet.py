"""The commissioning sheet of the NC programs: what to load, check and try, and where to sign."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from config.html_page import Section, html_page
from config.schema import Configuration
from config.schema.guard import SHARED_MEMORY, VACANT_R
from drivers.guard.check import PER_SECOND, pivot_check
from drivers.guard.programs import guard_program
from drivers.guard.text import (
    GUARD_VERSION,
    GuardPrograms,
    GuardStatus,
    GuardTextError,
    decimal,
    guard_axes,
    guard_digest,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Words:
    """What the sheet calls things on one kind of control."""

    control: str
    variable: str
    program: str
    call: str
    vacant: str
    clock: str
    brackets: tuple[str, str]
    offset: str
    """Of an axis, with its letter and its number from #5200 on."""
    own_offset: str
    """What an operator has shifted himself."""
    inch: str
    shift_block: str
    stops: Mapping[str, str]


WORDS = {
    "fanuc": Words(
        control="FANUC",
        variable="#",
        program="O",
        call="G65P",
        vacant="#0",
        clock="#3001/1000",
        brackets=("[", "]"),
        offset="#{number}",
        own_offset="EXT",
        inch="G20, then back to G21",
        shift_block="the block with G10",
        stops={"message": "operator message (#3006)", "stop": "alarm (#3000)"},
    ),
    "sinumerik": Words(
        control="SINUMERIK",
        variable="R",
        program="TP",
        call="TP",
        vacant=f"{VACANT_R:.0f}",
        clock="$AC_TIMER[{timer}]",
        brackets=("(", ")"),
        offset="$SA_TEMP_COMP_ABS_VALUE[{letter}]",
        own_offset="SD43900",
        inch="G70, then back to G71",
        shift_block="the block that writes SD43900",
        stops={"message": "message and M0", "stop": "alarm from 65000 on"},
    ),
}
SIGNATURES = ("Loaded and compared by", "Tested by", "Released for production by")
UNVERIFIED = (
    "This text was run in Toolpoint's own interpreter, never on a {control}. Everything marked [control] is what the "
    "documentation of such controls says, and has to be seen on this control before the sheet is signed."
)


def guard_sheet(configuration: Configuration) -> tuple[Section, ...]:
    """Return the sheet for this machine; raises GuardTextError where the programs cannot be made."""
    if configuration.cnc.guard.dialect not in WORDS:
        raise GuardTextError(
            "there is no sheet for LinuxCNC, which runs this text in Toolpoint's tests; go through "
            "docs/how-to/install-the-guard-macro.md, section 8"
        )
    text = guard_program(configuration)
    return (
        _identity(configuration, text),
        _macros(configuration),
        _limits(configuration),
        _checks(configuration),
        _loading(configuration),
        _tests(configuration),
        Section(
            title="Signatures",
            text="The programs are those with the digest above, every row has been seen on this machine.",
            head=("", "name", "date", "signature"),
            rows=tuple((role, "", "", "") for role in SIGNATURES),
        ),
    )


def sheet_markdown(configuration: Configuration) -> str:
    lines = [f"# Commissioning sheet of the guard macro: {configuration.machine}", ""]
    for section in guard_sheet(configuration):
        lines += [f"## {section.title}", ""]
        if section.text:
            lines += [section.text, ""]
        if section.head:
            lines.append(_markdown_row(section.head))
            lines.append("|" + "---|" * len(section.head))
            lines += [_markdown_row(row) for row in section.rows]
            lines.append("")
    return "\n".join(lines)


def sheet_html(configuration: Configuration) -> str:
    """Return the sheet as one HTML page that prints well."""
    title = f"Commissioning sheet of the guard macro: {configuration.machine}"
    return html_page(title, guard_sheet(configuration), paper=True)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _identity(configuration: Configuration, text: str) -> Section:
    guard, macros = configuration.cnc.guard, configuration.cnc.macros
    programs = GuardPrograms.of(macros, guard)
    calls = [("guard", programs.guard), ("initialise", programs.initialise), ("request", programs.request)]
    calls += [("safe point begins", programs.enter), ("safe point ends", programs.leave)]
    rows = [("machine", configuration.machine), ("control, serial number", ""), ("guard version", str(GUARD_VERSION))]
    rows += [("SHA-256 of the text", guard_digest(text))]
    words = _words(configuration)
    if guard.dialect == "sinumerik":
        calls.append(("start", programs.start))
    rows += [(name, f"{words.program}{number}") for name, number in calls if number is not None]
    rows += [("an expired block", f"{guard.on_expiry} what is applied, {words.stops[guard.alarm]}")]
    text = UNVERIFIED.format(control=words.control)
    return Section(title="What this sheet is for", text=text, head=("", "value"), rows=tuple(rows))


def _words(configuration: Configuration) -> Words:
    guard = configuration.cnc.guard
    words = WORDS[guard.dialect]
    return replace(words, clock=words.clock.format(timer=guard.timer))


def _offset(configuration: Configuration, axis: str) -> str:
    """Return what holds the offset of an axis on the control."""
    found = guard_axes(configuration.compensation.axes, configuration.cnc.guard)[axis]
    sloped = configuration.compensation.axes[axis].slope is not None
    if sloped and configuration.cnc.is_sinumerik:
        return f"$SA_TEMP_COMP_SLOPE[{found.letter}]"
    offset = _words(configuration).offset.format(number=5200 + found.number, letter=found.letter)
    return f"{offset}, by where the axis stands (#{5020 + found.number})" if sloped else offset


def _macros(configuration: Configuration) -> Section:
    macros, guard = configuration.cnc.macros, configuration.cnc.guard
    memory, v = configuration.guard_memory, _words(configuration).variable
    rows: list[tuple[str, ...]] = [
        (_list(v, set(macros.block) - _nc_owned(configuration)), "daemon", "block"),
        (_list(v, _nc_owned(configuration)), "NC programs", "echo, request, flag"),
        (f"{v}{memory[0]} to {v}{memory[-1]}", "guard alone", _memory_in_words(configuration)),
    ]
    if guard.dialect == "sinumerik":
        rows.append((_list(v, {guard.shown, guard.shown + 1}), "NC programs", "clock, count of power-ons"))
    return Section(
        title="Macro variables" if v == "#" else "R parameters",
        text="No other program may use one of these.",
        head=("macro", "written by", "what"),
        rows=tuple(rows),
    )


def _memory_in_words(configuration: Configuration) -> str:
    words = "memory: pending axis, planned, before, after, applied"
    sloped = configuration.compensation.slopes and not configuration.cnc.is_sinumerik
    return f"{words}, planned place, place of each slope" if sloped else words


def _list(variable: str, numbers: set[int]) -> str:
    return ", ".join(f"{variable}{number}" for number in sorted(numbers))


def _nc_owned(configuration: Configuration) -> set[int]:
    macros = configuration.cnc.macros
    owned = {*macros.echo_applied.values(), macros.echo_time, macros.echo_status, macros.echo_guard_version}
    owned |= {number for key, number in macros.request_macros.items() if key != "acknowledge"}
    return owned | ({macros.safe_flag} if macros.safe_flag is not None else set())


def _limits(configuration: Configuration) -> Section:
    controlled = guard_axes(configuration.compensation.axes, configuration.cnc.guard)
    rows = tuple(
        (
            name,
            f"{controlled[name].letter}, axis {controlled[name].number}",
            _offset(configuration, name),
            f"{axis.absolute_bound_um:g}",
            f"{axis.step_um:g}",
        )
        for name, axis in configuration.compensation.outputs.items()
    )
    return Section(title="Limits", head=("axis", "control", "external offset", "bound um", "step um"), rows=rows)


def _checks(configuration: Configuration) -> Section:
    guard = configuration.cnc.guard
    macros = configuration.cnc.macros
    highest = max(*macros.block, configuration.guard_memory[-1])
    rows = _checks_of_sinumerik(configuration) if guard.dialect == "sinumerik" else [
        ("custom macro B is there", "MDI: #1=1. runs without alarm"),
        (f"common variables up to #{highest}", "offset screen, macro page shows them"),
        ("#100-#199 are cleared by power-off, #500 and up are not", "set one of each, switch off and on [control]"),
        (
            f"least increment of the offsets is {guard.increment_mm:g} mm",
            "offset screen: decimals of EXT; parameter 1013 [control]",
        ),
        ("G90 and G91 are absolute and incremental", "a machining centre, or a lathe with G-code system B or C"),
        ("metric, G21", "#4006 is 21 in the program that calls the guard"),
        ("#5201.. is the external offset (EXT)", "set EXT by hand, read #5201.. [control]"),
        (f"{guard.read_ahead_stop} ends the reading ahead", "the last test below; else choose an M code of parameters "
         "3411 to 3432 and put it into cnc.guard.read_ahead_stop [control]"),
        ("#3001 counts milliseconds since power-on", "MDI: #500=#3001 twice, 10 s apart [control]"),
        ("no program of this machine writes #3001", "search the program memory for #3001="),
        ("the server's clock is #3001 in seconds", "compare the clock in `toolpoint status` with #3001/1000"),
        (
            "a program restart runs no macro of the blocks before its target",
            f"restart behind G65P{guard.program}: #{macros.echo_time} as before; else go on by sequence number search, "
            "or position the work anew [control]",
        ),
        ("offset changes by G10 are not locked", "data protection key, parameter 3290 [control]"),
        ("programs from O9000 are locked after loading", "parameter 3202 bit 4 (NE9) [control]"),
    ]  # fmt: skip
    if guard.dialect == "fanuc":
        rows += _checks_of_places(configuration)
    return Section(title="Check on the control", head=("what", "how", "seen"), rows=tuple((*row, "") for row in rows))


def _checks_of_places(configuration: Configuration) -> list[tuple[str, str]]:
    """Return what must be so for the slopes that the guard puts in for where an axis stands."""
    controlled = guard_axes(configuration.compensation.axes, configuration.cnc.guard)
    return [
        (
            f"#{5020 + controlled[name].number} is the machine position of {controlled[name].letter} [mm]",
            f"at both ends of the travel ({slope.travel_mm[0]:g} and {slope.travel_mm[1]:g} mm): read it, compare it "
            "with the position display (MACHINE) [control]",
        )
        for name, slope in configuration.compensation.slopes.items()
    ]


def _checks_of_sinumerik(configuration: Configuration) -> list[tuple[str, str]]:
    guard, macros = configuration.cnc.guard, configuration.cnc.macros
    highest = max(*macros.block, guard.memory_of(len(macros.values))[-1], guard.shown + 1)
    controlled = guard_axes(configuration.compensation.axes, guard).values()
    letters = ", ".join(dict.fromkeys(axis.letter for axis in controlled))
    start = GuardPrograms.of(macros, guard).start
    return [
        (f"R parameters up to R{highest}", "MD28050 (MM_NUM_R_PARAM) is greater [control]"),
        (f"MD32750 (TEMP_COMP_TYPE) bit 0 is 1 for {letters}", "machine data of the axis [control]"),
        (f"MD32760 (COMP_ADD_VELO_FACTOR) is above 0 for {letters}", "machine data of the axis [control]"),
        (f"SD43900 (TEMP_COMP_ABS_VALUE) of {letters} is written by nothing else", "PLC program, cycles [control]"),
        (f"least increment of SD43900 is {guard.increment_mm:g} mm", "write less in MDA and read it back [control]"),
        (f"$AC_TIMER[{guard.timer}] is free", "MD28258 (MM_NUM_AC_TIMER) is greater; search the programs for it"),
        (f"IDS={guard.synchronised_action} is free", "list of the synchronised actions"),
        (f"TP{start} runs at the head of every program and after power-on", "PROG_EVENT, MD20108 bit 3 [control]"),
        ("the server's clock is the timer", f"compare the clock in `toolpoint status` with R{guard.shown}"),
        ("metric, G71 or G710, and G40", "$P_GG[13] is 2 or 4 where the guard is called"),
        ("STOPRE ends the reading ahead", "the last test but one below [control]"),
        (
            "a block search and a program test run through the programs and do nothing",
            f"search with calculation to a block behind TP{GuardPrograms.of(macros, guard).guard}: "
            f"R{macros.echo_time} as before [control]",
        ),
        ("the cycles are locked after loading", "protection level of the folder of the user's cycles [control]"),
    ]


def _loading(configuration: Configuration) -> Section:
    programs, words = GuardPrograms.of(configuration.cnc.macros, configuration.cnc.guard), _words(configuration)
    steps = [
        "Compensation is off: `toolpoint status` says OFF, or the daemon does not run.",
        f"{words.own_offset} holds what the operator wants and nothing else; write it down here:",
        "Load the text, read it back, compare it with the file character by character.",
        f"MDI: {words.call}{programs.initialise}. The echo is 0, the status 0, the version {GUARD_VERSION}.",
        "Run `toolpoint commission`, which initialises the daemon's macros.",
        f"Put {words.call}{programs.guard} into the part programs, only where the tool is clear of the work.",
    ]
    return Section(
        title="Load",
        head=("step", "what", "done"),
        rows=tuple((str(number), step, "") for number, step in enumerate(steps, start=1)),
    )


def _tests(configuration: Configuration) -> Section:
    rows = tuple((str(number), *row, "") for number, row in enumerate(_test_steps(configuration), start=1))
    words = _words(configuration)
    return Section(
        title="Try, with the tool clear of everything",
        text="The daemon is stopped; variables are set by hand, but no clock. V is a time to come: "
        f"{words.clock} plus 60. "
        f"C is the check of what the other macros then hold: {_check_expression(configuration)}. "
        f"After each setting the guard is called once (MDI: {words.call}{configuration.cnc.guard.program}).",
        head=("test", "set", "expected after the guard", "seen"),
        rows=rows,
    )


def _test_steps(configuration: Configuration) -> Iterator[tuple[str, str]]:
    macros, guard = configuration.cnc.macros, configuration.cnc.guard
    name, axis = next(iter(configuration.compensation.outputs.items()))
    words, offset = _words(configuration), _offset(configuration, name)
    v, own = words.variable, words.own_offset
    value, echo, status = macros.values[name], macros.echo_applied[name], macros.echo_status
    unit, increment_um = macros.unit_um, guard.increment_mm * 1000.0
    step, bound = axis.step_um / unit, axis.absolute_bound_um / unit
    half_um = max(axis.step_um / 2.0 // increment_um, 1.0) * increment_um
    memory = guard.memory + SHARED_MEMORY
    half, late, fits = f"{half_um / unit:g}", f"{v}{macros.valid_until}", f"{v}{macros.check}=C"

    def state(code: GuardStatus) -> str:
        return f"{v}{status}={int(code)}"

    same = f"{offset} as before"
    yield (f"{v}{macros.enable}=0", f"{state(GuardStatus.DISABLED)}, {same}, no message")
    yield (
        f"{v}{macros.sequence_a}=1 {v}{value}={half} {late}=V {v}{macros.enable}=1 {v}{macros.sequence_b}=1 {fits}",
        f"{state(GuardStatus.APPLIED)}, {v}{echo}={half}, {offset} larger by {half_um / 1000.0:g} mm",
    )
    yield ("guard called again", f"{state(GuardStatus.APPLIED)}, {same}: nothing is added twice")
    yield (
        f"{v}{value}={min(4 * step, bound):g}",
        f"{state(GuardStatus.CHECK)}, message, {same}: the check is the old one",
    )
    yield (fits, f"{v}{echo} larger by {step:g}: one step for each call")
    yield (f"{v}{macros.sequence_a}=2", f"{state(GuardStatus.TORN)}, {same}, no message")
    yield (f"{v}{macros.sequence_a}=1 {late}=1", f"{state(GuardStatus.EXPIRED)}, message, {_expiry(guard.on_expiry)}")
    yield (f"{late}=V {v}{value}={bound + step:g}", f"{state(GuardStatus.OVERSIZE)}, message, {same}")
    yield (f"{v}{value}={words.vacant}", f"{state(GuardStatus.VACANT)}, message, {same}")
    yield (words.inch, f"{state(GuardStatus.INCH)}, message, {same}")
    yield (
        f"{late}=V {v}{value}={half} {fits}, G91 before the call",
        f"{state(GuardStatus.APPLIED)}, and G91 still active",
    )
    yield (
        f"{own} of {name} changed by hand by 0.010 mm, then {late}=V {v}{value}={step:g} {fits}",
        f"{v}{echo}={step:g}; {offset} keeps the 0.010 mm",
    )
    yield (
        f"{late}=V {v}{value}={half} {fits}, single block, RESET after {words.shift_block}, then call again",
        f"{state(GuardStatus.APPLIED)}, {offset} minus {own} of the operator equals {v}{memory}",
    )
    yield ("control off and on, guard called", f"{state(GuardStatus.EXPIRED)}, message, {same}")
    yield (
        f"{late}=V {fits}, in one program a feed move of 20 s and the guard in the next block",
        f"{v}{macros.echo_time} is the clock after the move, not before it: nothing was read ahead",
    )
    yield (f"{late}=V {v}{value}=0 {fits} until {v}{echo}=0", f"{offset} is what the operator had, and the 0.010 mm")
    if guard.dialect == "fanuc":
        yield from _place_steps(configuration)


def _place_steps(configuration: Configuration) -> Iterator[tuple[str, str]]:
    """Yield the tests of every slope that the guard puts in for where its axis stands."""
    macros, axes = configuration.cnc.macros, list(configuration.compensation.outputs.items())
    for bit, (name, axis) in enumerate(axes):
        if (slope := axis.slope) is None:
            continue
        value, echo, enable = macros.values[name], macros.echo_applied[name], macros.enable
        offset, ends = (
            _offset(configuration, name).split(",")[0],
            [abs(end - slope.pivot_mm) for end in slope.travel_mm],
        )
        end = slope.travel_mm[0] if ends[0] > ends[1] else slope.travel_mm[1]
        moved_mm = axis.step_um / 1e6 * (end - slope.pivot_mm)
        set_to = (
            f"#{macros.valid_until}=V #{value}={axis.step_um / macros.unit_um:g} #{enable}={1 << bit} #{macros.check}=C"
        )
        yield (
            f"{slope.of} at {slope.pivot_mm:g} mm (machine): {set_to}, the guard twice",
            f"#{echo}={axis.step_um / macros.unit_um:g}, {offset} as before: the pivot",
        )
        yield (
            f"{slope.of} at {end:g} mm, again until the status is no longer 13",
            f"#{macros.echo_status}=0, {offset} moved by {moved_mm:+.4g} mm",
        )
        yield (
            f"{slope.of} outside {slope.travel_mm[0]:g} to {slope.travel_mm[1]:g} mm, where the machine lets it",
            f"#{macros.echo_status}={int(GuardStatus.PLACE)}, message, {offset} as before",
        )
        yield (f"#{value}=0 #{macros.check}=C until #{echo}=0", f"{offset} as at the beginning")


def _check_expression(configuration: Configuration) -> str:
    """Return the check as a person types it in MDI."""
    macros = configuration.cnc.macros
    to_nm = f"*{decimal(macros.unit_um * 1000.0).rstrip('.')}"
    words = _words(configuration)
    v, left, right = words.variable, *words.brackets
    parts = [f"{v}{macros.sequence_b}+{v}{macros.enable}+ROUND{left}{v}{macros.valid_until}*{PER_SECOND}{right}"]
    parts += [
        f"{place}*ROUND{left}{v}{macros.values[axis]}{to_nm}{right}"
        for place, axis in enumerate(configuration.compensation.axes, start=1)
    ]
    pivots = configuration.compensation.pivots_mm
    places = {axis: place for place, axis in enumerate(configuration.compensation.axes, start=1)}
    return "+".join(parts) + "".join(f"{pivot_check(places[axis], at_mm):+d}" for axis, at_mm in pivots.items())


def _expiry(policy: str) -> str:
    return "offset as before" if policy == "keep" else "offset one step nearer to the operator's"
