"""Which machines are two computers of one name, as the rows show that arrive from a broker."""

import time

import structlog

from daemon.sinks.broker_refusals import two_computers

log = structlog.get_logger(__name__)
REPEATED_S = 600.0
"""So long after a row of another store one of the first shows that there are two."""


class SameName:
    """A history store that was replaced sends no more; one of two computers comes again after the other."""

    def __init__(self) -> None:
        self._last: dict[str, str] = {}
        """Machine -> store of its last row."""
        self._left: dict[str, dict[str, float]] = {}
        """Machine -> store -> when another one followed it."""
        self._found_s: dict[str, float] = {}

    def saw(self, machine: str, store: str) -> None:
        """Take machine and store of a row, in the broker's order; an earlier version does not tell its store."""
        if not store or store == (before := self._last.setdefault(machine, store)):
            return
        now_s = time.monotonic()
        left = {name: at_s for name, at_s in self._left.get(machine, {}).items() if now_s - at_s < REPEATED_S}
        if store in left:
            if machine not in self.names():
                log.warning("store.same_name", problem=two_computers([machine]))
            self._found_s[machine] = now_s
        self._last[machine], self._left[machine] = store, {**left, before: now_s}

    def names(self) -> list[str]:
        """Return the machines of which two computers have sent lately."""
        return sorted(name for name, at_s in self._found_s.items() if time.monotonic() - at_s < REPEATED_S)
