"""The reference in force: when it is set, when it ends, and what a restart makes of it."""

import uuid
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from config.schema.compensation import OutputConfig, ReferenceConfig
from daemon.cnc.clock_watch import clocks_differ, power_cycled
from daemon.compensation.handshake import Handshake
from daemon.history.writer import HistoryWriter
from daemon.messages import ReferenceEnded, ReferenceRequest
from drivers.clock import Clock
from models.records import CncRun, CncSample, Instant, Phase, Reference

LONGEST_GAP_REAL_S = 0.5
"""A gap between polls shorter than this is this computer's, not the link's [s of the wall clock]."""
SEEN_PERIOD_REAL_S = 10.0
"""The store is told this often what the CNC said [s of the wall clock]."""
SWITCHED_OFF = "the CNC was switched off and on"
IDLE = (CncRun.RESET, CncRun.STOP)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    """A reference that was asked for and has not come yet."""

    positioning: bool
    """The work was positioned; False: a person asked."""
    handshake: bool


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
        guard_programs: Collection[int] = (),
    ) -> None:
        self._config = reference
        self._safe_sequence_numbers = frozenset(output.safe_sequence_numbers)
        self._clock = clock
        self._history = history
        self._ask = ask
        self._say = say
        self._handshake = handshake
        self._safe_flag = safe_flag
        self._guard_programs = frozenset(guard_programs)
        self._previous: CncSample | None = None
        self._passed = False
        self._retreating = False
        self._asked: dict[str, _Asked] = {}
        self._by_handshake = False
        self._seen_before: dict[str, Any] | None = history.get_state("cnc_seen")
        self._seen_real_s = float("-inf")
        self.outcomes: dict[str, str] = {}
        """What became of the references that were asked for: '' in force, else why not."""
        self.current: Reference | None = None
        self.kept: Reference | None = None
        """The reference in force or, when it has ended, the one that tool settings still count from."""
        self.phase = Phase.CUTTING

    @property
    def zero_first(self) -> bool:
        """The offset is to be taken out before the next positioning."""
        return self._config.policy == "zero_first" and self._retreating

    @property
    def sample(self) -> CncSample | None:
        """The latest poll, with the part program's block while a program of the guard runs."""
        return self._previous

    def follow(self, polled: CncSample) -> None:
        """Take one poll of the CNC: a positioning may have passed, or the reference have ended."""
        previous, sample = self._previous, self._of_part_program(polled)
        self._previous = sample
        self.phase = phase_of(sample, self._safe_sequence_numbers, self._safe_flag)
        self._remember(sample)
        self._retreat_block(sample)
        cycled = self.kept is not None and self._cycled(self.kept, previous, sample)
        if self.current is not None and (ended := self._end(self.current, previous, sample)):
            self.end(ended, for_good=cycled)
        elif cycled:
            self.end(SWITCHED_OFF, for_good=True)
        if positioning_passed(previous, sample, self._config.program, self._config.sequence_numbers):
            self._passed = True
            self.ask_for(f"O{sample.program} N{sample.sequence_number}", sample, positioning=True)

    def ask_for(self, source: str, sample: CncSample, *, positioning: bool, handshake: bool = False) -> str:
        """Ask the thermal task for a reference now; return its identity."""
        identity = uuid.uuid4().hex[:12]
        self._asked[identity] = _Asked(positioning=positioning, handshake=handshake)
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
        """Take a reference into force; return why it is refused, '' when it holds."""
        asked = self._asked.pop(reference.reference_id, None)
        if refusal := self._objection(reference, asked, applied_um):
            self._refuse(reference.reference_id, asked, refusal)
            return refusal
        self._retreating = False
        self.current = self.kept = reference
        self._by_handshake = asked is not None and asked.handshake
        self.outcomes = {reference.reference_id: ""}
        self._history.reference(reference)
        self.keep()
        self._say("reference", f"set by {reference.source}")
        return ""

    def refused(self, reference_id: str, why: str) -> None:
        """The thermal task cannot set a reference that was asked for; work that was positioned has none then."""
        self._refuse(reference_id, self._asked.pop(reference_id, None), why)

    def forget(self, reference_id: str) -> None:
        """Nobody waits for this reference any more."""
        self._asked.pop(reference_id, None)

    def rebase(self, reference: Reference) -> None:
        """Keep the reference whose temperatures of returned sensors were set anew."""
        if self.kept is None or reference.reference_id != self.kept.reference_id:
            return
        self.kept = reference
        if self.current is not None:
            self.current = reference
        self.keep()

    def away_s(self, sample: CncSample) -> float:
        """Return how long before this poll the previous run of the daemon last polled the CNC [s]; inf: never."""
        seen = self._seen_before
        return float("inf") if seen is None else float(sample.time.utc_s - seen["utc_s"])

    def take_up(self, reference: Reference) -> str:
        """Return why a reference of the previous run no longer holds, '' when it is in force again."""
        assert self._previous is not None
        stored = self._history.get_state("reference") or {}
        ended = end_of_reference(reference, self._previous) or self._away(self._previous, stored)
        if ended:
            self._history.put_state("reference", None)
            return ended
        self.current = self.kept = reference
        self._by_handshake = bool(stored.get("by_handshake"))
        return ""

    def take_up_tools(self, reference: Reference) -> str:
        """Return why tool settings of the previous run no longer count, '' when they do, valid reference or not."""
        assert self._previous is not None
        cycled = reference.power_on_count != self._previous.power_on_count
        if why := SWITCHED_OFF if cycled else self._unseen(self._previous):
            return why
        self.kept = reference
        self.keep()
        return ""

    def keep(self) -> None:
        """Hand the reference in force to the store, with what tells that the NC program went on without a break.

        One that has ended is kept apart, for the tool settings.
        """
        self._history.put_state("kept_reference", None if self.kept is None else reference_to_state(self.kept))
        if self.current is None:
            self._history.put_state("reference", None)
            return
        counts = {"request_counter": self._handshake.counter, "by_handshake": self._by_handshake}
        self._history.put_state("reference", reference_to_state(self.current) | counts)

    def end(self, why: str, *, for_good: bool = False) -> None:
        """End the reference in force, and what was asked for before; `for_good`: the tool settings with it."""
        self._asked.clear()
        if self.current is not None:
            self._say("notice", f"reference ended: {why}")
        elif not (for_good and self.kept is not None):
            return
        if self.kept is not None:
            self._ask(ReferenceEnded(reference_id=self.kept.reference_id, for_good=for_good))
        self.current = None
        self.kept = None if for_good else self.kept
        self.keep()

    def _objection(self, reference: Reference, asked: _Asked | None, applied_um: float) -> str:
        what = f"reference of {reference.source} refused"
        if asked is None:
            return f"{what}: nobody waits for it any more"
        if self._config.policy == "zero_first" and applied_um > 0.0:
            return (
                f"{what}: the policy is zero_first and {applied_um:.1f} um are still applied; let the program wait at "
                "its retreat block until the offset is out"
            )
        if self._previous is not None and (ended := end_of_reference(reference, self._previous)):
            return f"{what}: meanwhile {ended}"
        return ""

    def _refuse(self, reference_id: str, asked: _Asked | None, why: str) -> None:
        self.outcomes = {reference_id: why}
        self._ask(ReferenceEnded(reference_id=reference_id))
        if asked is not None and asked.positioning:
            self.end(f"the work was positioned again, and that set none ({why})")
        if self.kept is not None:
            self._ask(self.kept)

    def _of_part_program(self, polled: CncSample) -> CncSample:
        """Return a poll as the part program stands in it: the guard's own programs are no other program."""
        if self._previous is None or polled.program not in self._guard_programs:
            return polled
        return replace(polled, program=self._previous.program, sequence_number=self._previous.sequence_number)

    def _remember(self, sample: CncSample) -> None:
        if sample.time.real_s - self._seen_real_s < SEEN_PERIOD_REAL_S:
            return
        self._seen_real_s = sample.time.real_s
        seen = {"utc_s": sample.time.utc_s, "clock_s": sample.clock_s, "sequence_number": sample.sequence_number}
        self._history.put_state("cnc_seen", seen | {"idle": sample.run in IDLE})

    def _retreat_block(self, sample: CncSample) -> None:
        """Under zero_first, the retreat block ends what there is and takes the offset out, reference or not."""
        if self._config.policy != "zero_first" or sample.run is not CncRun.START:
            return
        of_program = self._config.program in (None, sample.program)
        if of_program and sample.sequence_number in self._config.retreat_sequence_numbers and not self._retreating:
            self._retreating = True
            self.end(f"N{sample.sequence_number} takes the offset out before the next positioning")

    def _end(self, reference: Reference, previous: CncSample | None, sample: CncSample) -> str:
        if ended := end_of_reference(reference, sample):
            return ended
        if power_cycled(previous, sample):
            return "the CNC's clock went back: it was switched off and on"
        return self._missed(previous, sample)

    @staticmethod
    def _cycled(reference: Reference, previous: CncSample | None, sample: CncSample) -> bool:
        return sample.power_on_count != reference.power_on_count or power_cycled(previous, sample)

    def _missed(self, previous: CncSample | None, sample: CncSample) -> str:
        """Return why a positioning may have been missed between two polls, '' when none can have been."""
        if previous is None:
            return ""
        gap_s = sample.time.monotonic_s - previous.time.monotonic_s
        if gap_s <= LONGEST_GAP_REAL_S * self._clock.speed:
            return ""
        return self._may_be_missed(gap_s, previous.run in IDLE, previous.sequence_number, sample, self._by_handshake)

    def _may_be_missed(
        self, gap_s: float, idle_before: bool, sequence_before: int, sample: CncSample, by_handshake: bool
    ) -> str:
        if gap_s <= self._config.max_gap_s or not self._config.sequence_numbers or by_handshake:
            return ""
        stood = idle_before and sample.run in IDLE and sample.sequence_number == sequence_before
        if stood or (self._config.program is not None and sample.program != self._config.program):
            return ""
        return (
            f"the CNC could not be polled for {gap_s:.0f} s while the program ran, so a positioning may have been "
            "missed; pass the positioning again or set the reference by hand (`toolpoint reference`)"
        )

    def _away(self, sample: CncSample, stored: dict[str, Any]) -> str:
        """Return what may have happened while nobody polled the CNC that ends a stored reference."""
        if unseen := self._unseen(sample):
            return unseen
        seen, away_s = self._seen_before, self.away_s(sample)
        assert seen is not None
        if stored.get("request_counter") != self._handshake.counter:
            return "the NC program asked for something while the daemon was away"
        by_handshake = bool(stored.get("by_handshake"))
        return self._may_be_missed(away_s, seen["idle"], seen["sequence_number"], sample, by_handshake)

    def _unseen(self, sample: CncSample) -> str:
        """Return why nothing is known of the control while nobody polled it, '' when it has just gone on."""
        seen, away_s = self._seen_before, self.away_s(sample)
        if seen is None or away_s > self._config.max_outage_s:
            return f"the CNC was not polled for longer than {self._config.max_outage_s:g} s (reference.max_outage_s)"
        if clocks_differ(sample.clock_s - seen["clock_s"], away_s):
            return (
                "the CNC's clock and this computer's calendar went on differently while the daemon was away: the "
                "control was switched off and on, or a clock was set"
            )
        return ""


def reference_to_state(reference: Reference) -> dict[str, Any]:
    """Return a reference as JSON for the store."""
    return {
        "reference_id": reference.reference_id,
        "utc_s": reference.time.utc_s,
        "source": reference.source,
        "degc": [None if np.isnan(value) else float(value) for value in reference.degc],
        "program": reference.program,
        "work_offset": reference.work_offset,
        "power_on_count": reference.power_on_count,
    }


def reference_from_state(state: dict[str, Any], clock: Clock) -> Reference:
    """Return a stored reference; its age is carried over by the calendar clock."""
    now = clock.now()
    age_s = now.utc_s - state["utc_s"]
    return Reference(
        reference_id=state["reference_id"],
        time=Instant(monotonic_s=now.monotonic_s - age_s, utc_s=state["utc_s"], real_s=now.real_s - age_s),
        source=state["source"],
        degc=np.array([np.nan if value is None else value for value in state["degc"]]),
        program=state["program"],
        work_offset=state["work_offset"],
        power_on_count=state["power_on_count"],
    )


def phase_of(sample: CncSample, safe_sequence_numbers: Collection[int], safe_flag: int | None = None) -> Phase:
    """Return what the machine is doing; everything that is not known to be harmless is cutting."""
    if sample.run in (CncRun.RESET, CncRun.STOP):
        return Phase.IDLE
    flagged = safe_flag is not None and sample.macros.get(safe_flag) == 1.0
    if sample.run is CncRun.START and (flagged or sample.sequence_number in safe_sequence_numbers):
        return Phase.SAFE_POINT
    return Phase.CUTTING


def positioning_passed(
    previous: CncSample | None, sample: CncSample, program: int | None, sequence_numbers: Collection[int]
) -> bool:
    """Whether the program has reached a positioning block since the previous sample."""
    if sample.sequence_number not in sequence_numbers or sample.run is not CncRun.START:
        return False
    if program is not None and sample.program != program:
        return False
    if previous is None:
        return False
    if previous.run in (CncRun.RESET, CncRun.STOP):
        return True
    return (previous.program, previous.sequence_number) != (sample.program, sample.sequence_number)


def end_of_reference(reference: Reference, sample: CncSample) -> str:
    """Return why a reference no longer holds, '' while it does."""
    if sample.power_on_count != reference.power_on_count:
        return "the CNC was switched off and on"
    if sample.work_offset != reference.work_offset:
        return f"the work offset changed from {reference.work_offset} to {sample.work_offset}"
    if sample.program != reference.program:
        return f"the program changed from O{reference.program} to O{sample.program}"
    return ""
