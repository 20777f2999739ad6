"""Owns the reference: feeds its lifecycle with events, carries out the results, and keeps it for a restart."""

import math
import uuid
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from config.schema import Configuration
from daemon.cnc.events import Journal
from daemon.cnc.limits import reference_rules
from daemon.cnc.macro_block import UNSETTLED
from daemon.cnc.own_offset import OwnOffsetWatch
from daemon.compensation.handshake import Handshake
from daemon.history.writer import HistoryWriter
from daemon.state_store.store import StateStore
from drivers.clock import Clock
from drivers.contract import Cnc
from models.control import reference, reference_restart
from models.control.program import phase_of, power_cycled
from models.control.reference_records import (
    Announcement,
    Effect,
    ReferenceDocument,
    ReferenceEnded,
    ReferenceMemory,
    ReferenceRequest,
    ReferenceState,
    ReferenceTakenUp,
    SensorsSinceReference,
    ToolOrigin,
    ToolSeen,
)
from models.control.state import OutputMemory
from models.records import CncSample, FloatArray, Phase, Reference
from models.thermal.estimation import UNSURE_UM

KEPT_PERIOD_REAL_S = 10.0
"""How often the store gets what the CNC said [s of the wall clock]."""

PUT_BACK = "somebody has put back or emptied the guard's macros, so what is applied is not known"
ToThermal = ReferenceRequest | ReferenceEnded | ReferenceTakenUp
"""The messages to the thermal task."""
Decided = Callable[[str], None]
"""Takes what became of a reference by hand: '' in force, else why not."""


class References:
    """Carries out what `models.control.reference` decides; owned by the control task, changed in its stack alone."""

    def __init__(
        self,
        configuration: Configuration,
        clock: Clock,
        history: HistoryWriter,
        tell_thermal: Callable[[ToThermal], None],
        journal: Journal,
        handshake: Handshake,
        um_per_unit: Mapping[str, float],
    ) -> None:
        """`um_per_unit`: movement per unit of the macro value by axis [um]."""
        self._rules = reference_rules(configuration, clock.speed, um_per_unit)
        self._safe_sequence_numbers = frozenset(configuration.compensation.output.safe_sequence_numbers)
        macros = configuration.cnc.macros
        self._safe_flag = macros.safe_flag
        self._guard_status = macros.echo_status
        self._echo = (macros.echo_time, *macros.echo_applied.values())
        self._um_per_unit = [abs(um_per_unit[axis]) for axis in macros.echo_applied]
        self._foreign: list[str] = []
        self._positioned: tuple[str, int, list[float | None]] = ("", 0, [])
        """The latest reference that was asked for and does not count yet, and then the tool, and what was echoed."""
        self.terms = {n: a.tool_term for n, a in configuration.compensation.axes.items() if a.tool_term is not None}
        self._expanding = frozenset(label for term in self.terms.values() for label in term.temperatures)
        self.tells_prepared_tool = configuration.cnc.tells_prepared_tool
        self._clock = clock
        self._history = history
        self._store = StateStore(history, clock)
        self._tool_counter = configuration.compensation.reference.tool_counter
        self._own_offset = OwnOffsetWatch(configuration, self._store)
        self._tell_thermal = tell_thermal
        self._journal = journal
        self._handshake = handshake
        self._kept: ReferenceDocument | None = None
        self._kept_real_s = float("-inf")
        self._decided: dict[str, Decided] = {}
        self.left = self._store.get(ReferenceDocument)
        """What the previous run left."""
        self.tool_seen: ToolSeen | None = None
        self.memory = ReferenceMemory()
        self.phase = Phase.CUTTING

    @property
    def current(self) -> Reference | None:
        return self.memory.in_force

    @property
    def kept_id(self) -> str | None:
        """The reference in force or, when it has ended, the one that tool settings still count from."""
        return None if self.memory.record is None else self.memory.record.reference_id

    @property
    def labels_at_reference(self) -> dict[str, tuple[float, float]]:
        """Of each label that tools expand with, the time of the reference [s], and its increment then [K]."""
        record = self.memory.record
        at_s = self._clock.now().monotonic_s if record is None else record.reference.time.monotonic_s
        return dict.fromkeys(self._expanding, (at_s, 0.0))

    @property
    def tools_differ(self) -> bool:
        """It matters which tool is in the spindle: one was set, or its own expansion counts."""
        return bool(self._expanding or self.memory.tools_set)

    @property
    def tool_count(self) -> float | None:
        """How many tools have come into the spindle, by the NC's count; None where it does not say."""
        counter = self._tool_counter
        return None if counter is None or self.sample is None else self.sample.macros.get(counter)

    @property
    def zero_first(self) -> bool:
        """The offset is to be taken out before the next positioning."""
        return self._rules.zero_first and self.memory.retreating

    @property
    def sample(self) -> CncSample | None:
        """The latest poll, with the part program's block while a program of the guard runs."""
        return self.memory.sample

    async def on_poll(
        self, cnc: Cnc, polled: CncSample, asked_s: float, foreign: list[str], counted_id: str | None
    ) -> None:
        """Take one poll, asked for at `asked_s` [s], what was foreign in it, and what the CNC's block counts from."""
        if moved := await self._own_offset.changed(cnc, polled.macros) or self._unfit(polled, foreign, counted_id):
            self.end(moved, for_good=moved == PUT_BACK)
        self.on_sample(polled, asked_s)

    def _unfit(self, polled: CncSample, foreign: list[str], counted_id: str | None) -> str:
        """Return why nothing may count from this echo, '' when it may; a time of before a power cycle is no time."""
        before, known, self._foreign = self.sample or polled, self._foreign, foreign
        (then_s, *then), (now_s, *now) = ([each.macros.get(n) for n in self._echo] for each in (before, polled))
        went_back = then_s is not None and now_s is not None and now_s < then_s <= before.clock_s
        if (went_back or (foreign not in ([], known) and then != now)) and not power_cycled(before, polled):
            return PUT_BACK
        if counted_id == self._positioned[0]:
            self._positioned = ("", 0, now)
        identity, tool, stood = self._positioned
        late = self.current is not None and self.current.reference_id == identity
        changed = late and self.tools_differ and polled.tool_number != tool
        moved = late and _farthest_um(stood, now, self._um_per_unit) > UNSURE_UM
        return _changed_before(tool=changed, moved=moved)

    def on_sample(self, polled: CncSample, asked_s: float) -> None:
        """Take one poll of the CNC, for which it was asked at `asked_s` [s]."""
        self._step(reference.on_sample(self.memory, polled, self._rules, asked_s=asked_s, new_id=new_id))
        self.memory = reference.by_calendar(self.memory)
        assert self.sample is not None
        if any(asked.positioning for asked in self.memory.requests):
            self._end_what_was_left("the work was positioned again before the output had begun")
        self.phase = phase_of(self.sample, self._safe_sequence_numbers, self._safe_flag)

    def request(self, identity: str, source: str, *, positioning: bool, handshake: bool = False) -> None:
        """Ask the thermal task for a reference now."""
        self._step(reference.request(self.memory, identity, source, positioning=positioning, handshake=handshake))

    def request_by_hand(self, source: str, decided: Decided) -> None:
        """Ask for a reference that a person wants; `decided` is told once what became of this one."""
        self._decided[identity := new_id()] = decided
        self.request(identity, source, positioning=False)

    def handshake_positioned(self) -> None:
        self._step(reference.positioned_by_handshake(self.memory, self._rules))

    def too_early(self, applied_um: FloatArray) -> str:
        """Return why none can be set while this is applied, '' when one can: the estimation is not even asked."""
        return reference.still_applied(self._rules, self._most_um(applied_um))

    def adopt(self, found: Reference, applied_um: FloatArray) -> str:
        """Take a reference into force; return why it is refused, '' when it holds."""
        self._step(reference.adopt(self.memory, found, self._rules, still_applied_um=self._most_um(applied_um)))
        _, refusal = self.memory.outcome
        if not refusal:
            self._history.reference(found)
        return refusal

    def refused(self, identity: str, why: str) -> None:
        """The thermal task cannot set a reference that was asked for."""
        self._step(reference.refuse(self.memory, identity, why))

    def has_refused(self, identity: str | None) -> bool:
        """Whether this is the reference that was refused last: nothing that counts from it is followed."""
        refused, why = self.memory.outcome
        return bool(why) and identity == refused

    def withdraw(self, identity: str) -> None:
        """The reference is no longer waited for."""
        self.memory = reference.withdraw(self.memory, identity)

    def end(self, why: str, *, for_good: bool = False) -> None:
        """End the reference in force, and what was asked for before; `for_good`: and what tools were set by."""
        self._end_what_was_left(why)
        self._step(reference.end(self.memory, why, for_good=for_good))

    def rebase(self, found: Reference) -> None:
        """Take the temperatures of returned sensors, which were set anew."""
        self.memory = reference.rebase(self.memory, found)

    def on_sensors(self, sensors: SensorsSinceReference, seen_s: Mapping[str, float]) -> None:
        """Take what the thermal task knows of the sensors since the reference, and when labels last had values [s]."""
        self.memory = reference.with_sensors(self.memory, sensors, self._clock.now().monotonic_s, seen_s)

    def tool_set_right(
        self, before: Mapping[str, tuple[float, float]], now_degc: Mapping[str, float], now_s: float
    ) -> None:
        """Set a tool right that came into the spindle while a label had no value."""
        self.memory = reference.tool_set_right(self.memory, before, now_degc, now_s)

    def tool_begins(self, tool: ToolOrigin, estimate_reference_id: str | None, shown_s: Mapping[str, float]) -> None:
        """Let the expansion of the tool in the spindle count from now."""
        now_s = self._clock.now().monotonic_s
        self.memory = reference.tool_begins(self.memory, tool, estimate_reference_id, now_s, shown_s)

    def count_from(self, output: OutputMemory, axes: tuple[str, ...]) -> None:
        """Take what the output counts from after a step."""
        self.memory = reference.count_from(self.memory, output, axes)

    def away_s(self, sample: CncSample) -> float:
        """Return how long before this poll the previous run of the daemon last polled the CNC [s]; inf: never."""
        return reference_restart.away_s(self.left, sample)

    def restart(
        self, output: OutputMemory, axes: tuple[str, ...], model_id: str | None, *, refused: str
    ) -> OutputMemory:
        """Go on from what the previous run left, as far as it holds; return the output's memory with it."""
        if self.left is None or refused:
            if self.left is not None and self.current is None:
                self.memory = replace(self.memory, ended=refused)
            self.left = None
            return output
        self._step(
            reference_restart.restart(
                self.memory,
                self.left,
                self._rules,
                axes=axes,
                model_id=model_id,
                request_counter=self._handshake.counter,
            )
        )
        self.left = None
        return reference_restart.resumed(output, self.memory)

    def keep(self) -> None:
        """Hand what a restart takes up again to the store, when it has changed, and what the CNC said now and then.

        Until the output has begun, what the previous run left is not written over.
        """
        if self.left is not None and self.current is None:
            return
        document = reference_restart.document_of(self.memory, self._rules, self._handshake.answered, self.tool_seen)
        now_s, kept, names = self._clock.now().real_s, self._kept, ("state", "ended", "request_counter", "tool")
        changed = kept is None or kept.record is not document.record
        changed = changed or any(getattr(kept, name) != getattr(document, name) for name in names)
        if changed or now_s - self._kept_real_s >= KEPT_PERIOD_REAL_S:
            self._kept, self._kept_real_s = document, now_s
            self._store.put(document)

    def _end_what_was_left(self, why: str) -> None:
        """End what the previous run left, and what has not been taken up yet: that waits for the CNC's echo."""
        left = self.left
        if left is not None and left.state is ReferenceState.VALID and left.record is not None:
            source = left.record.reference.source
            self._journal.say("notice", f"the reference of {source} is not taken up again: {why}")
            self.left = replace(left, state=ReferenceState.ENDED, ended=why)
            self._store.put(self.left)

    def _most_um(self, applied_um: FloatArray) -> float:
        """Return the largest offset that is applied [um], NaN where nobody knows; without zero_first it may be any."""
        unsettled = self.sample is not None and self.sample.macros.get(self._guard_status) in UNSETTLED
        return math.nan if unsettled else float(np.abs(applied_um).max()) if self._rules.zero_first else 0.0

    def _step(self, step: reference.Step) -> None:
        self.memory, effects = step
        identity, refusal = self.memory.outcome
        if decided := self._decided.pop(identity, None):
            decided(refusal)
        for effect in effects:
            self._carry_out(effect)

    def _carry_out(self, effect: Effect) -> None:
        if isinstance(effect, Announcement):
            self._journal.say(effect.kind, effect.text)
            return
        if isinstance(effect, ReferenceRequest) and self.sample is not None:
            echo = [*map(self.sample.macros.get, self._echo[1:])]
            self._positioned = effect.reference_id, self.sample.tool_number, echo
        self._tell_thermal(effect)


def _changed_before(*, tool: bool, moved: bool) -> str:
    """Return what was no longer as at the positioning when its reference came, '' where nothing was."""
    guard = "the guard moved the axes between the positioning and its reference, which came late" if moved else ""
    return "the tool was changed between the positioning and its reference, which came late" if tool else guard


def _farthest_um(then: list[float | None], now: list[float | None], um_per_unit: list[float]) -> float:
    """Return how far the worst axis is from where it was by its echo [um]; without a bound where one is vacant."""
    axes = zip(then, now, um_per_unit, strict=True)
    return max(math.inf if a is None or b is None else um * abs(a - b) for a, b, um in axes)


def new_id() -> str:
    return uuid.uuid4().hex[:12]
