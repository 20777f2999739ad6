"""What people are told of alarms: once, with the end of it, and never more often than is allowed, whatever happens."""

import json
from dataclasses import asdict
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from daemon.sinks.alarms.ledger import MOST_ENTRIES, Condition, Ledger, Limits
from daemon.sinks.alarms.message import Message, in_words
from daemon.sinks.alarms.sink import SETTLED_S, OutputTrack

LIMITS = Limits(interval_s=300.0, remind_s=86_400.0)
FILE = TypeAdapter(Ledger)
EVERY = ("fault", "daemon", "link", "sensor", "hold")
pytestmark = pytest.mark.usefixtures("in_chicago")


def condition(kind: str = "link", subject: str = "CNC", **changes: object) -> Condition:
    return Condition(**{"kind": kind, "subject": subject, "text": "gone", "since_utc_s": 0.0} | changes)


def told(ledger: Ledger, now_s: float, limits: Limits = LIMITS) -> tuple[Ledger, list[str]]:
    entries = ledger.due(limits, now_s)
    return (ledger.told(entries, now_s), [in_words(entry) for entry in entries]) if entries else (ledger, [])


def test_an_alarm_is_told_once_then_its_end() -> None:
    ledger, said = told(Ledger().seen([condition()], EVERY, 10.0), 10.0)
    assert said == ["link CNC, since 1969-12-31 18:00:00-06:00: gone"]
    for now_s in range(20, 5000, 10):
        ledger, said = told(ledger.seen([condition(text=f"gone at {now_s}")], EVERY, now_s), now_s)
        assert said == []
    ledger, said = told(ledger.seen([], EVERY, 6000.0), 6000.0)
    assert said == ["over after 100 min: link CNC: gone at 4990"]
    assert ledger.alarms == () and told(ledger, 1e6)[1] == []


def test_every_sentence_is_english_for_the_end_and_for_many_sensors_too() -> None:
    begun = [condition("daemon", ""), condition("sensor", "", text="25 sensors do not count, such as 1, 2, 3, 4, 5")]
    ledger, said = told(Ledger().seen(begun, EVERY, 10.0), 10.0)
    since = "since 1969-12-31 18:00:00-06:00"
    assert said == [
        f"the daemon does not run, {since}: gone",
        f"many sensors, {since}: 25 sensors do not count, such as 1, 2, 3, 4, 5",
    ]
    entries = ledger.seen([condition("link", "CNC")], EVERY, 900.0).due(LIMITS, 900.0)
    assert [in_words(entry) for entry in entries] == [
        "over after 15 min: the daemon does not run: gone",
        f"link CNC, {since}: gone",
        "over after 15 min: many sensors: 25 sensors do not count, such as 1, 2, 3, 4, 5",
    ], "what is over does not stand before what begins, but for what is urgent"
    subject = Message(machine="mill 7", time_utc_s=900.0, entries=entries[1:]).subject
    assert subject == f"mill 7: first of 2: link CNC, {since}: gone"


def test_what_nobody_could_judge_neither_begins_nor_ends() -> None:
    """The daemon does not answer: its links are neither up nor down."""
    ledger, _ = told(Ledger().seen([condition()], EVERY, 10.0), 10.0)
    ledger = ledger.seen([condition("daemon", "")], ("daemon", "fault"), 1000.0)
    ledger, said = told(ledger, 1000.0)
    assert len(said) == 1 and said[0].startswith("the daemon does not run, since")


def test_what_comes_together_is_one_message_and_no_alarm_is_lost() -> None:
    many = [condition("sensor", str(number)) for number in range(130)]
    ledger, now_s, seen = Ledger().seen(many, EVERY, 0.0), 0.0, []
    while said := told(ledger, now_s)[1]:
        ledger, _ = told(ledger, now_s)
        seen += said
        assert len(said) <= MOST_ENTRIES
        now_s += LIMITS.interval_s
    assert len(seen) == len(set(seen)) == 130


def test_a_fault_does_not_wait_for_others_and_a_new_reason_is_told() -> None:
    ledger, _ = told(Ledger().seen([condition()], EVERY, 0.0), 0.0)
    fault = condition("fault", "", text="read-back differs")
    ledger, said = told(ledger.seen([condition(), condition(subject="bed"), fault], EVERY, 10.0), 10.0)
    assert said[0].startswith("FAULT, since") and len(said) == 2
    more = condition("fault", "", text="read-back differs; a write was refused", reasons=2)
    ledger = ledger.seen([condition(), condition(subject="bed"), more], EVERY, 20.0)
    assert told(ledger, 20.0)[1] == []
    ledger, said = told(ledger, 310.0)
    assert said == [
        "FAULT again or for one more reason, since 1969-12-31 18:00:00-06:00: read-back differs; a write was refused"
    ]


def test_what_was_over_before_it_could_be_told_is_told_once_with_its_times() -> None:
    ledger, _ = told(Ledger().seen([condition()], EVERY, 0.0), 0.0)
    for start_s in (10.0, 60.0, 110.0):
        ledger = ledger.over(condition("hold", "", since_utc_s=start_s), start_s + 30.0)
    ledger, said = told(ledger, 400.0)
    assert said == ["over after 2 min: HOLD (3 times): gone"]


def test_what_lasts_is_told_again_after_a_day() -> None:
    ledger, _ = told(Ledger().seen([condition()], EVERY, 0.0), 0.0)
    assert told(ledger, 86_399.0)[1] == []
    ledger, said = told(ledger, 86_400.0)
    assert said == ["link CNC still, since 1969-12-31 18:00:00-06:00: gone"]
    assert told(ledger, 86_500.0)[1] == []


STEPS = st.lists(
    st.tuples(
        st.floats(0.0, 400.0), st.lists(st.sampled_from([(k, s) for k in EVERY for s in ("", "b")])), st.booleans()
    ),
    max_size=60,
)


@given(steps=STEPS)
@settings(max_examples=60, deadline=None)
def test_however_alarms_come_and_go_messages_are_bounded_and_each_end_is_told(steps) -> None:
    ledger, now_s, sent, open_ = Ledger(), 0.0, [], {}
    for wait_s, there, taken in [*steps, *[(LIMITS.interval_s, [], True)] * 2]:
        now_s += wait_s
        ledger = ledger.seen([condition(k, s, since_utc_s=now_s) for k, s in there], EVERY, now_s)
        ledger = FILE.validate_json(json.dumps(asdict(ledger)))
        entries = ledger.due(LIMITS, now_s)
        if not entries or not taken:
            continue
        keys = [entry.alarm.key for entry in entries]
        assert len(keys) == len(set(keys)), "one alarm stands in a message once"
        for entry in entries:
            before = open_.get(entry.alarm.key)
            assert (entry.change in ("changed", "reminder")) <= bool(before) and not (
                entry.change == "raised" and before
            )
            open_[entry.alarm.key] = entry.change != "ended"
        ledger = ledger.told(entries, now_s)
        sent.append((now_s, any(key[0] in ("fault", "daemon") for key in keys)))
    for group in ([t for t, urgent in sent if urgent], [t for t, urgent in sent if not urgent]):
        assert all(b - a >= LIMITS.interval_s for a, b in pairwise(group))
    assert not any(open_.values()) and ledger.alarms == (), "every alarm of which people know has been ended for them"


def follow(*events: tuple[float, str, str]) -> tuple[OutputTrack, list[tuple[str, float]]]:
    track, over = OutputTrack(), []
    for utc_s, kind, text in events:
        track, ended = track.after(utc_s, kind, text)
        over += [(stay.state, utc_s - stay.since_utc_s) for stay in ended]
    return track, over


def test_a_restart_in_fault_is_the_same_fault() -> None:
    before = ((0.0, "fault", "why"), (0.0, "state", "ARMED -> FAULT: why"))
    track, over = follow(*before, (60.0, "start", "OFF: begun"), (60.5, "state", "OFF -> FAULT: why"))
    assert over == []
    assert track.now is not None and (track.now.state, track.now.since_utc_s) == ("FAULT", 0.0)
    track, over = follow(*before, (60.0, "start", "OFF: begun"))
    assert track.settled(60.0 + SETTLED_S - 1.0)[1] == ()
    settled, (ended,) = track.settled(60.0 + SETTLED_S)
    assert ended.state == "FAULT" and settled.now is not None and settled.now.state == "OFF"
