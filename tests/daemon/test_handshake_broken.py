"""Requests and references when something goes wrong between the poll, the step and the answer."""

import numpy as np
import pytest
from control_rig import Bench, running
from nc_requests import (
    ACKNOWLEDGE,
    KIND,
    PROBE,
    REFERENCE,
    TOOL_CHANGE,
    Z_AXIS,
    answer,
    ask,
    last_asked,
    requesting_bench,
)

from daemon.history import HistoryReader
from models.records import Reference


@pytest.fixture
def bench(tmp_path):
    return requesting_bench(tmp_path)


@pytest.fixture
async def rig(bench):
    async with running(bench.rig()) as rig:
        yield rig


async def zero_first_rig(tmp_path):
    bench = Bench(tmp_path)
    reference = bench.configuration.compensation.reference.model_copy(
        update={"policy": "zero_first", "retreat_sequence_numbers": [50]}
    )
    compensation = bench.configuration.compensation.model_copy(update={"reference": reference})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    return bench


async def test_a_retreat_block_takes_the_offset_out_also_when_the_reference_has_ended_before(tmp_path):
    bench = await zero_first_rig(tmp_path)
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


async def test_a_reference_that_comes_after_the_program_gave_up_is_refused(rig, bench):
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    late = last_asked(rig).reference_id
    bench.nc.macros.set(KIND, 0.0)
    await rig.turn()
    deliver_unasked(rig, late)
    await rig.turn()
    assert rig.control.reference is None


def deliver_unasked(rig, reference_id):
    """A reference arrives that nobody waits for."""
    rig.set_reference(reference_id + "x")
    rig.control._references.end("the test takes it away again")
    item = Reference(
        reference_id=reference_id,
        time=rig.clock.now(),
        source="late",
        degc=np.full(5, 20.0),
        program=rig.nc.program,
        work_offset=rig.nc.work_offset,
        power_on_count=rig.nc.power_on_count,
    )
    rig.control.deliver(item)


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
