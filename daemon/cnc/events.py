"""What the output did and why: events, notices, alarm, the latched FAULT, and what a restart needs."""

import re
from collections.abc import Sequence
from typing import Any, TypeVar

import structlog

from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import OutputFault
from daemon.state_store.store import StateStore

log = structlog.get_logger(__name__)

NOTICES_KEPT = 20
"""Latest notices that status can show."""
MOST_REASONS = 50
"""So many reasons of one FAULT are told apart."""
NUMBERS = re.compile(r"(?<![#\w.])[-+]?\d[\d.e+-]*(?: or [-+]?\d[\d.e+-]*)*")
"""Numbers in a reason, but not those of macros, tools or programs: with another value it is the same reason."""

Document = TypeVar("Document")


class Journal:
    """Hands what happened to history and log, and keeps what status shows; owned by the control task."""

    def __init__(self, history: HistoryWriter, store: StateStore, faults: tuple[str, ...]) -> None:
        self._history = history
        self._store = store
        self.faults = faults
        """Why the output is not trusted, in the order in which it was found; empty while it is."""
        kept = store.get(OutputFault)
        self.number = max(len(faults), 0 if kept is None else kept.number)
        """Number of the newest reason that was ever latched: whoever acknowledges names it."""
        self.notices: list[str] = []
        self.alarm = ""

    @property
    def fault(self) -> str | None:
        """Every reason of the latched FAULT in one text; None while there is none."""
        return "; ".join(self.faults) or None

    def event(self, kind: str, text: str, person: str) -> None:
        """Record something that happened, and who did it; a notice or a refusal is shown in status too."""
        if kind in ("refused", "notice"):
            self.notices = [*self.notices[1 - NOTICES_KEPT :], f"refused: {text}" if kind == "refused" else text]
        log.info(f"output.{kind}", text=text, person=person)
        self._history.event(kind, text, person)

    def say(self, kind: str, text: str) -> None:
        """Record something that the daemon itself did."""
        self.event(kind, text, "daemon")

    def notice(self, text: str) -> None:
        """Record something that a person should know."""
        self.say("notice", text)

    def raise_fault(self, *reasons: str) -> None:
        """Latch a FAULT; every reason that is not latched already is logged, recorded and stored."""
        latched = {NUMBERS.sub("~", reason) for reason in self.faults}
        for reason in reasons:
            if NUMBERS.sub("~", reason) in latched or len(self.faults) >= MOST_REASONS:
                continue
            latched.add(NUMBERS.sub("~", reason))
            self.faults, self.number = (*self.faults, reason), self.number + 1
            self.say("fault", reason)
            self.keep(OutputFault(reasons=self.faults, number=self.number))

    def acknowledge(self, *remain: str) -> None:
        """Clear the reasons that a person acknowledged; what remains wrong stays, or becomes, a reason."""
        self.faults = tuple(reason for reason in self.faults if reason in remain)
        self.keep(OutputFault(reasons=self.faults, number=self.number))
        self.raise_fault(*remain)

    def keep(self, document: Any) -> None:
        self._store.put(document)

    def audited(self, macros: Sequence[int]) -> tuple[dict[int, tuple[float, ...]] | None, int | None]:
        """Return what these macros may hold by the audit, and the number of the newest write in it."""
        return self._history.last_written_macros(macros), self._history.last_write_id()

    def kept(self, kind: type[Document]) -> Document | None:
        """Return what `keep` kept of this kind, None where there is none."""
        return self._store.get(kind)
