"""Where the output begins: the CNC's echo, what a previous run left, and for whom it must wait."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress

from daemon.output.cnc_session import CncSession
from daemon.output.journal import Journal
from daemon.output.references import References
from daemon.output.resume import ResumePoint, wanted_at_start, with_rest, with_tools
from daemon.output.tool_in_spindle import ToolInSpindle
from models.compensation import initial_memory
from models.output import OperatorRequest, OutputMemory
from models.records import Reference

NOT_REACHED = "the CNC has not been reached yet, so what it applies is unknown"


class Beginning:
    """Begins from the CNC's echo, not from zero and not from the store; owned by the control task."""

    def __init__(
        self,
        resume: ResumePoint,
        references: References,
        tool: ToolInSpindle,
        journal: Journal,
        ask: Callable[[Reference], None],
        axes: Sequence[str],
        *,
        model_id: str | None,
        max_outage_s: float,
    ) -> None:
        self._resume = resume
        self._references = references
        self._tool = tool
        self._journal = journal
        self._ask = ask
        self._axes = tuple(axes)
        self._model_id = model_id
        self._max_outage_s = max_outage_s
        self._waiting: frozenset[str] = frozenset()
        self.unknown = NOT_REACHED
        """Why nothing has begun, '' when it has."""

    def begin(self, session: CncSession, now_s: float) -> OutputMemory | None:
        """Return the memory to begin with at the first contact; None while the echo is vacant."""
        assert session.echo is not None and session.sample is not None
        applied_um = session.echo.applied_um
        in_time = self._references.away_s(session.sample) <= self._max_outage_s
        wanted = wanted_at_start(self._resume, applied_um, in_time=in_time)
        try:
            memory = initial_memory(now_s=now_s, applied_um=applied_um, wanted=wanted)
        except ValueError as error:
            self.unknown = self._journal.alarm = f"{error}: run the guard's initialising program, then acknowledge"
            return None
        self.unknown = ""
        if not (self._resume.resumable and in_time):
            self._waiting = frozenset(compress(self._axes, wanted))
        self._journal.say("start", f"{memory.state.value}: {memory.reason}")
        reference = self._resume.reference
        if reference is not None:
            memory = self._with_reference(memory, reference)
        return memory if memory.reference_id is not None else self._with_tools(memory)

    def heed(self, request: OperatorRequest) -> OperatorRequest:
        """Take what a person says of the axes that wait; who speaks for one lets the others go on waiting.

        An axis that nobody had switched on is switched off with the first one that is enabled: its
        offset is not followed again, it retreats.
        """
        if request.zero:
            self._waiting = frozenset()
        if request.enable and self._waiting:
            had = frozenset(compress(self._axes, self._resume.wanted))
            request = replace(request, disable=request.disable | (self._waiting - request.enable - had))
        self._waiting -= request.enable | request.disable
        return request

    def obstacle(self) -> str:
        """Return for which axes a person must speak first, '' when for none."""
        if not self._waiting:
            return ""
        axes = " ".join(sorted(self._waiting))
        return (
            f"the daemon was away too long to go on by itself: `toolpoint enable {axes}` or `toolpoint disable {axes}`"
        )

    def _with_tools(self, memory: OutputMemory) -> OutputMemory:
        """Go on with the tool settings of the previous run although no reference is valid."""
        kept = self._resume.kept_reference
        if kept is None:
            return memory
        found = with_tools(memory, self._resume.rest, self._axes, kept, self._model_id)
        if not found.tools:
            return memory
        numbers = ", ".join(f"T{number}" for number in sorted(found.tools))
        if ended := self._references.take_up_tools(kept):
            self._journal.notice(f"the tool settings of {numbers} have ended: {ended}; set these tools again")
            return memory
        self._ask(kept)
        self._journal.say("tool", f"the settings of {numbers} are taken up again")
        return found

    def _with_reference(self, memory: OutputMemory, reference: Reference) -> OutputMemory:
        if ended := self._references.take_up(reference):
            self._journal.notice(f"the reference of {reference.source} is not taken up again: {ended}")
            return memory
        try:
            memory = with_rest(memory, self._resume.rest, self._axes, reference, self._model_id)
        except ValueError as error:
            self._references.end(str(error))
            return memory
        self._tool.take_up(reference.reference_id)
        self._ask(reference)
        self._journal.say("reference", f"taken up again: {reference.source}")
        return memory
