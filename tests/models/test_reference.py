"""The life of a reference: its table, its rules on single events, and that nothing is ever missed."""

import json
from dataclasses import replace
from functools import partial
from itertools import count

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from daemon.state_store.store import from_json, to_json
from models.control import reference
from models.control.compensation import initial_memory
from models.control.reference_records import (
    Announcement,
    LabelOrigin,
    OutputBaseline,
    ReferenceDocument,
    ReferenceEnded,
    ReferenceMemory,
    ReferenceRequest,
    ReferenceRules,
    ReferenceState,
    ReferenceTakenUp,
    SensorsSinceReference,
    ToolOrigin,
)
from models.control.reference_restart import document_of, restart, resumed
from models.control.state import ToolBaseline
from models.records import CncMode, CncRun, CncSample, Instant, Reference

NONE, REQUESTED, VALID, ENDED = ReferenceState
DWELL_S, OTHER_S, POLL_S, STEP_S = 2.0, 1.0, 0.5, 0.25
RULES = ReferenceRules(sequence_numbers=frozenset({100}), positioning_dwell_s=DWELL_S, positioning_counter=560)
ZERO_FIRST = replace(RULES, zero_first=True, retreat_sequence_numbers=frozenset({50}))
AXES, MODEL = ("y", "z"), "m"


def at(monotonic_s):
    return Instant(monotonic_s=monotonic_s, utc_s=1.7e9 + monotonic_s, real_s=monotonic_s)


def sample(time_s=10.0, **changes):
    content = {
        "time": at(time_s),
        "mode": CncMode.MEMORY,
        "run": CncRun.START,
        "alarm": False,
        "program": 1000,
        "sequence_number": 200,
        "spindle_speed_rpm": 0.0,
        "motor_temperature_degc": 20.0,
        "clock_s": 500.0 + time_s,
        "power_on_count": 3,
        "work_offset": 54,
        "tool_number": 1,
    }
    return CncSample(**(content | changes))


def answered(question):
    return Reference(
        reference_id=question.reference_id,
        time=at(0.0),
        source=question.source,
        degc=np.array([20.0, np.nan]),
        program=question.program,
        work_offset=question.work_offset,
        power_on_count=question.power_on_count,
    )


def polled(memory, polled_sample, rules=RULES):
    return reference.on_sample(
        memory, polled_sample, rules, asked_s=polled_sample.time.monotonic_s, new_id=lambda: "next"
    )


def asked_for(memory, identity="r1", **how):
    memory, (question,) = reference.request(memory, identity, "O1000 N100", **({"positioning": True} | how))
    return memory, question


def in_force(identity="r1", rules=RULES, **how):
    memory, question = asked_for(polled(ReferenceMemory(), sample())[0], identity, **how)
    return reference.adopt(memory, answered(question), rules, still_applied_um=0.0)[0]


def said(effects):
    return [effect.text for effect in effects if isinstance(effect, Announcement)]


def test_every_state_is_entered_and_left():
    targets = {target for leaving in reference.TRANSITIONS.values() for _, target in leaving}
    assert set(reference.TRANSITIONS) == set(ReferenceState) == targets
    assert {state: [target for _, target in leaving] for state, leaving in reference.TRANSITIONS.items()} == {
        NONE: [VALID, REQUESTED, ENDED],
        REQUESTED: [VALID, ENDED, NONE],
        VALID: [NONE, ENDED],
        ENDED: [VALID, NONE, REQUESTED],
    }


def test_asked_for_in_force_ended_and_kept():
    memory, _ = polled(ReferenceMemory(), sample())
    assert memory.state is NONE
    memory, question = asked_for(memory)
    assert memory.state is REQUESTED and (question.program, question.work_offset, question.power_on_count) == (
        (1000, 54, 3)
    )
    memory, effects = reference.adopt(memory, answered(question), RULES, still_applied_um=7.0)
    assert (memory.state, memory.outcome, said(effects)) == (VALID, ("r1", ""), ["set by O1000 N100"])
    memory, effects = reference.end(memory, "made up")
    assert (memory.state, memory.in_force, memory.ended) == (ENDED, None, "made up")
    assert ReferenceEnded(reference_id="r1", for_good=False) in effects and memory.record is not None
    memory, _ = asked_for(memory, "r2")
    assert memory.state is REQUESTED
    assert reference.withdraw(memory, "r2").state is ENDED
    memory, effects = reference.end(memory, "for good", for_good=True)
    assert (memory.state, memory.record) == (NONE, None)
    assert effects == (ReferenceEnded(reference_id="r1", for_good=True),)


@pytest.mark.parametrize(
    ("change", "words", "state"),
    [
        ({"program": 2000}, "the program changed from O1000 to O2000", ENDED),
        ({"work_offset": 55}, "the work offset changed from 54 to 55", ENDED),
        ({"work_offset": 0}, "the control does not say which work offset is active", ENDED),
        ({"program": 0}, "the control does not say which program runs: give it an O number", ENDED),
        ({"power_on_count": 4}, "switched off and on", NONE),
        ({"clock_s": 5.0}, "clock went back", NONE),
    ],
)
def test_what_a_reference_is_bound_to_ends_it(change, words, state):
    memory, effects = polled(in_force(), sample(10.5, **change))
    assert memory.state is state and words in memory.ended and words in said(effects)[0]


@pytest.mark.parametrize("unsaid", [{"work_offset": 0}, {"program": 0}])
def test_no_reference_comes_into_force_for_a_work_or_a_program_that_the_control_does_not_name(unsaid):
    """Two of them have the same number, so a change from the one to the other would end nothing."""
    memory, question = asked_for(polled(ReferenceMemory(), sample(**unsaid))[0])
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    assert memory.in_force is None and "the control does not say which" in memory.ended
    by_hand = sample(**unsaid, mode=CncMode.MDI)
    memory, question = asked_for(polled(ReferenceMemory(), by_hand)[0])
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    assert (memory.in_force is not None) is ("program" in unsaid), "in MDI there is no program"


def test_a_refused_positioning_leaves_the_work_without_a_reference_and_a_refused_hand_does_not():
    for positioning, state in ((True, ENDED), (False, VALID)):
        memory, _ = asked_for(in_force(), "r2", positioning=positioning)
        memory, effects = reference.refuse(memory, "r2", "no temperatures")
        assert memory.state is state and memory.outcome == ("r2", "no temperatures")
        assert effects[-1] == ReferenceTakenUp(reference=memory.record.reference), "the estimate goes on from it"


def test_the_refusal_of_one_that_was_given_up_does_not_take_the_estimate_away_from_the_next():
    memory, late = asked_for(in_force(), "late")
    memory, _ = reference.end(reference.withdraw(memory, "late"), "the NC program gave up waiting")
    memory, question = asked_for(memory, "next")  # the estimation sets both before it takes any word on the first
    memory, effects = reference.adopt(memory, answered(late), RULES, still_applied_um=0.0)
    assert memory.state is REQUESTED and "no longer waited for" in memory.outcome[1]
    assert not any(isinstance(effect, ReferenceTakenUp) for effect in effects), "it would estimate from r1 for ever"
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    assert memory.in_force.reference_id == "next"


def test_a_reference_that_nobody_waits_for_or_that_holds_no_longer_is_refused():
    memory, question = asked_for(polled(ReferenceMemory(), sample())[0])
    late, _ = reference.adopt(reference.withdraw(memory, "r1"), answered(question), RULES, still_applied_um=0.0)
    assert late.state is NONE and "no longer waited for" in late.outcome[1]
    moved, _ = polled(memory, sample(10.5, work_offset=55))
    moved, _ = reference.adopt(moved, answered(question), RULES, still_applied_um=0.0)
    assert moved.in_force is None and "meanwhile the work offset" in moved.outcome[1]


def test_an_answer_to_what_was_asked_before_the_reference_in_force_comes_too_late():
    memory, hand = asked_for(polled(ReferenceMemory(), sample())[0], "hand", positioning=False)
    memory, question = asked_for(memory, "r2")
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    memory, _ = reference.adopt(memory, answered(hand), RULES, still_applied_um=0.0)
    assert memory.in_force.reference_id == "r2" and "no longer waited for" in memory.outcome[1]


def test_work_that_was_positioned_is_not_followed_with_the_old_reference_when_no_answer_comes():
    memory, question = asked_for(in_force(), "r2")
    for step in range(1, 11):
        memory, _ = polled(memory, sample(10.0 + POLL_S * step))
        assert memory.state is VALID
    memory, effects = polled(memory, sample(15.5))
    assert memory.state is ENDED and "no reference has come within 5 s" in said(effects)[0]
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    assert memory.in_force is None, "too late is never"


def test_zero_first_takes_the_offset_out_before_and_refuses_while_any_is_applied():
    memory, _ = polled(in_force(rules=ZERO_FIRST), sample(10.5, sequence_number=50), ZERO_FIRST)
    assert memory.retreating and memory.in_force is None
    memory, question = asked_for(memory, "r2")
    early, _ = reference.adopt(memory, answered(question), ZERO_FIRST, still_applied_um=0.5)
    assert early.in_force is None and "zero_first" in early.outcome[1] and early.retreating
    taken, _ = reference.adopt(memory, answered(question), ZERO_FIRST, still_applied_um=0.0)
    assert taken.state is VALID and not taken.retreating


def test_a_returned_sensor_never_brings_an_ended_reference_back():
    memory, _ = reference.end(in_force(), "made up")
    again = reference.rebase(memory, replace(memory.record.reference, degc=np.array([20.0, 21.0])))
    assert again.state is ENDED and again.record.reference.degc[1] == 21.0
    assert reference.rebase(again, replace(again.record.reference, reference_id="other")) is again


# --- gaps --------------------------------------------------------------------------------


def gap(seconds, before=None, after=None, rules=RULES, **how):
    memory, counted = in_force(rules=rules, **how), (before or {}).get("macros", {})
    memory = replace(memory, sample=replace(memory.sample, macros=counted))
    memory, _ = polled(memory, sample(10.5, **(before or {})), rules)
    memory, effects = polled(memory, sample(10.5 + seconds, **(after or {})), rules)
    return memory.state, said(effects)


STANDS = {"run": CncRun.STOP}


@pytest.mark.parametrize(
    ("seconds", "before", "after", "how", "state"),
    [
        (1.9, {}, {}, {}, VALID),
        (2.0, {}, {}, {}, ENDED),
        (3.0, {}, {"sequence_number": 300}, {}, ENDED),
        (3.0, {}, {"program": 1000}, {"rules": replace(RULES, program=7)}, ENDED),
        (60.0, {}, {}, {"handshake": True}, VALID),
        (60.0, {}, {}, {"rules": replace(RULES, sequence_numbers=frozenset())}, VALID),
        (1.9, STANDS, STANDS, {}, VALID),
        (60.0, STANDS, STANDS, {}, ENDED),
        (60.0, STANDS, STANDS | {"sequence_number": 300}, {}, ENDED),
        (60.0, {}, STANDS, {}, ENDED),
        (60.0, STANDS, {}, {}, ENDED),
        (60.0, {"macros": {560: 4.0}}, {"macros": {560: 4.0}}, {}, VALID),
        (60.0, {"macros": {560: 4.0}}, {"macros": {560: 5.0}}, {}, ENDED),
        (60.0, STANDS | {"macros": {560: 4.0}}, STANDS | {"macros": {560: 5.0}}, {}, ENDED),
        (60.0, {"macros": {560: 4.0}}, {"macros": {560: None}}, {}, ENDED),
        (0.5, {}, {"clock_s": 513.0}, {}, ENDED),  # this computer was paused: its own clock shows no gap
        (0.5, {}, {"clock_s": 513.0}, {"handshake": True}, VALID),
        (0.5, {}, {"clock_s": 511.9}, {}, VALID),
    ],
)
def test_a_gap_that_may_hide_a_positioning_ends_the_reference_unless_the_control_proves_the_contrary(
    seconds, before, after, how, state
):
    found, texts = gap(seconds, before, after, **how)
    assert found is state
    assert (state is VALID) != any("a positioning may have been missed" in text for text in texts)


@pytest.mark.parametrize(
    ("polls", "states"),
    [
        ([(4, 300), (5, 300), (5, 200)], [VALID, ENDED, ENDED]),  # its block passed between two polls
        ([(4, 100), (5, 100), (5, 100)], [VALID, ENDED, ENDED]),  # its block is the only one with a number
        ([(4, 300), (5, 300), (5, 100)], [VALID, ENDED, REQUESTED]),
        ([(4, 300), (5, 100), (5, 200)], [VALID, VALID, VALID]),
        ([(4, 300), (4, 100), (5, 100), (5, 200), (6, 200)], [VALID, VALID, VALID, VALID, ENDED]),
        ([(None, 300), (1, 300)], [VALID, ENDED]),
    ],
)
def test_a_counted_positioning_whose_block_no_poll_has_seen_ends_the_reference(polls, states):
    memory, found = in_force(), []
    for step, (number, block) in enumerate(polls):
        now = sample(10.5 + step * POLL_S, sequence_number=block, macros={560: number})
        if step == 0:
            memory = replace(memory, sample=replace(now, time=at(10.4)))
        memory, _ = polled(memory, now)
        found.append(memory.state)
    assert found == states


@pytest.mark.parametrize("program", [1000, 9010])
def test_a_call_of_the_guard_is_no_second_positioning_whichever_program_the_control_tells(program):
    """FOCAS tells the main program's number with the guard's block: back from it, N100 is no new one."""
    rules = replace(RULES, guard_programs=frozenset({9010}), guard_blocks=range(90_000, 91_000))
    memory, asked = polled(ReferenceMemory(), sample(), rules)
    for step, (number, block) in enumerate(
        [(1000, 100), (program, 90_010), (1000, 100), (program, 90_800), (1000, 100)]
    ):
        memory, effects = polled(memory, sample(10.5 + step * POLL_S, program=number, sequence_number=block), rules)
        asked += effects
    assert [type(effect) for effect in asked] == [ReferenceRequest]
    memory, _ = polled(memory, sample(13.0, program=2000, sequence_number=90_010), rules)
    assert memory.sample.program == 2000 and memory.sample.sequence_number == 0


def test_no_reference_outlasts_a_long_pause_of_this_computer_whatever_the_control_proves():
    state, texts = gap(0.5, after={"clock_s": 571.0 + 3.0}, handshake=True)
    assert state is ENDED and "clock went on by 63 s more than this computer's" in texts[0]


def test_what_was_asked_for_before_a_gap_does_not_come_into_force_after_it():
    memory, question = asked_for(polled(ReferenceMemory(), sample())[0], positioning=False)
    memory, _ = polled(memory, sample(14.0))
    memory, _ = reference.adopt(memory, answered(question), RULES, still_applied_um=0.0)
    assert memory.in_force is None and "may have been missed" in memory.ended


# --- what counts from it, and a restart --------------------------------------------------


def label(*, counted, rest_k=0.0):
    origin = LabelOrigin(
        sensor_ids=(7,), reference_degc=(20.0,), counted=(counted,), offset_k=(None,), rest_k=(rest_k, 0.0)
    )
    return SensorsSinceReference(reference_id="r", labels={"Nose": origin})


@pytest.mark.parametrize(("began_s", "right_k"), [(50.0, 1.0), (100.0, 1.0), (175.0, 1.0 + 0.75 * 2.0), (200.0, 1.0)])
def test_a_tool_that_came_while_its_sensors_were_away_is_set_right_when_they_return(began_s, right_k):
    """It began at the imputed 1.0 K; when the sensors return their label has gone 2.0 K further."""
    memory = in_force()
    memory = replace(
        memory, record=replace(memory.record, reference=replace(memory.record.reference, reference_id="r"))
    )
    tool = ToolOrigin(number=2, begin_degc={"Nose": 1.0, "Room": 0.5})
    for time_s, counts, rest_k in ((0.0, True, 0.0), (100.0, False, 0.0), (200.0, True, -2.0)):
        if began_s <= time_s and memory.record.tool is None:
            memory = reference.tool_begins(memory, tool, "r", began_s)
        memory = reference.with_sensors(memory, label(counted=counts, rest_k=rest_k), time_s)
    assert memory.record.tool.begin_degc == pytest.approx({"Nose": right_k, "Room": 0.5})
    assert not memory.labels_left_s


def with_label(memory, time_s, *, counted, step_k=0.0):
    """Take that the label's sensors count or not, as the estimation says it at a time [s]."""
    after_min = (time_s - memory.record.reference.time.monotonic_s) / 60.0 if step_k else 0.0
    said = label(counted=counted)
    said = replace(said, labels={"Nose": replace(said.labels["Nose"], rest_k=(step_k, after_min))})
    return reference.with_sensors(memory, said, time_s)


def test_a_tool_that_comes_while_the_step_of_a_return_fades_counts_from_what_the_sensors_say():
    """It began at 0.3 K of 2.6 K that the nose had: the rest of the step counted as its expansion, 1.1 um of a tool."""
    memory = with_label(in_force("r"), 1000.0, counted=True)
    memory = with_label(memory, 1100.0, counted=False)
    memory = with_label(memory, 1200.0, counted=True, step_k=-2.6)
    shown_k = 2.6 - 2.6 * np.exp(-5.0 / 30.0)
    tool = ToolOrigin(number=2, begin_degc={"Nose": shown_k, "Room": 0.5})
    began = reference.tool_begins(memory, tool, "r", 1207.0, {"Nose": 1205.0, "Room": 1205.0})
    assert began.record.tool.begin_degc == pytest.approx({"Nose": 2.6, "Room": 0.5})


@pytest.mark.parametrize(
    ("back_s", "began_s", "right_k"),
    [(110.0, 5.0, 1.0), (110.0, 10.0, 1.0), (110.0, 60.0, 2.0), (110.0, 110.0, 3.0), (110.0, 112.0, 3.0)]
    + [(210.0, 60.0, 1.5), (210.0, 160.0, 2.5), (210.0, 110.0, np.nan)],
)
def test_a_tool_that_came_while_nothing_was_heard_began_on_the_line_between_before_and_after(back_s, began_s, right_k):
    """Long after the one and before the other nobody knows: a spindle that cooled and warmed was 0.7 K off the line."""
    memory = in_force("r")
    memory = reference.tool_begins(memory, ToolOrigin(number=2, begin_degc={"Nose": 1.0, "Room": 0.5}), "r", began_s)
    before = {"Nose": (10.0, 1.0), "Room": (back_s - 10.0, 0.5)}
    memory = reference.tool_set_right(memory, before, {"Nose": 3.0, "Room": 9.0}, back_s)
    assert memory.record.tool.begin_degc == pytest.approx({"Nose": right_k, "Room": 0.5}, nan_ok=True)


def counted(memory, tools=()):
    output = replace(
        initial_memory(now_s=0.0, applied_um=np.array([1.0, -2.0]), wanted=(True, True)),
        reference_id="r1",
        error_reference_id="r1",
        model_id=MODEL,
        offset_um=np.array([0.5, 0.0]),
        weight=0.75,
        tools={
            number: ToolBaseline(
                baseline_um=np.array([np.nan, 3.0]), error_um=np.zeros(2), offset_um=np.array([0.0, 0.5])
            )
            for number in tools
        },
    )
    return reference.count_from(memory, output, AXES), output


def test_the_baseline_belongs_to_the_reference_that_the_output_counts_from():
    memory, output = counted(in_force())
    assert memory.record.baseline.baseline_um.tolist() == [1.0, -2.0]
    assert reference.count_from(memory, output, AXES) is memory, "nothing has changed"
    assert reference.count_from(in_force("r2"), output, AXES).record.baseline is None, "the output has not taken it yet"


def left_by(memory, now_s, counter=4, rules=RULES):
    """Through the store and another boot's monotonic clock."""
    text = json.dumps(to_json(document_of(memory, rules, counter)), allow_nan=False)
    return from_json(ReferenceDocument, json.loads(text), at(now_s))


def begun(left, first, *, counter=4, model_id=MODEL, axes=AXES, rules=RULES):
    memory, _ = polled(ReferenceMemory(), first)
    memory, effects = restart(memory, left, rules, axes=axes, model_id=model_id, request_counter=counter)
    output = initial_memory(now_s=0.0, applied_um=np.array([4.0, 5.0]), wanted=(True, True))
    return memory, effects, resumed(output, memory)


def test_a_restart_takes_the_reference_up_with_all_that_counts_from_it():
    memory, before = counted(in_force(handshake=True), tools=(2,))
    memory, effects, output = begun(left_by(memory, 40.0), sample(40.0))
    assert memory.state is VALID and np.array_equal(memory.record.reference.degc, [20.0, np.nan], equal_nan=True)
    assert isinstance(effects[0], ReferenceTakenUp) and said(effects) == ["taken up again: O1000 N100"]
    assert (output.reference_id, output.error_reference_id, output.model_id) == ("r1", "r1", MODEL)
    assert (output.baseline_um.tolist(), output.offset_um.tolist(), output.weight) == ([1.0, -2.0], [0.5, 0.0], 0.75)
    assert np.array_equal(output.tools[2].baseline_um, before.tools[2].baseline_um, equal_nan=True)
    assert output.command_um.tolist() == [4.0, 5.0], "the command still begins at the echo"


@pytest.mark.parametrize(
    ("first", "how", "words", "tools_stay"),
    [
        (sample(40.0, work_offset=55), {}, "the work offset changed", True),
        (sample(40.0), {"counter": 5}, "asked for something while the daemon was away", True),
        (sample(40.0, power_on_count=4), {}, "switched off and on", False),
        (sample(40.0, clock_s=515.0), {}, "went on differently", False),
        (sample(4000.0), {}, "not polled for longer than 600 s", False),
        (sample(40.0), {"model_id": "another"}, "it belongs to model m, the model is now another", False),
        (sample(40.0), {"axes": ("y", "x")}, "its baseline was not stored", False),
    ],
)
def test_what_does_not_hold_any_more_is_not_taken_up_and_says_why(first, how, words, tools_stay):
    memory, _ = counted(in_force(handshake=True), tools=(2,))
    memory, effects, output = begun(left_by(memory, first.time.monotonic_s), first, **how)
    assert memory.in_force is None and words in said(effects)[0] and words in memory.ended
    assert (memory.state, bool(output.tools)) == ((ENDED, True) if tools_stay else (NONE, False))
    assert output.reference_id is None and output.baseline_um.tolist() == [4.0, 5.0]


@pytest.mark.parametrize(("now", "taken_up"), [(MODEL, False), (None, True)])
def test_a_reference_from_which_no_model_has_counted_is_another_model_s_not_after_a_restart(now, taken_up):
    """It was taken up with any: the output would have gone by all that the machine has moved since the reference."""
    memory, before = counted(in_force(handshake=True))
    memory = reference.count_from(memory, replace(before, model_id=None), AXES)
    memory, effects, output = begun(left_by(memory, 40.0), sample(40.0), model_id=now)
    assert (memory.in_force is not None, output.reference_id == "r1") == (taken_up, taken_up)
    assert taken_up or memory.ended.endswith("no model has counted from it yet, the model is now m")


def test_what_is_kept_counts_with_the_sensors_and_the_factors_that_it_was_kept_with():
    memory, _ = counted(in_force(handshake=True), tools=(2,))
    kept, now = (replace(RULES, counts_with={"the list of sensors": ids, "the factor": "1"}) for ids in ("1 2", "2 1"))
    again, _, _ = begun(left_by(memory, 40.0, rules=kept), sample(40.0), rules=kept)
    assert again.state is VALID
    again, effects, output = begun(left_by(memory, 40.0, rules=kept), sample(40.0), rules=now)
    assert again.in_force is None and not output.tools
    assert [text.partition(": ")[2] for text in said(effects)] == [
        "the list of sensors changed while the daemon was away",
        "the list of sensors changed while the daemon was away; set these tools again",
    ]
    named = {"sensors, as another version calls them": "1 2", "the factor": "1"}
    left = left_by(memory, 40.0, rules=replace(RULES, counts_with=named))
    again, effects, output = begun(left, sample(40.0), rules=kept)
    assert again.in_force is None and not output.tools
    assert "another version of the daemon" in said(effects)[0]
    without_marks = left_by(memory, 40.0, rules=replace(RULES, counts_with={}))
    assert begun(without_marks, sample(40.0), rules=kept)[0].in_force is not None, "version 0.1.0 kept none"


def test_a_restart_before_the_answer_to_a_positioning_does_not_take_the_reference_before_up():
    memory, _ = counted(in_force(handshake=True), tools=(2,))
    memory, _ = asked_for(memory, "r2")
    memory, _, output = begun(left_by(memory, 40.0), sample(40.0))
    assert memory.state is ENDED and "positioned again" in memory.ended and list(output.tools) == [2]


def test_without_the_handshake_a_restart_while_the_program_ran_takes_nothing_up():
    memory, _ = counted(in_force())
    memory, effects, _ = begun(left_by(memory, 40.0), sample(40.0))
    assert memory.in_force is None and "may have been missed" in said(effects)[0]


@pytest.mark.parametrize(("calendar_s", "state"), [(0.0, VALID), (-1.9, NONE)])
def test_a_calendar_that_was_set_back_makes_no_restart_so_short_that_nothing_can_have_passed(calendar_s, state):
    """The control's clock went on by 3.4 s, and two hide a positioning."""
    memory, _ = counted(in_force())
    first = sample(11.5, clock_s=511.5 - calendar_s)
    assert begun(left_by(memory, 11.5), first)[0].state is state


@pytest.mark.parametrize("handshake", [False, True])
def test_a_positioning_that_was_counted_during_a_short_restart_is_none_that_the_reference_knows(handshake):
    """Also where the one before was asked for: a program may ask for one and pass its block for the other."""
    memory, _ = counted(polled(in_force(handshake=handshake), sample(10.5, macros={560: 4.0}))[0])
    for number, state in ((4.0, VALID), (5.0, ENDED)):
        start = ReferenceMemory(sample=sample(11.0, macros={560: number}))
        memory = replace(memory, sample=sample(10.5, macros={560: 4.0}), state=VALID)
        after, effects = restart(start, left_by(memory, 10.5), RULES, axes=AXES, model_id=MODEL, request_counter=4)
        assert (after.in_force is not None) == (state is VALID), (after.ended, effects)


def test_a_reference_that_was_set_since_the_start_stays():
    memory, _ = counted(in_force())
    after, effects = restart(
        in_force("new"), left_by(memory, 11.0), RULES, axes=AXES, model_id=MODEL, request_counter=4
    )
    assert after.in_force.reference_id == "new" and effects == ()


# --- whatever happens --------------------------------------------------------------------


class Workshop(RuleBasedStateMachine):
    """A control whose program positions work again and again, and a daemon that polls it when it can.

    Known is what the daemon cannot know: how often the work was positioned. Nothing may count from a positioning
    that is not the latest.
    """

    def __init__(self):
        super().__init__()
        self.memory, self.ids = ReferenceMemory(), (f"r{n}" for n in count())
        self.now_s, self.until_s, self.block, self.run = 10.0, 11.0, 200, CncRun.START
        self.program, self.work_offset, self.power_on = 1000, 54, 1
        self.positioned = self.counter = self.seen_counter = 0
        self.open = {}
        """Identity -> question of the daemon that nobody has answered."""
        self.zero_of = {}
        """Identity -> how often the work had been positioned when the reference was asked for."""
        self.linked, self.polled = True, False

    @initialize(handshake=st.booleans(), counted=st.booleans())
    def programme(self, handshake, counted):
        self.handshake = handshake
        self.rules = RULES if counted else replace(RULES, positioning_counter=None)
        self.poll(0.0)

    def _take(self, step):
        self.memory, effects = step
        for effect in effects:
            if isinstance(effect, ReferenceRequest):
                self.open[effect.reference_id], self.zero_of[effect.reference_id] = effect, self.positioned
        return effects

    def _pass(self, seconds):
        """Let the program run on; it stands at N100 for the dwell, and elsewhere for a while."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s = min(self.now_s + STEP_S, end_s)
            if self.run is CncRun.START and self.now_s >= self.until_s:
                self.block = {100: 200, 200: 300, 300: 100}[self.block]
                if self.block == 100:
                    self.positioned += 1
                    self.counter += self.handshake
                self.until_s = self.now_s + (DWELL_S if self.block == 100 else OTHER_S)

    @rule(delay=st.sampled_from([0.0, 0.1, 0.4]))
    @precondition(lambda self: self.linked)
    def poll(self, delay):
        asked_s = self.now_s
        self._pass(delay)
        found = sample(
            self.now_s,
            run=self.run,
            sequence_number=self.block,
            program=self.program,
            work_offset=self.work_offset,
            power_on_count=self.power_on,
            macros={560: float(self.positioned)},
        )
        self._take(reference.on_sample(self.memory, found, self.rules, asked_s=asked_s, new_id=partial(next, self.ids)))
        risen, self.seen_counter = self.counter - self.seen_counter, self.counter
        if risen > 1:
            self._take(reference.end(self.memory, "requests were missed"))
        if risen:
            self._take(reference.positioned_by_handshake(self.memory, self.rules))
            how = {"positioning": True, "handshake": True}
            self._take(reference.request(self.memory, next(self.ids), "handshake", **how))
        self.polled = True

    @rule(polls=st.integers(1, 8))
    @precondition(lambda self: self.linked)
    def go_on(self, polls):
        for _ in range(polls):
            self._pass(POLL_S)
            self.poll(0.0)

    @rule(seconds=st.sampled_from([0.5, 1.5, 3.0, 10.0, 60.0]))
    def stall(self, seconds):
        self._pass(seconds)
        self.polled = False

    @rule()
    def link(self):
        self.linked = not self.linked

    @rule()
    def start_or_stop(self):
        if self.run is not CncRun.START:
            self.run, self.until_s = CncRun.START, self.now_s + (DWELL_S if self.block == 100 else OTHER_S)
        else:
            self.run = CncRun.STOP

    @rule(program=st.sampled_from([1000, 2000]), work_offset=st.sampled_from([54, 55]))
    def select(self, program, work_offset):
        self.program, self.work_offset, self.polled = program, work_offset, False

    @rule()
    def power_cycle(self):
        self.power_on, self.polled = self.power_on + 1, False

    @rule(data=st.data(), refused=st.booleans())
    @precondition(lambda self: self.open)
    def answer(self, data, refused):
        question = self.open.pop(data.draw(st.sampled_from(sorted(self.open))))
        if refused:
            self._take(reference.refuse(self.memory, question.reference_id, "made up"))
        else:
            self._take(reference.adopt(self.memory, answered(question), self.rules, still_applied_um=9.0))

    @rule()
    def by_hand(self):
        if self.polled and not self.handshake:
            self._take(reference.request(self.memory, next(self.ids), "hand", positioning=False))

    @rule(seconds=st.sampled_from([0.0, 1.0, 5.0, 700.0]))
    def restart(self, seconds):
        memory = self.memory
        if memory.record is not None and memory.record.baseline is None:
            nothing = np.zeros(2)
            baseline = OutputBaseline(axes=AXES, model_id=MODEL, baseline_um=nothing, offset_um=nothing, weight=1.0)
            memory = replace(memory, record=replace(memory.record, baseline=baseline))
        counter, was_known = self.seen_counter, memory.sample is not None
        document = document_of(memory, self.rules, counter)
        self._pass(seconds)
        self.open, self.memory, self.polled = {}, ReferenceMemory(), False
        self.seen_counter = self.counter
        if not self.linked or not was_known:
            return
        self.poll(0.0)
        how = {"axes": AXES, "model_id": MODEL, "request_counter": self.counter}
        left = from_json(ReferenceDocument, json.loads(json.dumps(to_json(document))), at(self.now_s))
        self._take(restart(self.memory, left, self.rules, **how))

    @invariant()
    def a_reference_in_force_is_of_the_latest_positioning(self):
        found = self.memory.in_force
        awaited = [asked for asked in self.memory.requests if asked.positioning]
        if found is None or awaited or not self.polled:
            return
        assert self.zero_of[found.reference_id] == self.positioned
        assert (found.program, found.work_offset, found.power_on_count) == (
            (self.program, self.work_offset, self.power_on)
        )

    @invariant()
    def state_and_content_agree(self):
        memory = self.memory
        assert (memory.in_force is not None) is (memory.state is VALID)
        assert memory.state is not NONE or (memory.record is None and not memory.requests)
        assert memory.state is not REQUESTED or memory.requests
        assert memory.state is not ENDED or (memory.record is not None and not memory.requests)
        assert memory.state is not VALID or not memory.ended


def test_whatever_happens_nothing_is_in_force_but_the_reference_of_the_latest_positioning():
    run_state_machine_as_test(Workshop, settings=settings(max_examples=60, stateful_step_count=40, deadline=None))


def test_the_refusal_of_the_first_positioning_is_why_there_is_no_reference():
    memory, question = asked_for(polled(ReferenceMemory(), sample())[0])
    refused, _ = reference.refuse(memory, "r1", "no temperatures")
    assert refused.state is NONE and refused.ended == "the work was positioned, and that set none (no temperatures)"
    refused, _ = reference.adopt(memory, answered(question), ZERO_FIRST, still_applied_um=3.0)
    assert "that set none" in refused.ended and "zero_first" in refused.ended
    ended, _ = reference.end(polled(ReferenceMemory(), sample())[0], "a request was refused")
    assert ended.ended == "a request was refused", "the program's request was not a positioning that never passed"
