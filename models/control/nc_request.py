"""What the NC program asks for through its request macros, as a pure function of what they hold.

Every macro must hold what its meaning allows: a vacant one is not zero, and a fraction is not rounded.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

LAST_COUNTER = 999_999
"""The counter runs from 1 to here and starts again."""
LAST_TOOL = 99_999_999
"""Highest tool number, of eight digits; T0 is the empty spindle."""


class RequestKind(IntEnum):
    """What the NC program asks for."""

    WITHDRAWN = 0
    REFERENCE = 1
    PROBE = 2
    TOOL_CHANGE = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestMacros:
    """Numbers of the macros of a request."""

    counter: int
    kind: int
    axis: int
    value_mm: int
    acknowledge: int


@dataclass(frozen=True, slots=True, kw_only=True)
class NcRequest:
    """One request; a value that its kind has no use for is 0."""

    counter: int
    kind: RequestKind
    axis: str | None = None
    """None: every axis."""
    value_mm: float = 0.0
    tool_number: int = 0

    def __str__(self) -> str:
        return f"request {self.counter} of the NC program ({self.kind.name.lower().replace('_', ' ')})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """A request that is not what it must be."""

    why: str
    number: float | None
    """The request's counter, to be answered with minus it; None where no program can wait for such an answer."""
    may_have_positioned: bool
    """The work may have been positioned: nothing that can be read says that the request was about something else."""

    def __str__(self) -> str:
        number = "" if self.number is None else f" {self.number:.12g}"
        return f"request{number} of the NC program"


class _WrongError(Exception):
    """A macro does not hold what it must; the text says what it holds and what it must hold."""


def counter_of(macros: Mapping[int, float | None], numbers: RequestMacros) -> int | None:
    """Return the request counter, 0 before the first request; None where it is no counter."""
    counter = _whole(macros, numbers.counter)
    return counter if counter is not None and 0 <= counter <= LAST_COUNTER else None


def missed_requests(latest: int, counter: int) -> str:
    """Return what a counter says of requests between it and the latest one that was seen, '' when there were none."""
    if counter > latest:
        missed = counter - latest - 1
        return f"{missed} request(s) of the NC program were missed" if missed else ""
    if counter == latest or (latest, counter) == (LAST_COUNTER, 1):
        return ""
    return f"the request counter went back from {latest} to {counter}: requests of the NC program may have been missed"


def parse_request(
    macros: Mapping[int, float | None], numbers: RequestMacros, axes: Sequence[str]
) -> NcRequest | Refusal:
    """Return the request that the macros hold, or why it is refused.

    `macros`: values by macro number, read after the counter was seen to change; None: vacant. `numbers`: which macro
    holds which part of the request. `axes`: names of the axes, '' for one that is a slope; the request counts them from
    1, and 0 means all.
    """
    try:
        counter = _counter(macros, numbers)
        kind = _kind(macros, numbers)
        axis = _axis(macros, numbers, axes) if kind in (RequestKind.REFERENCE, RequestKind.PROBE) else None
        return NcRequest(
            counter=counter,
            kind=kind,
            axis=axis,
            value_mm=_millimetres(macros, numbers) if kind is RequestKind.PROBE else 0.0,
            tool_number=_tool_number(macros, numbers) if kind is RequestKind.TOOL_CHANGE else 0,
        )
    except _WrongError as error:
        return Refusal(
            why=str(error),
            number=_answerable(macros, numbers),
            may_have_positioned=_may_have_positioned(macros, numbers),
        )


def _whole(macros: Mapping[int, float | None], number: int) -> int | None:
    """Return a whole number, None where there is something else."""
    value = macros.get(number)
    return int(value) if value is not None and value.is_integer() else None


def _wrong(name: str, macros: Mapping[int, float | None], number: int, must_be: str) -> _WrongError:
    value = macros.get(number)
    held = f"{name} in macro #{number} is vacant" if value is None else f"{name} {value:.12g} in macro #{number}"
    return _WrongError(f"{held}: it must be {must_be}")


def _counter(macros: Mapping[int, float | None], numbers: RequestMacros) -> int:
    counter = counter_of(macros, numbers)
    if counter:
        return counter
    must_be = f"a whole number from 1 to {LAST_COUNTER}; set it to 0 and ask again"
    raise _wrong("the request counter", macros, numbers.counter, must_be)


def _answerable(macros: Mapping[int, float | None], numbers: RequestMacros) -> float | None:
    value = macros.get(numbers.counter)
    return value if value is not None and 0.0 < value <= LAST_COUNTER else None


def _kind(macros: Mapping[int, float | None], numbers: RequestMacros) -> RequestKind:
    value = _whole(macros, numbers.kind)
    if value not in set(RequestKind):
        known = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in RequestKind)
        raise _wrong("kind", macros, numbers.kind, f"one of {known}")
    return RequestKind(value)


def _axis(macros: Mapping[int, float | None], numbers: RequestMacros, axes: Sequence[str]) -> str | None:
    index = _whole(macros, numbers.axis)
    if index is None or not 0 <= index <= len(axes) or (index and not axes[index - 1]):
        known = ", ".join(f"{number} {axis}" for number, axis in enumerate(axes, start=1) if axis)
        raise _wrong("axis", macros, numbers.axis, f"one of 0 (all), {known}")
    return axes[index - 1] if index else None


def _millimetres(macros: Mapping[int, float | None], numbers: RequestMacros) -> float:
    value = macros.get(numbers.value_mm)
    if value is None or not math.isfinite(value):
        raise _wrong("the probe value", macros, numbers.value_mm, "what was measured [mm]")
    return value


def _tool_number(macros: Mapping[int, float | None], numbers: RequestMacros) -> int:
    value = _whole(macros, numbers.value_mm)
    if value is None or not 0 <= value <= LAST_TOOL:
        raise _wrong("the tool number", macros, numbers.value_mm, f"a whole number from 0 to {LAST_TOOL}")
    return value


def _may_have_positioned(macros: Mapping[int, float | None], numbers: RequestMacros) -> bool:
    """Return whether a refused request may have announced a positioning, as a reference of all axes does."""
    if counter_of(macros, numbers) is None:
        return True
    kind = _whole(macros, numbers.kind)
    if kind == RequestKind.REFERENCE:
        return _whole(macros, numbers.axis) in (None, 0)
    return kind not in (RequestKind.PROBE, RequestKind.TOOL_CHANGE)
