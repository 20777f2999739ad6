"""The reference in force: when it is set, when it ends, and what a restart makes of it."""

import uuid
from collections.abc import Callable

import structlog

from config.schema.compensation import OutputConfig, ReferenceConfig
from daemon.history.writer import HistoryWriter
from daemon.output.handshake import Handshake
from daemon.output.reference_watch import (
    clock_restarted,
    end_of_reference,
    phase_of,
    positioning_passed,
    power_cycled,
)
from daemon.output.resume import reference_to_state
from daemon.thermal import ReferenceEnded, ReferenceRequest
from drivers.clock import Clock
from models.records import CncRun, CncSample, Phase, Reference

log = structlog.get_logger(__name__)

LONGEST_GAP_REAL_S = 0.5
"""A gap between polls shorter than this is this computer's, not the link's [s of the wall clock]."""
IDLE = (CncRun.RESET, CncRun.STOP)


class References:
    """Follows the program from poll to poll; owned by the control task."""

    def __init__(
        self,
        reference: ReferenceConfig,
        output: OutputConfig,
        clock: Clock,
        history: HistoryWriter,
        ask: Callable[[ReferenceRequest | ReferenceEnded | Reference], None],
        say: Callable[[str, str], None],
        handshake: Handshake,
        safe_flag: int | None,
    ) -> None:
        self._config = reference
        self._safe_sequence_numbers = frozenset(output.safe_sequence_numbers)
        self._clock = clock
        self._history = history
        self._ask = ask
        self._say = say
        self._handshake = handshake
        self._safe_flag = safe_flag
        self._previous: CncSample | None = None
        self._passed = False
        self._retreating = False
        self.current: Reference | None = None
        self.phase = Phase.CUTTING

    @property
    def zero_first(self) -> bool:
        """The offset is to be taken out before the next positioning."""
        return self._config.policy == "zero_first" and self._retreating

    def follow(self, sample: CncSample) -> None:
        """Take one poll of the CNC: a positioning may have passed, or the reference have ended."""
        previous, self._previous = self._previous, sample
        self.phase = phase_of(sample, self._safe_sequence_numbers, self._safe_flag)
        if self.current is not None and (ended := self._end(self.current, previous, sample)):
            self.end(ended)
        numbers = self._config.sequence_numbers
        if positioning_passed(previous, sample, self._config.program, numbers):
            self._passed = True
            self.ask_for(f"O{sample.program} N{sample.sequence_number}", sample)

    def ask_for(self, source: str, sample: CncSample) -> str:
        """Ask the thermal task for a reference now; return its identity."""
        identity = uuid.uuid4().hex[:12]
        self._ask(
            ReferenceRequest(
                reference_id=identity,
                source=source,
                program=sample.program,
                work_offset=sample.work_offset,
                power_on_count=sample.power_on_count,
            )
        )
        return identity

    def handshake_positioned(self) -> None:
        """The handshake reports a positioning: say so when polling has not seen it pass."""
        if self._config.sequence_numbers and not self._passed:
            self._say("notice", "the handshake reports a positioning whose sequence number passed between two polls")
        self._passed = False

    def adopt(self, reference: Reference, applied_um: float) -> str:
        """Take a reference into force; return why the policy refuses it, '' when it holds."""
        if self._config.policy == "zero_first" and applied_um > 0.0:
            self._retreating = True
            return (
                f"reference of {reference.source} refused: the policy is zero_first and {applied_um:.1f} um are still "
                "applied; let the program wait at its retreat block until the offset is out"
            )
        if self._previous is not None and (ended := end_of_reference(reference, self._previous)):
            return f"reference of {reference.source} refused: meanwhile {ended}"
        self._retreating = False
        self.current = reference
        self._history.reference(reference)
        self.keep()
        self._say("reference", f"set by {reference.source}")
        return ""

    def rebase(self, reference: Reference) -> None:
        """Keep the reference whose temperatures of returned sensors were set anew."""
        if self.current is not None and reference.reference_id == self.current.reference_id:
            self.current = reference
            self.keep()

    def take_up(self, reference: Reference, sample: CncSample) -> str:
        """Return why a reference of the previous run no longer holds, '' when it is in force again."""
        ended = end_of_reference(reference, sample)
        stored = self._history.get_state("reference") or {}
        elapsed_s = sample.time.utc_s - stored.get("cnc_seen_utc_s", sample.time.utc_s)
        clock_s = stored.get("cnc_clock_s")
        if not ended and clock_s is not None and clock_restarted(sample.clock_s - clock_s, elapsed_s):
            ended = "the CNC's clock shows that it was switched off and on while the daemon was away"
        if not ended and stored.get("request_counter") != self._handshake.counter:
            ended = "the NC program asked for something while the daemon was away"
        if not ended:
            self.current = reference
        return ended

    def keep(self) -> None:
        """Hand the reference in force to the store, with what tells that the CNC went on without a break."""
        if self.current is None:
            self._history.put_state("reference", None)
            return
        state = reference_to_state(self.current)
        if self._previous is not None:
            state |= {"cnc_clock_s": self._previous.clock_s, "cnc_seen_utc_s": self._previous.time.utc_s}
        self._history.put_state("reference", state | {"request_counter": self._handshake.counter})

    def end(self, why: str) -> None:
        """End the reference in force."""
        if self.current is not None:
            self._say("notice", f"reference ended: {why}")
            self._ask(ReferenceEnded(reference_id=self.current.reference_id))
            self.current = None
            self.keep()

    def _end(self, reference: Reference, previous: CncSample | None, sample: CncSample) -> str:
        if ended := end_of_reference(reference, sample):
            return ended
        if power_cycled(previous, sample):
            return "the CNC's clock went back: it was switched off and on"
        if self._config.policy == "zero_first" and sample.sequence_number in self._config.retreat_sequence_numbers:
            self._retreating = True
            return f"N{sample.sequence_number} takes the offset out before the next positioning"
        return self._missed(previous, sample)

    def _missed(self, previous: CncSample | None, sample: CncSample) -> str:
        """Return why a positioning may have been missed between two polls, '' when none can have been."""
        if previous is None or not self._config.sequence_numbers or self._handshake.in_use:
            return ""
        gap_s = sample.time.monotonic_s - previous.time.monotonic_s
        if gap_s <= max(self._config.max_gap_s, LONGEST_GAP_REAL_S * self._clock.speed):
            return ""
        stood = previous.run in IDLE and sample.run in IDLE and sample.sequence_number == previous.sequence_number
        if stood or (self._config.program is not None and sample.program != self._config.program):
            return ""
        return (
            f"the CNC could not be polled for {gap_s:.0f} s while the program ran, so a positioning may have been "
            "missed; pass the positioning again or set the reference by hand (`toolpoint reference`)"
        )
