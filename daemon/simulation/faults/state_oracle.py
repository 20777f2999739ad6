"""The state that the output must be in: the specification's table of states, written down a second time.

A campaign that asked the product's own table where the output belongs would accept every mistake in it.
This page takes nothing from `models.control.compensation`; a test holds the two against each other.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

FOLLOWERS: Mapping[str, frozenset[str]] = {
    "OFF": frozenset({"ARMED", "FAULT"}),
    "ARMED": frozenset({"ACTIVE", "RETREAT", "FAULT"}),
    "ACTIVE": frozenset({"HOLD", "RETREAT", "FAULT"}),
    "HOLD": frozenset({"ACTIVE", "RETREAT", "FAULT"}),
    "RETREAT": frozenset({"OFF", "ARMED", "FAULT"}),
    "FAULT": frozenset({"HOLD"}),
}
"""What may come after each state: OFF begins by being asked for, following ends by freezing or by a retreat, only a
retreat ends in OFF, and only an acknowledgement, into HOLD, ends a FAULT."""
STARTS = frozenset({"OFF", "HOLD"})
"""A start finds the tool at zero, or holds what is applied."""
HEARTBEAT = frozenset({"ARMED", "ACTIVE", "HOLD", "RETREAT"})
"""States in which the block is kept valid and enabled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """What decides where the output rests."""

    asked_for: bool
    """A person has switched at least one axis on."""
    trusted: bool
    """The CNC has shown nothing that must not be trusted."""
    zero_first: bool
    """The offset is being taken out before the work is positioned."""
    connected: bool
    """The CNC answers, and the guard's echo is there."""
    at_zero: bool
    can_follow: bool
    """Reference, model, temperatures and links are good."""


LONGEST_WAY = 6


def next_state(state: str, now: Situation) -> str:
    """Return the state after one step; time limits are left out. FAULT is left by nothing but a person."""
    if state == "FAULT" or not now.trusted:
        return "FAULT"
    leaves = not now.asked_for or now.zero_first
    match state:
        case "OFF":
            return "OFF" if leaves or not now.connected else "ARMED"
        case "RETREAT" if now.connected and not leaves:
            return "ARMED"
        case "RETREAT":
            return "OFF" if now.connected and now.at_zero else "RETREAT"
        case _ if leaves:
            return "RETREAT"
        case "ARMED":
            return "ACTIVE" if now.can_follow else "ARMED"
        case _:
            return "ACTIVE" if now.can_follow else "HOLD"


def way(state: str, now: Situation) -> list[str]:
    """Return the states that an output in `state` passes while nothing changes, to the one in which it rests."""
    passed = [state]
    while len(passed) < LONGEST_WAY and (following := next_state(passed[-1], now)) != passed[-1]:
        passed.append(following)
    return passed


def resting_state(state: str, now: Situation) -> str:
    """Return where an output that is in `state` comes to rest while nothing changes."""
    return way(state, now)[-1]


def unlawful(changes: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the changes of state that the specification does not allow."""
    return [(before, after) for before, after in changes if after not in FOLLOWERS.get(before, frozenset())]
