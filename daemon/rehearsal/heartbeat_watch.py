"""Whether the block of macros is alive in the states in which it must be, and dead in the others."""

from config.schema.cnc import MacroMapConfig
from daemon.rehearsal.invariants import Claims, Ledger
from daemon.rehearsal.state_oracle import HEARTBEAT
from drivers.sim.contract import SimulatedNc

SETTLED_S = 120.0
"""Looked at when nothing has happened for so long [s]."""


class HeartbeatWatch:
    """Looks at enable bits and valid_until in the CNC, in the CNC's own time."""

    def __init__(self, macros: MacroMapConfig, ledger: Ledger) -> None:
        self._map = macros
        self._ledger = ledger
        self._disturbed_until_s = 0.0
        self._state = ("", 0.0)

    def disturbed(self, until_s: float) -> None:
        """Something happens until then."""
        self._disturbed_until_s = max(self._disturbed_until_s, until_s)

    def look(self, time_s: float, claims: Claims, nc: SimulatedNc) -> None:
        """Compare the block with the state that the daemon claims, when both have long been what they are."""
        if claims.state != self._state[0]:
            self._state = (claims.state, time_s)
        if time_s - max(self._state[1], self._disturbed_until_s) < SETTLED_S or not claims.link:
            return
        enabled = bool(nc.macros.get(self._map.enable))
        valid = (nc.macros.get(self._map.valid_until) or 0.0) > nc.clock_s
        alive = enabled and valid
        right = alive if claims.state in HEARTBEAT else not alive
        what = "" if right else f"{time_s:.1f} s, {claims.state}: enabled {enabled}, valid {valid}"
        self._ledger.check("heartbeat", right, what)
