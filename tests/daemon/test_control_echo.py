"""What the control says that it applies is believed only as far as the guard can have done it."""

import pytest
from control_rig import ENABLE, running

from daemon.history.reader import HistoryReader

ECHO_Z = 513


@pytest.mark.parametrize("echo_mm", [0.025, 0.5, -0.031])
async def test_an_echo_that_the_block_cannot_explain_is_a_fault_at_the_start(bench, echo_mm):
    bench.nc.macros.set(ECHO_Z, echo_mm)
    async with running(bench.rig()) as rig:
        for _ in range(5):
            await rig.turn(safe=False)
        assert rig.state == "FAULT" and "axis z" in rig.control.journal.alarm
        assert bench.nc.written == []
        assert bench.nc.macros.get(ENABLE) == 0.0


async def test_a_foreign_echo_never_becomes_the_baseline(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        bench.nc.macros.set(ECHO_Z, 0.025)
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        bench.nc.written.clear()
        rig.set_reference("r2")
        await rig.turn(rig.estimate(0.0, 0.0), safe=False)
        assert rig.state == "FAULT"
        assert bench.nc.written == []
        assert abs(rig.applied["z"]) < 0.01


async def test_nobody_can_acknowledge_an_echo_beyond_the_bound(bench):
    bench.nc.macros.set(ECHO_Z, 0.5)
    async with running(bench.rig()) as rig:
        await rig.turn(safe=False)
        await rig.turn(safe=False)
        rig.acknowledge("p")
        await rig.turn(safe=False)
        assert rig.state == "FAULT" and bench.nc.written == []


async def refuse(rig, bench):
    """The guard runs, and takes nothing over."""
    bench.nc.macros.set(514, bench.nc.macros.get(514) + 1.0)
    bench.nc.macros.set(515, 3.0)
    await rig.turn(rig.estimate(0.0, 0.0), safe=False)


async def test_a_guard_that_refuses_twice_raises_the_alarm_and_once_does_not(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await refuse(rig, bench)
        assert rig.control.journal.alarm == "", "the block may have been torn by its writing"
        await refuse(rig, bench)
        assert rig.state == "ACTIVE" and "status 3" in rig.control.journal.alarm
        await rig.turn(rig.estimate(0.0, 0.0))
        await rig.turn(rig.estimate(0.0, 0.0))
        assert rig.control.journal.alarm == ""


async def test_a_guard_that_never_runs_raises_the_alarm(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        for _ in range(20):
            await rig.turn(rig.estimate(0.0, 0.0), after_s=4.9, safe=False)
        assert rig.control.guard_watch.silent_s > 90.0
        limit_s = rig.configuration.compensation.output.guard_alarm_after_s
        while rig.control.guard_watch.silent_s <= limit_s:
            await rig.turn(rig.estimate(0.0, 0.0), after_s=4.9, safe=False)
        await rig.turn(rig.estimate(0.0, 0.0), after_s=4.9, safe=False)
        assert rig.state == "ACTIVE" and "has not run for 30 min" in rig.control.journal.alarm


async def test_the_audit_holds_when_the_guard_had_taken_over_what_a_cycle_led_to(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        for _ in range(20):
            await rig.turn(rig.estimate(0.0, -5.0), safe=False)
        await rig.turn(safe=True)
        await rig.turn(safe=True)
        await rig.history.flushed()
        with HistoryReader(rig.history.path) as reader:
            writes = reader.writes(0.0, 2.0**40)
        echoed = [record for record in writes if record.echoed_after_s is not None]
        latest = echoed[-1]
        assert latest.compensation_um["z"] == pytest.approx(5.0, abs=0.11) and latest.cause == "estimate"
        assert latest.echoed_after_s > latest.delay_s["read_back"]
        assert all(record.echoed_after_s is None for record in writes if record.cause == "tick")
