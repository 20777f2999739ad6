"""The output's state as the history's events tell it, so that no FAULT is missed while nobody looks."""

import re
from dataclasses import dataclass, replace

from models.records import OutputState

CHANGE = re.compile(r"(\w+) -> (\w+): (.*)", re.DOTALL)
START = re.compile(r"(\w+): (.*)", re.DOTALL)
SETTLED_S = 30.0
"""A start of the daemon counts when no change follows for so long: a latched FAULT comes right after it."""
ALARMING = (OutputState.FAULT, OutputState.HOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stay:
    """A stay of the output in one state."""

    state: str
    since_utc_s: float
    reason: str
    reasons: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputTrack:
    now: Stay | None = None
    """None: nothing is known yet."""
    faults: tuple[str, ...] = ()
    """Reasons of the latched FAULT."""
    started: Stay | None = None
    """What the daemon began with, while that may change at once."""

    def after(self, utc_s: float, kind: str, text: str) -> tuple["OutputTrack", tuple[Stay, ...]]:
        """Return the track after an event, and the stays that have ended."""
        if kind == "fault":
            faults = (*self.faults, text)
            if self.now is None or self.now.state != OutputState.FAULT:
                return replace(self, faults=faults), ()
            now = replace(self.now, reason="; ".join(faults), reasons=len(faults))
            return replace(self, faults=faults, now=now), ()
        if kind == "start" and (match := START.fullmatch(text)):
            track, ended = self.settled(utc_s)
            return replace(track, started=_stay(match[1], utc_s, match[2])), ended
        if kind == "state" and (match := CHANGE.fullmatch(text)):
            track, ended = self.settled(utc_s)
            track, left = track._to(_stay(match[2], utc_s, match[3]))
            return track, (*ended, *left)
        return self, ()

    def settled(self, utc_s: float) -> tuple["OutputTrack", tuple[Stay, ...]]:
        """Return the track at a time, and the stay that a start of the daemon has ended."""
        if self.started is None or 0.0 <= utc_s - self.started.since_utc_s < SETTLED_S:
            return self, ()
        return self._to(self.started)

    def _to(self, stay: Stay) -> tuple["OutputTrack", tuple[Stay, ...]]:
        before = self.now
        if before is not None and before.state == stay.state:
            return replace(self, started=None), ()
        ended = () if before is None else (before,)
        if stay.state != OutputState.FAULT:
            return OutputTrack(now=stay), ended
        faults = self.faults or (stay.reason,)
        stay = replace(stay, reason="; ".join(faults), reasons=len(faults))
        return OutputTrack(now=stay, faults=faults), ended


def _stay(state: str, utc_s: float, reason: str) -> Stay:
    return Stay(state=state, since_utc_s=utc_s, reason=reason)
