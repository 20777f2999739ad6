"""What the control says that it applies is believed only as far as the guard can have done it."""

import pytest
from control_rig import ENABLE, Bench, Z, running

from daemon.history import HistoryReader
from models.records import WriteOutcome

ECHO_Z = 513


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


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


async def test_a_restart_does_not_clear_a_fault(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -10.0, 30)
        rig.alive()
        bench.nc.macros.set(Z, 0.002)
        await rig.turn()
        assert rig.state == "FAULT"
    bench.nc.macros.set(Z, rig.control.session.known[Z][0] if rig.control.session else 0.002)
    bench.nc.written.clear()
    async with running(bench.rig()) as again:
        await again.follow(0.0, -10.0, 10)
        assert again.state == "FAULT" and bench.nc.written == []
        again.acknowledge("p")
        await again.turn(safe=False)
        assert again.state == "HOLD"
    async with running(bench.rig()) as third:
        await third.turn()
        assert third.state != "FAULT", "acknowledged once is acknowledged"


async def test_another_model_does_not_take_the_old_reference_up(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        await rig.follow(0.0, -10.0, 30)
        stored = rig.history.get_state("reference")
        del stored["crc32"]
        stored["record"]["baseline"]["model_id"] = "another"
        rig.history.put_state("reference", stored)
        rig.alive()
    async with running(bench.rig()) as again:
        await again.follow(0.0, -10.0, 5)
        assert again.state == "HOLD"
        assert any("belongs to model another" in notice for notice in again.control.journal.notices)


async def test_a_control_that_refuses_a_write_is_a_fault_and_counted(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        bench.nc.refuses = Z
        await rig.follow(0.0, -10.0, 5)
        assert rig.state == "FAULT" and "refused" in rig.control.journal.alarm
        assert rig.control.writer.counts["refused"] == 1
        await rig.history.flushed()


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


def test_outcomes_are_named():
    assert WriteOutcome.REFUSED.name == "REFUSED"


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
