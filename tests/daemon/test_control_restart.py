"""The control task after a restart of the daemon: from the echo, with the reference and its baseline."""

import json
from dataclasses import replace

import pytest
from control_rig import Z, record_for, running
from wires import EVER, check_audit

from config.records.commissioning import CommissionedAxis
from config.schema.cnc_drivers import OpcUaNodesConfig
from config.schema.compensation import ToolTermConfig
from daemon.history.reader import HistoryReader
from daemon.messages import ReferenceRebased, ReferenceRefused, ReferenceRequest, ReferenceTakenUp
from models.control.state import OperatorRequest
from models.records import WriteOutcome

ECHO_Y = 512
TERM = ToolTermConfig(length_mm=200.0, expansion_um_per_m_k=10.0, temperatures={"A": 1.0})


async def leave(bench, error_um=-10.0):
    """Run until the output is active with an offset, then end as a crash would: without a word."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        rig.alive()
        await rig.follow(0.0, error_um, 60)
        assert rig.state == "ACTIVE"
        return rig.control.reference


async def test_a_restart_resumes_from_the_echo_with_the_same_reference(bench):
    left = await leave(bench)
    bench.clock.monotonic_s += 30.0
    value = bench.nc.macros.get(Z)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "HOLD"
        assert isinstance(rig.asked[0], ReferenceTakenUp)
        assert rig.control.reference.reference_id == left.reference_id
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, -10.0))
            assert bench.nc.macros.get(Z) == pytest.approx(value, abs=0.11e-3), "no step and no creep"
        assert rig.state == "ACTIVE"
        await rig.follow(0.0, -12.0, 20)
        assert rig.applied["z"] == pytest.approx(12.0, abs=0.11)


@pytest.mark.parametrize("reference", [True, False])
async def test_the_command_begins_where_the_guard_has_gone_before_the_first_write(bench, reference):
    """A block of before the start that was ahead of the tool: the guard took it after the first poll."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, -10.0), safe=False)
        rig.alive()
    bench.clock.monotonic_s += 5.0
    async with running(bench.rig(**({} if reference else {"model_id": "another"}))) as rig:
        await rig.control._guarded(rig.control._poll())
        at_start_um = rig.applied["z"]
        bench.nc.safe_point()
        begun_um = rig.applied["z"]
        assert begun_um > at_start_um + 0.5
        assert rig.control.writer.unwritten(rig.control.session)
        await rig.turn(safe=False)
        assert rig.state == "HOLD"
        assert bench.nc.macros.get(Z) * 1000.0 == pytest.approx(begun_um, abs=1e-6)
        assert not rig.control.writer.unwritten(rig.control.session)
        await rig.turn()
        assert rig.applied["z"] == pytest.approx(begun_um, abs=1e-6)


async def test_what_the_guard_takes_of_before_the_start_just_before_the_first_write_is_taken_out_again(bench):
    """Switched off, and killed before the block said so: the output begins OFF, with a block that is still valid."""
    async with running(bench.rig()) as rig:
        await rig.active()
        for _ in range(30):
            await rig.turn(rig.estimate(0.0, -8.0), safe=False)
        rig.alive()
        rig.control._startup.keep((False, False, False))
    async with running(bench.rig()) as rig:

        def guard_between(macros):
            if tuple(macros) == rig.block.ours:  # what is to be written was compared
                bench.nc.after_read = None
                bench.nc.safe_point()

        bench.nc.after_read = guard_between
        await rig.turn(safe=False)
        assert rig.applied["z"] == 8.0
        for _ in range(30):
            await rig.turn()
        assert (rig.state, rig.applied["z"]) == ("OFF", 0.0)


async def test_a_restart_takes_the_reference_up_as_returned_sensors_have_set_it_anew(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        anew = replace(rig.control.reference, degc=rig.control.reference.degc + 1.0)
        rig.control.deliver(ReferenceRebased(reference=anew))
        await rig.turn()
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        (taken_up,) = [message for message in rig.asked if isinstance(message, ReferenceTakenUp)]
        assert taken_up.reference.degc == pytest.approx(anew.degc)


async def test_a_restart_keeps_the_baseline_of_the_second_reference(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        await rig.follow(0.0, -10.0, 40)
        rig.set_reference("r2", handshake=True)
        await rig.follow(0.0, -3.0, 20)
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -3.0, 20)
        assert rig.applied["z"] == pytest.approx(13.0, abs=0.11)
        rig.control.request(OperatorRequest(disable=frozenset({"y", "z"})), "p")
        await rig.follow(0.0, -3.0, 30)
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11), "retreats to that reference's baseline"


async def test_an_estimate_right_after_the_restart_does_not_count_twice(bench):
    await leave(bench)
    async with running(bench.rig()) as rig:
        await rig.control._guarded(rig.control._poll())
        rig.control.deliver(rig.estimate(0.0, -10.0))
        await rig.follow(0.0, -10.0, 20)
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"temperatures": "exchanged"}, "what sensors or the control read, or the list of them changed"),
        ({"spindle_speed": "s=Speed.2"}, "what sensors or the control read, or the list of them changed"),
        ({"record": -1}, "the commissioned movement per macro value changed"),
        ({"z": {"estimate": "Y1"}}, "what axis z follows, or its tool term changed"),
        ({"z": {"tool_term": TERM}}, "what axis z follows, or its tool term changed"),
    ],
)
async def test_a_reference_counts_with_the_sensors_factors_and_axes_of_its_run_alone(bench, changes, words):
    """Its temperatures are kept in the sensors' order, its baseline in um: taken up, 10 K and 20 um would be wrong.

    A tool setting and a probe hold the estimate of what their axis followed then.
    """
    await leave(bench)
    if "temperatures" in changes:
        content = bench.configuration.model_dump(mode="json")
        first, *others = content["temperatures"]["sensors"]
        content["temperatures"]["sensors"] = [*others, first]
        bench.configuration = type(bench.configuration).model_validate_json(json.dumps(content))
        record = record_for(bench.configuration)
    elif "spindle_speed" in changes:
        opcua = bench.configuration.cnc.opcua.model_copy(update={"nodes": OpcUaNodesConfig(**changes)})
        cnc = bench.configuration.cnc.model_copy(update={"opcua": opcua})
        bench.configuration = bench.configuration.model_copy(update={"cnc": cnc})
        record = record_for(bench.configuration)
    elif "z" in changes:
        compensation = bench.configuration.compensation
        z = compensation.axes["z"].model_copy(update=changes["z"])
        compensation = compensation.model_copy(update={"axes": compensation.axes | {"z": z}})
        bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
        record = record_for(bench.configuration)
    else:
        axes = dict.fromkeys("xyz", CommissionedAxis(sign=-1, scale=1.0, written_um=10.0, measured_um=-10.0))
        record = record_for(bench.configuration, axes=axes)
    async with running(bench.rig(record=record)) as rig:
        await rig.turn()
        applied = rig.applied["z"]
        await rig.follow(0.0, -20.0, 3)
        assert rig.state == "HOLD" and rig.control.reference is None and rig.applied["z"] == applied
        assert words in rig.control.reference_ended
        assert not any(isinstance(message, ReferenceTakenUp) for message in rig.asked)


async def test_a_reference_is_as_old_as_it_is_after_a_restart_though_the_calendar_was_set_before(bench):
    """By the calendar of then it would be three hours older: what drifts, and the lags at it, would be wrong."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        await rig.follow(0.0, -10.0, 20)
        set_s = rig.control.reference.time.monotonic_s
        bench.clock.calendar_s += 10800.0
        await rig.follow(0.0, -10.0, 20)
        assert rig.state == "ACTIVE" and rig.control.reference.time.monotonic_s == set_s
        rig.alive()
    bench.clock.monotonic_s += 5.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert isinstance(rig.asked[0], ReferenceTakenUp)
        assert rig.asked[0].reference.time.monotonic_s == pytest.approx(set_s, abs=0.1)


async def test_a_reference_without_its_baseline_is_not_taken_up(bench):
    await leave(bench)
    async with running(bench.rig()) as rig:
        stored = rig.history.get_state("reference")
        del stored["crc32"]
        rig.history.put_state("reference", stored | {"record": stored["record"] | {"baseline": None}})
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 3)
        assert rig.state == "HOLD" and rig.control.reference is None
        assert "baseline was not stored" in rig.control.journal.notices[-1]
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_after_a_long_outage_the_output_holds_without_a_reference(bench):
    await leave(bench)
    bench.clock.monotonic_s += 2000.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 5)
        assert rig.control.reference is None
        assert rig.state in ("HOLD", "RETREAT")


async def test_after_a_power_cycle_the_old_reference_is_not_taken_up(bench):
    await leave(bench)
    bench.nc.power_cycle()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.follow(0.0, -20.0, 3)
        assert rig.control.reference is None
        assert rig.state == "HOLD"
        assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_every_write_is_in_the_audit(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -5.0, 10)
        sent = rig.control.writer.counts["sent"]
    with HistoryReader(bench.configuration.history.path) as reader:
        records = reader.writes(0.0, 1e11)
        assert len(records) == sent
        assert all(record.outcome is WriteOutcome.VERIFIED for record in records)
        assert reader.unsettled_writes() == []
        assert any(event.kind == "request" and event.person == "a person" for event in reader.events(0.0, 1e11))


async def test_an_intent_that_a_crash_left_without_an_outcome_is_settled_by_reading_back(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -8.0, 20)
        held = {number: bench.nc.macros.get(number) for number in (500, Z)}
        lost = rig.history.write_intent(rig.control.command, ((500, held[500] + 1), (Z, 0.5)), "tick")
        arrived = rig.history.write_intent(rig.control.command, tuple(held.items()), "tick")
        await rig.history.flushed()
        rig.alive()
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.history.flushed()
        with HistoryReader(rig.history.path) as reader:
            assert reader.unsettled_writes() == []
            records = {record.write_id: record for record in reader.writes(0.0, 2.0**40)}
    assert records[int(lost)].outcome is WriteOutcome.FAILED
    assert records[int(arrived)].outcome is WriteOutcome.VERIFIED
    assert "ended while writing" in records[int(lost)].detail


async def leave_with_y_off(bench):
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        await rig.follow(-11.0, -12.0, 60)
        rig.control.request(OperatorRequest(disable=frozenset({"y"})), "p")
        await rig.turn()
        rig.alive()
    bench.clock.monotonic_s += 3600.0


async def test_an_axis_that_was_switched_off_stays_so_over_a_long_outage(bench):
    await leave_with_y_off(bench)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "HOLD" and "away too long" in rig.control.memory.reason
        rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        await rig.turn()
        assert rig.control.memory.wanted == (False, False, True)
        rig.set_reference("r9")
        before = rig.applied["y"]
        for _ in range(20):
            await rig.turn(rig.estimate(-19.0, 0.0))
        assert rig.applied["y"] <= before


async def test_a_cnc_that_is_reached_late_is_no_short_outage(bench):
    await leave(bench)
    bench.nc.reachable = False
    async with running(bench.rig(), connect=False) as rig:
        await rig.turn()
        bench.clock.monotonic_s += 8 * 3600.0
        bench.nc.reachable = True
        await rig.connected()
        await rig.turn()
        assert rig.state == "HOLD" and rig.control.reference is None


@pytest.mark.parametrize("again", [False, True])
async def test_work_that_is_positioned_before_the_echo_is_known_ends_what_the_previous_run_left(bench, again):
    await leave(bench)
    applied = bench.nc.macros.get(ECHO_Y)
    bench.nc.macros.set(ECHO_Y, None)
    async with running(bench.rig()) as rig:
        await rig.turn(safe=False)
        bench.nc.sequence_number = 100
        await rig.turn(safe=False)
        (asked,) = [each for each in rig.asked if isinstance(each, ReferenceRequest)]
        rig.control.deliver(ReferenceRefused(reference_id=asked.reference_id, why="no temperature has arrived"))
        bench.nc.sequence_number = 200
        await rig.turn(safe=False)
        assert rig.state == "none"
        if not again:
            bench.nc.macros.set(ECHO_Y, applied)
            await rig.turn(safe=False)
            assert rig.state == "HOLD" and rig.control.reference is None
            assert rig.control.reference_ended.endswith("positioned, and that set none (no temperature has arrived)")
        assert any("is not taken up again" in notice for notice in rig.control.journal.notices)
    bench.nc.macros.set(ECHO_Y, applied)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "HOLD" and rig.control.reference is None


async def test_without_the_handshake_a_restart_while_the_program_ran_may_have_missed_a_positioning(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -10.0, 60)
        rig.alive()
    bench.clock.monotonic_s += 300.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        assert any("may have been missed" in notice for notice in rig.control.journal.notices)


async def test_a_calendar_that_was_set_back_takes_no_reference_up(bench):
    await leave(bench)
    bench.nc.clock_zero_s += 7200.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        assert any("calendar" in notice for notice in rig.control.journal.notices)


async def test_a_restart_in_hold_begins_where_the_guard_has_gone_meanwhile_and_stays_there(bench):
    """The block of before stays valid for some seconds: the guard goes on with it while no daemon lives."""
    async with running(bench.rig()) as rig:
        await rig.active(handshake=True)
        rig.alive()
        for _ in range(30):  # the guard is not called: what is written runs ahead of what is applied
            await rig.turn(rig.estimate(0.0, -9.96), safe=False)
        await rig.turn(rig.estimate(0.0, -9.96, confidence=0.1), safe=False)
        assert rig.state == "HOLD"
        assert (rig.applied["z"], bench.nc.macros.get(Z)) == (0.0, pytest.approx(9.96e-3))
    bench.nc.safe_point()
    assert bench.nc.guard.applied_um["z"] == 10.0, "in whole micrometres of the control"
    async with running(bench.rig()) as rig:
        for _ in range(10):
            await rig.turn(rig.estimate(0.0, -20.0, confidence=0.1))
            assert rig.state == "HOLD"
            assert (rig.applied["z"], bench.nc.macros.get(Z)) == (10.0, pytest.approx(10.0e-3))
        configuration = bench.configuration
        await rig.history.flushed()
        with HistoryReader(configuration.history.path) as reader:
            writes = [record for record in reader.writes(*EVER) if record.compensation_um]
            begun_s = [event.time_s for event in reader.events(*EVER) if event.kind == "start"]
    check_audit(writes, configuration, begun_s=begun_s)
    moved = replace(writes[-1], compensation_um=writes[-1].compensation_um | {"z": 10.04}, time_s=writes[-1].time_s + 1)
    for later in ([], [moved.time_s]):
        with pytest.raises(AssertionError):
            check_audit([*writes, moved], configuration, begun_s=[*begun_s, *later])
