"""Requests of the NC program: a counter that rises, and an answer.

The program sets kind, axis and value, raises the counter and waits. The answer is the counter
when the request was taken, minus the counter when it was refused. A program that has given up
sets the kind to 0.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from config.schema.cnc import RequestMacrosConfig


class RequestKind(IntEnum):
    """What the NC program asks for."""

    WITHDRAWN = 0
    REFERENCE = 1
    PROBE = 2
    TOOL_CHANGE = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class NcRequest:
    """One request."""

    counter: int
    kind: RequestKind
    axis: str | None
    """None: every axis."""
    value_mm: float

    def __str__(self) -> str:
        return f"request {self.counter} of the NC program ({self.kind.name.lower().replace('_', ' ')})"


class RequestError(Exception):
    """A request that cannot be understood; the text says why."""


class Handshake:
    """Sees requests in the macros that are polled, and says when one was lost."""

    def __init__(self, macros: RequestMacrosConfig | None, axes: Sequence[str]) -> None:
        self._macros = macros
        self._axes = tuple(axes)
        self.counter: int | None = None
        """The latest counter that was seen; None before the first poll."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """The macros of a request, to be read once more after its counter was seen."""
        return tuple(self._macros.model_dump().values()) if self._macros is not None else ()

    @property
    def acknowledge(self) -> int:
        """Number of the macro that takes the answer."""
        assert self._macros is not None
        return self._macros.acknowledge

    def begin(self, macros: Mapping[int, float | None]) -> int | None:
        """Take the counter as it stands when the CNC is first seen; return it when it waits for an answer."""
        self.counter = self._counter(macros)
        if self._macros is None or not self.counter:
            return None
        answered = macros.get(self._macros.acknowledge)
        return None if answered is not None and abs(round(answered)) == self.counter else self.counter

    def risen(self, macros: Mapping[int, float | None]) -> bool:
        """Whether the polled counter is another than the latest."""
        counter = self._counter(macros)
        return self._macros is not None and counter is not None and counter != self.counter

    def withdrawn(self, macros: Mapping[int, float | None]) -> bool:
        """Whether the program has given up its latest request."""
        return self._macros is not None and macros.get(self._macros.kind) == 0.0

    def take(self, macros: Mapping[int, float | None]) -> tuple[NcRequest, int]:
        """Return the request that was read after its counter, and how many before it were never seen.

        Raises RequestError, with the counter taken all the same, when it cannot be understood.
        """
        assert self._macros is not None
        counter = self._counter(macros)
        if counter is None:
            raise RequestError(f"macro #{self._macros.counter} of the request counter is vacant")
        lost = counter - (self.counter or 0) - 1
        self.counter = counter
        request = NcRequest(
            counter=counter,
            kind=self._kind(macros, counter),
            axis=self._axis(macros, counter),
            value_mm=macros.get(self._macros.value_mm) or 0.0,
        )
        return request, max(lost, 0)

    def _counter(self, macros: Mapping[int, float | None]) -> int | None:
        value = macros.get(self._macros.counter) if self._macros is not None else None
        return None if value is None else round(value)

    def _kind(self, macros: Mapping[int, float | None], counter: int) -> RequestKind:
        assert self._macros is not None
        value = macros.get(self._macros.kind)
        try:
            return RequestKind(round(value)) if value is not None else RequestKind.WITHDRAWN
        except ValueError as error:
            known = ", ".join(f"{kind.value} {kind.name.lower()}" for kind in RequestKind)
            raise RequestError(
                f"request {counter}: kind {value:g} in macro #{self._macros.kind} is none of {known}"
            ) from error

    def _axis(self, macros: Mapping[int, float | None], counter: int) -> str | None:
        assert self._macros is not None
        value = macros.get(self._macros.axis)
        index = 0 if value is None else round(value)
        if not 0 <= index <= len(self._axes):
            raise RequestError(
                f"request {counter}: axis {index} in macro #{self._macros.axis} is none of 0 (all), "
                + ", ".join(f"{number} {axis}" for number, axis in enumerate(self._axes, start=1))
            )
        return self._axes[index - 1] if index else None
