"""Expressions of SINUMERIK programs, compiled into functions: truth values, whole and real numbers are kept apart.

As on the control, AND, OR and B_AND bind more closely than comparisons, so that these need brackets, and two real
numbers are equal when they differ by less than 1e-12 of their size.
"""

import math
import operator
import re
from collections.abc import Callable
from typing import Protocol, TypeAlias

from drivers.sim.nc.blocks import NcError
from drivers.sim.nc.sinumerik.control import NOT_MACHINING, SinumerikControl

Value: TypeAlias = bool | int | float
EQUAL = 1e-12
LARGEST_INT = 2**31 - 1
_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+\.?\d*|\.\d+)|(?P<system>\$[A-Z_]+)|(?P<word>[A-Z_][A-Z0-9_]*)"
    r'|(?P<text>"[^"]*")|(?P<mark>==|<>|<=|>=|[-+*/()\[\],=<>]))'
)
_R = re.compile(r"R(\d+)")


class Frame(Protocol):
    """What an expression is worked out in."""

    @property
    def control(self) -> SinumerikControl: ...

    @property
    def local(self) -> dict[str, Value]:
        """Variables of the running program."""

    @property
    def given(self) -> list[bool]:
        """Which parameters the call has given."""


Expression: TypeAlias = Callable[[Frame], Value]


class Tokens:
    """Tokens of one block, taken one after the other."""

    def __init__(self, line: str) -> None:
        self.line = line
        self._found: list[str] = []
        at = 0
        while line[at:].strip():
            match = _TOKEN.match(line, at)
            if match is None:
                raise NcError(f"{line[at:].strip()[0]!r} in {line!r} is not known here")
            self._found.append(match[0].strip())
            at = match.end()

    def peek(self) -> str:
        """Return the next token, '' behind the last."""
        return self._found[0] if self._found else ""

    def take(self, expected: str = "") -> str:
        """Take the next token; raises NcError when it is not the expected one."""
        text = self.peek()
        if not text or (expected and text != expected):
            raise NcError(f"{expected or 'more'!r} is expected before {text!r} in {self.line!r}")
        del self._found[0]
        return text

    def accept(self, text: str) -> bool:
        if self.peek() != text:
            return False
        self.take()
        return True

    def finish(self) -> None:
        if self._found:
            raise NcError(f"{self.peek()!r} is not expected in {self.line!r}")


def real(value: Value) -> float:
    """Return a number; a truth value is none."""
    if isinstance(value, bool):
        raise NcError("a truth value is no number")
    return float(value)


def whole(value: Value) -> int:
    """Return a whole number; a real one is none, even where its fraction is 0."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise NcError(f"{value} is of the type REAL, and INT is needed")
    return value


def truth(value: Value) -> bool:
    """Return a truth value; a number is none."""
    if not isinstance(value, bool):
        raise NcError(f"{value} is a number, and a condition is needed")
    return value


def _equal(left: float, right: float) -> bool:
    return abs(left - right) <= EQUAL * max(abs(left), abs(right))


_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "==": _equal,
    "<>": lambda left, right: not _equal(left, right),
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
}


def _added(left: Value, right: Value) -> Value:
    total = real(left) + real(right)
    return int(total) if isinstance(left, int) and isinstance(right, int) else total


def _subtracted(left: Value, right: Value) -> Value:
    return _added(left, _negative(right))


def _multiplied(left: Value, right: Value) -> Value:
    product = real(left) * real(right)
    return int(product) if isinstance(left, int) and isinstance(right, int) else product


def _divided(left: Value, right: Value) -> Value:
    if real(right) == 0.0:
        raise NcError("division by zero")
    return real(left) / real(right)


def _negative(value: Value) -> Value:
    real(value)
    return -value


def _int(value: float) -> int:
    if not -LARGEST_INT - 1 <= value <= LARGEST_INT:
        raise NcError(f"{value:g} is too large for INT")
    return int(value)


def _rounded(value: Value) -> Value:
    return _int(math.copysign(math.floor(abs(real(value)) + 0.5), real(value)))


_LEVELS: tuple[dict[str, Callable[[Value, Value], Value]], ...] = (
    {"OR": lambda left, right: truth(left) or truth(right)},
    {"AND": lambda left, right: truth(left) and truth(right)},
    {"B_OR": lambda left, right: whole(left) | whole(right)},
    {"B_AND": lambda left, right: whole(left) & whole(right)},
    {"+": _added, "-": _subtracted},
    {"*": _multiplied, "/": _divided},
)
"""Operations, the loosest first; comparisons are looser still."""
_FUNCTIONS: dict[str, Callable[[Value], Value]] = {
    "ABS": lambda value: abs(real(value)),
    "TRUNC": lambda value: _int(float(math.trunc(real(value)))),
    "ROUND": _rounded,
}


def expression(tokens: Tokens) -> Expression:
    left = _level(tokens, 0)
    if tokens.peek() not in _COMPARISONS:
        return left
    compare = _COMPARISONS[tokens.take()]
    right = _level(tokens, 0)
    if tokens.peek() in _COMPARISONS:
        raise NcError(f"a second comparison in {tokens.line!r} needs brackets")
    return lambda frame: compare(real(left(frame)), real(right(frame)))


def _level(tokens: Tokens, level: int) -> Expression:
    if level == len(_LEVELS):
        return _atom(tokens)
    left = _level(tokens, level + 1)
    while tokens.peek() in _LEVELS[level]:
        left = _joined(_LEVELS[level][tokens.take()], left, _level(tokens, level + 1))
    return left


def _joined(work: Callable[[Value, Value], Value], left: Expression, right: Expression) -> Expression:
    return lambda frame: work(left(frame), right(frame))


def _atom(tokens: Tokens) -> Expression:
    text = tokens.take()
    if text == "(":
        inside = expression(tokens)
        tokens.take(")")
        return inside
    if text == "-":
        negated = _atom(tokens)
        return lambda frame: _negative(negated(frame))
    if text == "NOT":
        denied = _atom(tokens)
        return lambda frame: not truth(denied(frame))
    if text in _FUNCTIONS:
        work = _FUNCTIONS[text]
        tokens.take("(")
        inside = expression(tokens)
        tokens.take(")")
        return lambda frame: work(inside(frame))
    if text[0].isdigit() or text[0] == ".":
        constant = float(text) if "." in text else int(text)
        return lambda _: constant
    if text.startswith("$"):
        return _system(tokens, text)
    return variable(text, tokens.line)


def variable(text: str, line: str) -> Expression:
    """Compile an R parameter or a variable of the program."""
    if match := _R.fullmatch(text):
        number = int(match[1])
        return lambda frame: frame.control.parameter(number)
    if not text.startswith("_"):
        raise NcError(f"{text!r} in {line!r} is not known here")

    def local(frame: Frame) -> Value:
        if text not in frame.local:
            raise NcError(f"{text} is not defined")
        return frame.local[text]

    return local


def index_of(tokens: Tokens) -> str:
    tokens.take("[")
    text = tokens.take()
    tokens.take("]")
    return text


def _system(tokens: Tokens, name: str) -> Expression:
    if name == "$P_TOOLNO":
        return lambda frame: frame.control.tool_number
    if name == "$MN_SCALING_SYSTEM_IS_METRIC":
        return lambda frame: frame.control.basic_metric
    if name in NOT_MACHINING:
        return lambda frame: name in frame.control.not_machining
    index = index_of(tokens)
    if name == "$AC_TIMER":
        return lambda frame: frame.control.timer(int(index))
    if name == "$P_GG":
        return lambda frame: frame.control.groups[int(index)]
    if name == "$P_SUBPAR":
        return lambda frame: frame.given[int(index) - 1]
    if name == "$SA_TEMP_COMP_ABS_VALUE":
        return lambda frame: frame.control.external_mm[frame.control.axis(index)] / frame.control.datum_mm
    if name == "$SA_TEMP_COMP_SLOPE":
        return lambda frame: frame.control.slopes[frame.control.axis(index)]
    if name == "$SA_TEMP_COMP_REF_POSITION":
        return lambda frame: frame.control.pivots_mm[frame.control.axis(index)]
    if name == "$MA_TEMP_COMP_TYPE":
        return lambda frame: frame.control.compensation_types[index]
    if name == "$MA_COMP_ADD_VELO_FACTOR":
        return lambda frame: frame.control.velocity_factors[index]
    raise NcError(f"{name} is not known here")
