"""What falls due when, and what goes first."""

import asyncio

import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from daemon.compensation.operator_requests import Cadence
from daemon.compensation.parts import Inbox


def test_it_is_due_every_period():
    cadence = Cadence(1.0, start_s=10.0)
    assert [time_s for time_s in (9.9, 10.0, 10.5, 11.0, 11.9, 12.0) if cadence.due(time_s)] == [10.0, 11.0, 12.0]


def test_what_was_late_is_not_made_up_for():
    cadence = Cadence(1.0, start_s=10.0)
    assert cadence.due(17.3)
    assert not cadence.due(17.4)
    assert cadence.next_s == pytest.approx(17.55), "not at once, and not a whole period later either"
    assert cadence.due(17.6)


async def test_waiting_ends_with_a_message_or_with_the_time():
    inbox, taken = Inbox(), []
    await inbox.woken(0.001)
    await inbox.woken(-1.0)
    assert not inbox
    asyncio.get_running_loop().call_soon(inbox.put, lambda: taken.append(1))
    async with asyncio.timeout(30.0):
        await inbox.woken(1e6)
    inbox.take()()
    assert taken == [1] and not inbox


@pytest.mark.parametrize(("new_reference", "expected"), [(False, ["act", "poll"]), (True, ["poll", "act"])])
async def test_an_estimate_goes_before_the_poll_and_counts_as_the_ticks_work(tmp_path, new_reference, expected):
    """But a new reference begins from where the guard stands now."""
    configuration, clock = machine(tmp_path), HandClock()
    rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(rig):
        await rig.active()
        control, order = rig.control, []

        async def act(estimate):
            order.append("act" if estimate is not None else "tick")

        async def poll():
            order.append("poll")
            control.stop()

        control._act, control._poll = act, poll
        if new_reference:
            rig.set_reference("r2")
        control.deliver(rig.estimate(1.0, 2.0))
        await control.run()
    assert order[:2] == expected
