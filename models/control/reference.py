"""The lifecycle of the reference, as pure functions on events: asked for, in force, ended, kept for the tool settings.

Every function takes what is remembered and what has happened, and returns what is remembered from then on and what
follows from it: messages to the estimation, and what people are told. `TRANSITIONS` is the whole state machine: for
each state the conditions that leave it, the first that holds wins.

A reference never moves the output: what is applied when it comes into force becomes the baseline, which
`models.control.baseline` takes.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from models.control.program import (
    counted,
    in_part_program,
    may_be_missed,
    positioning_passed,
    power_cycled,
    seen_of,
    stood_still_s,
)
from models.control.reference_records import (
    Announcement,
    Effect,
    OutputBaseline,
    ReferenceEnded,
    ReferenceMemory,
    ReferenceRecord,
    ReferenceRequest,
    ReferenceRules,
    ReferenceState,
    ReferenceTakenUp,
    RequestedReference,
    SensorsSinceReference,
    ToolOrigin,
)
from models.control.state import OutputMemory
from models.records import CncMode, CncRun, CncSample, Reference
from models.thermal.mean_increment import Fading

BY_NUMBER = (CncMode.MEMORY, CncMode.REMOTE)
"""Modes in which there is a program, and a number of it."""
SWITCHED_OFF = "the CNC was switched off and on"
CLOCK_WENT_BACK = "the CNC's clock went back: it was switched off and on"

Step = tuple[ReferenceMemory, tuple[Effect, ...]]
"""The memory after an event, and what follows from it."""

LONGEST_STAND_S = 60.0
"""When this computer stood still for longer while the CNC went on, no reference holds, whatever the CNC proves [s]."""
LONGEST_STAND_DWELLS = 4.0
"""But on a clock that runs ahead not before so many dwells: there a moment of the wall clock is long."""
CALENDAR_SET_S = 2.0
"""The calendar was set where it differs by more from the monotonic clock than at the reference [s]."""
LABEL_AWAY_S = 25.0
"""A label without a value for so long has been away: it has one with every cycle [s]."""
TOOL_UNKNOWN_S = 60.0
"""What a label had within an absence, so far from both its ends, nobody knows [s]."""
COUNTED = ("baseline_um", "offset_um", "model_shift_um", "counted_found_um", "tools")
"""What the output counts from, in its memory and in a reference's baseline."""
EVER_SEEN: Mapping[str, float] = MappingProxyType({})


class Condition(StrEnum):
    """What may leave a state."""

    IN_FORCE = "a valid reference was set"
    ASKED_FOR = "one is asked for"
    HOLDS_NO_LONGER = "the one in force is no longer valid"
    NOTHING_COUNTS = "nothing may count from the one that has ended"
    KEPT = "none is asked for, and tool settings count from one that has ended"
    NOBODY_ASKS = "none is asked for any more"


TRANSITIONS: dict[ReferenceState, tuple[tuple[Condition, ReferenceState], ...]] = {
    ReferenceState.NONE: (
        (Condition.IN_FORCE, ReferenceState.VALID),
        (Condition.ASKED_FOR, ReferenceState.REQUESTED),
        (Condition.KEPT, ReferenceState.ENDED),
    ),
    ReferenceState.REQUESTED: (
        (Condition.IN_FORCE, ReferenceState.VALID),
        (Condition.KEPT, ReferenceState.ENDED),
        (Condition.NOBODY_ASKS, ReferenceState.NONE),
    ),
    ReferenceState.VALID: (
        (Condition.NOTHING_COUNTS, ReferenceState.NONE),
        (Condition.HOLDS_NO_LONGER, ReferenceState.ENDED),
    ),
    ReferenceState.ENDED: (
        (Condition.IN_FORCE, ReferenceState.VALID),
        (Condition.NOTHING_COUNTS, ReferenceState.NONE),
        (Condition.ASKED_FOR, ReferenceState.REQUESTED),
    ),
}
"""State -> (condition, next state), the first condition that holds wins."""


def on_sample(
    memory: ReferenceMemory, polled: CncSample, rules: ReferenceRules, *, asked_s: float, new_id: Callable[[], str]
) -> Step:
    """Take one poll of the CNC: a positioning may have passed, or the reference have ended; return memory and effects.

    `memory`: from the previous event. `polled`: the poll. `rules`: where the work is positioned. `asked_s`: monotonic
    time at which the control was asked for it [s]; what it shows is no older. `new_id`: gives the identity of the
    reference that is asked for, if one is.
    """
    previous, sample = memory.sample, in_part_program(memory.sample, polled, rules.guard_programs, rules.guard_blocks)
    missed = "" if previous is None else _missed(memory, previous, sample, rules)
    passed = positioning_passed(previous, sample, rules.program, rules.sequence_numbers)
    ahead, raised = counted(previous, sample, memory.count_ahead, rules, passed=passed)
    memory, effects = _retreated(replace(memory, sample=sample, asked_s=asked_s, count_ahead=ahead), sample, rules)
    record, restarted = memory.record, power_cycled(previous, sample)
    cycled = record is not None and (restarted or record.reference.power_on_count != sample.power_on_count)
    ended = missed
    if memory.in_force is not None:
        ended = end_of_reference(memory.in_force, sample) or (CLOCK_WENT_BACK if restarted else "") or missed
    ended = ended or raised or _unanswered(memory, sample, rules)
    if ended or cycled:
        memory, more = end(memory, ended or SWITCHED_OFF, for_good=cycled)
        effects += more
    if passed:
        source = f"O{sample.program} N{sample.sequence_number}"
        memory, more = request(replace(memory, positioning_seen=True), new_id(), source, positioning=True)
        effects += more
    return memory, effects


def request(
    memory: ReferenceMemory, reference_id: str, source: str, *, positioning: bool, handshake: bool = False
) -> Step:
    """Ask for a reference now."""
    assert memory.sample is not None
    asked = RequestedReference(
        reference_id=reference_id,
        positioning=positioning,
        handshake=handshake,
        asked_s=memory.sample.time.monotonic_s,
    )
    question = ReferenceRequest(
        reference_id=reference_id,
        source=source,
        program=memory.sample.program,
        work_offset=memory.sample.work_offset,
        power_on_count=memory.sample.power_on_count,
    )
    return moved(replace(memory, requests=(*memory.requests, asked))), (question,)


def adopt(memory: ReferenceMemory, reference: Reference, rules: ReferenceRules, *, still_applied_um: float) -> Step:
    """Take a reference that has come into force, or refuse it; what was asked for before it is no longer waited for."""
    asked = _request_for(memory, reference.reference_id)
    why = _refusal(memory, reference, asked, rules, still_applied_um)
    if why:
        return refuse(memory, reference.reference_id, why)
    record = ReferenceRecord(reference=reference, by_handshake=asked is not None and asked.handshake)
    memory = replace(
        memory,
        requests=memory.requests[memory.requests.index(asked) + 1 :] if asked is not None else (),
        record=record,
        ended="",
        outcome=(reference.reference_id, ""),
        retreating=False,
    )
    return moved(memory, in_force=True), (Announcement(kind="reference", text=f"set by {reference.source}"),)


def still_applied(rules: ReferenceRules, still_applied_um: float) -> str:
    """Return why no reference can be set while so much is applied [um], NaN: nobody knows; '' when one can."""
    if math.isnan(still_applied_um):
        return (
            "the guard has not settled what is applied (status 6, 8, 9 or 14), or its echo is not known: call it, then "
            "position again"
        )
    if not rules.zero_first or still_applied_um <= 0.0:
        return ""
    return (
        f"the policy is zero_first and {still_applied_um:.1f} um are still applied; let the program wait "
        "at its retreat block until the offset is out"
    )


def refuse(memory: ReferenceMemory, reference_id: str, why: str) -> Step:
    """Take the refusal of a reference that was asked for; work that was positioned has none then."""
    asked = _request_for(memory, reference_id)
    effects: tuple[Effect, ...] = (ReferenceEnded(reference_id=reference_id),)
    memory = replace(memory, outcome=(reference_id, why))
    if asked is not None and asked.positioning:  # it is still waited for, so that this is why there is none
        memory, more = end(memory, f"the work was positioned, and that set none ({why})")
        effects += more
    memory = withdraw(memory, reference_id)
    if memory.record is not None and not memory.requests:  # one that is still to come would be lost by going back
        effects += (ReferenceTakenUp(reference=memory.record.reference, sensors=memory.record.sensors),)
    return memory, effects


def withdraw(memory: ReferenceMemory, reference_id: str) -> ReferenceMemory:
    """Return the memory when this reference is no longer waited for."""
    left = tuple(asked for asked in memory.requests if asked.reference_id != reference_id)
    return moved(replace(memory, requests=left))


def end(memory: ReferenceMemory, why: str, *, for_good: bool = False) -> Step:
    """End the reference in force, and what was asked for before."""
    record, in_force = memory.record, memory.in_force is not None
    ended = why if in_force or memory.requests else memory.ended or why
    memory = replace(memory, requests=(), ended=ended)
    if record is None or not (in_force or for_good):
        return moved(memory), ()
    effects: tuple[Effect, ...] = (ReferenceEnded(reference_id=record.reference_id, for_good=for_good),)
    if in_force:
        effects = (Announcement(kind="notice", text=f"reference ended: {why}"), *effects)
    memory = replace(memory, record=None if for_good else record)
    return moved(memory, holds_no_longer=True), effects


def rebase(memory: ReferenceMemory, reference: Reference) -> ReferenceMemory:
    """Take the temperatures of returned sensors, which were set anew; a reference never comes back by that."""
    if memory.record is None or memory.record.reference_id != reference.reference_id:
        return memory
    return replace(memory, record=replace(memory.record, reference=reference))


def positioned_by_handshake(memory: ReferenceMemory, rules: ReferenceRules) -> Step:
    """Take the handshake's word for a positioning; tell when polling has not seen its sequence number pass."""
    text = "the handshake reports a positioning whose sequence number passed between two polls"
    unseen = bool(rules.sequence_numbers) and not memory.positioning_seen
    return replace(memory, positioning_seen=False), (Announcement(kind="notice", text=text),) if unseen else ()


def by_calendar(memory: ReferenceMemory) -> ReferenceMemory:
    """Return the memory with the reference's time by the calendar of now, by which a restart tells how old it is."""
    record, sample = memory.record, memory.sample
    if record is None or sample is None:
        return memory
    then, now = record.reference.time, sample.time
    utc_s = now.utc_s - (now.monotonic_s - then.monotonic_s)
    if abs(utc_s - then.utc_s) <= CALENDAR_SET_S:
        return memory
    reference = replace(record.reference, time=replace(then, utc_s=utc_s))
    return replace(memory, record=replace(record, reference=reference))


def end_of_reference(reference: Reference, sample: CncSample) -> str:
    """Return why a reference no longer holds by what it is bound to, '' while it does."""
    if sample.power_on_count != reference.power_on_count:
        return SWITCHED_OFF
    if sample.work_offset == 0:
        return "the control does not say which work offset is active"
    if sample.program == 0 and sample.mode in BY_NUMBER:
        return "the control does not say which program runs: give it an O number, not a name"
    if sample.work_offset != reference.work_offset:
        return f"the work offset changed from {reference.work_offset} to {sample.work_offset}"
    if sample.program != reference.program:
        return f"the program changed from O{reference.program} to O{sample.program}"
    return ""


def moved(memory: ReferenceMemory, *, in_force: bool = False, holds_no_longer: bool = False) -> ReferenceMemory:
    """Return the memory in the state that its table says."""
    kept, asked = memory.record is not None, bool(memory.requests)
    holds = {
        Condition.IN_FORCE: in_force,
        Condition.ASKED_FOR: asked,
        Condition.HOLDS_NO_LONGER: holds_no_longer,
        Condition.NOTHING_COUNTS: not kept,
        Condition.KEPT: kept and not asked,
        Condition.NOBODY_ASKS: not asked,
    }
    for condition, target in TRANSITIONS[memory.state]:
        if holds[condition]:
            return replace(memory, state=target)
    return memory


# --- what counts from the reference ------------------------------------------------------


def count_from(memory: ReferenceMemory, output: OutputMemory, axes: tuple[str, ...]) -> ReferenceMemory:
    """Take what the output counts from, where it counts from this reference."""
    record = memory.record
    if record is None or output.error_reference_id != record.reference_id:
        return memory
    known, now = record.baseline, {name: getattr(output, name) for name in COUNTED}
    same = known is not None and all(getattr(known, name) is value for name, value in now.items())
    if known is not None and same and (known.weight, known.model_id) == (output.weight, output.model_id):
        return memory
    baseline = OutputBaseline(axes=axes, model_id=output.model_id, weight=output.weight, **now)
    return replace(memory, record=replace(record, baseline=baseline))


def tool_begins(
    memory: ReferenceMemory,
    tool: ToolOrigin,
    estimate_reference_id: str | None,
    now_s: float,
    shown_s: Mapping[str, float] = EVER_SEEN,
) -> ReferenceMemory:
    """Let the expansion of the tool in the spindle count from now [s]; `shown_s`: when each label had its increment.

    What an increment still holds of the step of a sensor's return fades out, and is no expansion of this tool.
    """
    record = memory.record
    if record is None:
        return memory
    ours = estimate_reference_id == record.reference_id
    begin_degc = {
        label: increment - _fading_k(record, label, shown_s.get(label, now_s))
        for label, increment in tool.begin_degc.items()
    }
    unheard = tuple(label for label in begin_degc if now_s - shown_s.get(label, -math.inf) > LABEL_AWAY_S)
    tool = replace(tool, begin_degc=MappingProxyType(begin_degc), unheard=unheard)
    return replace(memory, tool_began_s=now_s, record=replace(record, tool=tool if ours else None))


def _fading_k(record: ReferenceRecord, label: str, time_s: float) -> float:
    """Return what a label's mean increment holds at a time [s] of the step of the latest return [K]."""
    origin = None if record.sensors is None else record.sensors.labels.get(label)
    if origin is None:
        return 0.0
    step_k, after_min = origin.rest_k
    began_min = record.reference.time.monotonic_s / 60.0 + after_min
    return float(Fading(amount=np.array([step_k]), since_min=began_min).at(time_s / 60.0)[0])


def tool_origin(memory: ReferenceMemory, tool_number: int, estimate_reference_id: str | None) -> ToolOrigin:
    """Return since when a tool's expansion counts; without any label: since the reference."""
    record = memory.record
    ours = record is not None and estimate_reference_id == record.reference_id
    if record is None or record.tool is None or not ours or record.tool.number != tool_number:
        return ToolOrigin(number=tool_number, begin_degc=MappingProxyType({}))
    return record.tool


def tool_set_right(
    memory: ReferenceMemory, before: Mapping[str, tuple[float, float]], now_degc: Mapping[str, float], now_s: float
) -> ReferenceMemory:
    """Set a tool right that came into the spindle while a label had no value.

    Result: with what the tool began at on a straight line between the two, NaN where that was long after the one and
    long before the other; unchanged where no label was away then.

    `memory`: with the tool, whose label began at its last increment. `before`: of each label the time [s] and the mean
    increment [K] that it had last. `now_degc`: mean increment of the labels that have one [K]. `now_s`: of these [s];
    where they were measured before the tool came, and arrive after it, it begins at them.
    """
    record = memory.record
    if record is None or record.tool is None:
        return memory
    begin_degc = dict(record.tool.begin_degc)
    for label, increment in now_degc.items():
        at_s, then = before.get(label, (now_s, increment))
        began_s = memory.tool_began_s
        if label in begin_degc and now_s - at_s > LABEL_AWAY_S and at_s <= began_s:
            known = min(began_s - at_s, abs(now_s - began_s)) <= TOOL_UNKNOWN_S
            share = min((began_s - at_s) / (now_s - at_s), 1.0)
            begin_degc[label] += (increment - then) * share if known else math.nan
    unheard = tuple(label for label in record.tool.unheard if label not in now_degc)
    if begin_degc == record.tool.begin_degc and unheard == record.tool.unheard:
        return memory
    tool = replace(record.tool, begin_degc=MappingProxyType(begin_degc), unheard=unheard)
    return replace(memory, record=replace(record, tool=tool))


def with_sensors(
    memory: ReferenceMemory, sensors: SensorsSinceReference, now_s: float, seen_s: Mapping[str, float] = EVER_SEEN
) -> ReferenceMemory:
    """Take what the estimation knows of the sensors since the reference; `seen_s`: when each label last had a value.

    A tool that came into the spindle while sensors of a label were away began at an imputed temperature. When they
    return, and the step fades out that this is, it is set right by its share of the step.
    """
    record = memory.record
    if record is None or record.reference_id != sensors.reference_id:
        return memory
    before = {} if record.sensors is None else record.sensors.labels
    left_s = dict(memory.labels_left_s)
    begin_degc = {} if record.tool is None else dict(record.tool.begin_degc)
    for label, origin in sensors.labels.items():
        was = before[label].counted if label in before else origin.counted
        if any(then and not now for then, now in zip(was, origin.counted, strict=True)):
            left_s.setdefault(label, now_s)
        if not any(now and not then for then, now in zip(was, origin.counted, strict=True)):
            continue
        away_since_s = min(left_s.pop(label, now_s), seen_s.get(label, now_s))
        if label in begin_degc and away_since_s <= memory.tool_began_s < now_s:
            step_k = origin.rest_k[0] - _fading_k(record, label, now_s)
            begin_degc[label] -= step_k * (memory.tool_began_s - away_since_s) / (now_s - away_since_s)
    tool = record.tool if record.tool is None else replace(record.tool, begin_degc=MappingProxyType(begin_degc))
    return replace(memory, labels_left_s=MappingProxyType(left_s), record=replace(record, sensors=sensors, tool=tool))


# --- the parts of it ---------------------------------------------------------------------


def _request_for(memory: ReferenceMemory, reference_id: str) -> RequestedReference | None:
    return next((asked for asked in memory.requests if asked.reference_id == reference_id), None)


def _refusal(
    memory: ReferenceMemory,
    reference: Reference,
    asked: RequestedReference | None,
    rules: ReferenceRules,
    still_applied_um: float,
) -> str:
    what = f"reference of {reference.source} refused"
    if asked is None:
        return f"{what}: it is no longer waited for"
    if why := still_applied(rules, still_applied_um):
        return f"{what}: {why}"
    if memory.sample is not None and (ended := end_of_reference(reference, memory.sample)):
        return f"{what}: meanwhile {ended}"
    return ""


def _retreated(memory: ReferenceMemory, sample: CncSample, rules: ReferenceRules) -> Step:
    """Under zero_first, the retreat block ends what there is and takes the offset out, reference or not."""
    if not rules.zero_first or sample.run is not CncRun.START or memory.retreating:
        return memory, ()
    if rules.program not in (None, sample.program) or sample.sequence_number not in rules.retreat_sequence_numbers:
        return memory, ()
    why = f"N{sample.sequence_number} takes the offset out before the next positioning"
    return end(replace(memory, retreating=True), why)


def _unanswered(memory: ReferenceMemory, sample: CncSample, rules: ReferenceRules) -> str:
    """Return why work that was positioned has no reference although none was refused, '' while one may come."""
    latest_s = sample.time.monotonic_s - rules.answer_within_s
    if any(asked.positioning and asked.asked_s < latest_s for asked in memory.requests):
        return f"the work was positioned again, and no reference has come within {rules.answer_within_s:g} s"
    return ""


def _missed(memory: ReferenceMemory, previous: CncSample, sample: CncSample, rules: ReferenceRules) -> str:
    """Return why a positioning may have been missed between two polls, '' when none can have been."""
    gap_s = sample.time.monotonic_s - memory.asked_s
    stood_s = stood_still_s(sample.clock_s - previous.clock_s, gap_s)
    if stood_s > max(LONGEST_STAND_S, LONGEST_STAND_DWELLS * rules.positioning_dwell_s):
        return (
            f"the CNC's clock went on by {stood_s:.0f} s more than this computer's, which slept or was paused: what is "
            "known of the temperatures in time is wrong by that; let it never sleep, and position the work again"
        )
    if memory.in_force is not None and memory.record is not None:
        by_handshake = memory.record.by_handshake
    else:
        by_handshake = all(asked.handshake for asked in memory.requests)
    gap_s += stood_s
    return may_be_missed(seen_of(previous, rules), seen_of(sample, rules), gap_s, rules, by_handshake=by_handshake)
