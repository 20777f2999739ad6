"""Serves the requests of the NC program, and answers when what was asked for is done."""

from collections.abc import Callable
from dataclasses import dataclass

from daemon.cnc.session import CncSession
from daemon.compensation.handshake import Handshake, NcRequest, RequestError, RequestKind
from daemon.compensation.references import References
from models.control.state import OutputMemory
from models.records import WriteOutcome

HANDSHAKE_CAUSE = "handshake"
"""Cause of an answer in the audit."""


@dataclass(slots=True, kw_only=True)
class _Pending:
    """A request that has no answer yet."""

    request: NcRequest
    reference_id: str | None = None
    """The reference that it waits for."""
    settles: bool = False
    """The answer waits until the CNC holds the new command."""
    refusal: str = ""


class RequestDesk:
    """One desk for one NC program; owned by the control task."""

    def __init__(
        self,
        handshake: Handshake,
        references: References,
        say: Callable[[str, str], None],
        set_tool: Callable[[str], str],
        change_tool: Callable[[int], None],
        probe: Callable[[str, float], str],
    ) -> None:
        self._handshake = handshake
        self._references = references
        self._say = say
        self._set_tool = set_tool
        self._change_tool = change_tool
        self._probe = probe
        self._pending: _Pending | None = None

    async def look(self, session: CncSession) -> None:
        """Take what the poll shows: a new request, or one that the program no longer waits for."""
        sample = session.sample
        assert sample is not None
        if self._handshake.counter is None:
            self._begin(session)
            return
        if not self._handshake.risen(sample.macros):
            self._watch_withdrawal(session)
            return
        found = await session.cnc.read_macros(self._handshake.numbers)
        try:
            request, lost = self._handshake.take(found)
        except RequestError as error:
            self._refuse_unknown(str(error))
            return
        if lost:
            self._references.end(f"{lost} request(s) of the NC program were missed")
        self._serve(request)
        self._references.keep()

    def refused(self, reference_id: str, why: str) -> None:
        """Take the refusal of a reference that was asked for."""
        if self._pending is not None and self._pending.reference_id == reference_id:
            self._pending.refusal = why

    def fail(self, why: str) -> None:
        """What was asked for did not take effect."""
        if self._pending is not None and self._pending.reference_id is None and not self._pending.refusal:
            self._pending.refusal = why

    async def answer(self, session: CncSession, memory: OutputMemory) -> str:
        """Write the answer as soon as what was asked for is done, or refused; return what the read-back shows wrong.

        A lost link leaves the answer to the next session; the request stays until it is written.
        """
        pending = self._pending
        if pending is None:
            return ""
        if not pending.refusal:
            if pending.reference_id is not None and memory.reference_id != pending.reference_id:
                return ""
            if pending.settles and memory.settling:
                return ""
        counter = pending.request.counter
        value = float(-counter if pending.refusal else counter)
        receipt = await session.write_one(self._handshake.acknowledge, value, cause=HANDSHAKE_CAUSE)
        self._pending = None
        if pending.refusal:
            self._say("refused", f"{pending.request}: {pending.refusal}")
        return "" if receipt.outcome is WriteOutcome.VERIFIED else receipt.detail

    def _begin(self, session: CncSession) -> None:
        assert session.sample is not None
        waiting = self._handshake.begin(session.sample.macros)
        if waiting is not None:
            late = NcRequest(counter=waiting, kind=RequestKind.WITHDRAWN, axis=None, value_mm=0.0)
            self._pending = _Pending(request=late, refusal="it was made while the daemon was away; ask again")

    def _refuse_unknown(self, why: str) -> None:
        counter = self._handshake.counter
        if counter is None:
            self._say("notice", why)
            return
        unknown = NcRequest(counter=counter, kind=RequestKind.WITHDRAWN, axis=None, value_mm=0.0)
        self._pending = _Pending(request=unknown, refusal=why)

    def _watch_withdrawal(self, session: CncSession) -> None:
        pending, sample = self._pending, session.sample
        if pending is None or sample is None:
            return
        if self._handshake.withdrawn(sample.macros) and pending.request.kind is not RequestKind.WITHDRAWN:
            self._pending = None
            self._say("notice", f"{pending.request}: the program no longer waits for the answer")
            if pending.reference_id is not None:
                self._references.forget(pending.reference_id)
                self._references.end("the NC program gave up waiting for its reference")

    def _serve(self, request: NcRequest) -> None:
        sample = self._references.sample
        assert sample is not None
        pending = self._pending = _Pending(request=request)
        match request.kind:
            case RequestKind.WITHDRAWN:
                self._pending = None
                self._references.end(f"{request} was withdrawn before it could be answered")
            case RequestKind.REFERENCE if request.axis is None:
                self._references.handshake_positioned()
                pending.reference_id = self._references.ask_for(str(request), sample, positioning=True, handshake=True)
                pending.settles = True
            case RequestKind.REFERENCE:
                pending.settles = True
                pending.refusal = self._set_tool(request.axis or "")
            case RequestKind.PROBE if request.axis is None:
                pending.refusal = "a probe value needs one axis, not 0 (all)"
            case RequestKind.PROBE:
                pending.refusal = self._probe(request.axis or "", request.value_mm * 1e3)
            case RequestKind.TOOL_CHANGE:
                self._change_tool(round(request.value_mm))
