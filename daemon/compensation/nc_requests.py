"""Serves the requests of the NC program, and answers when what was asked for is done."""

from dataclasses import dataclass, replace

from daemon.cnc.events import Journal
from daemon.cnc.session import CncSession
from daemon.compensation.handshake import Handshake
from daemon.compensation.probing import MeasuredByNc
from daemon.compensation.references import References, new_id
from drivers.contract import FatalDriverError
from models.control.nc_request import NcRequest, Refusal, RequestKind
from models.control.program import power_cycled
from models.control.state import OutputInputs, OutputMemory
from models.records import CncSample, WriteOutcome

HANDSHAKE_CAUSE = "handshake"
UNANSWERED = "an answer to the NC program could not be written"
WITHDRAWN = "the program no longer waits for the answer"
SWITCHED_OFF = "the CNC was switched off and on since, as far as anybody has seen; ask again"


@dataclass(slots=True, kw_only=True)
class _Pending:
    """A request that has no answer yet."""

    request: NcRequest | Refusal
    number: float
    """Its counter, which is the answer, or minus the answer."""
    reference_id: str | None = None
    settles: bool = False
    """The answer waits until the CNC holds the new command."""
    refusal: str = ""


class RequestDesk:
    """One desk for one NC program; owned by the control task."""

    def __init__(self, handshake: Handshake, references: References, journal: Journal, output: MeasuredByNc) -> None:
        self._handshake = handshake
        self._references = references
        self._journal = journal
        self._output = output
        self._pending: _Pending | None = None
        self._sample: CncSample | None = None

    async def look(self, session: CncSession) -> None:
        """Take what the poll shows: a new request, or one that the program no longer waits for."""
        before, sample = self._sample, session.sample
        assert sample is not None
        risen = self._handshake.counter is not None and self._handshake.risen(sample.macros)
        found = await session.cnc.read_macros(self._handshake.numbers) if risen else {}
        self._sample = sample
        if self._handshake.counter is None:
            if (refusal := self._handshake.begin(sample.macros)) is not None:
                self._refuse(refusal)
            return
        if not risen:
            self._watch_withdrawal(session)
            return
        request, missed = self._handshake.take(found)
        if missed:
            self._references.end(missed)
        if request is not None:
            self._output.drop(WITHDRAWN)
        if isinstance(request, NcRequest) and power_cycled(before, sample):
            request = Refusal(why=SWITCHED_OFF, number=float(request.counter), may_have_positioned=False)
        if isinstance(request, Refusal):
            self._refuse(request)
        elif request is not None:
            self._serve(request)
        self._note_answered()

    def refused(self, reference_id: str, why: str) -> None:
        """Take the refusal of a reference that was asked for."""
        if self._pending is not None and self._pending.reference_id == reference_id:
            self._pending.refusal = why

    def fail(self, why: str) -> None:
        """What was asked for did not take effect."""
        if self._pending is not None and self._pending.reference_id is None and not self._pending.refusal:
            self._pending.refusal = why

    def judged(self, memory: OutputMemory, inputs: OutputInputs) -> OutputInputs:
        """Return the inputs of a step without what was measured before and cannot be counted in it."""
        if not (lost := self._output.given_up(memory, inputs)):
            return inputs
        self.fail(lost)
        return replace(inputs, tool_setting=None, probe_um=None)

    async def answer(self, session: CncSession, memory: OutputMemory) -> None:
        """Write the answer as soon as what was asked for is done, or refused; one that does not arrive is a FAULT.

        A lost link leaves the answer to the next session; the request stays until it is written.
        """
        pending = self._pending
        if pending is None:
            return
        if not pending.refusal:
            if pending.reference_id is not None and memory.reference_id != self._awaited(pending.reference_id):
                return
            if pending.settles and memory.settling:
                return
        value = -pending.number if pending.refusal else pending.number
        try:
            receipt = await session.write_one(self._handshake.acknowledge, value, cause=HANDSHAKE_CAUSE)
        except FatalDriverError as error:
            self._journal.raise_fault(f"{UNANSWERED}: {error}")
            return
        self._pending = None
        self._note_answered()
        if pending.refusal:
            self._journal.say("refused", f"{pending.request}: {pending.refusal}")
        if receipt.outcome is not WriteOutcome.VERIFIED:
            self._journal.raise_fault(f"{UNANSWERED}: {receipt.detail}")

    def _awaited(self, reference_id: str) -> str:
        """Return whose coming answers: a later reference where polling saw the positioning only after the request."""
        asked, current = self._references.memory.requests, self._references.current
        waits = current is None or any(each.reference_id == reference_id for each in asked)
        return reference_id if waits or current is None else current.reference_id

    def _refuse(self, request: Refusal) -> None:
        """Answer with minus the counter where a program may wait for it; say in any case why."""
        if request.may_have_positioned:
            self._references.end(f"{request} was refused, and the work may have been positioned ({request.why})")
        if request.number is None:
            self._journal.say("refused", f"{request}: {request.why}")
        else:
            self._pending = _Pending(request=request, number=request.number, refusal=request.why)

    def _watch_withdrawal(self, session: CncSession) -> None:
        pending, sample = self._pending, session.sample
        if pending is None or sample is None:
            return
        if self._handshake.withdrawn(sample.macros) and isinstance(pending.request, NcRequest):
            self._pending = None
            self._output.drop(WITHDRAWN)
            self._journal.say("notice", f"{pending.request}: {WITHDRAWN}")
            if pending.reference_id is not None:
                self._references.withdraw(pending.reference_id)
                self._references.end("the NC program gave up waiting for its reference")
            self._note_answered()

    def _note_answered(self) -> None:
        """A restart takes the reference up again only where nothing was asked for that waits for its answer."""
        if self._pending is None:
            self._handshake.answered = self._handshake.counter

    def _serve(self, request: NcRequest) -> None:
        pending = self._pending = _Pending(request=request, number=float(request.counter))
        match request.kind:
            case RequestKind.WITHDRAWN:
                self._pending = None
                self._references.end(f"{request} was withdrawn before it could be answered")
            case RequestKind.REFERENCE if request.axis is None:
                self._references.handshake_positioned()
                pending.reference_id = new_id()
                self._references.request(pending.reference_id, str(request), positioning=True, handshake=True)
                pending.settles = True
            case RequestKind.REFERENCE:
                pending.settles = True
                pending.refusal = self._output.set_tool(request.axis or "")
            case RequestKind.PROBE if request.axis is None:
                pending.refusal = "a probe value needs one axis, not 0 (all)"
            case RequestKind.PROBE:
                pending.refusal = self._output.take_probe(request.axis or "", request.value_mm * 1e3)
            case RequestKind.TOOL_CHANGE:
                self._output.change_tool(request.tool_number)
