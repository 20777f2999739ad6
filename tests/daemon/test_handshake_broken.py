"""Requests and references when something goes wrong between the poll, the step and the answer."""

import pytest
from control_rig import Bench, running
from nc_requests import (
    ACKNOWLEDGE,
    COUNTER,
    PROBE,
    REFERENCE,
    TOOL_CHANGE,
    Z_AXIS,
    answer,
    ask,
    requesting_bench,
    zero_first,
)

from daemon.history.reader import HistoryReader
from drivers.contract import LinkError


@pytest.fixture
def bench(tmp_path):
    return requesting_bench(tmp_path)


async def test_a_retreat_block_takes_the_offset_out_also_when_the_reference_has_ended_before(tmp_path):
    bench = zero_first(Bench(tmp_path))
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -8.0, 40)
        bench.nc.work_offset = 55
        await rig.turn()
        bench.nc.work_offset = 54
        await rig.turn()
        assert rig.state == "HOLD"
        bench.nc.sequence_number = 50
        for _ in range(40):
            await rig.turn()
        assert rig.state == "OFF" and rig.applied["z"] == pytest.approx(0.0)


async def test_the_gap_rule_is_waived_only_for_a_reference_that_the_handshake_set(rig, bench):
    await rig.active()
    ask(bench, 1, TOOL_CHANGE, 0, 2.0)
    await rig.turn()
    assert answer(bench) == 1.0
    await rig.turn(rig.estimate(0.0, 0.0), after_s=60.0)
    assert rig.control.reference is None


async def test_what_was_asked_for_when_the_link_dropped_is_refused_and_not_answered_as_done(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, PROBE, Z_AXIS, 0.003)
    await rig.control._guarded(rig.control._poll())
    bench.nc.reachable = False
    await rig.turn()
    bench.nc.reachable = True
    await rig.connected()
    await rig.turn()
    await rig.turn()
    assert answer(bench) == -1.0
    assert rig.control.memory.offset_um[2] == 0.0
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        (probe,) = reader.probes(0.0, 2.0**40)
    assert not probe.accepted and "lost before it took effect" in probe.reason


async def test_an_answer_that_could_not_be_written_is_written_on_the_next_session(rig, bench):
    await rig.active()
    await rig.follow(0.0, 0.0, 2)
    ask(bench, 1, TOOL_CHANGE, 0, 2.0)
    await rig.control._guarded(rig.control._poll())
    bench.nc.groups_until_lost = 0
    await rig.control._guarded(rig.control._act(None))
    assert answer(bench) == 0.0
    await rig.connected()
    await rig.turn()
    await rig.turn()
    assert answer(bench) == 1.0


async def test_a_control_that_refuses_the_answer_is_a_fault(rig, bench):
    await rig.active()
    bench.nc.refuses = ACKNOWLEDGE
    ask(bench, 1, TOOL_CHANGE, 0, 2.0)
    await rig.turn()
    assert "answer to the NC program" in (rig.control.journal.fault or "")


async def test_a_restart_after_a_tool_change_takes_the_reference_up(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        ask(bench, 1, TOOL_CHANGE, 0, 2.0)
        await rig.turn()
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is not None


async def test_programs_of_the_guard_are_no_other_program(rig, bench):
    await rig.active()
    guard = rig.configuration.cnc.guard.program
    for number in (guard, guard + 2, guard + 4):
        bench.nc.program, bench.nc.sequence_number = number, 900
        await rig.turn()
        assert rig.control.reference is not None
        assert rig.control.phase.value == "cutting", "N900 of the guard is no safe point of the program"


async def test_what_was_asked_for_before_the_cnc_was_switched_off_is_refused_too_when_the_link_drops_once_more(
    rig, bench
):
    await rig.active(handshake=True)
    ask(bench, 1, REFERENCE)
    bench.nc.power_cycle()
    bench.clock.monotonic_s += 100.0
    bench.nc.after_read = lambda _macros: setattr(bench.nc, "breaks", LinkError("the control is still starting"))
    await rig.turn()
    bench.nc.after_read = None
    bench.nc.breaks = None
    await rig.connected()
    await rig.turn()
    assert answer(bench) == -1.0


async def test_the_first_request_of_all_ends_what_the_work_had_before(tmp_path):
    """Nothing had been asked for since the control is there: its counter was vacant when the daemon saw it first."""
    bench = requesting_bench(tmp_path)
    bench.nc.macros.set(COUNTER, None)
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, 0.0, 2)
        assert rig.state == "ACTIVE"
        ask(bench, 1, REFERENCE)
        await rig.turn(rig.estimate(0.0, 0.0))
        assert rig.control.reference is None and answer(bench) == -1.0
