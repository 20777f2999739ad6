"""Judges by truth: after bad input has passed the tool stands within 1 um of the twin, or the output says otherwise."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from config.schema import Configuration
from daemon.simulation.faults.invariants import Claims, Ledger
from daemon.simulation.faults.operations_check import Request
from daemon.simulation.faults.twin import Twin

WITHIN_UM = 1.0
ROUNDED_UM = 0.1
"""The control rounds what it applies to its least increment, and a change below the dead band is not written [um]."""
PASSED_S = 120.0
"""Bad input has passed when nothing has gone wrong for so long: a minute's means, and the cycles that a value after a
gap takes [s]."""
DELAY_S = 30.0
"""A cycle, a tick and a safe point may lie between the twin's request and what is applied [s]."""
RUNS = 2
"""So many more runs of the guard than the steps of the way are granted, once the slew rate has had its time."""
REFERENCE, PROBE, TOOL_CHANGE = 1, 2, 3
"""Kinds of request of the NC program."""


@dataclass(slots=True)
class _Way:
    """An axis is off the twin's request, and may be on its way there."""

    since_s: float
    runs: int
    off_um: float
    wanted_um: float
    """The twin's request at the latest look."""
    told: bool = False


@dataclass(slots=True)
class TruthWatch:
    """Brings events to the twin and compares at every look; told by the campaign's observer."""

    configuration: Configuration
    ledger: Ledger
    twin: Twin
    worst_um: float = 0.0
    """Farthest from the twin after a way back that was granted [um]."""
    _reference: str | None = None
    _restarted: bool = False
    _busy_until_s: float = 0.0
    _judges: bool = False
    _trust: str = ""
    _active: tuple[bool, ...] = ()
    _guard_time: float | None = None
    _runs: int = 0
    _ways: dict[str, _Way] = field(default_factory=dict)

    NAME = "within_1_um_of_the_twin"

    # --- events ---------------------------------------------------------------------------

    def restarted(self, time_s: float) -> None:
        """A daemon is started: of tool settings only those count that it takes up, unless it does the reference."""
        self.busy(time_s)
        self.twin.restarted()
        self._restarted = True

    def busy(self, until_s: float) -> None:
        """Something goes wrong until then, or a person does something."""
        self._busy_until_s = max(self._busy_until_s, until_s)

    def heard(
        self, time_s: float, claims: Claims | None, applied_um: Callable[[], Mapping[str, float]], *, disturbed: bool
    ) -> None:
        """Take what the daemon says of itself; `applied_um` tells what the NC applies [um]."""
        if disturbed:
            self.busy(time_s)
        if claims is None:
            self._judges = False
            return
        if claims.reference is not None and claims.reference != self._reference:
            self._reference = claims.reference
            if self._restarted:
                self.twin.forget(but_for=claims.tools)
            self.twin.reference(time_s, claims.model, applied_um())
        self._restarted &= claims.reference is None
        if claims.model is not None and claims.estimate_reference == claims.reference is not None:
            self.twin.model(time_s, claims.model)
        self._active = claims.wanted
        self._trust = f"confidence {claims.confidence:.2f}, {len(claims.left_out)} sensors imputed, {claims.model}"
        self._judges = claims.state == "ACTIVE" and claims.link and self.twin.known

    def answered(self, request: Request | None, value: float, applied_um: Mapping[str, float]) -> None:
        """Take the answer to a request of the NC program; a negative one changes nothing."""
        if request is None or value <= 0:
            return
        names = list(self.configuration.compensation.axes)
        axis = names[request.axis - 1] if 1 <= request.axis <= len(names) else ""
        if request.kind == PROBE and axis in self.twin.axes:
            self.twin.probed(axis, request.value_mm * 1e3, applied_um[axis])
        elif request.kind == REFERENCE and axis in self.twin.axes:
            self.twin.tool_set(request.time_s, axis, applied_um[axis])
        elif request.kind == TOOL_CHANGE:
            self.twin.tool_changed(round(request.value_mm))

    # --- comparison -----------------------------------------------------------------------

    def applied(self, time_s: float, applied_um: Mapping[str, float], guard_time: float | None) -> None:
        """Compare what the NC applies; `guard_time`: the guard's own note of its latest run."""
        if guard_time != self._guard_time:
            self._guard_time = guard_time
            self._runs += 1
        self.twin.settled(time_s, applied_um)
        if not self._judges or time_s - self._busy_until_s <= PASSED_S:
            self._ways.clear()
            return
        for name, on in zip(self.configuration.compensation.axes, self._active, strict=False):
            if name in self.twin.axes and on:
                self._compare(time_s, name, applied_um[name])
            else:
                self._ways.pop(name, None)

    def _compare(self, time_s: float, name: str, applied_um: float) -> None:
        wanted_um = self.twin.request_um(name)
        if wanted_um is None or not math.isfinite(wanted_um):
            return
        off_um = abs(applied_um - wanted_um)
        if off_um <= WITHIN_UM + ROUNDED_UM:
            self._ways.pop(name, None)
            self._note(off_um, "")
            return
        way = self._ways.get(name)
        if way is None:
            way = self._ways[name] = _Way(since_s=time_s, runs=self._runs, off_um=off_um, wanted_um=wanted_um)
        if (further_um := abs(wanted_um - way.wanted_um)) > WITHIN_UM:  # another tool came on the way
            way.off_um += further_um
        way.wanted_um = wanted_um
        axis = self.configuration.compensation.axes[name]
        if time_s - way.since_s <= DELAY_S + 60.0 * way.off_um / axis.slew_um_per_min:
            way.runs = self._runs
        elif self._runs - way.runs > RUNS + way.off_um / axis.step_um and not way.told:
            way.told = True
            self._note(
                off_um,
                f"{time_s:.1f} s: {name} at {applied_um:.3f} um, the twin at {wanted_um:.3f} um since "
                f"{way.since_s:.1f} s; nothing has gone wrong since {self._busy_until_s:.1f} s; {self._trust}",
            )

    def _note(self, off_um: float, what: str) -> None:
        self.worst_um = max(self.worst_um, off_um)
        self.ledger.check(self.NAME, not what, what)
