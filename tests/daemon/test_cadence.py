"""What falls due when, and what goes first."""

import pytest
from control_rig import HandClock, Rig, machine, record_for, running
from memory_cnc import MemoryNc

from daemon.compensation.operator_requests import Cadence


def test_what_was_late_is_not_made_up_for():
    cadence = Cadence(1.0, start_s=10.0)
    assert cadence.due(17.3)
    assert not cadence.due(17.4)
    assert cadence.next_s == pytest.approx(17.55), "not at once, and not a whole period later either"
    assert cadence.due(17.6)


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
