"""Checks requests of the NC program, the policy zero_first, an exchange of models, and the end of a reference."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from config.schema.cnc import MacroMapConfig, RequestMacrosConfig
from daemon.simulation.faults.invariants import Claims, Ledger
from daemon.simulation.faults.script import POLICIES, Happening, Incident
from daemon.simulation.faults.state_oracle import HEARTBEAT
from drivers.sim.contract import SimulatedNc
from drivers.sim.faults import FaultKind

ANSWERED_WITHIN_S = 9.0
"""A request has its answer so soon while nothing is wrong; the NC program waits for 10 s [s]."""
ENDED_WITHIN_S = 10.0
"""A reference that the CNC has shown to be over counts no longer so soon [s]."""
TAKEN_UP_AFTER_S = 60.0
"""A model that was released makes the estimates so soon [s] ..."""
WAITS_S = 240.0
"""... or so much later where the daemon says why it waits: a silent sensor counts for two minutes."""
AT_ZERO_UM = 0.06
PROBE, TOOL_CHANGE = 2, 3
CALM_S = 60.0
"""Requests and models are judged when nothing else has happened for so long [s]."""
HAND_S = 15.0
"""A reference by hand is in force so soon after a person has asked for it [s]."""
ENDS_A_REFERENCE = (Incident.POWER_CYCLE, Incident.OTHER_PROGRAM, Incident.WORK_OFFSET)
QUIET = (FaultKind.STUCK_SENSOR, FaultKind.DRIFTING_SENSOR, FaultKind.FLIPPED_BIT, Incident.WRONG_SENSOR)
"""The fault of a single sensor prevents no answer."""
FOUND_K = 3.0
"""A sensor of the watching model that is so far beyond the limit which training gave it must not count [K] ..."""
FOUND_AFTER_S = 900.0
"""... when it has been for so long [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What the NC program asks for."""

    time_s: float
    counter: int
    kind: int
    axis: int
    value_mm: float
    nonsense: bool = False
    """It was made of what is no request."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A probe value that the daemon has taken."""

    answered_s: float
    axis: int
    deviation_um: float


class OperationsWatch:
    """Checks what belongs to normal work and to a person's decisions; told by the campaign."""

    NAMES = (
        "request_answered",
        "nonsense_is_refused",
        "answer_belongs_to_a_request",
        "reference_ends",
        "zero_first_at_zero",
        "model_taken_up",
        "wrong_sensor_left_out",
    )

    def __init__(self, ledger: Ledger, request: RequestMacrosConfig | None, least: float) -> None:
        """`least`: an estimate of less confidence is not followed, and no other model goes on from it."""
        self._ledger = ledger
        self._request = request
        self._least = least
        self._waiting: Request | None = None
        self.latest: Request | None = None
        self._busy_until_s = 0.0
        self._ended: tuple[str, float] | None = None
        self._to_show: Happening | None = None
        self._reference: str | None = None
        self._reference_s = 0.0
        self._asked_by_hand_s = -1e9
        self._by_hand = False
        """No handshake proves that no positioning was missed."""
        self._model_due: tuple[str, float] | None = None
        self.zero_first = False
        self.retreating = False
        """The daemon has seen the retreat block and has set no reference since."""
        self.probes: list[Probe] = []
        self.tool_unnamed = False
        """A tool came, and its name was not taken: the program gave up waiting, as while the link was away."""

    # --- what happens ---------------------------------------------------------------------

    def begun(self, time_s: float, happening: Happening) -> None:
        """Something happens: nothing is judged until it has long been over."""
        if happening.kind not in QUIET:
            self._busy_until_s = max(self._busy_until_s, happening.end_s + CALM_S, time_s + CALM_S)
        if happening.kind is Incident.HAND_REFERENCE:
            self._asked_by_hand_s = time_s
        missed = happening.kind is Incident.MISSED_POSITIONING and self._by_hand
        if happening.kind in ENDS_A_REFERENCE or missed:
            self._to_show = happening
        if happening.kind is Incident.OTHER_POLICY:
            self.zero_first = int(happening.target or 0) % POLICIES == 0

    def ended(self, happening: Happening) -> None:
        """It is over: a program or a work offset that no poll has shown was never there for the daemon."""
        if self._to_show is happening and happening.duration_s > 0 and happening.kind in ENDS_A_REFERENCE:
            self._to_show = None

    def restarted(self, time_s: float) -> None:
        self._busy_until_s = max(self._busy_until_s, time_s + 2 * CALM_S)
        self._ended = self._model_due = self._reference = None
        self._waiting = None
        self.retreating = False

    def died(self, time_s: float) -> None:
        """A daemon has died: what it took in its last moments may not be stored."""
        self.probes = [probe for probe in self.probes if time_s - probe.answered_s > CALM_S]

    def released(self, time_s: float, model_id: str) -> None:
        """Another model was released, and the daemon told so."""
        self._model_due = (model_id, time_s + TAKEN_UP_AFTER_S)

    def asked(self, request: Request) -> None:
        self._waiting = self.latest = request
        self.tool_unnamed |= request.kind == TOOL_CHANGE and not request.nonsense

    def answered(self, time_s: float, value: float) -> str:
        """Take an answer as it is written; return the mark under which the output must not step, '' for none."""
        request, self._waiting = self._waiting, None
        if request is not None and request.nonsense:
            self._ledger.check("nonsense_is_refused", value < 0, f"{time_s:.1f} s: answer {value:g} to {request}")
            return ""
        latest = self.latest
        belongs = latest is not None and abs(round(value)) in (latest.counter, latest.counter - 1)
        what = "" if belongs else f"{time_s:.1f} s: answer {value:g} after {latest}"
        self._ledger.check("answer_belongs_to_a_request", belongs, what)
        if request is not None and request.time_s > self._busy_until_s:
            self._ledger.check("request_answered", True)
        if request is None or value <= 0:
            return ""
        self.tool_unnamed &= request.kind != TOOL_CHANGE
        if request.kind == PROBE:
            self.probes.append(Probe(answered_s=time_s, axis=request.axis, deviation_um=request.value_mm * 1e3))
            return "probe"
        return "tool" if request.kind > PROBE or request.axis else ""

    def polled(self, time_s: float, *, retreat_block: bool) -> None:
        """Take what a poll has shown the daemon: the end of a reference, the program's retreat block."""
        shown, self._to_show = self._to_show, None
        if shown is not None and self._reference is not None and self._ended is None:
            self._ended = (self._reference, time_s)
        if retreat_block and self.zero_first:
            self.retreating = True

    # --- what the daemon says ---------------------------------------------------------------

    def heard(self, time_s: float, claims: Claims, applied_um: Callable[[], Mapping[str, float]]) -> None:
        """Take what the daemon says of itself; `applied_um` tells what the NC applies per axis [um]."""
        if claims.reference != self._reference:
            self._reference = claims.reference
            if claims.reference is not None:
                self._reference_s = time_s
                self._by_hand = time_s - self._asked_by_hand_s <= HAND_S
                if self.zero_first and time_s > self._busy_until_s:
                    most_um = max(map(abs, applied_um().values()), default=0.0)
                    zero = most_um <= AT_ZERO_UM
                    what = "" if zero else f"{time_s:.1f} s: a reference with {most_um:.2f} um applied"
                    self._ledger.check("zero_first_at_zero", zero, what)
                self.retreating = False
        if self._ended is not None and (time_s - self._ended[1] > ENDED_WITHIN_S or claims.reference != self._ended[0]):
            gone = claims.reference != self._ended[0]
            self._ledger.check("reference_ends", gone, "" if gone else f"{time_s:.1f} s: {self._ended[0]} still counts")
            self._ended = None
        if claims.state == "FAULT":
            self._busy_until_s = max(self._busy_until_s, time_s + CALM_S)
        self._judge_request(time_s)

    def round(self, time_s: float, claims: Claims | None) -> None:
        """Look whether a released model makes the estimates; one waits for states and an estimate to go on from."""
        if claims is None or self._model_due is None or time_s < self._model_due[1] or time_s < self._busy_until_s:
            return
        if claims.reference is None or claims.estimate_reference != claims.reference:
            return
        model_id, _ = self._model_due
        taken = claims.model == model_id
        waits = claims.waits and time_s < self._model_due[1] + WAITS_S
        followed = claims.confidence >= self._least and claims.in_domain and not claims.doubtful
        if (waits or not followed) and not taken:
            return
        what = "" if taken else f"{time_s:.1f} s: {claims.model} estimates, {model_id} was released; {claims.waits}"
        self._ledger.check("model_taken_up", taken, what)
        self._model_due = None

    def wrong_sensor(self, time_s: float, happening: Happening, claims: Claims, limit_k: float) -> None:
        """Check that a sensor which has long been wrong, by more than `limit_k`, does not count for the watching model.

        Every reference lets it count again, from what it then says.
        """
        began_s = max(happening.at_s, self._reference_s)
        off_k = abs(happening.amount) * (time_s - began_s) / 3600.0
        far_off_s = began_s + (limit_k + FOUND_K) / abs(happening.amount) * 3600.0
        if claims.reference is None or claims.estimate_reference != claims.reference:
            return  # nothing follows the estimate, which may be one of long ago
        if time_s < max(far_off_s + FOUND_AFTER_S, self._busy_until_s):
            return
        left_out = int(happening.target or 0) in claims.left_out
        what = "" if left_out else f"{time_s:.1f} s: sensor {happening.target} is {off_k:.1f} K off and counts"
        self._ledger.check("wrong_sensor_left_out", left_out, what)

    def _judge_request(self, time_s: float) -> None:
        waiting = self._waiting
        if waiting is None or time_s - waiting.time_s < ANSWERED_WITHIN_S:
            return
        self._waiting = None
        if waiting.time_s > self._busy_until_s:
            self._ledger.check("request_answered", False, f"{time_s:.1f} s: no answer to {waiting}")


SETTLED_S = 120.0
"""Looked at when nothing has happened for so long [s]."""


class HeartbeatWatch:
    """Looks at enable bits and valid_until in the CNC, in the CNC's own time."""

    def __init__(self, macros: MacroMapConfig, ledger: Ledger) -> None:
        self._map = macros
        self._ledger = ledger
        self._disturbed_until_s = 0.0
        self._state = ("", 0.0)

    def disturbed(self, until_s: float) -> None:
        """Something happens until then."""
        self._disturbed_until_s = max(self._disturbed_until_s, until_s)

    def look(self, time_s: float, claims: Claims, nc: SimulatedNc) -> None:
        """Compare the block with the state that the daemon claims, when both have long been what they are."""
        if claims.state != self._state[0]:
            self._state = (claims.state, time_s)
        if time_s - max(self._state[1], self._disturbed_until_s) < SETTLED_S or not claims.link:
            return
        enabled = bool(nc.macros.get(self._map.enable))
        valid = (nc.macros.get(self._map.valid_until) or 0.0) > nc.clock_s
        alive = enabled and valid
        right = alive if claims.state in HEARTBEAT else not alive
        what = "" if right else f"{time_s:.1f} s, {claims.state}: enabled {enabled}, valid {valid}"
        self._ledger.check("heartbeat", right, what)
