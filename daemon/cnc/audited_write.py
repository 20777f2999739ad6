"""The one place that writes macro variables: intent, comparison, write, read-back, outcome, receipt.

Nothing reaches the CNC without its row in the audit, and nothing is written over a value that is not ours: what stands
in the macros is read as the last request before the write, for an estimate's write while the estimate is made.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from daemon.cnc.macro_block import MacroBlock
from daemon.history.writer import HistoryWriter, WriteId
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from drivers.contract import Cnc, FatalDriverError, NotSentError
from models.records import CompensationCommand, Receipt, Trace, WriteOutcome

MacroValues = Mapping[int, float | None]
Groups = tuple[tuple[tuple[int, float], ...], ...]
Expected = Mapping[int, tuple[float | None, ...]]
"""Per macro what may stand in it; None: it may be vacant."""

LOOK_LASTS_S = 0.02
"""What was looked at before the write was decided on counts for so long [s of the wall clock], and only if nothing
else was asked of the control since."""
LATE_S, LATE_LOOK_S = 1.0, 0.05
"""A gateway acknowledges a value before it shows it: so long it is looked for, so far apart [s of the wall clock]."""


class ForeignValueError(NotSentError):
    """Something that is not ours stands in a macro that was to be written; nothing was sent."""


class AuditError(NotSentError):
    """The audit did not take the intent in time; nothing was sent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MacroWrite:
    """One write: what, over what, why."""

    groups: Groups
    """Macro and value, each group sent only after the previous one was accepted."""
    expected: Expected
    """What may stand in the macros now; one that is not named here is written over unseen."""
    cause: str
    trace: Trace
    sequence: int = 0
    command: CompensationCommand | None = None
    person: str | None = None
    also_read: tuple[int, ...] = ()
    """Macros to read back beside those that are written."""
    commit_s: float | None = None
    """Wait at most this long for the audit's commit of the intent before anything is sent [s of the wall clock]."""
    sending: Callable[[MacroValues], None] = lambda _found: None
    """Called with what stands in the macros, after the comparison and before anything is sent."""
    kept: bool = False
    """`sending` keeps macros and number of the write where they survive this process: the audit commits them later."""
    judge: Callable[[MacroValues], Sequence[str]] = lambda _found: ()
    """Called with what was read back; returns what is wrong with it beside the values that were written."""

    @property
    def macros(self) -> tuple[tuple[int, float], ...]:
        """Macro and value in the order written."""
        return tuple(pair for group in self.groups for pair in group)


class AuditedWriter:
    """Writes over one connection; owned by the task that owns the connection."""

    def __init__(self, cnc: Cnc, block: MacroBlock, clock: Clock, history: HistoryWriter, telemetry: Telemetry) -> None:
        self.cnc = cnc
        self.block = block
        self.clock = clock
        self._history = history
        self._telemetry = telemetry
        self.last_write_id: int | None = None
        """Number of the latest write in the audit."""
        self._look: tuple[MacroValues, float] | None = None

    def note(self, kind: str, text: str) -> None:
        """Record what the daemon found out about earlier writes."""
        self._history.event(kind, text, "daemon")

    async def look_ahead(self, macros: Sequence[int]) -> None:
        """Read what stands in macros that are about to be written: the comparison of the next write has it then."""
        self.forget_look()
        found = await self.cnc.read_macros(macros)
        self._look = found, self.clock.now().real_s

    def forget_look(self) -> None:
        """Have the next write read again: something else has been asked of the control."""
        self._look = None

    async def write(self, write: MacroWrite) -> Receipt:
        """Compare, write, read back; intent and outcome are in the audit however it ends.

        Raises ForeignValueError with nothing sent, and what the driver raises. Only what was refused before anything
        was sent is REFUSED in the audit; after any other error each macro may hold the old or the new value.
        """
        macros, trace = write.macros, write.trace
        written = {number: (value,) for number, value in macros}
        intent = self._history.write_intent(write.command, macros, write.cause, write.person, kept=write.kept)
        self.last_write_id = int(intent)
        unsent = True
        try:
            if write.commit_s is not None:
                await self._committed(intent, write.commit_s)
            before = await self._compare(write.expected)
            write.sending(before)
            unsent = False
            await self.cnc.write_macros(write.groups)
            trace = replace(trace, written=self.clock.now())
            found, problems = await self._read_back(written, write.also_read, before)
            trace = replace(trace, read_back=self.clock.now())
        except BaseException as error:
            refused = isinstance(error, NotSentError) or (unsent and isinstance(error, FatalDriverError))
            detail = str(error) or type(error).__name__
            if not refused and isinstance(error, FatalDriverError):
                detail += "; other values of this write may have arrived"
            self._conclude(write, intent, WriteOutcome.REFUSED if refused else WriteOutcome.FAILED, detail, {}, trace)
            raise
        problems += write.judge(found)
        outcome = WriteOutcome.DIFFERS if problems else WriteOutcome.VERIFIED
        return self._conclude(write, intent, outcome, "; ".join(problems), found, trace)

    async def _read_back(
        self, written: Expected, also: Sequence[int], before: MacroValues
    ) -> tuple[MacroValues, list[str]]:
        """Return what the control holds now, and how it differs; what stands there from before may yet change."""
        numbers = tuple(dict.fromkeys((*written, *also)))
        now_s = asyncio.get_running_loop().time
        until_s = now_s() + LATE_S  # the heartbeat and whoever asks wait meanwhile
        while True:
            found = await self.cnc.read_macros(numbers)
            if not (problems := self.block.differences(written, found)):
                return found, problems
            late = [each for each, value in written.items() if self.block.differences({each: value}, found)]
            gone = any(each in before and before[each] != found.get(each) for each in late)
            if gone or now_s() >= until_s:
                return found, problems
            await asyncio.sleep(LATE_LOOK_S)

    async def _committed(self, intent: WriteId, commit_s: float) -> None:
        try:
            async with asyncio.timeout(commit_s):
                await intent
        except TimeoutError:
            problem = self._history.problem or "the store does not answer"
            raise AuditError(
                f"the audit cannot be written, and nothing is written to the CNC without it: {problem}"
            ) from None

    async def _compare(self, expected: Expected) -> MacroValues:
        """Return what stands in the macros; raises ForeignValueError when it is not what may stand there."""
        look = self._look
        self.forget_look()
        if not expected:
            return {}
        age_s = self.clock.now().real_s - look[1] if look is not None else LOOK_LASTS_S
        if look is not None and 0.0 <= age_s < LOOK_LASTS_S and look[0].keys() >= expected.keys():
            found = look[0]
        else:
            found = await self.cnc.read_macros(tuple(expected))
        if problems := self.block.differences(expected, found):
            raise ForeignValueError(f"{'; '.join(problems)}; nothing was written")
        return found

    def _conclude(
        self, write: MacroWrite, intent: WriteId, outcome: WriteOutcome, detail: str, found: MacroValues, trace: Trace
    ) -> Receipt:
        receipt = Receipt(
            sequence=write.sequence,
            macros=write.macros,
            outcome=outcome,
            detail=detail,
            read_back=tuple(found.get(number) for number, _ in write.macros),
            applied_um=self.block.echo(found).applied_um,
            trace=trace,
        )
        self._history.write_outcome(intent, receipt)
        self._telemetry.write(receipt)
        return receipt
