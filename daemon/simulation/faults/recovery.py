"""Checks whether the output returns to the state that the table gives, and how soon.

After every incident the situation is worked out from the machine's side, and the specification's table (`state_oracle`)
is followed from the state that the daemon then claimed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from daemon.simulation.faults.invariants import Claims, Ledger
from daemon.simulation.faults.script import RESTARTS, Happening, Incident
from daemon.simulation.faults.state_oracle import Situation, resting_state
from drivers.latsis.line_pass import RELEASED_AFTER_CYCLES
from drivers.sim.faults import FaultKind

STAYING = frozenset({"ACTIVE", "HOLD"})
"""States in which a cut freezes the weight of the estimate."""
FOUND_LATER, NAMED_ANOTHER = "found wrong later", "the NC program has named"
"""What the reason says of what was measured with a sensor that was wrong."""
WITHIN_S = 15.0
"""The state must be right so soon after the first good input [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the machine's side knows."""

    reachable: bool
    """The CNC answers and may be written to."""
    temperatures: bool
    """Temperatures arrive."""
    distrust: bool
    """The daemon has been shown something that it must not trust, and no person has acknowledged since."""
    echo_known: bool
    at_zero: bool
    zero_first: bool = False
    """The NC program has passed its retreat block and not been positioned since, under that policy."""
    reference_blind: bool = False
    """Lines were disturbed when the reference was set or the tool came, so that labels may count from nothing."""
    model_has_states: bool = False
    """The model needs hours of history; it may still say that it has too little."""
    sensor_was_wrong: bool = False
    """A sensor has been stuck or drifted since the reference, so that the estimate may really do harm."""
    measured_unsurely: bool = False
    """A sensor has been wrong in this campaign, or the work positioned while the estimate was not followed: what was
    measured before may be off."""
    tool_unnamed: bool = False
    """The NC program gave up naming the tool that came, while the daemon could not answer."""
    frozen_in_cut: bool = False
    """The work is being cut, and confidence is less than what the estimate was weighed with before the cut."""


class CutFreeze:
    """Tells when confidence that falls below `full_confidence` must freeze an output: within a cut."""

    def __init__(self, full_confidence: float) -> None:
        self._full = full_confidence
        self._weighed = 0.0

    def look(self, claims: Claims, least_confidence: float, *, cutting: bool) -> bool:
        """Return whether the output must stay where it is; `cutting`: neither idle nor at a safe point."""
        confidence = min(claims.confidence, self._full)
        if cutting and claims.state in STAYING:
            return confidence < self._weighed
        if confidence >= least_confidence:
            self._weighed = confidence
        return False


def ready(truth: Truth, claims: Claims, least_confidence: float) -> bool:
    """Tell whether the output may follow the estimate."""
    return (
        truth.reachable
        and truth.temperatures
        and truth.echo_known
        and claims.reference is not None
        and claims.estimate_reference == claims.reference
        and claims.confidence >= least_confidence
        and claims.in_domain
        and (claims.estimated or not truth.reference_blind)
        and not (claims.doubtful and truth.model_has_states)
        and not (claims.harmful and truth.sensor_was_wrong)
        and not (FOUND_LATER in claims.reason and truth.measured_unsurely)
        and not (NAMED_ANOTHER in claims.reason and truth.tool_unnamed)
        and not truth.frozen_in_cut
    )


def where_it_leads(state: str, truth: Truth, claims: Claims, least_confidence: float) -> str:
    """Return where the table of states leads from a state; what only time brings about is left out."""
    now = Situation(
        asked_for=any(claims.wanted),
        trusted=not truth.distrust,
        zero_first=truth.zero_first,
        connected=truth.reachable and truth.echo_known,
        at_zero=truth.at_zero,
        can_follow=ready(truth, claims, least_confidence),
    )
    return resting_state(state, now)


class GoodInput:
    """What must arrive after an incident before the output can be right again.

    After one on a line a whole cycle of that line, after one on all lines a whole cycle of each, after a start of the
    daemon a cycle and a poll, and else a poll that the CNC answers. The third cycle, when the nodes were counted anew,
    and as many as a value after a gap takes, when the line was silent for so long: before, it is not believed.
    """

    def __init__(self, lines: Sequence[str], *, stale_after_s: float = 60.0, release_after_samples: int = 3) -> None:
        self._lines = frozenset(lines)
        self._stale_after_s = stale_after_s
        self._release_after_samples = release_after_samples
        self._cycles: dict[str, int] = {}
        self._any_line = False
        self._cnc = False

    @property
    def there(self) -> bool:
        return not (self._cycles or self._any_line or self._cnc)

    def after(self, happening: Happening) -> None:
        kind = happening.kind
        if happening.target in self._lines:
            believed = self._release_after_samples if happening.duration_s > self._stale_after_s else 1
            counted = kind is FaultKind.RENUMBERED or (kind is FaultKind.DEAD_LINE and happening.amount > 0)
            line = str(happening.target)
            awaited = RELEASED_AFTER_CYCLES + believed - 1 if counted else believed
            self._cycles[line] = max(self._cycles.get(line, 0), awaited)
            return
        if kind in RESTARTS:
            self._any_line = True
        if kind in (Incident.BLIND, Incident.CORRUPT_RETURN, Incident.CORRUPT_START):  # longer than values are held
            for line in self._lines:
                self._cycles[line] = max(self._cycles.get(line, 0), self._release_after_samples)
        self._cnc |= kind not in (Incident.BLIND, Incident.CORRUPT_RETURN)

    def cycle(self, line: str) -> None:
        """A line sent a whole, undisturbed cycle."""
        self._any_line = False
        if line in self._cycles:
            self._cycles[line] -= 1
            if self._cycles[line] <= 0:
                del self._cycles[line]

    def cnc(self) -> None:
        self._cnc = False


@dataclass(slots=True)
class _Case:
    """One incident, or several that met."""

    kinds: set[str]
    good_s: float | None = None
    state_then: str = ""
    asked_for: bool = False
    last_state: str = ""
    wrong_since_s: float | None = None
    took_s: float = 0.0


@dataclass(slots=True)
class RecoveryWatch:
    """Judges one case after the other; a new incident before the judgement joins the case."""

    ledger: Ledger
    least_confidence: float
    times_s: dict[str, list[float]] = field(default_factory=dict)
    _case: _Case | None = None

    def begun(self, kind: str) -> None:
        """Something happens: a case that is not judged yet is put off."""
        self._case = None

    def over(self, kinds: set[str]) -> None:
        """Everything that was going on has ended."""
        self._case = _Case(kinds=kinds)

    @property
    def waiting(self) -> bool:
        """The first good input of a case is awaited."""
        return self._case is not None and self._case.good_s is None

    @property
    def open(self) -> bool:
        """A case waits for its judgement."""
        return self._case is not None and self._case.good_s is not None

    def good_input(self, time_s: float, claims: Claims) -> None:
        """The first good input after the case has arrived."""
        if self._case is not None and self._case.good_s is None:
            self._case.good_s = time_s
            self._case.state_then = self._case.last_state = claims.state
            self._case.asked_for = any(claims.wanted)

    def left_fault(self, time_s: float, *, acknowledged: bool) -> None:
        """FAULT has been left: only a person may have done that; it leads to HOLD, and the way back begins anew."""
        self.ledger.check("fault_is_latched", acknowledged, f"{time_s:.1f} s: FAULT was left, not acknowledged")
        if self._case is not None and self._case.good_s is not None:
            self._case.state_then = "HOLD"
            self._case.good_s, self._case.wrong_since_s = time_s, None

    def look(self, time_s: float, truth: Truth, claims: Claims) -> None:
        """Compare the claimed state with where the table leads; judge when the time to get there is over."""
        case = self._case
        if case is None or case.good_s is None:
            return
        if any(claims.wanted) != case.asked_for:  # switched on or off since: the way begins anew from where it then was
            case.asked_for, case.state_then = not case.asked_for, case.last_state
        case.last_state = claims.state
        from_then = where_it_leads(case.state_then, truth, claims, self.least_confidence)
        from_now = where_it_leads(claims.state, truth, claims, self.least_confidence)
        if _same(claims.state, from_now) and _same(from_now, from_then):
            case.wrong_since_s = None
            if time_s - case.good_s < WITHIN_S:
                return
            self._judge(case, True)
            return
        if case.wrong_since_s is None:
            case.wrong_since_s = time_s
        case.took_s = time_s - case.good_s
        if time_s - case.wrong_since_s > WITHIN_S:
            what = f"{time_s:.1f} s after {'+'.join(sorted(case.kinds))}: {claims.state} ({claims.reason}), "
            self._judge(case, False, f"{what}the table leads from {case.state_then} to {from_then}; {truth}; {claims}")

    def _judge(self, case: _Case, right: bool, what: str = "") -> None:
        """Count a case that is over: right for as long as it was watched, or wrong for too long."""
        self.ledger.check("state_after_fault", right, what)
        for kind in case.kinds:
            self.times_s.setdefault(kind, []).append(case.took_s)
        self._case = None


def _same(first: str, second: str) -> bool:
    """Tell whether two states are one; a retreat takes the time that the slew rate and the safe points give it."""
    return first == second or {first, second} == {"RETREAT", "OFF"}
