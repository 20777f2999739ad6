"""When a person at the machine is told, in the states that ask something of the guard."""

from dataclasses import replace

import numpy as np
import pytest
from history_records import cnc_sample

from config.schema.compensation import OutputConfig
from daemon.cnc.macro_block import Echo
from daemon.compensation.alarms import NEARING, PLACE, GuardWatch, alarm_of
from drivers.guard.text import GuardStatus
from models.control.compensation import initial_memory
from models.control.state import OutputMemory
from models.records import OutputState

INCH = 6


def memory_in(state: OutputState) -> OutputMemory:
    memory = initial_memory(now_s=0.0, applied_um=np.array([5.0]), wanted=(True,))
    return replace(memory, state=state, reason="somebody switched it off")


def alarm(state: OutputState, *, refusals: int, now_s: float = 10.0) -> str:
    watch = GuardWatch(OutputConfig())
    watch.refusals = refusals
    echo = Echo(applied_um=np.array([5.0]), time_s=1.0, status=INCH, guard_version=1.0)
    return alarm_of(memory_in(state), None, echo, now_s=now_s, guard=watch, inhibit=lambda: None)


@pytest.mark.parametrize("state", [OutputState.ACTIVE, OutputState.HOLD, OutputState.RETREAT])
def test_a_guard_that_refuses_is_an_alarm_wherever_an_offset_stands(state: OutputState) -> None:
    assert "the guard does not apply the block (status 6" in alarm(state, refusals=2)
    assert alarm(state, refusals=1) == ""


@pytest.mark.parametrize("state", [OutputState.OFF, OutputState.ARMED])
def test_nothing_is_said_where_nothing_is_asked_of_it(state: OutputState) -> None:
    assert alarm(state, refusals=9) == ""


def test_a_long_hold_is_told_beside_the_guard() -> None:
    both = alarm(OutputState.HOLD, refusals=2, now_s=1000.0)
    assert "status 6" in both and "held for longer than 300 s: somebody switched it off" in both


def test_a_long_hold_is_one_alarm_however_long_it_lasts() -> None:
    """The audit gets an alarm when its first words change: they must not count the seconds."""
    assert len({alarm(OutputState.HOLD, refusals=0, now_s=now_s) for now_s in (400.0, 402.0, 500.0)}) == 1


def told(*statuses: int, state: OutputState = OutputState.ACTIVE) -> str:
    """Return the alarm after so many runs of the guard."""
    watch, echo = GuardWatch(OutputConfig()), Echo(applied_um=np.array([5.0]), time_s=0.0, status=0, guard_version=2.0)
    watch.follow(echo, cnc_sample(0.0))
    for run, status in enumerate(statuses, start=1):
        echo = replace(echo, time_s=float(run), status=status)
        watch.follow(echo, cnc_sample(float(run)))
    return alarm_of(memory_in(state), None, echo, now_s=10.0, guard=watch, inhibit=lambda: None)


def test_a_slope_that_is_on_its_way_twice_is_an_alarm_that_does_not_say_that_nothing_was_applied() -> None:
    assert told(13) == "" and told(13, 0, 13) == ""
    said = told(13, 13)
    assert said == told(13, 13, 13), "one alarm, however long it lasts"
    assert said.startswith(
        "the guard applies the block, but a slope is not yet in for where its axis stands (status 13)"
    )
    assert "call the guard again, the axis standing where the work is" in said and "does not apply" not in said
    assert told(13, 2) == "", "one torn read is none either after it"
    assert "(status 2" in told(13, 2, 2)


def test_an_axis_with_a_slope_outside_its_travel_is_told_with_where_to_call_the_guard() -> None:
    assert told(12) == "" and told(12, 13) == ""
    said = told(12, 12, state=OutputState.HOLD)
    assert said.startswith("the guard applies nothing of the block, of any axis: one with a slope stands outside")
    assert "(status 12): call the guard where the work is" in said and "slope.travel_mm" in said


def test_the_numbers_are_those_of_the_guards_text() -> None:
    assert (PLACE, NEARING) == (GuardStatus.PLACE, GuardStatus.NEARING)
