"""Keeps which lines and sources answer from memory: what each has said, over a restart too."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from daemon.state_store.documents import InputsRead
from drivers.clock import Clock
from models.cleanse import IndexArray
from models.records import FloatArray
from models.standing_input import StandingInput, renewed_input

KEPT_PERIOD_S = 600.0
"""How often what inputs say is kept for a restart, beside when one is found or goes on [s]."""


class MemoryWatch:
    """The inputs of one machine; owned by the thermal task."""

    def __init__(self, places: Mapping[str, IndexArray], clock: Clock) -> None:
        """`places`: of the sensors of each line and source, in the machine's order."""
        self._places, self._clock = places, clock
        self._inputs = {name: StandingInput(degc=np.full(len(of), np.nan)) for name, of in places.items()}
        self._stood_since_s: dict[str, float] = {}
        """Since when inputs had stood that go on, until all their values count again [s]."""
        self.kept = InputsRead(inputs={})
        self._kept_s = -np.inf
        self._found: frozenset[str] = frozenset()

    def recall(self, kept: InputsRead) -> None:
        """Go on with what the previous run knew."""
        self.kept, now_s = kept, self._clock.now().monotonic_s
        for name, each in kept.inputs.items():
            if name in self._inputs and len(each.degc) == len(self._places[name]):
                self._inputs[name] = replace(each, since_s=min(each.since_s - self._to_utc_s(), now_s))

    def take(self, name: str, degc: FloatArray, now_s: float) -> FloatArray:
        """Take the numbers of an input as they were read [degC]; return the latest ones of its sensors [degC]."""
        before = self._inputs[name]
        now = self._inputs[name] = renewed_input(before, degc, now_s)
        if before.stands_s(now_s) and now.since_s > before.since_s:
            self._stood_since_s.setdefault(name, before.since_s)
        found = frozenset([*self._stood_since_s, *(each for each, of in self._inputs.items() if of.stands_s(now_s))])
        if found != self._found or now_s - self._kept_s >= KEPT_PERIOD_S:
            known = {each: replace(of, since_s=of.since_s + self._to_utc_s()) for each, of in self._inputs.items()}
            going_on = {each: of for each, of in self.kept.inputs.items() if each in self._stood_since_s}
            self._found, self._kept_s, self.kept = found, now_s, InputsRead(inputs=known | going_on)
        return now.degc

    def why(self, now_s: float) -> str:
        """Return which line or source seems to answer from memory, '' when none does."""
        for name, since_s in self._stood_since_s.items():
            return f"{name} goes on after it had sent the very same numbers for {(now_s - since_s) / 60.0:.0f} min"
        for name, each in self._inputs.items():
            if stood_s := each.stands_s(now_s):
                return (
                    f"{name} has sent the very same numbers for {stood_s / 60.0:.0f} min, though they changed all the "
                    "time before: it may answer from memory; check it and what its sensors hang on"
                )
        return ""

    def standing(self, now_s: float) -> list[int]:
        """Return the places of all sensors of inputs that seem to answer from memory."""
        return [place for name, each in self._inputs.items() if each.stands_s(now_s) for place in self._places[name]]

    def stood_since_s(self, name: str) -> float | None:
        """Return since when an input had stood that goes on, until all its values count again [s]."""
        return self._stood_since_s.get(name)

    def counts(self, name: str) -> None:
        """All values of an input that goes on count again."""
        del self._stood_since_s[name]

    def _to_utc_s(self) -> float:
        now = self._clock.now()
        return now.utc_s - now.monotonic_s
