"""Decides whether the reference of the previous run of the daemon may be resumed."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from models.control.program import clocks_differ, may_be_missed, seen_of
from models.control.reference import SWITCHED_OFF, Step, end_of_reference, moved
from models.control.reference_records import (
    Announcement,
    Effect,
    ReferenceDocument,
    ReferenceMemory,
    ReferenceRecord,
    ReferenceRules,
    ReferenceState,
    ReferenceTakenUp,
    ToolSeen,
)
from models.control.state import OutputMemory, ToolBaseline
from models.records import CncSample


def document_of(
    memory: ReferenceMemory, rules: ReferenceRules, request_counter: int | None, tool: ToolSeen | None = None
) -> ReferenceDocument:
    """Return what a restart takes up again; what was only asked for is not, and ends what the work had before."""
    state, ended = memory.state, memory.ended
    if state is ReferenceState.VALID and any(asked.positioning for asked in memory.requests):
        state, ended = ReferenceState.ENDED, "the work was positioned again, and no reference came before the restart"
    if state is ReferenceState.REQUESTED:
        state = ReferenceState.NONE if memory.record is None else ReferenceState.ENDED
    seen = None if memory.sample is None else seen_of(memory.sample, rules)
    return ReferenceDocument(
        state=state,
        record=memory.record,
        ended=ended,
        request_counter=request_counter,
        seen=seen,
        counts_with=rules.counts_with,
        tool=tool,
    )


def restart(
    memory: ReferenceMemory,
    left: ReferenceDocument,
    rules: ReferenceRules,
    *,
    axes: tuple[str, ...],
    model_id: str | None,
    request_counter: int | None,
) -> Step:
    """Go on from what the previous run of the daemon left, as far as it still holds.

    Result: VALID with the reference, ENDED with one that tool settings count from, or unchanged.

    `memory`: with the first poll; a reference that was set since the start stays. `left`: what was kept. `rules`: the
    configuration of now. `axes`, `model_id`: what the output is made for now. `request_counter`: the handshake's
    counter in the first poll.
    """
    record, sample = left.record, memory.sample
    if record is None or sample is None or memory.record is not None:
        return replace(memory, ended=memory.ended or left.ended), ()
    if record.tool is not None and record.tool.unheard:
        begin_degc = {**record.tool.begin_degc, **dict.fromkeys(record.tool.unheard, np.nan)}
        record = replace(record, tool=replace(record.tool, begin_degc=MappingProxyType(begin_degc)))
    source, tools = record.reference.source, _tools_left(record, axes)
    effects: tuple[Effect, ...] = ()
    if left.state is ReferenceState.VALID:
        why = end_of_reference(record.reference, sample) or _not_resumed(left, record, sample, rules, request_counter)
        if not (why := why or _not_counted(record, axes, model_id) or _counts_otherwise(left, rules)):
            memory = moved(replace(memory, record=record, ended=""), in_force=True)
            taken_up = ReferenceTakenUp(reference=record.reference, sensors=record.sensors)
            return memory, (taken_up, Announcement(kind="reference", text=f"taken up again: {source}"))
        memory = replace(memory, ended=f"it was not taken up again after a restart: {why}")
        effects = (Announcement(kind="notice", text=f"the reference of {source} is not taken up again: {why}"),)
    else:
        memory = replace(memory, ended=memory.ended or left.ended)
    if not tools or record.baseline is None:
        return memory, effects
    numbers = ", ".join(f"T{number}" for number in sorted(tools))
    why = SWITCHED_OFF if record.reference.power_on_count != sample.power_on_count else _unseen(left, sample, rules)
    why = why or _counts_otherwise(left, rules)
    if not why and record.baseline.model_id != model_id:
        why = f"they belong to model {record.baseline.model_id}, the model is now {model_id}"
    if why:
        text = f"the tool settings of {numbers} have ended: {why}; set these tools again"
        return memory, (*effects, Announcement(kind="notice", text=text))
    taken_up = ReferenceTakenUp(reference=record.reference, sensors=record.sensors)
    said = Announcement(kind="tool", text=f"the settings of {numbers} are taken up again")
    return moved(replace(memory, record=record)), (*effects, taken_up, said)


def resumed(output: OutputMemory, memory: ReferenceMemory) -> OutputMemory:
    """Return the output's memory with what counts from the reference that was taken up again.

    Without it the request would count from what is applied now, which already holds the compensation.
    """
    record = memory.record
    if record is None or record.baseline is None:
        return output
    baseline = record.baseline
    counted = replace(
        output,
        error_reference_id=record.reference_id,
        model_id=baseline.model_id,
        offset_um=baseline.offset_um,
        model_shift_um=baseline.model_shift_um,
        counted_found_um=baseline.counted_found_um,
        tools=baseline.tools,
    )
    if memory.in_force is None:
        return counted
    weight = output.weight if np.isnan(baseline.weight) else baseline.weight
    return replace(counted, reference_id=record.reference_id, baseline_um=baseline.baseline_um, weight=weight)


def away_s(left: ReferenceDocument | None, sample: CncSample) -> float:
    """Return how long before this poll the previous run of the daemon last polled the CNC [s]."""
    return float("inf") if left is None or left.seen is None else sample.time.utc_s - left.seen.utc_s


def _not_resumed(
    left: ReferenceDocument,
    record: ReferenceRecord,
    sample: CncSample,
    rules: ReferenceRules,
    request_counter: int | None,
) -> str:
    """Return what ends the reference and may have happened while the CNC was not polled."""
    if unseen := _unseen(left, sample, rules):
        return unseen
    assert left.seen is not None
    if left.request_counter != request_counter:
        return "the NC program asked for something while the daemon was away"
    gap_s, now = max(away_s(left, sample), sample.clock_s - left.seen.clock_s), seen_of(sample, rules)
    if now.sequence_number in rules.sequence_numbers and now.sequence_number != left.seen.sequence_number:
        return "the program stands at the positioning of the work, which began while the daemon was away"
    if left.seen.positioning_count != now.positioning_count:
        return "the program has counted a positioning while the daemon was away"
    return may_be_missed(left.seen, now, gap_s, rules, by_handshake=record.by_handshake)


def _unseen(left: ReferenceDocument, sample: CncSample, rules: ReferenceRules) -> str:
    """Return why the control's state while it was not polled is unknown, '' when it has just gone on."""
    gap_s = away_s(left, sample)
    if left.seen is None or gap_s > rules.max_outage_s:
        return f"the CNC was not polled for longer than {rules.max_outage_s:g} s (reference.max_outage_s)"
    if clocks_differ(sample.clock_s - left.seen.clock_s, gap_s):
        return (
            "the CNC's clock and this computer's calendar went on differently while the daemon was away: the "
            "control was switched off and on, or a clock was set"
        )
    return ""


def _counts_otherwise(left: ReferenceDocument, rules: ReferenceRules) -> str:
    """Return what was changed since, without which nothing that was kept may be counted from; '' when nothing was.

    Version 0.1.0 kept no marks, so that there is nothing to compare.
    """
    if not left.counts_with:
        return ""
    if left.counts_with.keys() != rules.counts_with.keys():
        return "another version of the daemon kept it, or one that knew other axes"
    changed = [what for what, mark in left.counts_with.items() if rules.counts_with[what] != mark]
    return f"{' and '.join(changed)} changed while the daemon was away" if changed else ""


def _not_counted(record: ReferenceRecord, axes: tuple[str, ...], model_id: str | None) -> str:
    if record.baseline is None or record.baseline.axes != axes:
        return "its baseline was not stored"
    if record.baseline.model_id is None and model_id is not None:
        return f"no model has counted from it yet, the model is now {model_id}"
    if record.baseline.model_id != model_id:
        return f"it belongs to model {record.baseline.model_id}, the model is now {model_id}"
    return ""


def _tools_left(record: ReferenceRecord, axes: tuple[str, ...]) -> Mapping[int, ToolBaseline]:
    same = record.baseline is not None and record.baseline.axes == axes
    return record.baseline.tools if same and record.baseline is not None else MappingProxyType({})
