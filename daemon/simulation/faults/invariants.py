"""Checks from the machine's side what must hold of a daemon whatever happens, by arithmetic of its own.

The daemon's claims are used only where the sentence speaks of them, as in "nothing is written in FAULT".
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from config.schema import Configuration
from config.schema.cnc import MacroMapConfig

SLACK_UM = 0.06
"""What rounding in the macros, and a value applied a moment ago, may add [um]."""
GO_ON = ("switching", "model", "tool", "probe")
"""At these what is written begins where it was, or where the tool is."""
LATE_S = 15.0
"""A limit in time is kept to within this [s]."""
EXAMPLES = 5
"""So many violations of each invariant are described."""


@dataclass(slots=True)
class Count:
    """How often an invariant was checked and violated."""

    checked: int = 0
    violated: int = 0
    examples: list[str] = field(default_factory=list)


class Ledger:
    """Counts per invariant."""

    def __init__(self, names: Sequence[str] = (), tell: Callable[[str], None] = lambda _: None) -> None:
        """Begin with these names; `tell` gets the first violations of each as they are found."""
        self.counts: dict[str, Count] = {name: Count() for name in names}
        self._tell = tell

    def check(self, name: str, holds: bool, what: str = "") -> None:
        """Count one check; `what` describes the violation."""
        count = self.counts.setdefault(name, Count())
        count.checked += 1
        if not holds:
            count.violated += 1
            if len(count.examples) < EXAMPLES:
                count.examples.append(what)
                self._tell(f"{name}: {what}")

    @property
    def violations(self) -> int:
        return sum(count.violated for count in self.counts.values())


@dataclass(frozen=True, slots=True)
class Claims:
    """What the daemon says of itself, in the order of `daemon.simulation.faults.daemon`'s messages."""

    state: str
    wanted: tuple[bool, ...]
    reference: str | None
    link: bool
    confidence: float
    in_domain: bool
    estimate_reference: str | None
    reason: str
    estimated: bool = True
    """Every axis that is switched on has an estimate."""
    model: str | None = None
    doubtful: bool = False
    """The model says that something stands against following it."""
    harmful: bool = False
    """Measurements show that the estimate does harm."""
    left_out: tuple[int, ...] = ()
    """Sensors that the estimate imputes."""
    tools: tuple[int, ...] = ()
    """Tools whose settings count."""
    waits: str = ""
    """Why a released model makes no estimates yet, '' when none waits."""
    fault: int = 0
    """Number of the newest FAULT."""


class WriteWatch:
    """Checks every group of macro variables that reaches the CNC, and every movement of the tool."""

    NAMES = (
        "allow_list",
        "block_order",
        "finite",
        "bound_written",
        "slew_written",
        "nothing_written_in_fault",
        "nothing_written_without_link",
        "hold_freezes",
        "no_step_at_reference",
        "no_step_at_switching",
        "no_step_at_restart",
        "no_step_at_model",
        "no_step_at_tool",
        "no_step_at_probe",
        "hold_is_left",
        "bound_applied",
        "step_applied",
        "no_motion_in_cut",
        "no_motion_on_bad_input",
    )

    def __init__(self, configuration: Configuration, ledger: Ledger) -> None:
        self._ledger = ledger
        self._map: MacroMapConfig = configuration.cnc.macros
        self._allowed = frozenset(self._map.allowed)
        self._axes = configuration.compensation.axes
        self._axis_of = {number: axis for axis, number in self._map.values.items()}
        self._content = {*self._axis_of, self._map.valid_until, self._map.enable, self._map.check} - {None}
        self._bad_after_s = configuration.compensation.output.stale_after_s
        self._hold_limit_s = configuration.compensation.output.hold_limit_s
        self._block: list[tuple[int, float]] | None = None
        self._sequence = 0.0
        self._written: dict[str, tuple[float, float]] = {}
        self._state_at_write = ""
        self._wanted_at_write: tuple[bool, ...] = ()
        self._applied: dict[str, float] = {}
        self._cutting = False
        self._marks: dict[str, float] = {}
        self._reference: str | None = None
        self._model: str | None = None
        self._hold_since_s = math.inf
        self._wanted: tuple[bool, ...] = ()
        self._bad_since_s = math.inf
        self._echo_known = True

    # --- what the machine sees ------------------------------------------------------------

    def group(self, time_s: float, group: Sequence[tuple[int, float]], claims: Claims | None, *, taken: bool) -> None:
        """Take one group of (macro, value) that arrived; `taken` says that the CNC accepted it."""
        check = self._ledger.check
        for number, value in group:
            allowed, finite = number in self._allowed, math.isfinite(value)
            check("allow_list", allowed, "" if allowed else f"{time_s:.1f} s: #{number} was written")
            check("finite", finite, "" if finite else f"{time_s:.1f} s: #{number} = {value}")
        state = claims.state if claims is not None else ""
        right, link = state != "FAULT", claims is not None and claims.link
        check("nothing_written_in_fault", right, "" if right else f"{time_s:.1f} s: {group} in FAULT")
        check("nothing_written_without_link", link, "" if link else f"{time_s:.1f} s: {group} without a link")
        self._order(time_s, group, taken=taken)
        for number, value in group:
            axis = self._axis_of.get(number)
            if axis is not None and claims is not None and math.isfinite(value):
                self._value(time_s, axis, value * self._map.unit_um, claims, taken=taken)
        if any(number in self._axis_of for number, _ in group):
            self._marks.clear()
            self._state_at_write, self._wanted_at_write = state, claims.wanted if claims else ()

    def applied(self, time_s: float, applied_um: dict[str, float], *, cutting: bool) -> None:
        """Take what the NC applies now; to be called at least once between two runs of the guard."""
        for axis, um in applied_um.items():
            limits = self._axes[axis]
            inside = math.isfinite(um) and abs(um) <= limits.absolute_bound_um + SLACK_UM
            self._ledger.check("bound_applied", inside, "" if inside else f"{time_s:.1f} s: {axis} at {um} um")
            before = self._applied.get(axis)
            if before is None:
                continue
            moved_um = abs(um - before)
            what = "" if moved_um == 0.0 else f"{time_s:.1f} s: {axis} by {moved_um:.3f} um"
            self._ledger.check("step_applied", moved_um <= limits.step_um + SLACK_UM, what)
            if self._cutting and cutting:
                self._ledger.check("no_motion_in_cut", moved_um == 0.0, what)
        self._applied = dict(applied_um)
        self._cutting = cutting

    # --- what changes around it -----------------------------------------------------------

    def restarted(self, time_s: float) -> None:
        """A daemon has been started."""
        self._marks = {"restart": time_s}
        self._block = None
        self._state_at_write = ""
        self._reference, self._model, self._wanted = None, None, ()
        self._hold_since_s = math.inf

    def mark(self, time_s: float, name: str) -> None:
        """Say that something has happened at which what is written must go on where it was."""
        if name:
            self._marks[name] = time_s

    def heard(self, time_s: float, claims: Claims | None) -> None:
        if claims is None:
            return
        if claims.reference != self._reference:
            self._reference = claims.reference
            if claims.reference is not None:
                self._marks["reference"] = time_s
        if claims.wanted != self._wanted:
            self._wanted = claims.wanted
            self._marks["switching"] = time_s
        if claims.model != self._model:
            if self._model is not None:
                self._marks["model"] = time_s
            self._model = claims.model
        if claims.state != "HOLD":
            self._hold_since_s = math.inf
            return
        self._hold_since_s = min(self._hold_since_s, time_s)
        held_s = time_s - self._hold_since_s
        left = held_s <= self._hold_limit_s + LATE_S
        self._ledger.check("hold_is_left", left, "" if left else f"{time_s:.1f} s: in HOLD for {held_s:.0f} s")

    def input_is(self, time_s: float, *, good: bool, echo_known: bool = True) -> None:
        """Say whether temperatures and the guard's echo arrive; without temperatures what is written must freeze."""
        self._echo_known = echo_known
        if good:
            self._bad_since_s = math.inf
        else:
            self._bad_since_s = min(self._bad_since_s, time_s)

    # --- arithmetic -----------------------------------------------------------------------

    def _order(self, time_s: float, group: Sequence[tuple[int, float]], *, taken: bool) -> None:
        numbers = [number for number, _ in group]
        if self._map.sequence_a in numbers:
            right = len(group) == 1 and group[0][1] != self._sequence
            self._ledger.check("block_order", right, "" if right else f"{time_s:.1f} s: began with {group}")
            self._block = list(group) if taken else None
        elif self._map.sequence_b in numbers:
            block = self._block or []
            content = {number for number, _ in block[1:]}
            whole = content == self._content
            right = whole and bool(block) and len(group) == 1 and group[0][1] == block[0][1]
            self._ledger.check("block_order", right, "" if right else f"{time_s:.1f} s: {group} after {block}")
            self._block = None
            self._sequence = group[0][1] if taken else self._sequence
        elif set(numbers) & self._content:
            right = self._block is not None
            self._ledger.check("block_order", right, "" if right else f"{time_s:.1f} s: {group} without sequence_a")
            if self._block is not None:
                self._block = [*self._block, *group] if taken else None

    def _value(self, time_s: float, axis: str, um: float, claims: Claims, *, taken: bool) -> None:
        limits, check = self._axes[axis], self._ledger.check
        where = f"{time_s:.1f} s, {claims.state}: {axis} = {um:.4f} um"
        check("bound_written", abs(um) <= limits.absolute_bound_um + SLACK_UM, where)
        before = self._written.get(axis)
        there_um = self._applied.get(axis)
        if before is not None and there_um is not None:
            last_s, last_um = before
            per_s = limits.slew_um_per_min / 60.0
            reach_um = per_s * (time_s - last_s + 1.0) + SLACK_UM
            where += f" after {last_um:.4f} um {time_s - last_s:.1f} s ago, {there_um:.4f} um applied"
            from_last, from_tool = abs(um - last_um), abs(um - there_um)
            check("slew_written", min(from_last, from_tool) <= reach_um, where)
            self._unsteppy(time_s, axis, last_s, (min(from_last, from_tool), from_tool), where)
            self._frozen(time_s, axis, um, (from_last, from_tool), claims, where)
        if taken:
            self._written[axis] = (time_s, um)

    def _unsteppy(self, time_s: float, axis: str, last_s: float, distances_um: tuple[float, float], where: str) -> None:
        """After a reference and a restart the command begins at the tool; after switching, where it was or there."""
        per_s = self._axes[axis].slew_um_per_min / 60.0
        nearest_um, from_tool_um = distances_um
        for mark, since_s in self._marks.items():
            goes_on = mark in GO_ON or not self._echo_known
            distance_um, from_s = (nearest_um, min(since_s, last_s)) if goes_on else (from_tool_um, since_s)
            reach_um = per_s * (time_s - from_s + 2.0) + SLACK_UM
            self._ledger.check(f"no_step_at_{mark}", distance_um <= reach_um, f"{where} ({mark} at {since_s:.1f} s)")

    def _frozen(
        self, time_s: float, axis: str, um: float, distances_um: tuple[float, float], claims: Claims, where: str
    ) -> None:
        """In HOLD, and without temperatures, an axis that is switched on stands still (or begins at the tool).

        A retreat follows no temperature: zero_first takes the offset out all the same, but nothing may grow meanwhile.
        """
        still = min(distances_um) <= SLACK_UM
        index = list(self._axes).index(axis)
        on = index < len(claims.wanted) and claims.wanted[index]
        stayed_on = on and self._wanted_at_write == claims.wanted
        if stayed_on and claims.state == "HOLD" and self._state_at_write == "HOLD":
            self._ledger.check("hold_freezes", still, where)
        bad_s = time_s - self._bad_since_s
        if stayed_on and self._written[axis][0] > self._bad_since_s + self._bad_after_s + 2.0:
            before_um = self._written[axis][1]
            withdraws = claims.state == "RETREAT" and min(0.0, before_um) <= um <= max(0.0, before_um)
            what = f"{where}; no temperatures for {bad_s:.0f} s"
            self._ledger.check("no_motion_on_bad_input", still or withdraws, what)
