"""Expressions of custom macro B, compiled into functions of the running interpreter.

A vacant variable (None) counts as 0 in arithmetic and in GT, GE, LT and LE; EQ and NE tell it from 0. A variable
that stands alone keeps being vacant: `#1=#2` makes #1 vacant when #2 is.
"""

import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.custom_macro.control import LOCALS, MacroControl

TokenKind = Literal["comment", "number", "word", "mark"]

WORDS = (
    *("WHILE", "ROUND", "GOTO", "THEN", "SQRT", "ABS", "FIX", "FUP", "MOD", "AND", "XOR", "END"),
    *("IF", "DO", "OR", "EQ", "NE", "GT", "GE", "LT", "LE"),
)
"""Words of more than one letter, the longer ones first; every other letter is an address."""
_PATTERN = re.compile(
    rf"\((?P<comment>[^()]*)\)|(?P<number>\d+\.?\d*|\.\d+)"
    rf"|(?P<word>{'|'.join(WORDS)}|[A-Z])|(?P<mark>[#\[\]=+\-*/])"
)


@dataclass(frozen=True, slots=True)
class Token:
    """One word, number, mark or comment of a block."""

    kind: TokenKind
    text: str


def tokens_of(line: str) -> list[Token]:
    """Return the tokens of one block; raises NcError for a character that a control does not take."""
    found: list[Token] = []
    position = 0
    while position < len(line):
        if line[position] == " ":
            position += 1
            continue
        match = _PATTERN.match(line, position)
        if match is None:
            raise NcError(f"{line[position]!r} in {line!r} is no character of custom macro text")
        kind = match.lastgroup
        assert kind is not None
        found.append(Token(kind, match[kind]))  # type: ignore[arg-type]
        position = match.end()
    return found


class Reader:
    """Tokens of one block, taken one after the other; comments are kept apart."""

    def __init__(self, line: str) -> None:
        self.line = line
        found = tokens_of(line)
        self.comments = [token.text for token in found if token.kind == "comment"]
        self._tokens = [token for token in found if token.kind != "comment"]
        self._next = 0

    @property
    def done(self) -> bool:
        return self._next >= len(self._tokens)

    def peek(self) -> str:
        """Return the next token's text, '' at the end."""
        return "" if self.done else self._tokens[self._next].text

    def peek_kind(self) -> str:
        """Return the next token's kind, '' at the end."""
        return "" if self.done else self._tokens[self._next].kind

    def take(self, expected: str = "") -> str:
        """Return the next token's text; raises NcError when it is not the expected one."""
        text = self.peek()
        if not text or (expected and text != expected):
            wanted = repr(expected) if expected else "more"
            raise NcError(f"{wanted} is expected {f'before {text!r}' if text else 'at the end'} of {self.line!r}")
        self._next += 1
        return text

    def accept(self, text: str) -> bool:
        if self.peek() != text:
            return False
        self._next += 1
        return True

    def whole(self) -> int:
        text = self.take()
        if not text.isdigit():
            raise NcError(f"a whole number is expected instead of {text!r} in {self.line!r}")
        return int(text)

    def finish(self) -> None:
        if not self.done:
            raise NcError(f"{self.peek()!r} is not expected in {self.line!r}")


class Frame:
    """What an expression is worked out in: the local variables of one call level, and the control."""

    __slots__ = ("control", "local")

    def __init__(self, control: MacroControl) -> None:
        self.control = control
        self.local: list[float | None] = [None] * LOCALS

    def get(self, number: int) -> float | None:
        """Return a variable, None where it is vacant."""
        return self.local[number] if 0 < number < LOCALS else self.control.get(number)

    def set(self, number: int, value: float | None) -> None:
        if number == 0:
            raise NcError("#0 cannot be written: it is always vacant")
        if 0 < number < LOCALS:
            self.local[number] = value
        else:
            self.control.set(number, value)


Value: TypeAlias = Callable[[Frame], float | None]
Number: TypeAlias = Callable[[Frame], float]
Condition: TypeAlias = Callable[[Frame], bool]

_SUMS = ("+", "-", "OR", "XOR")
_PRODUCTS = ("*", "/", "AND", "MOD")
_COMPARISONS = ("EQ", "NE", "GT", "GE", "LT", "LE")


def round_half_away(value: float) -> float:
    """Return the nearest whole number; halves go away from zero."""
    return math.copysign(math.floor(abs(value) + 0.5), value)


_FUNCTIONS: dict[str, Callable[[float], float]] = {
    "ABS": abs,
    "FIX": math.trunc,
    "FUP": lambda value: math.copysign(math.ceil(abs(value)), value),
    "ROUND": round_half_away,
}


def expression(reader: Reader) -> Value:
    """Compile sums of products."""
    left = _product(reader)
    while reader.peek() in _SUMS:
        left = _arithmetic(reader.take(), left, _product(reader))
    return left


def number_of(value: Value) -> Number:
    """Return the function that takes vacant as 0."""
    return lambda frame: value(frame) or 0.0


def condition(reader: Reader) -> Condition:
    """Compile `[expression comparison expression]`."""
    reader.take("[")
    left = expression(reader)
    comparison = reader.take()
    if comparison not in _COMPARISONS:
        raise NcError(f"a comparison ({', '.join(_COMPARISONS)}) is expected instead of {comparison!r}")
    right = expression(reader)
    reader.take("]")
    if comparison == "EQ":
        return lambda frame: left(frame) == right(frame)
    if comparison == "NE":
        return lambda frame: left(frame) != right(frame)
    compare = {"GT": operator.gt, "GE": operator.ge, "LT": operator.lt, "LE": operator.le}[comparison]
    return lambda frame: bool(compare(left(frame) or 0.0, right(frame) or 0.0))


def variable_number(reader: Reader) -> int | Number:
    """Compile what follows `#`: a number, or an expression in brackets or another variable."""
    reader.take("#")
    if reader.peek_kind() == "number":
        return reader.whole()
    return number_of(_atom(reader))


def _product(reader: Reader) -> Value:
    left = _atom(reader)
    while reader.peek() in _PRODUCTS:
        left = _arithmetic(reader.take(), left, _atom(reader))
    return left


def _atom(reader: Reader) -> Value:
    text = reader.peek()
    if text == "#":
        return _variable(reader)
    if text == "[":
        reader.take()
        inside = expression(reader)
        reader.take("]")
        return inside
    if text in ("+", "-"):
        return _signed(reader)
    if text in _FUNCTIONS or text == "SQRT":
        return _function(reader)
    if reader.peek_kind() == "number":
        value = float(reader.take())
        return lambda _: value
    raise NcError(f"an expression is expected {f'instead of {text!r}' if text else 'at the end'} of {reader.line!r}")


def _signed(reader: Reader) -> Value:
    negative = reader.take() == "-"
    if reader.peek_kind() == "number":
        value = float(reader.take()) * (-1.0 if negative else 1.0)
        return lambda _: value
    inside = _atom(reader)
    return (lambda frame: -(inside(frame) or 0.0)) if negative else number_of(inside)


def _variable(reader: Reader) -> Value:
    number = variable_number(reader)
    if not isinstance(number, int):
        return lambda frame: frame.get(whole_number(number(frame)))
    if 0 < number < LOCALS:
        return lambda frame: frame.local[number]
    return lambda frame: frame.control.get(number)


def whole_number(value: float) -> int:
    if not math.isfinite(value) or abs(value - round(value)) > 1e-6:
        raise NcError(f"{value:g} is no whole number")
    return round(value)


def _function(reader: Reader) -> Value:
    name = reader.take()
    reader.take("[")
    inside = expression(reader)
    reader.take("]")
    if name == "SQRT":
        return lambda frame: _root(inside(frame) or 0.0)
    work = _FUNCTIONS[name]
    return lambda frame: float(work(inside(frame) or 0.0))


def _root(value: float) -> float:
    if value < 0.0:
        raise NcError(f"SQRT of {value:g}: there is none")
    return math.sqrt(value)


def _divide(left: float, right: float) -> float:
    if right == 0.0:
        raise NcError("division by zero")
    return left / right


def _modulo(left: float, right: float) -> float:
    if right == 0.0:
        raise NcError("MOD by zero")
    return math.fmod(left, right)


def _bits(work: Callable[[int, int], int]) -> Callable[[float, float], float]:
    return lambda left, right: float(work(whole_number(left), whole_number(right)))


_OPERATIONS: dict[str, Callable[[float, float], float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _divide,
    "MOD": _modulo,
    "AND": _bits(operator.and_),
    "OR": _bits(operator.or_),
    "XOR": _bits(operator.xor),
}


def _arithmetic(name: str, left: Value, right: Value) -> Value:
    work = _OPERATIONS[name]
    return lambda frame: work(left(frame) or 0.0, right(frame) or 0.0)
