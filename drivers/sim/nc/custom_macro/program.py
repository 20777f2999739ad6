"""Compiling the text of O-programs into blocks, once."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.custom_macro.expressions import (
    Condition,
    Frame,
    Reader,
    Value,
    condition,
    expression,
    number_of,
    variable_number,
    whole_number,
)


class Running(Protocol):
    """The running program, as its statements act on it."""

    @property
    def frame(self) -> Frame:
        """Local variables of the present level, and the control."""

    def alarm(self, number: int, text: str) -> None:
        """End the program with an alarm."""

    def words(self, words: list[tuple[str, float | None]]) -> None: ...


Action = Callable[[Running], int | None]
"""Runs a block; returns the index of the block to go to, None for the next one."""
MOST_LOOPS = 3
_LOCALS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26)
ARGUMENTS = dict(zip("ABCIJKDEFHMQRSTUVWXYZ", _LOCALS, strict=True))
"""Local variable of each argument of G65."""
OPERATOR_MESSAGE, ALARM = 3006, 3000


@dataclass(frozen=True, slots=True)
class CompiledBlock:
    line: int
    """Line of the text, counted from 1."""
    text: str
    action: Action


@dataclass(slots=True)
class MacroProgram:
    number: int
    title: str
    blocks: list[CompiledBlock] = field(default_factory=list)
    labels: dict[int, int] = field(default_factory=dict)
    """Index of the block that carries an N number."""

    @property
    def name(self) -> str:
        return f"O{self.number}"

    def where(self, index: int) -> str:
        """Return program, line and text of a block."""
        block = self.blocks[index]
        return f"{self.name} line {block.line} ({block.text})"


@dataclass(slots=True)
class _Building:
    program: MacroProgram
    targets: list[tuple[int, int, str]] = field(default_factory=list)
    """Line, N number and text of every jump to a fixed number."""
    loops: list[tuple[int, int]] = field(default_factory=list)
    """Number of every loop that is open, and the index of its WHILE."""
    ends: dict[int, int] = field(default_factory=dict)
    """Index behind the END of the WHILE at an index."""


def compile_programs(text: str) -> dict[int, MacroProgram]:
    """Return the programs of a text by O number; raises NcError naming line and statement."""
    programs: dict[int, MacroProgram] = {}
    building: _Building | None = None
    for line_number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if line in ("", "%"):
            continue
        try:
            reader = Reader(line)
            if reader.peek() == "O":
                _finish(building)
                building = _Building(_head(reader))
                if building.program.number in programs:
                    raise NcError(f"O{building.program.number} occurs twice")
                programs[building.program.number] = building.program
            elif building is None:
                raise NcError("a program begins with its O number")
            else:
                _add(building, reader, line_number)
        except NcError as error:
            if error.where:
                raise
            raise NcError(error.problem, where=f"line {line_number} ({line})") from error
    _finish(building)
    return programs


def _head(reader: Reader) -> MacroProgram:
    reader.take("O")
    number = reader.whole()
    reader.finish()
    return MacroProgram(number, reader.comments[0] if reader.comments else "")


def _finish(building: _Building | None) -> None:
    if building is None:
        return
    program = building.program
    if building.loops:
        raise NcError(f"DO{building.loops[-1][0]} has no END", where=f"O{program.number}")
    for line, target, text in building.targets:
        if target not in program.labels:
            raise NcError(f"there is no N{target} in O{program.number}", where=f"line {line} ({text})")


def _add(building: _Building, reader: Reader, line: int) -> None:
    program = building.program
    labelled = reader.accept("N")
    if labelled:
        number = reader.whole()
        if number in program.labels:
            raise NcError(f"N{number} occurs twice")
        program.labels[number] = len(program.blocks)
    if reader.done and not labelled:
        return
    action = _nothing if reader.done else _block(building, reader, line)
    reader.finish()
    program.blocks.append(CompiledBlock(line, reader.line, action))


def _nothing(_: Running) -> None:
    return None


def _block(building: _Building, reader: Reader, line: int) -> Action:
    first = reader.peek()
    if first == "#":
        return _assignment(reader)
    if first == "IF":
        return _if(building, reader, line)
    if first == "GOTO":
        return _goto(building, reader, line)
    if first == "WHILE":
        return _while(building, reader)
    if first == "END":
        return _end(building, reader)
    return _words(reader)


def _assignment(reader: Reader) -> Action:
    number = variable_number(reader)
    reader.take("=")
    value = expression(reader)
    if number in (ALARM, OPERATOR_MESSAGE):
        return _stop(number == ALARM, value, reader)
    if not isinstance(number, int):
        return lambda run: run.frame.set(whole_number(number(run.frame)), value(run.frame))
    if number < 34:
        if number == 0:
            raise NcError("#0 cannot be written: it is always vacant")
        return _set_local(number, value)
    return lambda run: run.frame.control.set(number, value(run.frame))


def _set_local(number: int, value: Value) -> Action:
    def action(run: Running) -> None:
        frame = run.frame
        frame.local[number] = value(frame)

    return action


def _stop(alarm: bool, value: Value, reader: Reader) -> Action:
    text = reader.comments[-1] if reader.comments else ""
    code = number_of(value)
    if alarm:
        return lambda run: run.alarm(whole_number(code(run.frame)), text)
    return lambda run: run.frame.control.show(text)


def _if(building: _Building, reader: Reader, line: int) -> Action:
    reader.take("IF")
    holds: Condition = condition(reader)
    if reader.accept("THEN"):
        then = _assignment(reader)
    elif reader.peek() == "GOTO":
        then = _goto(building, reader, line)
    else:
        raise NcError("GOTO or THEN is expected after IF[..]")
    return lambda run: then(run) if holds(run.frame) else None


def _goto(building: _Building, reader: Reader, line: int) -> Action:
    reader.take("GOTO")
    labels = building.program.labels
    if reader.peek_kind() == "number":
        target = reader.whole()
        building.targets.append((line, target, reader.line))
        return lambda run: labels[target]
    where = number_of(expression(reader))
    return lambda run: _label(labels, whole_number(where(run.frame)))


def _label(labels: dict[int, int], number: int) -> int:
    if number not in labels:
        raise NcError(f"there is no N{number}")
    return labels[number]


def _while(building: _Building, reader: Reader) -> Action:
    reader.take("WHILE")
    holds = condition(reader)
    reader.take("DO")
    number = reader.whole()
    if not 1 <= number <= MOST_LOOPS or number in (loop for loop, _ in building.loops):
        raise NcError(f"DO{number}: loops are numbered 1 to {MOST_LOOPS}, each once within another")
    start, ends = len(building.program.blocks), building.ends
    building.loops.append((number, start))
    return lambda run: None if holds(run.frame) else ends[start]


def _end(building: _Building, reader: Reader) -> Action:
    reader.take("END")
    number = reader.whole()
    if not building.loops or building.loops[-1][0] != number:
        raise NcError(f"END{number} closes no loop")
    _, start = building.loops.pop()
    building.ends[start] = len(building.program.blocks) + 1
    return lambda run: start


def _words(reader: Reader) -> Action:
    """Compile a block of address words: G and M codes with what they need."""
    words: list[tuple[str, Value]] = []
    calls = False
    while not reader.done:
        letter = reader.take()
        if len(letter) != 1 or not letter.isalpha():
            raise NcError(f"{letter!r} is no address")
        literal = reader.peek()
        words.append((letter, _word_value(reader)))
        if calls and letter not in "GP" and literal.isdigit():
            raise NcError(f"{letter}{literal}: an argument without a decimal point counts in least increments")
        calls = calls or (letter == "G" and literal == "65")
    return lambda run: run.words([(letter, value(run.frame)) for letter, value in words])


def _word_value(reader: Reader) -> Value:
    """Compile a number, a variable or an expression in brackets, each with its sign."""
    negative = reader.accept("-")
    if reader.peek() not in ("#", "[") and reader.peek_kind() != "number":
        raise NcError(f"an address takes a number, a variable or [..], not {reader.peek()!r}")
    if reader.peek_kind() == "number":
        constant = float(reader.take()) * (-1.0 if negative else 1.0)
        return lambda _: constant
    if reader.peek() == "[":
        reader.take()
        value = expression(reader)
        reader.take("]")
    else:
        number = variable_number(reader)
        value = _variable_value(number)
    if not negative:
        return value
    return lambda frame: None if (found := value(frame)) is None else -found


def _variable_value(number: int | Callable[..., float]) -> Value:
    if isinstance(number, int):
        return lambda frame: frame.get(number)
    return lambda frame: frame.get(whole_number(number(frame)))
