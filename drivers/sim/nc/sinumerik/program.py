"""Compiling an archive of SINUMERIK programs into blocks, once."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.sinumerik.control import SinumerikControl
from drivers.sim.nc.sinumerik.expressions import (
    Expression,
    Frame,
    Tokens,
    Value,
    expression,
    index_of,
    real,
    truth,
    variable,
)

_HEAD = re.compile(r"%_N_(TP\d+)_SPF")
_PROC = re.compile(r"PROC (TP\d+)(?:\(([^)]*)\))?((?: SAVE| DISPLOF| SBLOF)*)")
_PARAMETER = re.compile(r"REAL (_[A-Z0-9_]+)")
_DEFINITION = re.compile(r"DEF (REAL|INT) (.+)")
_DEFINED = re.compile(r"(_[A-Z0-9_]+)(?:=(-?\d+))?")
_LABEL = re.compile(r"([A-Z_][A-Z0-9_]*):")
_SIMPLE = re.compile(r"(M0|STOPRE)")
_MESSAGE = re.compile(r'MSG\("([^"()]*)"\)')
_ALARM = re.compile(r'SETAL\((\d+),"([^"]*)"\)')
_DWELL = re.compile(r"G4 F(\d+\.?\d*)")
_ACTION = re.compile(r"IDS=(\d+) DO \$R(\d+)=\$AC_TIMER\[(\d+)\]")
_CALL = re.compile(r"(TP\d+)")
_SPEED = re.compile(r"S=(_[A-Z0-9_]+) F=(_[A-Z0-9_]+)")
_R = re.compile(r"R(\d+)")
LONGEST_LABEL = 31


class Running(Frame, Protocol):
    """The running program, as its blocks act on it."""

    dwell_s: float

    @property
    def kinds(self) -> dict[str, str]:
        """Type of each variable of the program."""

    def alarm(self, number: int, text: str) -> None:
        """End the program with an alarm."""

    def call(self, name: str) -> None:
        """Run a program without arguments."""

    def end(self) -> None:
        """Go back to the program that called."""


Action = Callable[[Running], int | None]
"""Runs a block; returns the index of the block to go to, None for the next one."""


@dataclass(frozen=True, slots=True)
class Block:
    line: int
    text: str
    action: Action


@dataclass(slots=True)
class SinumerikProgram:
    name: str
    parameters: tuple[str, ...] = ()
    blocks: list[Block] = field(default_factory=list)
    labels: dict[str, int] = field(default_factory=dict)
    open_ifs: list[list[int]] = field(default_factory=list)
    jumps: list[tuple[int, str, str, str]] = field(default_factory=list)
    """Block, kind, label and text of every jump."""

    def where(self, index: int) -> str:
        """Return program, line and text of a block."""
        block = self.blocks[min(index, len(self.blocks) - 1)]
        return f"{self.name} line {block.line} ({block.text})"


def compile_archive(text: str) -> dict[str, SinumerikProgram]:
    """Return the programs of an archive by name; raises NcError naming line and statement."""
    programs: dict[str, SinumerikProgram] = {}
    program: SinumerikProgram | None = None
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        try:
            if head := _HEAD.fullmatch(line):
                _finish(program)
                program = SinumerikProgram(head[1])
                if program.name in programs:
                    raise NcError(f"{program.name} occurs twice")
                programs[program.name] = program
            elif line.startswith(";") or not line:
                continue
            elif program is None:
                raise NcError("an archive begins with %_N_ and the name of a program")
            else:
                _add(program, line, number)
        except NcError as error:
            raise error if error.where else NcError(error.problem, where=f"line {number} ({line})") from error
    _finish(program)
    return programs


def _finish(program: SinumerikProgram | None) -> None:
    if program is None:
        return
    if program.open_ifs:
        raise NcError("an IF has no ENDIF", where=program.name)
    for at, kind, label, text in program.jumps:
        if label not in program.labels:
            raise NcError(f"there is no {label}: in {program.name}", where=text)
        if (program.labels[label] > at) != (kind == "GOTOF"):
            raise NcError(f"{label}: does not lie in the direction of {kind}", where=text)


def _add(program: SinumerikProgram, line: str, number: int) -> None:
    if not program.blocks and not line.startswith("PROC "):
        raise NcError("a program begins with PROC")
    if label := _LABEL.fullmatch(line):
        if label[1] in program.labels or len(label[1]) > LONGEST_LABEL:
            raise NcError(f"the label {label[1]} occurs twice, or is too long")
        program.labels[label[1]] = len(program.blocks)
        return
    program.blocks.append(Block(number, line, _block(program, line)))


def _block(program: SinumerikProgram, line: str) -> Action:
    if line.startswith("PROC "):
        return _head(program, line)
    if definition := _DEFINITION.fullmatch(line):
        return _definition(program, definition[1], definition[2])
    if line.startswith("IF "):
        return _if(program, line)
    if line == "ENDIF":
        if not program.open_ifs:
            raise NcError("ENDIF closes no IF")
        program.open_ifs.pop().append(len(program.blocks))
        return _nothing
    if line.startswith(("GOTOF ", "GOTOB ")):
        kind, label = line.split(" ", 1)
        return _goto(program, kind, label, line)
    return _plain(line) or _assignment(line)


def _nothing(_: Running) -> None:
    return None


def _head(program: SinumerikProgram, line: str) -> Action:
    match = _PROC.fullmatch(line)
    if match is None or match[1] != program.name or program.blocks:
        raise NcError(f"PROC {program.name} is expected once, at the head")
    if match[2]:
        found = [_PARAMETER.fullmatch(each.strip()) for each in match[2].split(",")]
        if not all(found):
            raise NcError("parameters are REAL here")
        program.parameters = tuple(each[1] for each in found if each)
    return _nothing


def _definition(program: SinumerikProgram, kind: str, names: str) -> Action:
    if any(not block.text.startswith(("PROC ", "DEF ")) for block in program.blocks):
        raise NcError("definitions stand at the head of a program")
    found: dict[str, Value] = {}
    for text in names.split(","):
        match = _DEFINED.fullmatch(text)
        if match is None:
            raise NcError(f"{text!r} is not known here")
        value = int(match[2] or 0)
        found[match[1]] = value if kind == "INT" else float(value)

    def action(run: Running) -> None:
        run.local.update(found)
        run.kinds.update(dict.fromkeys(found, kind))

    return action


def _if(program: SinumerikProgram, line: str) -> Action:
    condition, jump, label = re.fullmatch(r"IF (.+?)(?: (GOTOF|GOTOB) ([A-Z0-9_]+))?", line).groups()  # type: ignore[union-attr]
    tokens = Tokens(condition)
    holds: Expression = expression(tokens)
    tokens.finish()
    if jump:
        there = _goto(program, jump, label, line)
        return lambda run: there(run) if truth(holds(run)) else None
    ends: list[int] = []
    program.open_ifs.append(ends)
    return lambda run: None if truth(holds(run)) else ends[0]


def _goto(program: SinumerikProgram, kind: str, label: str, line: str) -> Action:
    program.jumps.append((len(program.blocks), kind, label, line))
    labels = program.labels
    return lambda run: labels[label]


def _plain(line: str) -> Action | None:
    """Compile a statement that stands alone; None where it is none of those."""
    if line == "M17":
        return lambda run: run.end()
    if _SIMPLE.fullmatch(line):
        return _nothing
    if match := _MESSAGE.fullmatch(line):
        text = match[1]
        return lambda run: run.control.show(text)
    if match := _ALARM.fullmatch(line):
        number, words = int(match[1]), match[2]
        return lambda run: run.alarm(number, words)
    if match := _DWELL.fullmatch(line):
        return _dwell(float(match[1]))
    if match := _ACTION.fullmatch(line):
        return _synchronised(*(int(part) for part in match.groups()))
    if match := _CALL.fullmatch(line):
        name = match[1]
        return lambda run: run.call(name)
    if match := _SPEED.fullmatch(line):
        return _spindle(*(variable(name, line) for name in match.groups()))
    return None


def _spindle(speed: Expression, feed: Expression) -> Action:
    def action(run: Running) -> None:
        run.control.spindle_rpm, run.control.feed_mm_min = real(speed(run)), real(feed(run))

    return action


def _dwell(seconds: float) -> Action:
    def action(run: Running) -> None:
        run.dwell_s = seconds

    return action


def _synchronised(number: int, parameter: int, timer: int) -> Action:
    def each_cycle(control: SinumerikControl) -> None:
        control.set_parameter(parameter, control.timer(timer))

    def action(run: Running) -> None:
        run.control.actions[number] = each_cycle
        each_cycle(run.control)

    return action


def _assignment(line: str) -> Action:
    tokens = Tokens(line)
    name = tokens.take()
    index = index_of(tokens) if name.startswith("$") else ""
    tokens.take("=")
    value = expression(tokens)
    tokens.finish()
    if match := _R.fullmatch(name):
        number = int(match[1])
        return lambda run: run.control.set_parameter(number, real(value(run)))
    if name == "$AC_TIMER":
        return lambda run: run.control.start_timer(int(index), real(value(run)))
    if name == "$SA_TEMP_COMP_ABS_VALUE":
        return lambda run: run.control.set_compensation(index, real(value(run)))
    if name == "$SA_TEMP_COMP_SLOPE":
        return lambda run: run.control.set_slope(index, real(value(run)))
    if not name.startswith("_"):
        raise NcError(f"{name!r} in {line!r} is not known here")

    def local(run: Running) -> None:
        found = value(run)
        if name not in run.kinds:
            raise NcError(f"{name} is not defined")
        if run.kinds[name] == "INT" and not isinstance(found, int):
            if not float(found).is_integer():
                raise NcError(f"{name} is INT, and {found} would be rounded")
            found = int(found)
        run.local[name] = real(found) if run.kinds[name] == "REAL" else found

    return local
