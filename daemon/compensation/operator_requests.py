"""Keeps the requests of people until they are decided, and says when the output's next step is due."""

import asyncio
from functools import partial

from daemon.cnc.events import Journal
from daemon.cnc.interlocks import Interlocks, in_words
from daemon.cnc.session import CncLink
from daemon.compensation.parts import Inbox
from daemon.compensation.references import Decided, References
from daemon.compensation.restart import StartupRecovery
from models.control.state import NO_REQUEST, Inhibit, InhibitCode, OperatorRequest


class Requests:
    """A queue of people's requests, carried out in the control task's stack, and a way to wait for the decision."""

    def __init__(
        self,
        interlocks: Interlocks,
        journal: Journal,
        link: CncLink,
        references: References,
        startup: StartupRecovery,
        inbox: Inbox,
    ) -> None:
        self._interlocks = interlocks
        self._journal = journal
        self._link = link
        self._references = references
        self._startup = startup
        self._inbox = inbox
        self._waiting: list[tuple[OperatorRequest, str]] = []
        self._acted = asyncio.Event()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, request: OperatorRequest, person: str) -> str:
        """Queue a request; return why it is refused, '' when it is taken."""
        if (inhibit := self._inhibit(request, self._startup.not_begun)) is not None:
            self.note_refusal(f"{in_words(request)}: {inhibit}", person)
            return str(inhibit)
        self._waiting.append((request, person))
        self._inbox.wake()
        return ""

    def _inhibit(self, request: OperatorRequest, not_begun: str) -> Inhibit | None:
        if request.acknowledge not in (0, newest := self._journal.number):
            if (fault := self._journal.fault) is None:
                return Inhibit(code=InhibitCode.FAULT, text="there is no FAULT that is not acknowledged")
            text = f"the newest is FAULT {newest}, not {request.acknowledge}"
            return Inhibit(code=InhibitCode.FAULT, text=text, remedy=f"look at it before you acknowledge it: {fault}")
        return self._interlocks.request_inhibit(request, self._link.session, not_begun=not_begun)

    def put_reference(self, person: str, decided: Decided = lambda _refusal: None) -> str:
        """Queue a reference by hand; return why it is refused, '' when it is taken, and `decided` hears the rest."""
        if (session := self._link.session) is None or session.echo is None or self._references.sample is None:
            return "no link to the CNC, so program, work offset and power-on count are unknown"
        if refusal := self._references.too_early(session.echo.applied_um):
            self.note_refusal(f"a reference by hand: {refusal}", person)
            return refusal
        self._inbox.put(partial(self._references.request_by_hand, f"hand: {person}", decided))
        return ""

    def note_refusal(self, text: str, person: str) -> None:
        """Have it recorded that something was refused to a person."""
        self._inbox.put(partial(self._journal.event, "refused", text, person))

    def take(self) -> OperatorRequest:
        """Return the oldest request, an empty one when there is none; an acknowledgement is carried out at once."""
        request, person = self._waiting.pop(0) if self._waiting else (NO_REQUEST, "")
        if person:
            self._journal.event("request", in_words(request), person)
        if request.acknowledge and (inhibit := self._inhibit(request, "")) is not None:
            self._journal.event("refused", f"{in_words(request)}: {inhibit}", person)
            request = NO_REQUEST
        elif request.acknowledge and (session := self._link.session) is not None and self._journal.fault is not None:
            self._journal.acknowledge(*session.acknowledge())
        return self._startup.heed(request)

    def decided(self) -> None:
        """Say that the output has decided on everything that was taken."""
        self._acted.set()

    async def carried_out(self) -> None:
        """Wait until everything that was queued before has been decided on."""
        while True:
            self._acted.clear()
            await self._acted.wait()
            if not self._waiting:
                return


class Cadence:
    """Falls due every period; what was late is not made up for."""

    def __init__(self, period_s: float, start_s: float) -> None:
        self.period_s = period_s
        self.next_s = start_s

    def due(self, now_s: float) -> bool:
        """Return whether it is due at `now_s` [s]; if so, it is due again one period later, not much sooner."""
        if now_s < self.next_s:
            return False
        self.next_s = max(self.next_s + self.period_s, now_s + self.period_s / 4)
        return True
