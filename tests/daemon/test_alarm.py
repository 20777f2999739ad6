"""When a person at the machine is told, in the states that ask something of the guard."""

from dataclasses import replace

import numpy as np
import pytest

from config.schema.compensation import OutputConfig
from daemon.cnc.macro_block import Echo
from daemon.compensation.alarms import GuardWatch, alarm_of
from models.control.compensation import initial_memory
from models.control.state import OutputMemory
from models.records import OutputState

INCH = 6


def memory_in(state: OutputState) -> OutputMemory:
    memory = initial_memory(now_s=0.0, applied_um=np.array([5.0]), wanted=(True,))
    return replace(memory, state=state, reason="somebody switched it off")


def alarm(state: OutputState, *, refusals: int, now_s: float = 10.0) -> str:
    watch = GuardWatch()
    watch.refusals = refusals
    echo = Echo(applied_um=np.array([5.0]), time_s=1.0, status=INCH, guard_version=1.0)
    return alarm_of(memory_in(state), echo, now_s=now_s, guard=watch, config=OutputConfig(), inhibit=None)


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
