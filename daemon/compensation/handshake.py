"""Requests of the NC program: kind, axis and value, a counter that rises, and an answer.

The answer is the counter when the request was taken, minus the counter when it was refused. A program that has given up
sets the kind to 0.
"""

import math
from collections.abc import Mapping, Sequence

from config.schema.cnc import RequestMacrosConfig
from models.control.nc_request import NcRequest, Refusal, RequestMacros, counter_of, missed_requests, parse_request

LATE = "it was made while the daemon was away; ask again"


class Handshake:
    """Sees requests in the macros that are polled, and says when one was lost."""

    def __init__(self, macros: RequestMacrosConfig | None, axes: Sequence[str]) -> None:
        self._macros = RequestMacros(**macros.model_dump()) if macros is not None else None
        self._axes = tuple(axes)
        self._shown: float | None = None
        """What the macro of the counter held when it was last read."""
        self._begun = False
        self.counter: int | None = None
        """The latest counter that was seen; None before the first."""
        self.answered: int | None = None
        """The latest whose request was answered or given up; what was asked for after it may be done by half."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """The macros of a request, to be read once more after its counter was seen."""
        m = self._macros
        return () if m is None else (m.counter, m.kind, m.axis, m.value_mm, m.acknowledge)

    @property
    def acknowledge(self) -> int:
        """Number of the macro that takes the answer."""
        assert self._macros is not None
        return self._macros.acknowledge

    def begin(self, macros: Mapping[int, float | None]) -> Refusal | None:
        """Take the counter as it stands when the CNC is first seen; return what is refused of what waits there."""
        if self._macros is None or (self._begun and not self.risen(macros)):
            return None
        seen, self._begun, self._shown = self._begun, True, self._counter_macro(macros)
        self.counter = self.answered = counter_of(macros, self._macros)
        if self.counter is None:
            found = parse_request(macros, self._macros, self._axes)
            return found if isinstance(found, Refusal) else None
        answered = macros.get(self._macros.acknowledge)
        if not self.counter or (answered is not None and abs(answered) == self.counter):
            return None
        return Refusal(why=LATE, number=float(self.counter), may_have_positioned=seen)

    def risen(self, macros: Mapping[int, float | None]) -> bool:
        return self._macros is not None and self._counter_macro(macros) != self._shown

    def withdrawn(self, macros: Mapping[int, float | None]) -> bool:
        """Whether the program has given up its latest request."""
        return self._macros is not None and macros.get(self._macros.kind) == 0.0

    def take(self, macros: Mapping[int, float | None]) -> tuple[NcRequest | Refusal | None, str]:
        """Return the request that was read after its counter, if it rose, and what that says of others before it."""
        assert self._macros is not None
        self._shown = self._counter_macro(macros)
        counter, latest = counter_of(macros, self._macros), self.counter or 0
        if counter is None:
            return parse_request(macros, self._macros, self._axes), ""
        missed = missed_requests(latest, counter)
        if self.counter == counter:
            return None, ""
        self.counter = counter
        return parse_request(macros, self._macros, self._axes) if counter else None, missed

    def _counter_macro(self, macros: Mapping[int, float | None]) -> float | None:
        assert self._macros is not None
        value = macros.get(self._macros.counter)
        return None if value is None or math.isnan(value) else value
