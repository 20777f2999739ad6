"""Decides what of a previous run of the daemon may be resumed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
import structlog

from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.macro_block import ECHO_SLACK_UM, Echo
from daemon.cnc.session import CncSession
from daemon.cnc.write_ahead import WriteAheadRecord
from daemon.compensation.references import References
from daemon.history.writer import HistoryWriter
from daemon.state_store.documents import DaemonAlive, OutputFault, SpindleSpeedSwitch, WantedAxes
from daemon.state_store.store import StateStore
from drivers.clock import Clock
from models.control.compensation import initial_memory
from models.control.state import Inhibit, InhibitCode, OperatorRequest, OutputMemory
from models.records import CncSample, FloatArray, Instant, Receipt, Trace, WriteOutcome

log = structlog.get_logger(__name__)


class OpenWrite(NamedTuple):
    """A write of which the previous run recorded no outcome."""

    write_id: int
    macros: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumePoint:
    """What the previous run of the daemon left, as far as it may be resumed."""

    wanted: tuple[bool, ...]
    known_macros: dict[int, tuple[float, ...]] | None
    refused: str = ""
    """Why it does not go on as before, '' when it may."""
    undecided: frozenset[str] = frozenset()
    """Axes on which nobody has decided since an earlier run did not go on as before."""
    faults: tuple[str, ...] = ()
    """The reasons of the latched FAULT that has not been acknowledged."""
    open_writes: tuple[OpenWrite, ...] = ()
    """The intents without an outcome, one that the store has not got yet with them."""


def wanted_at_start(wanted: Sequence[bool], undecided: Sequence[bool], applied_um: FloatArray) -> tuple[bool, ...]:
    """Return which axes stay switched on at the first contact with the CNC.

    Of those on which a person must decide that is only what still carries an offset: it is held until then.
    """
    moved = np.abs(applied_um) > ECHO_SLACK_UM
    return tuple(bool(each) for each in np.where(undecided, moved, wanted))


def record_changes(journal: Journal, before: OutputMemory, after: OutputMemory, alarm: str) -> None:
    if after.state is not before.state:
        journal.say("state", f"{before.state.value} -> {after.state.value}: {after.reason}")
    if before.tools and not after.tools:
        numbers = ", ".join(f"T{number}" for number in sorted(before.tools))
        journal.notice(f"the tool settings of {numbers} have ended; set these tools again")
    if alarm and alarm.partition(":")[0] != journal.alarm.partition(":")[0]:
        journal.say("alarm", alarm)
    journal.alarm = alarm


def load_resume_point(
    configuration: Configuration, history: HistoryWriter, clock: Clock, last_block: WriteAheadRecord
) -> ResumePoint:
    """Read from the store what was switched on, the reference, and what the macros may hold."""
    axes = tuple(configuration.compensation.axes)
    store = StateStore(history, clock)
    wanted, fault, alive = store.get(WantedAxes), store.get(OutputFault), store.get(DaemonAlive)
    outage_s = clock.now().utc_s - alive.utc_s if alive is not None else float("inf")
    longest_s, refused = configuration.compensation.reference.max_outage_s, ""
    if not 0 <= outage_s <= longest_s:
        refused = f"the daemon was away for longer than {longest_s:g} s (reference.max_outage_s)"
    if last_block.behind:
        refused = STORE_BEHIND
        history.event("audit gap", STORE_BEHIND, "daemon")
        if configuration.spindle_speed is not None:
            store.put(SpindleSpeedSwitch(off_by="a start on a store that could not be written"))
    if alive is not None and refused:
        log.warning("resume.refused", why=refused)
    newest = history.last_write_id()
    known, lost = last_block.newer_of(history.last_written_macros(), newest)
    open_writes = [OpenWrite(record.write_id, record.macros) for record in history.unsettled_writes()]
    if (unaudited := last_block.unaudited(newest)) is not None:
        number, macros = unaudited
        history.write_intent(None, macros, KEPT_CAUSE, number=number)
        open_writes.append(OpenWrite(number, tuple(macros)))
    if lost:
        log.warning("audit.gap", macros=lost)
        history.event("audit gap", f"the daemon ended while writing; not in the audit: {lost}", "daemon")
    return ResumePoint(
        wanted=tuple(wanted is not None and wanted.axes.get(axis, False) for axis in axes),
        refused=refused,
        undecided=frozenset(() if wanted is None else wanted.undecided),
        faults=() if fault is None else fault.reasons,
        known_macros=known,
        open_writes=tuple(open_writes),
    )


STORE_BEHIND = "the store could not be written when the daemon ended, so what it holds of then is not gone on with"
UNEXPLAINED = "what the CNC holds is not what the store says was written last, so it is not gone on with"
KEPT_CAUSE = "last block"
"""Cause in the audit of a write whose intent it had not got when the daemon was killed."""
NOT_REACHED = "the CNC has not been reached yet, so what it applies is unknown"


class StartupRecovery:
    """Begins from the CNC's echo, not from zero and not from the store; owned by the control task."""

    def __init__(
        self,
        resume: ResumePoint,
        references: References,
        journal: Journal,
        axes: Sequence[str],
        model_id: str | None,
        max_outage_s: float,
    ) -> None:
        self._resume = resume
        self._references = references
        self._journal = journal
        self._axes = tuple(axes)
        self._model_id = model_id
        self._max_outage_s = max_outage_s
        self._open_writes = resume.open_writes
        self._waiting: frozenset[str] = frozenset()
        self._kept: WantedAxes | None = None
        self.not_begun = NOT_REACHED
        """Why nothing has begun, '' when it has."""

    def settle_writes(self, history: HistoryWriter, sample: CncSample, echo: Echo, now: Instant) -> None:
        """Give every write of the previous run without an outcome the one that reading back shows; once."""
        for write in self._open_writes:
            receipt = _outcome_of(write, sample, echo, now)
            history.write_outcome(write.write_id, receipt)
            log.warning("audit.settled", write=write.write_id, outcome=receipt.outcome.name.lower())
        self._open_writes = ()

    def begin(self, session: CncSession, now_s: float, *, explained: bool) -> OutputMemory | None:
        """Return the memory to begin with at the first contact; None while the echo is vacant.

        `explained`: the CNC holds what the previous run has left there, so what that has recorded is of then.
        """
        assert session.echo is not None and session.sample is not None
        applied_um, resume = session.echo.applied_um, self._resume
        refused = resume.refused or ("" if explained else UNEXPLAINED)
        anew = bool(refused) or self._references.away_s(session.sample) > self._max_outage_s
        undecided = [anew or axis in resume.undecided for axis in self._axes]
        wanted = wanted_at_start(resume.wanted, undecided, applied_um)
        try:
            memory = initial_memory(now_s=now_s, applied_um=applied_um, wanted=wanted, settled=session.echo.settled)
        except ValueError as error:
            self.not_begun = self._journal.alarm = f"{error}: run the guard's initialising program, then acknowledge"
            return None
        self._waiting = frozenset(compress(self._axes, np.logical_and(undecided, wanted)))
        self._journal.say("start", f"{memory.state.value}: {memory.reason}")
        begun = self._references.restart(memory, self._axes, self._model_id, refused=refused)
        self.not_begun = ""
        return begun

    def keep(self, wanted: tuple[bool, ...]) -> None:
        """Keep which axes are switched on for the next start, and on which of them nobody has decided yet."""
        axes = dict(zip(self._axes, wanted, strict=True))
        kept = WantedAxes(axes=axes, undecided=tuple(sorted(self._waiting)))
        if kept != self._kept:
            self._kept = kept
            self._journal.keep(kept)

    def heed(self, request: OperatorRequest) -> OperatorRequest:
        """Take a person's decision on axes that wait; a decision on one leaves the others waiting.

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

    def inhibit(self) -> Inhibit | None:
        """Return for which axes a person must decide first, None when for none."""
        if not self._waiting:
            return None
        axes = " ".join(sorted(self._waiting))
        return Inhibit(
            code=InhibitCode.OUTAGE,
            text="the daemon was away too long or could not write its store, so it does not go on by itself",
            remedy=f"`toolpoint enable {axes}` or `toolpoint disable {axes}`",
        )


SAME = 1e-6
"""Largest difference between a macro as written and as found."""


def _outcome_of(write: OpenWrite, sample: CncSample, echo: Echo, now: Instant) -> Receipt:
    """Return what reading back at the start shows of a write.

    Only the newest can still be found in the CNC; an older one was overwritten by writes that have
    outcomes of their own, or by the newest.
    """
    found = tuple(sample.macros.get(number) for number, _ in write.macros)
    whole = all(
        value is not None and abs(value - written) <= SAME * max(1.0, abs(written))
        for value, (_, written) in zip(found, write.macros, strict=True)
    )
    how = "it arrived whole" if whole else "the CNC holds other values"
    if any(number not in sample.macros for number, _ in write.macros):
        how = "these macros are not polled; whoever owns them writes them anew"
    return Receipt(
        sequence=0,
        macros=write.macros,
        outcome=WriteOutcome.VERIFIED if whole else WriteOutcome.FAILED,
        detail=f"the daemon ended while writing; read back at the start: {how}",
        read_back=found,
        applied_um=echo.applied_um,
        trace=Trace(first_byte=now, last_byte=now, read_back=now),
    )
