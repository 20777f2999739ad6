"""What the output did and why: events, notices, alarm, the latched FAULT, and what a restart needs."""

from collections.abc import Sequence
from typing import Any

import structlog

from daemon.history.writer import HistoryWriter

log = structlog.get_logger(__name__)

NOTICES_KEPT = 20
"""Latest notices that status can show."""


class Journal:
    """Hands what happened to history and log, and keeps what status shows; owned by the control task."""

    def __init__(self, history: HistoryWriter, fault: str | None) -> None:
        self._history = history
        self.fault = fault
        """Why the output is not trusted; None while it is."""
        self.notices: list[str] = []
        self.alarm = ""

    def event(self, kind: str, text: str, person: str) -> None:
        """Record something that happened, and who did it; a refusal is shown in status too."""
        if kind == "refused":
            self.notices = [*self.notices[1 - NOTICES_KEPT :], f"refused: {text}"]
        log.info(f"output.{kind}", text=text, person=person)
        self._history.event(kind, text, person)

    def say(self, kind: str, text: str) -> None:
        """Record something that the daemon itself did; a notice is shown in status too."""
        if kind == "notice":
            self.notices = [*self.notices[1 - NOTICES_KEPT :], text]
        self.event(kind, text, "daemon")

    def notice(self, text: str) -> None:
        """Record something that a person should know."""
        self.say("notice", text)

    def raise_fault(self, reason: str) -> None:
        """Latch a FAULT; a second reason replaces the first in what is shown."""
        if self.fault is None:
            self.say("fault", reason)
            self._history.put_state("fault", reason)
        self.fault = reason

    def acknowledge(self, remains: str) -> None:
        """Clear the FAULT that a person acknowledged, except for what remains."""
        self.fault = remains or None
        self._history.put_state("fault", self.fault)

    def keep(self, key: str, value: Any) -> None:
        """Keep a JSON value for the next start of the daemon."""
        self._history.put_state(key, value)

    def audited(self, macros: Sequence[int]) -> tuple[dict[int, tuple[float, ...]] | None, int | None]:
        """Return what these macros may hold by the audit, and the number of the newest write in it."""
        return self._history.last_written_macros(macros), self._history.last_write_id()

    def kept(self, key: str) -> Any:
        """Return a value that `keep` kept, None where there is none."""
        return self._history.get_state(key)
