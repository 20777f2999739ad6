"""Whether the output comes back to the state that its table gives, and how soon.

After every incident the conditions of the table are worked out from what the machine's side knows to be
true, and the table is followed from the state that the daemon then claimed. That is where it must be
within some seconds of the first good input.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from daemon.rehearsal.invariants import Claims, Ledger
from drivers.latsis_numbering import RELEASED_AFTER_CYCLES
from drivers.sim.campaign_script import Happening
from drivers.sim.faults import FaultKind
from models.compensation import TRANSITIONS, Condition
from models.records import OutputState

WITHIN_S = 15.0
"""The state must be right so soon after the first good input [s]."""
LONGEST_WALK = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What the machine's side knows."""

    reachable: bool
    """The CNC answers and may be written to."""
    temperatures: bool
    """Temperatures arrive."""
    distrust: bool
    """The daemon has been shown something that it must not trust, and nobody has acknowledged since."""
    echo_known: bool
    at_zero: bool
    """The NC applies nothing."""


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
    )


def where_it_leads(
    state: str,
    truth: Truth,
    claims: Claims,
    least_confidence: float,
    table: Mapping[OutputState, tuple[tuple[Condition, OutputState], ...]] = TRANSITIONS,
) -> str:
    """Follow the table from a state until nothing leaves it; conditions that only time fulfils are left out."""
    wanted = any(claims.wanted)
    good = ready(truth, claims, least_confidence)
    holds = {
        Condition.OUTPUT_FAULT: truth.distrust,
        Condition.WANTED: wanted and truth.reachable and truth.echo_known,
        Condition.NONE_WANTED: not wanted,
        Condition.READY: wanted and good,
        Condition.BAD_INPUT: not good,
        Condition.HELD_TOO_LONG: False,
        Condition.RETREATED: truth.reachable and truth.at_zero,
        Condition.ACKNOWLEDGED: False,
    }
    here = OutputState(state)
    for _ in range(LONGEST_WALK):
        target = next((target for condition, target in table[here] if holds.get(condition, False)), None)
        if target is None:
            break
        here = target
    return here.value


class GoodInput:
    """What must arrive after an incident before the output can be right again.

    A poll that the CNC answers, and a whole cycle: of the line that was disturbed, or of any line. A line whose
    nodes were counted anew is believed again only after some whole cycles.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        self._lines = frozenset(lines)
        self._cycles: dict[str, int] = {}
        self._any_line = False
        self._cnc = False

    @property
    def there(self) -> bool:
        """All of it has arrived."""
        return not (self._cycles or self._any_line or self._cnc)

    def after(self, happening: Happening) -> None:
        """An incident is over."""
        self._cnc = True
        if happening.target not in self._lines:
            self._any_line = not self._cycles
            return
        counted = happening.kind is FaultKind.RENUMBERED or (
            happening.kind is FaultKind.DEAD_LINE and happening.amount > 0
        )
        line = str(happening.target)
        self._cycles[line] = max(self._cycles.get(line, 0), RELEASED_AFTER_CYCLES if counted else 1)
        self._any_line = False

    def cycle(self, line: str) -> None:
        """A line was heard whole and undisturbed."""
        self._any_line = False
        if line in self._cycles:
            self._cycles[line] -= 1
            if self._cycles[line] <= 0:
                del self._cycles[line]

    def cnc(self) -> None:
        """The CNC has answered a poll."""
        self._cnc = False


@dataclass(slots=True)
class _Case:
    """One incident, or several that met."""

    kinds: set[str]
    ended_s: float
    good_s: float | None = None
    state_then: str = ""


@dataclass(slots=True)
class RecoveryWatch:
    """Judges one case after the other; a new incident before the judgement joins the case."""

    ledger: Ledger
    least_confidence: float
    times_s: dict[str, list[float]] = field(default_factory=dict)
    disturbed: int = 0
    """Cases that a person or a new incident interrupted before they could be judged."""
    _case: _Case | None = None

    def begun(self, kind: str) -> None:
        """Something happens: a case that is not judged yet is put off."""
        if self._case is not None:
            self.disturbed += 1
        self._case = None

    def over(self, time_s: float, kinds: set[str]) -> None:
        """Everything that was going on has ended."""
        self._case = _Case(kinds=kinds, ended_s=time_s)

    @property
    def waiting_since_s(self) -> float | None:
        """When the incidents of the open case ended, while its first good input is awaited."""
        return self._case.ended_s if self._case is not None and self._case.good_s is None else None

    @property
    def open(self) -> bool:
        """A case waits for its judgement."""
        return self._case is not None and self._case.good_s is not None

    def good_input(self, time_s: float, claims: Claims) -> None:
        """The first good input after the case has arrived."""
        if self._case is not None and self._case.good_s is None:
            self._case.good_s = time_s
            self._case.state_then = claims.state

    def look(self, time_s: float, truth: Truth, claims: Claims) -> None:
        """Compare the claimed state with where the table leads; judge when they agree or time is over."""
        case = self._case
        if case is None or case.good_s is None:
            return
        from_then = where_it_leads(case.state_then, truth, claims, self.least_confidence)
        from_now = where_it_leads(claims.state, truth, claims, self.least_confidence)
        took_s = time_s - case.good_s
        agrees = _same(claims.state, from_now) and _same(from_now, from_then)
        if not agrees and took_s <= WITHIN_S:
            return
        self.ledger.check(
            "state_after_fault",
            agrees,
            f"{time_s:.1f} s after {'+'.join(sorted(case.kinds))}: {claims.state} ({claims.reason}), "
            f"the table leads from {case.state_then} to {from_then}; {truth}; {claims}",
        )
        for kind in case.kinds:
            self.times_s.setdefault(kind, []).append(took_s)
        self._case = None


def _same(first: str, second: str) -> bool:
    """Tell whether two states are one; a retreat takes the time that the slew rate and the safe points give it."""
    return first == second or {first, second} == {OutputState.RETREAT.value, OutputState.OFF.value}
