"""When a reference begins and ends, and what the machine is doing."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from models.control.program import phase_of, positioning_passed, power_cycled
from models.control.reference import end_of_reference
from models.records import CncMode, CncRun, CncSample, Instant, Phase, Reference

NOW = Instant(monotonic_s=0.0, utc_s=0.0, real_s=0.0)
SAMPLE = CncSample(
    time=NOW,
    mode=CncMode.MEMORY,
    run=CncRun.START,
    alarm=False,
    program=100,
    sequence_number=200,
    spindle_speed_rpm=0.0,
    motor_temperature_degc=20.0,
    clock_s=1000.0,
    power_on_count=3,
    work_offset=54,
    tool_number=1,
)
REFERENCE = Reference(
    reference_id="r", time=NOW, source="t", degc=np.zeros(1), program=100, work_offset=54, power_on_count=3
)


@pytest.mark.parametrize(
    ("run", "sequence", "phase"),
    [
        (CncRun.START, 900, Phase.SAFE_POINT),
        (CncRun.START, 200, Phase.CUTTING),
        (CncRun.HOLD, 900, Phase.CUTTING),
        (CncRun.UNKNOWN, 900, Phase.CUTTING),
        (CncRun.RESET, 200, Phase.IDLE),
        (CncRun.STOP, 200, Phase.IDLE),
    ],
)
def test_whatever_is_not_known_to_be_harmless_is_cutting(run, sequence, phase):
    assert phase_of(replace(SAMPLE, run=run, sequence_number=sequence), [900]) is phase


def test_only_the_edge_into_a_positioning_block_sets_a_reference():
    at = replace(SAMPLE, sequence_number=100)
    assert positioning_passed(SAMPLE, at, None, [100])
    assert not positioning_passed(at, at, None, [100])
    assert not positioning_passed(None, at, None, [100])
    assert not positioning_passed(SAMPLE, replace(at, run=CncRun.STOP), None, [100])
    assert not positioning_passed(SAMPLE, at, 7, [100])


@pytest.mark.parametrize("run", [CncRun.HOLD, CncRun.UNKNOWN])
def test_a_feed_hold_in_the_positioning_block_hides_no_positioning_and_makes_no_second_one(run):
    began, held = replace(SAMPLE, sequence_number=100), replace(SAMPLE, sequence_number=100, run=run)
    for polls in ((SAMPLE, held, began), (SAMPLE, began, held, began)):
        seen = [positioning_passed(before, now, None, [100]) for before, now in pairwise(polls)]
        assert seen == [True] + [False] * (len(polls) - 2)


def test_work_that_was_clamped_while_the_program_stood_stopped_at_its_block_is_positioned_when_it_goes_on():
    stopped, on = replace(SAMPLE, sequence_number=100, run=CncRun.STOP), replace(SAMPLE, sequence_number=110)
    seen = [
        positioning_passed(before, now, None, [100]) for before, now in pairwise((SAMPLE, stopped, stopped, on, on))
    ]
    assert seen == [False, False, True, False]
    assert not positioning_passed(replace(stopped, run=CncRun.RESET), on, None, [100]), "it may begin anew"
    assert not positioning_passed(stopped, replace(on, program=7), None, [100])


def test_a_power_cycle_shows_in_the_count_or_in_the_clock_going_back():
    assert not power_cycled(None, SAMPLE)
    assert not power_cycled(SAMPLE, replace(SAMPLE, clock_s=999.5))
    assert power_cycled(SAMPLE, replace(SAMPLE, clock_s=5.0))
    assert power_cycled(SAMPLE, replace(SAMPLE, power_on_count=4))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"power_on_count": 4}, "switched off"),
        ({"work_offset": 55}, "work offset"),
        ({"program": 7}, "program changed"),
    ],
)
def test_what_ends_a_reference(change, words):
    assert end_of_reference(REFERENCE, SAMPLE) == ""
    assert words in end_of_reference(REFERENCE, replace(SAMPLE, **change))
