"""The control task when the output cannot be trusted or the link is lost: nothing is written that should not be."""

import asyncio
from dataclasses import replace

import pytest
import structlog
from click.testing import CliRunner
from control_rig import BLOCK, ENABLE, SEQUENCE_A, SEQUENCE_B, Bench, Y, Z, record_for, running

from daemon.cli import main
from daemon.history.reader import HistoryReader
from daemon.monitor.control_socket import ControlSocket
from daemon.state_store.documents import OutputFault
from daemon.state_store.store import StateStore
from drivers.contract import LinkError
from models.control.state import OperatorRequest
from models.records import CncRun, WriteOutcome


async def test_a_foreign_value_is_a_fault_until_it_is_acknowledged(rig, bench):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    bench.nc.macros.set(Z, 0.002)
    bench.nc.written.clear()
    await rig.turn(rig.estimate(0.0, -10.0))
    assert rig.state == "FAULT"
    assert f"#{Z} holds 0.002" in rig.control.journal.alarm
    await rig.follow(0.0, -10.0, 20)
    assert rig.state == "FAULT" and bench.nc.written == []
    applied = dict(rig.applied)
    assert rig.acknowledge("p") == ""
    await rig.turn(safe=False)
    assert rig.control.memory.state == "HOLD" or rig.state == "ACTIVE"
    assert bench.nc.macros.get(Z) * 1000 == pytest.approx(applied["z"], abs=0.6)
    await rig.follow(0.0, -10.0, 20)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(10.0, abs=0.11)


async def test_a_fault_while_retreating_can_be_left(rig, bench):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    rig.control.request(OperatorRequest(zero=True), "p")
    await rig.turn()
    bench.nc.macros.set(Y, 0.001)
    await rig.turn()
    assert rig.state == "FAULT"
    rig.acknowledge("p")
    await rig.follow(0.0, -10.0, 40)
    assert rig.state == "OFF"
    assert rig.applied["z"] == pytest.approx(0.0, abs=1e-6)


async def test_a_read_back_that_differs_is_a_fault(rig, bench):
    await rig.active()
    bench.nc.forgets = Z
    await rig.turn(rig.estimate(0.0, -5.0))
    assert rig.control.writer.receipt.outcome is WriteOutcome.DIFFERS
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and bench.nc.written == []
    assert "read-back" in rig.control.memory.reason or "holds" in rig.control.memory.reason
    bench.nc.forgets = None
    rig.acknowledge("p")
    await rig.follow(0.0, -5.0, 30)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)


async def test_a_refused_write_is_a_fault_and_counted(rig, bench):
    await rig.active()
    bench.nc.refuses = Z
    await rig.turn(rig.estimate(0.0, -5.0))
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and bench.nc.written == []
    assert rig.control.writer.counts["refused"] == 1
    bench.nc.refuses = None
    rig.acknowledge("p")
    await rig.follow(0.0, -5.0, 30)
    assert rig.state == "ACTIVE"


@pytest.mark.parametrize("refuses", [SEQUENCE_A, Z, ENABLE, SEQUENCE_B])
async def test_what_arrived_before_the_control_refused_is_known_as_ours_after_a_restart(bench, refuses):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -5.0, 10)
        bench.nc.refuses = refuses
        await rig.turn(rig.estimate(0.0, -8.0))
        held = {number: bench.nc.macros.get(number) for number in BLOCK}
        await rig.history.flushed()
        with HistoryReader(rig.history.path) as reader:
            record = reader.writes(0.0, 2.0**40)[-1]
            possible = reader.last_written_macros()
        assert record.outcome is WriteOutcome.FAILED
        assert f"#{refuses}" in record.detail and "may have arrived" in record.detail
        assert all(value in possible[number] for number, value in held.items())
    async with running(bench.rig()) as again:
        await again.turn(safe=False)
        assert "was refused" in again.control.journal.fault and "we wrote" not in again.control.journal.fault


@pytest.mark.parametrize("error", [ZeroDivisionError("nobody expected this"), asyncio.CancelledError()])
async def test_an_unknown_exception_latches_a_fault_and_the_loop_goes_on(rig, bench, error):
    await rig.active()
    await rig.follow(0.0, -5.0, 15)
    with structlog.testing.capture_logs() as logs:
        bench.nc.breaks = error
        await rig.turn(rig.estimate(0.0, -5.0))
    assert [entry for entry in logs if entry["event"] == "control.defect"]
    bench.nc.written.clear()
    await rig.follow(0.0, -5.0, 10)
    assert rig.state == "FAULT" and type(error).__name__ in rig.control.journal.alarm
    assert bench.nc.written == []
    assert rig.control.session.sample.time.monotonic_s == rig.clock.monotonic_s, "it still polls"
    rig.acknowledge("p")
    await rig.follow(0.0, -5.0, 5)
    assert rig.state == "ACTIVE"


@pytest.mark.parametrize("vacant", [SEQUENCE_A, Z, ENABLE, SEQUENCE_B])
async def test_a_vacant_macro_at_the_start_is_an_alarm_that_no_acknowledgement_makes_ours(bench, vacant):
    bench.nc.macros.set(vacant, None)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert f"#{vacant} is vacant" in rig.control.journal.alarm
        rig.acknowledge("p")
        await rig.turn()
        rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []
        assert rig.state == "FAULT"
        bench.nc.macros.set(vacant, 0.0)
        await rig.turn()
        rig.acknowledge("p")
        await rig.turn()
        await rig.turn()
        assert rig.state != "FAULT", rig.control.memory.reason


async def test_a_vacant_echo_at_the_start_is_an_alarm_and_nothing_is_written(bench):
    bench.nc.macros.set(513, None)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert "echo" in rig.control.journal.alarm
        assert "echo is vacant" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        await rig.turn()
        assert bench.nc.written == []
        bench.nc.macros.set(513, 0.0)
        await rig.turn()
        await rig.turn()
        assert rig.state == "OFF" and rig.control.journal.alarm == ""


async def test_enable_bits_that_nobody_here_has_set_are_a_fault(bench):
    bench.nc.macros.set(ENABLE, 4.0)
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.turn()
        assert rig.state == "FAULT" and "enable bits" in rig.control.journal.alarm
        assert bench.nc.written == []


@pytest.mark.parametrize("groups", [0, 1, 2])
async def test_a_link_lost_while_writing_is_no_fault_and_is_made_good(rig, bench, groups):
    await rig.active()
    await rig.follow(0.0, -8.0, 5)
    bench.nc.groups_until_lost = groups
    clients = len(bench.nc.opened)
    await rig.turn(rig.estimate(0.0, -8.0))
    assert rig.link.session is None
    await rig.connected()
    assert len(bench.nc.opened) == clients + 1, "a new client"
    assert bench.nc.opened[-2].closed
    await rig.follow(0.0, -8.0, 30)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11)
    assert rig.control.journal.fault is None
    assert rig.control.writer.counts["sent"] == rig.control.writer.counts["verified"] + 1


async def lose_the_link(rig, bench, *, handshake):
    await rig.active(handshake=handshake)
    await rig.follow(0.0, -8.0, 20)
    bench.nc.reachable = False
    await rig.follow(0.0, -20.0, 20)
    assert rig.state == "HOLD" and "no link" in rig.control.memory.reason
    bench.nc.reachable = True
    await rig.connected()
    return bench.nc.macros.get(Z)


async def test_without_the_link_the_output_holds_and_then_goes_on(rig, bench):
    value = await lose_the_link(rig, bench, handshake=True)
    await rig.turn(rig.estimate(0.0, -20.0))
    assert abs(bench.nc.macros.get(Z) - value) * 1000 <= 0.51
    await rig.follow(0.0, -20.0, 40)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(20.0, abs=0.11)


async def test_a_positioning_may_have_been_missed_while_the_link_was_down_and_no_handshake_proves_the_contrary(
    rig, bench
):
    bench.nc.macros.set(520, 1.0)
    bench.nc.macros.set(524, 1.0)
    value = await lose_the_link(rig, bench, handshake=False)
    await rig.follow(0.0, -20.0, 20)
    assert rig.state == "HOLD" and rig.control.reference is None
    assert any("may have been missed" in notice for notice in rig.control.journal.notices)
    assert bench.nc.macros.get(Z) == value


async def test_a_gap_in_which_the_program_cannot_have_left_a_positioning_block_misses_nothing(rig, bench):
    await rig.active()
    await rig.turn(rig.estimate(0.0, -8.0), after_s=1.9)
    assert rig.state == "ACTIVE" and rig.control.reference is not None


async def test_a_positioning_that_passes_while_the_link_is_frozen_for_three_seconds_ends_the_reference(rig, bench):
    """2 s of dwell on N100, unseen: enabling must not move the tool on a part that was positioned freshly."""
    await rig.active()
    await rig.follow(0.0, -8.0, 20)
    value = bench.nc.macros.get(Z)
    await rig.turn(rig.estimate(0.0, -14.0), after_s=3.0)
    await rig.follow(0.0, -14.0, 20)
    assert rig.control.reference is None and rig.state == "HOLD"
    assert "could not be polled for 3.0 s" in rig.control.memory.reason, "status tells why, not only the events"
    assert rig.control.reference_ended in rig.control.memory.reason
    assert bench.nc.macros.get(Z) == value


async def test_an_answer_that_was_long_under_way_may_show_the_past(rig, bench):
    """The gap counts from when the control was asked before: what the poll before showed may be as old as that."""
    await rig.active()
    rig.control._references.memory = replace(rig.control._references.memory, asked_s=bench.clock.monotonic_s - 1.6)
    await rig.turn(rig.estimate(0.0, -8.0), after_s=0.5)
    assert rig.control.reference is None


@pytest.mark.parametrize(("count", "stays"), [(7.0, True), (8.0, False), (None, False)])
async def test_a_counter_of_positionings_proves_that_none_was_missed(tmp_path, count, stays):
    bench = Bench(tmp_path)
    counting = bench.configuration.compensation.reference.model_copy(update={"positioning_counter": 560})
    compensation = bench.configuration.compensation.model_copy(update={"reference": counting})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    bench.nc.macros.set(560, 7.0)
    async with running(bench.rig()) as rig:
        await rig.active()
        bench.nc.macros.set(560, count)
        await rig.turn(rig.estimate(0.0, -8.0), after_s=60.0)
        assert (rig.control.reference is not None) is stays


async def test_a_program_that_ran_whole_in_a_gap_from_idle_to_idle_ends_the_reference(rig, bench):
    """It positions new work and stands again where it stood: no poll has seen anything."""
    bench.nc.run = CncRun.STOP
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    assert rig.state == "ACTIVE" and rig.applied["z"] == 8.0
    await rig.turn(rig.estimate(0.0, -12.0), after_s=20.0)
    assert rig.state == "HOLD" and "may have been missed" in rig.control.memory.reason
    await rig.follow(0.0, -12.0, 10)
    assert rig.applied["z"] == 8.0


async def test_acknowledging_without_a_link_is_refused(rig, bench):
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    await rig.turn()
    bench.nc.reachable = False
    await rig.turn()
    assert "no link to the CNC" in rig.acknowledge("p")
    await rig.turn()
    bench.nc.reachable = True
    await rig.connected()
    await rig.turn()
    assert rig.state == "FAULT"
    assert rig.acknowledge("p") == ""
    await rig.follow(0.0, 0.0, 5)
    assert rig.state == "ACTIVE"


async def test_another_control_behind_the_same_address_is_never_written_to(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 20)
    bench.nc.reachable = False
    await rig.turn()
    bench.nc.identity, bench.nc.reachable = "urn:another-control", True
    await rig.connected()
    bench.nc.written.clear()
    await rig.follow(0.0, -8.0, 5)
    assert rig.state == "HOLD" and "urn:another-control" in rig.control.memory.reason
    assert bench.nc.written == []


async def test_a_scaled_clock_never_drives_a_control_that_is_not_simulated(bench):
    bench.nc.guard.place(bench.nc.macros, {"z": 5.0})  # so that the output begins in HOLD
    bench.nc.identity = "urn:a-real-control"
    bench.clock.speed = 60.0
    record = record_for(bench.configuration, cnc_identity="urn:a-real-control")
    async with running(bench.rig(record=record)) as rig:
        await rig.turn()
        assert "clock is simulated" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        rig.control.request(OperatorRequest(zero=True), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []


async def test_an_insecure_connection_is_never_written_over(tmp_path):
    bench = Bench(tmp_path, cnc={"allow_insecure_writes": False})
    bench.nc.guard.place(bench.nc.macros, {"z": 5.0})
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert "not secure" in rig.control.request(OperatorRequest(enable=frozenset({"z"})), "p")
        rig.control.request(OperatorRequest(zero=True), "p")
        for _ in range(5):
            await rig.turn()
        assert bench.nc.written == []


async def raised(rig):
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        return [event.text for event in reader.events(0.0, 2.0**40) if event.kind == "fault"]


async def test_every_reason_of_a_fault_is_logged_recorded_stored_and_shown_in_order(rig, bench):
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    with structlog.testing.capture_logs() as logs:
        await rig.turn()
        bench.nc.macros.set(Y, 0.001)
        await rig.turn()
        rig.control.journal.raise_fault("an answer to the NC program could not be written: made up")
        for _ in range(5):
            await rig.turn()
    told = [entry["text"] for entry in logs if entry["event"] == "output.fault"]
    assert [f"#{Z}" in told[0], f"#{Y}" in told[1], "made up" in told[2], len(told)] == [True, True, True, 3]
    assert await raised(rig) == told == list(rig.control.journal.faults)
    assert StateStore(rig.history, bench.clock).get(OutputFault).reasons == tuple(told)
    places = [rig.control.journal.alarm.index(reason) for reason in told]
    assert places == sorted(places) and rig.control.memory.reason == "; ".join(told)


async def test_every_reason_comes_back_after_a_restart_and_none_that_was_acknowledged(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        bench.nc.macros.set(Z, 0.002)
        await rig.turn()
        rig.control.journal.raise_fault("something else that was found later")
        reasons = rig.control.journal.faults
        rig.alive()
    async with running(bench.rig()) as rig:
        assert rig.control.journal.faults == reasons and len(reasons) == 2
        await rig.turn()
        assert rig.control.journal.faults == reasons, "found again, it is no new reason"
        assert rig.acknowledge("p") == ""
        await rig.turn()
        assert rig.control.journal.faults == () and rig.state != "FAULT"
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.journal.faults == () and rig.state != "FAULT"


async def test_an_acknowledgement_leaves_what_is_still_wrong(rig, bench):
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    await rig.turn()
    bench.nc.macros.set(500, None)
    await rig.turn()
    assert len(rig.control.journal.faults) == 2
    rig.acknowledge("p")
    await rig.turn()
    assert rig.state == "FAULT" and len(rig.control.journal.faults) == 1
    assert "#500 is vacant" in rig.control.journal.faults[0] and "#500 is vacant" in rig.control.journal.alarm
    assert StateStore(rig.history, bench.clock).get(OutputFault).reasons == rig.control.journal.faults


async def test_an_acknowledgement_that_meets_a_lost_link_is_refused_in_words(rig, bench):
    """It was taken while the link stood, and the link was lost before it was carried out."""
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    await rig.turn()
    assert rig.acknowledge("p") == ""
    rig.link.lost(LinkError("cable"))
    await rig.control._guarded(rig.control._act(None))
    assert rig.state == "FAULT" and rig.control.journal.fault is not None
    assert "acknowledge the fault: there is no link to the CNC" in rig.control.journal.notices[-1]
    await rig.connected()
    await rig.turn(safe=False)
    assert rig.state == "FAULT", "nobody has acknowledged what the control holds now"


async def test_an_acknowledgement_clears_no_newer_fault_than_the_one_it_names(rig, bench):
    """Two people look at a FAULT; one acknowledges, the macro is written over again, then the other acknowledges."""
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    for _ in range(2):
        bench.nc.macros.set(Z, 0.002)
        await rig.turn(rig.estimate(0.0, -10.0))
        assert rig.state == "FAULT"
        if (seen := rig.snapshots.control.fault) == 1:
            assert rig.control.request(OperatorRequest(acknowledge=seen), "first") == ""
            await rig.follow(0.0, -10.0, 20)
            assert rig.state == "ACTIVE"
    refused = rig.control.request(OperatorRequest(acknowledge=1), "second")
    assert "the newest is FAULT 2, not 1" in refused and f"#{Z} holds 0.002" in refused
    await rig.turn()
    assert rig.state == "FAULT"
    assert rig.control.request(OperatorRequest(acknowledge=2), "second") == ""
    rig.control.journal.raise_fault("found after the request was queued")
    await rig.turn()
    assert rig.state == "FAULT" and len(rig.control.journal.faults) == 2, "nothing of it is cleared"
    assert any("refused: acknowledge the fault: the newest is FAULT 3" in each for each in rig.control.journal.notices)


async def test_the_numbers_of_faults_go_on_over_a_restart(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        rig.control.journal.raise_fault("one")
        await rig.turn()
        rig.control.request(OperatorRequest(acknowledge=1), "p")
        await rig.turn()
        rig.control.journal.raise_fault("two")
        await rig.history.flushed()
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.journal.faults[0] == "two" and rig.snapshots.control.fault >= 2


async def test_the_command_shows_the_fault_that_it_acknowledges_and_asks(rig, bench, tmp_path):
    await rig.active()
    bench.nc.macros.set(Z, 0.002)
    await rig.turn()
    assert rig.state == "FAULT"
    path, desk = tmp_path / "s", rig.desk()
    serving = asyncio.create_task(ControlSocket(path, None, desk.handle).run())
    while not path.exists():
        await asyncio.sleep(0.01)

    async def told(*words, typed=""):
        asked = asyncio.create_task(
            asyncio.to_thread(CliRunner().invoke, main, ["acknowledge", "--socket", str(path), *words], input=typed)
        )
        while not asked.done():
            await rig.turn()
            await asyncio.sleep(0.02)
        return asked.result()

    refused = await told(typed="n\n")
    assert refused.exit_code == 1 and f"#{Z} holds 0.002" in refused.output and "Acknowledge FAULT 1" in refused.output
    assert (await told(typed="")).exit_code == 1 and rig.state == "FAULT", "nobody has said yes"
    assert "the newest is FAULT 1, not 7" in (await told("7")).output and rig.state == "FAULT"
    assert (await told(typed="y\n")).exit_code == 0 and rig.state != "FAULT"
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)


async def test_a_fault_that_waits_for_the_cnc_is_not_taken_for_acknowledged(tmp_path):
    """After a restoration status told the FAULT, and the command ended with 0 as if there were none."""
    path = tmp_path / "s"

    async def waiting(request, person):
        assert request["command"] == "status"
        return {"output": {"state": "OFF", "reason": "FAULT: the history was restored", "since_s": None, "fault": 1}}

    serving = asyncio.create_task(ControlSocket(path, None, waiting).run())
    while not path.exists():
        await asyncio.sleep(0.01)
    done = await asyncio.to_thread(CliRunner().invoke, main, ["acknowledge", "--socket", str(path)], input="y\n")
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert done.exit_code == 1 and "the CNC has not been reached yet" in done.output, done.output


async def test_a_fault_of_a_daemon_that_the_upgrade_has_not_restarted_yet_is_acknowledged(tmp_path):
    """That of 0.1.0 tells no number of its FAULT, and takes none."""
    path, asked = tmp_path / "s", []

    async def earlier(request, person):
        asked.append(request)
        if request["command"] == "status":
            return {"output": {"state": "FAULT", "reason": "macro variable #502 holds 7"}}
        return {"decided": True, "state": "HOLD", "reason": "acknowledged by a person", "alarm": ""}

    serving = asyncio.create_task(ControlSocket(path, None, earlier).run())
    while not path.exists():
        await asyncio.sleep(0.01)
    done = await asyncio.to_thread(CliRunner().invoke, main, ["acknowledge", "--socket", str(path)], input="y\n")
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    assert done.exit_code == 0 and "holds 7" in done.output and "HOLD" in done.output, done.output
    assert asked[-1] == {"command": "acknowledge"}
