"""The control task: what it follows, what a person may ask of it, when a reference ends."""

import asyncio
import time
from contextlib import asynccontextmanager

import numpy as np
import pytest
from control_rig import BLOCK, ENABLE, SEQUENCE_A, SEQUENCE_B, VALID_UNTIL, Rig, Z, machine, record_for, running
from memory_cnc import MemoryNc

from config.records.commissioning import CommissionedAxis
from daemon.messages import ReferenceRebased, ReferenceRefused, ReferenceRequest
from daemon.monitor.control_socket import RequestError
from drivers.clock import SystemClock
from models.control.state import OperatorRequest
from models.records import CncRun


async def test_the_tool_point_is_moved_against_the_error(rig):
    await rig.active()
    await rig.follow(5.0, -12.0)
    assert rig.state == "ACTIVE"
    assert rig.applied == pytest.approx({"x": 0.0, "y": -5.0, "z": 12.0}, abs=0.11)
    assert rig.control.writer.counts["verified"] == rig.control.writer.counts["sent"] > 0
    assert rig.control.writer.axes == {"y", "z"}


async def test_the_block_is_written_first_to_last_with_valid_until_on_the_clock_of_the_cnc(rig, bench):
    await rig.active()
    bench.nc.written.clear()
    await rig.turn(rig.estimate(0.0, -3.0), safe=False)
    numbers = [number for number, _ in bench.nc.written]
    values = dict(bench.nc.written)
    assert sorted(numbers) == sorted(BLOCK)
    assert numbers[0] == SEQUENCE_A and numbers[-1] == SEQUENCE_B
    assert values[SEQUENCE_A] == values[SEQUENCE_B]
    validity_s = bench.configuration.compensation.output.validity_s
    assert values[VALID_UNTIL] == pytest.approx(bench.nc.clock_s + validity_s, abs=0.01)
    assert values[ENABLE] == 0b110
    assert abs(bench.nc.clock_s - bench.clock.monotonic_s) > 100, "the clocks differ, or nothing is shown"


async def test_an_axis_that_moves_further_than_is_written_stops_within_its_bound_however_the_control_rounds(bench):
    """16.7 um move it by 30.06, and the control makes 17 of them."""
    scales = {"y": 1.0, "z": 1.8}
    proved = {a: CommissionedAxis(sign=1, scale=s, written_um=10.0, measured_um=10.0 * s) for a, s in scales.items()}
    async with running(bench.rig(record=record_for(bench.configuration, axes=proved))) as rig:
        await rig.active()
        await rig.follow(0.0, -100.0, 80)
        assert rig.state == "ACTIVE", rig.control.journal.fault
        assert 28.0 < 1.8 * rig.applied["z"] <= 30.0


async def test_nothing_is_written_before_a_person_asks(rig, bench):
    await rig.turn()
    rig.set_reference()
    await rig.follow(5.0, 5.0, 5)
    assert bench.nc.written == []


async def test_slew_rate_and_bound_hold_whatever_is_estimated(rig, bench):
    await rig.active()
    before = 0.0
    for error in (-500.0, 500.0, -7.0, 300.0):
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, error))
            now = bench.nc.macros.get(Z) * 1000.0
            assert abs(now - before) <= 60.0 / 60.0 * 0.5 + 1e-6
            assert abs(now) <= 30.0 + 1e-9
            before = now


async def test_an_axis_that_the_bound_keeps_from_where_the_estimate_is_says_so(rig):
    """Over a day of positionings that move nothing the offset grows; beyond the bound the tool is wrong by the rest."""
    await rig.active()
    await rig.follow(0.0, -30.8, 130)
    assert rig.state == "ACTIVE" and rig.control.journal.alarm == ""
    await rig.follow(0.0, -20.0, 40)
    await rig.follow(0.0, -31.5, 2)
    assert rig.applied["z"] < 29.0 and rig.control.journal.alarm == "", "it is on its way, and has not reached it"
    await rig.follow(0.0, -34.0, 20)
    assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(30.0, abs=0.11)
    assert "axis z has reached its bound: it stands 4.0 um short" in rig.control.journal.alarm
    await rig.follow(0.0, -29.0, 8)
    assert rig.control.journal.alarm == ""


async def test_nan_never_leaves(rig, bench):
    await rig.active()
    await rig.follow(3.0, -3.0, 10)
    await rig.follow(np.nan, np.nan, 5)
    assert rig.state == "HOLD"
    assert np.isfinite([value for _, value in bench.nc.written]).all()
    assert rig.applied == pytest.approx({"x": 0.0, "y": -3.0, "z": 3.0}, abs=0.11)
    await rig.follow(3.0, -3.0, 3)
    assert rig.state == "ACTIVE"


async def test_requests_that_cannot_be_met_are_refused_in_words(rig):
    assert "not been reached" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
    await rig.turn()
    assert "no axis w" in rig.control.request(OperatorRequest(enable=frozenset({"w"})), "p")
    assert "no axis w" in rig.control.request(OperatorRequest(disable=frozenset({"w"})), "p")
    assert "axis x has no model" in rig.control.request(OperatorRequest(enable=frozenset({"x"})), "p")
    await rig.turn()
    assert not any(rig.control.memory.wanted)


async def test_without_a_commissioning_record_nothing_is_enabled(bench):
    async with running(bench.rig(record=None)) as rig:
        await rig.turn()
        assert "no commissioning record" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_the_record_of_another_control_or_macro_map_does_not_count(bench):
    for changes, words in (
        ({"cnc_identity": "urn:other"}, "is for 'urn:other'"),
        ({"macro_map_sha256": "0" * 64}, "macro map has changed"),
        ({"machine": "another"}, "is of machine 'another', this one is 'rig'"),
        ({"axes": {}}, "not commissioned: axis z"),
    ):
        async with running(bench.rig(record=record_for(bench.configuration, **changes))) as rig:
            await rig.turn()
            assert words in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_without_a_model_nothing_is_enabled(bench):
    async with running(bench.rig(model_problem="no thermal model is configured")) as rig:
        await rig.turn()
        assert "no thermal model" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")


async def test_switching_off_retreats_and_then_writes_enable_0_once(rig, bench):
    await rig.active()
    await rig.follow(-4.0, -6.0, 20)
    rig.control.request(OperatorRequest(disable=frozenset({"y", "z"}), zero=True), "p")
    await rig.follow(-4.0, -6.0, 30)
    assert rig.state == "OFF"
    assert rig.applied == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.0}, abs=1e-6)
    assert bench.nc.macros.get(ENABLE) == 0.0
    bench.nc.written.clear()
    await rig.follow(-4.0, -6.0, 200)
    assert bench.nc.written == []


async def test_setting_a_reference_does_not_move_the_output(rig, bench):
    await rig.active()
    await rig.follow(0.0, -15.0)
    before = bench.nc.macros.get(Z)
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 5)
    assert bench.nc.macros.get(Z) == pytest.approx(before, abs=1e-9)
    await rig.follow(0.0, -2.0, 10)
    assert bench.nc.macros.get(Z) * 1000 == pytest.approx(before * 1000 + 2.0, abs=0.11)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda nc: setattr(nc, "program", 2000), "program changed"),
        (lambda nc: setattr(nc, "work_offset", 55), "work offset changed"),
        (lambda nc: nc.power_cycle(), "switched off and on"),
        (lambda nc: setattr(nc, "clock_zero_s", nc.clock_zero_s - 100.0), "clock went back"),
    ],
)
async def test_the_reference_ends_and_the_output_holds(rig, bench, change, words):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    change(bench.nc)
    await rig.turn(rig.estimate(0.0, -25.0))
    await rig.follow(0.0, -25.0, 10)
    assert rig.control.reference is None
    assert any(words in notice for notice in rig.control.journal.notices)
    assert rig.state == "HOLD"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)
    assert rig.history.get_state("reference")["state"] in ("ended", "none")
    rig.set_reference("r2")
    await rig.follow(0.0, 0.0, 10)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_positioning_block_asks_for_a_reference_once(rig, bench):
    await rig.turn()
    bench.nc.sequence_number = 100
    for _ in range(5):
        await rig.turn()
    assert len(rig.asked) == 1
    request = rig.asked[0]
    assert isinstance(request, ReferenceRequest)
    assert (request.source, request.program, request.work_offset) == ("O1000 N100", 1000, 54)


async def test_a_reference_by_hand_names_the_person_and_needs_a_link(rig, bench):
    await rig.turn()
    assert rig.control.requests.put_reference("Ada (uid 7)") == ""
    assert rig.asked == [], "asked for in the control task's own stack"
    await rig.hear()
    assert "Ada" in rig.asked[0].source
    bench.nc.reachable = False
    await rig.turn()
    assert "no link" in rig.control.requests.put_reference("Ada")


async def some_turns(rig):
    for _ in range(4):
        await rig.turn()
        await asyncio.sleep(0)


async def asked_by_two(rig):
    """Two people ask for a reference at the same moment; return their waiting answers and what the estimation hears."""
    await rig.active()
    rig.asked.clear()
    desk = rig.desk()
    answers = [asyncio.create_task(desk.handle({"command": "reference"}, name)) for name in ("Ada", "Bob")]
    await asyncio.sleep(0)
    await rig.turn()
    assert [question.source for question in rig.asked] == ["hand: Ada", "hand: Bob"]
    return answers, [question.reference_id for question in rig.asked]


async def test_of_two_people_each_hears_what_became_of_his_own_reference(rig):
    (of_ada, of_bob), (first, second) = await asked_by_two(rig)
    rig.set_reference(first)
    await some_turns(rig)
    assert (await asyncio.wait_for(of_ada, 1.0))["decided"], "hers is in force, whatever becomes of his"
    rig.control.deliver(ReferenceRefused(reference_id=second, why="no temperature has arrived"))
    await some_turns(rig)
    with pytest.raises(RequestError, match="no temperature has arrived"):
        await asyncio.wait_for(of_bob, 1.0)
    assert rig.control.reference.reference_id == first


async def test_a_reference_by_hand_that_nobody_has_decided_on_is_not_said_to_be(rig, monkeypatch):
    monkeypatch.setattr("daemon.monitor.commands.DECISION_S", 0.05)
    await rig.active()
    answer = asyncio.create_task(rig.desk().handle({"command": "reference"}, "Ada"))
    while not answer.done():
        await rig.turn()
        await asyncio.sleep(0.01)
    assert await answer == {"decided": False}


async def test_an_estimate_of_another_reference_moves_nothing(rig, bench):
    await rig.active()
    await rig.follow(0.0, -5.0, 15)
    await rig.follow(0.0, -25.0, 10, reference_id="old")
    assert rig.state == "HOLD"
    assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)


@asynccontextmanager
async def looping(configuration):
    """The control task in its own loop by the computer's clock, a reference set and the Z axis switched on."""
    clock = SystemClock()
    nc = MemoryNc(configuration, clock)
    async with running(Rig(configuration, nc, clock, record=record_for(configuration))) as rig:
        task = asyncio.create_task(rig.control.run())
        try:
            await until(lambda: rig.control.memory is not None)
            rig.set_reference()
            await until(lambda: rig.control.reference is not None)
            rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
            yield rig, nc, task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_the_loop_polls_ticks_writes_and_survives_a_defect(tmp_path):
    configuration = machine(tmp_path)
    async with looping(configuration) as (rig, nc, task):
        rig.control.deliver(rig.estimate(0.0, 0.0))
        await until(lambda: rig.state == "ACTIVE")
        assert rig.control.writer.counts["verified"] > 0
        ticks = rig.ticks
        nc.breaks = RuntimeError("made up")
        await until(lambda: rig.state == "FAULT")
        await until(lambda: rig.ticks > ticks + 1)
        assert not task.done()
        rig.control.stop()
        async with asyncio.timeout(10):
            await task


async def test_a_refusal_behind_a_reference_does_not_hide_that_the_echo_is_looked_at_first(rig):
    await rig.active()
    rig.set_reference("r2")
    rig.set_reference("late", positioning=False)
    rig.control._references.withdraw("late")
    await rig.hear()
    assert rig.control.reference.reference_id == "r2" and "no longer waited for" in rig.control.journal.notices[-1]
    assert rig.control._unseen_reference, "the baseline is where the guard stands now, not at the last poll"


async def test_a_defect_while_a_message_is_taken_is_a_fault_and_the_next_message_is_taken(rig, monkeypatch):
    await rig.active()
    await rig.follow(0.0, -5.0, 15)

    def broken(_reference):
        raise ValueError("nobody expected this")

    monkeypatch.setattr(rig.control._references, "rebase", broken)
    rig.control.deliver(ReferenceRebased(reference=rig.control.reference))
    rig.control.deliver(rig.estimate(0.0, -6.0))
    assert rig.control.journal.fault is None, "it is met in the control task's own stack"
    await rig.hear()
    await rig.hear()
    assert rig.control.journal.fault == "unexpected ValueError in the output task: nobody expected this"
    assert rig.control._estimate.thermal_error_um[1] == -6.0
    await rig.turn()
    assert rig.state == "FAULT"


async def test_a_defect_at_the_tick_is_a_fault_and_the_loop_goes_on(tmp_path):
    configuration, clock = machine(tmp_path), SystemClock()
    the_rig = Rig(configuration, MemoryNc(configuration, clock), clock, record=record_for(configuration))
    async with running(the_rig) as rig:
        ticks = []

        def broken():
            ticks.append(None)
            raise ZeroDivisionError("nobody expected this")

        rig.on_tick = broken
        task = asyncio.create_task(rig.control.run())
        try:
            await until(lambda: rig.state == "FAULT" or task.done())
            await until(lambda: len(ticks) > 1 or task.done())
            assert not task.done() and "ZeroDivisionError" in rig.control.journal.fault
            assert len(rig.control.journal.faults) == 1, "one reason, however often"
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_an_estimate_is_written_without_waiting_for_the_next_tick(tmp_path):
    """The tick is a minute here: only the estimate itself can cause the write."""
    configuration = machine(tmp_path, tick_s=60.0, validity_s=100.0)
    async with looping(configuration) as (rig, nc, task):
        for _ in range(3):
            rig.control.deliver(rig.estimate(0.0, -5.0))
            writes = rig.control.writer.counts["verified"]
            await until(lambda writes=writes: rig.control.writer.counts["verified"] > writes, 20.0)
        assert rig.state == "ACTIVE"


async def test_a_reference_begins_where_the_guard_went_since_the_last_poll(tmp_path):
    """The next poll is a minute away: only a look at the echo tells that the guard has taken the block meanwhile."""
    configuration = machine(tmp_path, tick_s=60.0, validity_s=100.0)
    rarely = configuration.cnc.model_copy(update={"poll_period_s": 60.0})
    configuration = configuration.model_copy(update={"cnc": rarely})
    async with looping(configuration) as (rig, nc, task):
        while rig.state != "ACTIVE" or nc.macros.get(Z) < 0.0002:
            await wrote_after(rig, rig.estimate(0.0, -5.0))
        nc.safe_point()
        assert rig.applied["z"] >= 0.2
        rig.set_reference("r2")
        await until(lambda: rig.control.reference.reference_id == "r2")
        await wrote_after(rig, rig.estimate(0.0, 0.0))
        assert rig.control.memory.reference_id == "r2"
        assert nc.macros.get(Z) * 1000 == pytest.approx(rig.applied["z"], abs=1e-6)


async def wrote_after(rig, estimate):
    writes = rig.control.writer.counts["verified"]
    rig.control.deliver(estimate)
    await until(lambda: rig.control.writer.counts["verified"] > writes)


async def until(condition, timeout_s=30.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        await asyncio.sleep(0.005)


async def test_everything_that_is_not_known_to_be_harmless_is_cutting(rig, bench):
    await rig.turn()
    assert rig.control.phase.value == "cutting"
    bench.nc.sequence_number = 900
    await rig.turn()
    assert rig.control.phase.value == "safe point"
    bench.nc.run = CncRun.HOLD
    await rig.turn()
    assert rig.control.phase.value == "cutting"
    bench.nc.run = CncRun.RESET
    await rig.turn()
    assert rig.control.phase.value == "idle"
