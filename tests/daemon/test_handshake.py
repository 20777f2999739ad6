"""Requests of the NC program: reference, tool setting, probe, tool change; lost, late and unknown ones."""

import numpy as np
import pytest
from control_rig import SEQUENCE_A, Bench, Z, record_for, running
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
    zero_first,
)

from config.records.commissioning import CommissionedAxis
from daemon.commissioning.judgement import LARGEST_SCALE
from daemon.history.reader import HistoryReader
from daemon.messages import ReferenceEnded, ReferenceRebased, ReferenceRefused
from drivers.contract import LinkError
from models.records import WriteOutcome


@pytest.fixture
def bench(tmp_path):
    return requesting_bench(tmp_path)


async def test_a_reference_is_answered_only_when_it_is_in_force_and_the_cnc_holds_its_value(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, REFERENCE)
    await rig.turn(rig.estimate(0.0, -8.0))
    assert answer(bench) == 0.0, "nobody has set the reference yet"
    rig.set_reference(last_asked(rig).reference_id)
    before = bench.nc.macros.get(Z)
    await rig.turn()
    await rig.turn()
    assert answer(bench) == 1.0
    assert bench.nc.macros.get(Z) == pytest.approx(before)
    assert rig.control.memory.baseline_um[2] == pytest.approx(before * 1000.0)


async def test_a_refused_reference_is_answered_with_minus_and_ends_the_old_one(rig, bench):
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    asked = last_asked(rig)
    rig.control.deliver(ReferenceRefused(reference_id=asked.reference_id, why="no temperature has arrived"))
    await rig.turn()
    assert answer(bench) == -1.0
    assert rig.control.reference is None, "the work lies elsewhere now"
    assert rig.state == "HOLD"
    assert any("no temperature" in notice for notice in rig.control.journal.notices)


async def test_a_probe_value_corrects_the_output_and_stands_in_the_history(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, PROBE, Z_AXIS, 0.003)
    await rig.follow(0.0, -8.0, 40)
    assert answer(bench) == 1.0
    assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        (probe,) = reader.probes(0.0, 2.0**40)
    assert (probe.axis, probe.deviation_um, probe.accepted) == ("z", pytest.approx(3.0), True)
    assert probe.applied_um == pytest.approx(8.0, abs=0.11)
    assert probe.thermal_error_um == pytest.approx(-8.0)


@pytest.mark.parametrize("behind_s", [0.0, 0.8])
@pytest.mark.parametrize(("kind", "value_mm"), [(PROBE, 0.002), (REFERENCE, 0.0)])
async def test_what_was_measured_before_the_guard_moved_does_not_count_after_it(rig, bench, kind, value_mm, behind_s):
    """The program measures, calls the guard and asks: the value counts from an offset that it was not measured with."""
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    for _ in range(12):
        await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    before, request = rig.applied["z"], bench.nc.macros.get(Z)
    bench.nc.safe_point()
    assert rig.applied["z"] > before + 1.0
    ran_s = bench.nc.macros.get(514)
    bench.nc.macros.set(514, ran_s + behind_s)  # a gateway shows the clock of its cycle before
    ask(bench, 1, kind, Z_AXIS, value_mm)
    await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    assert answer(bench) == -1.0
    assert bench.nc.macros.get(Z) == pytest.approx(request, abs=1e-3)
    for _ in range(5):
        await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    ask(bench, 2, kind, Z_AXIS, value_mm)
    await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    await rig.turn(safe=False)
    assert answer(bench) == 2.0


@pytest.mark.parametrize(("kind", "value_mm"), [(PROBE, 0.002), (REFERENCE, 0.0)])
async def test_nor_where_the_guard_moved_and_the_program_asked_while_the_link_was_away(rig, bench, kind, value_mm):
    """It is heard half a minute later, when the guard has long stood still again."""
    await rig.active(handshake=True)
    await rig.follow(0.0, -8.0, 40)
    for _ in range(12):
        await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    before = rig.applied["z"]
    bench.nc.reachable = False
    await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    bench.nc.safe_point()
    assert rig.applied["z"] > before + 1.0
    ask(bench, 1, kind, Z_AXIS, value_mm)
    bench.clock.monotonic_s += 30.0
    bench.nc.reachable = True
    await rig.connected()
    for _ in range(5):
        await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    assert answer(bench) == -1.0
    ask(bench, 2, kind, Z_AXIS, value_mm)
    for _ in range(2):
        await rig.turn(rig.estimate(0.0, -13.0), safe=False)
    assert answer(bench) == 2.0


async def test_a_probe_value_that_was_taken_is_not_refused_when_the_link_is_lost_in_the_write_after_it(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, PROBE, Z_AXIS, 0.003)
    await rig.control._guarded(rig.control._poll())
    bench.nc.groups_until_lost = 1
    bench.clock.monotonic_s += 1.0
    await rig.control._guarded(rig.control._act(rig.estimate(0.0, -8.0)))
    assert rig.link.session is None
    await rig.control._guarded(rig.control._act(None))
    await rig.connected()
    await rig.follow(0.0, -8.0, 40)
    assert (answer(bench), rig.applied["z"]) == (1.0, pytest.approx(5.0, abs=0.11)), "the answer is what the tool does"
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        (probe,) = reader.probes(0.0, 2.0**40)
    assert probe.accepted, probe.reason


@pytest.mark.parametrize(
    ("axis", "value_mm", "words"),
    [(Z_AXIS, 0.05, "more than the bound"), (0, 0.001, "needs one axis"), (1, 0.001, "no estimate")],
)
async def test_a_probe_value_that_cannot_be_used_moves_nothing(rig, bench, axis, value_mm, words):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    before = rig.applied["z"]
    ask(bench, 1, PROBE, axis, value_mm)
    await rig.follow(0.0, -8.0, 10)
    assert answer(bench) == -1.0
    assert rig.applied["z"] == before
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        events = [event.text for event in reader.events(0.0, 2.0**40) if event.kind == "refused"]
        assert any(words in text for text in events), events
        assert all(not probe.accepted for probe in reader.probes(0.0, 2.0**40))


@pytest.mark.parametrize("waits", [True, False])
async def test_a_probe_in_a_fault_moves_nothing_after_the_acknowledgement(rig, bench, waits):
    """In FAULT no answer is written: the program must not be left with a probe that counts without its knowledge."""
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    before = rig.applied["z"]
    rig.control.journal.raise_fault("macro #501 holds 0.002, we wrote 0")
    await rig.turn(rig.estimate(0.0, -8.0))
    assert rig.state == "FAULT"
    ask(bench, 1, PROBE, Z_AXIS, -0.0056)
    await rig.turn(rig.estimate(0.0, -8.0))
    assert answer(bench) == 0.0, "nothing is written"
    if not waits:
        bench.nc.macros.set(KIND, 0.0)
        await rig.turn(rig.estimate(0.0, -8.0))
    assert rig.acknowledge("p") == ""
    await rig.follow(0.0, -8.0, 40)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(before, abs=0.11)
    assert answer(bench) == (-1.0 if waits else 0.0), "refused where the program still waits"
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        (probe,) = reader.probes(0.0, 2.0**40)
    assert not probe.accepted and "in FAULT" in probe.reason


@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("kind", ["read back otherwise", "refused", "defect"])
async def test_a_probe_whose_step_ends_in_a_fault_is_refused_and_moves_nothing(rig, bench, monkeypatch, kind, waits):
    """The write of the step that took it is what finds the fault: the program gets no answer until somebody comes."""
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    before = rig.applied["z"]
    ask(bench, 1, PROBE, Z_AXIS, 0.003)
    await rig.control._guarded(rig.control._poll())
    bench.nc.forgets = Z if kind == "read back otherwise" else None
    bench.nc.refuses = Z if kind == "refused" else None
    if kind == "defect":
        monkeypatch.setattr(rig.control.writer, "write_when_due", _defect)
    bench.clock.monotonic_s += 1.0
    await rig.control._guarded(rig.control._act(rig.estimate(0.0, -8.0)))
    assert rig.control.journal.fault and answer(bench) == 0.0
    bench.nc.forgets = bench.nc.refuses = None
    monkeypatch.undo()
    await rig.follow(0.0, -8.0, 3)
    if not waits:
        bench.nc.macros.set(KIND, 0.0)
        await rig.turn(rig.estimate(0.0, -8.0))
    assert rig.acknowledge("p") == ""
    await rig.follow(0.0, -8.0, 40)
    assert rig.state == "ACTIVE"
    assert rig.applied["z"] == pytest.approx(before, abs=0.11)
    assert answer(bench) == (-1.0 if waits else 0.0), "refused where the program still waits"
    await rig.history.flushed()
    with HistoryReader(rig.history.path) as reader:
        (found,) = reader.probes(0.0, 2.0**40)
    assert not found.accepted and "FAULT" in found.reason
    ask(bench, 2, PROBE, Z_AXIS, 0.003)
    await rig.follow(0.0, -8.0, 40)
    assert (answer(bench), rig.applied["z"]) == (2.0, pytest.approx(before - 3.0, abs=0.11)), "once"


async def _defect(*_):
    raise ZeroDivisionError("in the write")


@pytest.mark.parametrize("trouble", ["fault", "link"])
async def test_a_tool_setting_whose_step_does_not_take_effect_leaves_the_tool_s_expansion_alone(rig, bench, trouble):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    kept = rig.control._references.memory.record.tool
    ask(bench, 1, REFERENCE, Z_AXIS)
    await rig.control._guarded(rig.control._poll())
    if trouble == "fault":
        bench.nc.refuses = SEQUENCE_A
    else:
        rig.link.lost(LinkError("gone"))
    bench.clock.monotonic_s += 1.0
    await rig.control._guarded(rig.control._act(rig.estimate(0.0, -9.0)))
    assert not rig.control.memory.tools
    assert rig.control._references.memory.record.tool == kept


async def test_a_tool_setting_moves_nothing_and_a_tool_change_selects_it(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, TOOL_CHANGE, 0, 2.0)
    await rig.turn(rig.estimate(0.0, -8.0))
    assert answer(bench) == 1.0
    ask(bench, 2, REFERENCE, Z_AXIS)
    await rig.follow(0.0, -8.0, 4)
    assert answer(bench) == 2.0
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11)
    assert list(rig.control.memory.tools) == [2], "the tool that the program named"


async def test_a_tool_setting_is_answered_also_beside_an_axis_that_moves_five_times_as_far_as_is_written(bench):
    """A value of the block counts to a nanometre, so that the movement counts to five."""
    scales = {"y": LARGEST_SCALE, "z": 1.0}
    proved = {a: CommissionedAxis(sign=1, scale=s, written_um=10.0, measured_um=10.0 * s) for a, s in scales.items()}
    async with running(bench.rig(record=record_for(bench.configuration, axes=proved))) as rig:
        await rig.active()
        for _ in range(40):
            await rig.turn(rig.estimate(-0.1522, -8.0))
        ask(bench, 1, REFERENCE, Z_AXIS)
        await rig.follow(-0.1522, -8.0, 4)
        assert answer(bench) == 1.0 and not rig.control.memory.settling


async def test_a_tool_setting_without_a_reference_of_the_work_is_refused(rig, bench):
    await rig.turn()
    ask(bench, 1, REFERENCE, Z_AXIS)
    await rig.turn()
    assert answer(bench) == -1.0


async def test_requests_that_were_never_seen_end_the_reference(rig, bench):
    await rig.active()
    ask(bench, 3, TOOL_CHANGE, 0, 1.0)
    await rig.turn()
    assert rig.control.reference is None
    assert any("2 request(s) of the NC program were missed" in notice for notice in rig.control.journal.notices)


async def test_a_program_that_gives_up_waiting_has_no_reference(rig, bench):
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    bench.nc.macros.set(KIND, 0.0)
    await rig.turn()
    assert rig.control.reference is None
    assert answer(bench) == 0.0


async def test_a_reference_is_not_taken_up_when_the_program_asked_for_something_meanwhile(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        rig.alive()
    ask(bench, 1, REFERENCE)
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        assert any("while the daemon was away" in notice for notice in rig.control.journal.notices)


async def test_the_answer_is_audited_with_intent_and_outcome_and_does_not_hide_the_block(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -8.0, 20)
        ask(bench, 1, TOOL_CHANGE, 0, 1.0)
        await rig.turn()
        await rig.history.flushed()
        rig.alive()
        with HistoryReader(rig.history.path) as reader:
            (record,) = [w for w in reader.writes(0.0, 2.0**40) if w.cause == "handshake"]
            assert record.outcome is WriteOutcome.VERIFIED
            assert dict(record.macros) == {ACKNOWLEDGE: 1.0}
            assert Z in reader.last_written_macros()
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.state == "HOLD", "its own block is known again, no foreign value"


async def test_a_positioning_that_polling_missed_is_noticed_by_the_handshake(rig, bench):
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    assert any("passed between two polls" in notice for notice in rig.control.journal.notices)


async def test_a_request_is_answered_too_where_polling_sees_its_positioning_only_after_it(rig, bench):
    """A control that tells its values one after the other shows the request a poll before the block that asks."""
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    by_request = last_asked(rig).reference_id
    bench.nc.sequence_number = 100
    await rig.turn()
    by_block = last_asked(rig).reference_id
    assert by_block != by_request
    rig.set_reference(by_request)
    rig.set_reference(by_block)
    for _ in range(3):
        await rig.turn()
    assert rig.control.memory.reference_id == by_block
    assert answer(bench) == 1.0


async def test_a_reference_that_has_ended_answers_nobody_by_the_one_before_it(rig, bench):
    await rig.active()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    bench.nc.work_offset += 1
    for _ in range(3):
        await rig.turn()
    assert answer(bench) == 0.0


async def test_a_positioning_that_polling_saw_too_is_no_notice(rig, bench):
    await rig.active()
    bench.nc.sequence_number = 100
    await rig.turn()
    ask(bench, 1, REFERENCE)
    await rig.turn()
    assert not any("between two polls" in notice for notice in rig.control.journal.notices)


@pytest.mark.parametrize("away", [False, True])
async def test_what_was_asked_for_before_the_cnc_was_switched_off_is_no_positioning_after_it(rig, bench, away):
    await rig.active(handshake=True)
    await rig.follow(0.0, -8.0, 40)
    asked = len(rig.asked)
    if away:
        bench.nc.reachable = False
        await rig.turn(safe=False)
    ask(bench, 1, REFERENCE)
    bench.nc.power_cycle()
    bench.clock.monotonic_s += 100.0
    if away:
        bench.nc.reachable = True
        await rig.connected()
    await rig.turn()
    assert answer(bench) == -1.0
    assert [type(item) for item in rig.asked[asked:]] == [ReferenceEnded] and rig.control.reference is None
    assert any("switched off and on" in notice for notice in rig.control.journal.notices)
    ask(bench, 2, REFERENCE)
    await rig.turn()
    rig.set_reference(last_asked(rig).reference_id)
    await rig.follow(0.0, 0.0, 3)
    assert answer(bench) == 2.0 and rig.state == "ACTIVE"


async def test_a_clock_that_went_on_too_little_while_the_daemon_was_away_is_a_power_cycle(bench):
    async with running(bench.rig()) as rig:
        await rig.active()
        rig.alive()
    bench.clock.monotonic_s += 60.0
    bench.nc.clock_zero_s -= 50.0
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        assert any("switched off and on" in notice for notice in rig.control.journal.notices)


async def test_zero_first_takes_the_offset_out_at_the_retreat_block_and_refuses_a_reference_before(tmp_path):
    bench = zero_first(Bench(tmp_path))
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -8.0, 40)
        rig.set_reference("by hand", positioning=False)
        await rig.turn(rig.estimate(0.0, -8.0))
        assert rig.state == "ACTIVE" and rig.control.reference.reference_id == "r1", "by hand it only refuses"
        bench.nc.sequence_number = 50
        await rig.turn(rig.estimate(0.0, -8.0))
        assert rig.state == "RETREAT" and rig.control.reference is None
        rig.set_reference("early")
        await rig.hear()
        assert rig.control.reference is None
        assert any("zero_first" in notice for notice in rig.control.journal.notices)
        for _ in range(40):
            await rig.turn()
        assert rig.state == "OFF" and np.allclose(list(rig.applied.values()), 0.0)
        bench.nc.sequence_number = 100
        await rig.turn()
        rig.set_reference(last_asked(rig).reference_id)
        await rig.follow(0.0, -3.0, 20)
        assert rig.state == "ACTIVE"
        assert rig.applied["z"] == pytest.approx(3.0, abs=0.11)


async def test_zero_first_refuses_a_reference_by_hand_before_anything_begins_to_count_from_it(tmp_path):
    """The estimation would trust every sensor anew, and the reference that stays would be without their doubt."""
    bench = zero_first(Bench(tmp_path))
    async with running(bench.rig()) as rig:
        await rig.active()
        assert rig.control.requests.put_reference("Ada") == ""
        await rig.hear()
        assert last_asked(rig).source == "hand: Ada"
        rig.set_reference(last_asked(rig).reference_id, positioning=False)
        await rig.follow(0.0, -8.0, 40)
        rig.asked.clear()
        assert "zero_first and 8.0 um are still applied" in rig.control.requests.put_reference("Ada")
        await rig.follow(0.0, -8.0, 2)
        assert rig.state == "ACTIVE" and not rig.asked
        assert "zero_first" in rig.control.journal.notices[-1]


async def test_zero_first_takes_no_vacant_echo_for_an_offset_that_is_out(tmp_path):
    bench = zero_first(Bench(tmp_path))
    async with running(bench.rig()) as rig:
        await rig.active()
        bench.nc.macros.set(513, None)
        await rig.turn(safe=False)
        assert "its echo is not known" in rig.control.requests.put_reference("Ada")
        bench.nc.sequence_number = 100
        await rig.turn(safe=False)
        rig.set_reference(last_asked(rig).reference_id)
        await rig.turn(safe=False)
        assert rig.control.reference is None and "its echo is not known" in rig.control.reference_ended


async def test_a_reference_that_has_ended_never_comes_back_by_a_sensor_that_returns(rig, bench):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ended = rig.control.reference
    bench.nc.work_offset = 55
    await rig.turn()
    assert rig.control.reference is None
    assert any(isinstance(item, ReferenceEnded) and item.reference_id == "r1" for item in rig.asked)
    bench.nc.work_offset = 54
    await rig.turn()
    rig.control.deliver(ReferenceRebased(reference=ended))
    await rig.turn()
    assert rig.control.reference is None and rig.state == "HOLD"


async def test_a_reference_by_hand_that_is_refused_while_a_probe_waits_for_its_step_has_no_part_in_it(tmp_path):
    """The thermal task has begun to count from it before it hears of the refusal."""
    bench = zero_first(requesting_bench(tmp_path))
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, -8.0, 40)
        ask(bench, 1, PROBE, Z_AXIS, 0.003)
        await rig.control._guarded(rig.control._poll())
        rig.set_reference("by hand", positioning=False)
        await rig.turn(rig.estimate(0.0, 0.0, reference_id="by hand"))
        assert rig.state == "ACTIVE" and rig.control.reference.reference_id == "r1"
        await rig.follow(0.0, -8.0, 40)
        assert answer(bench) == 1.0
        assert rig.applied["z"] == pytest.approx(5.0, abs=0.11)


@pytest.mark.parametrize("asks_anew", [False, True])
@pytest.mark.parametrize("kind", [PROBE, REFERENCE])
async def test_what_the_program_no_longer_waits_for_is_not_counted_where_the_guard_has_gone(
    rig, bench, kind, asks_anew
):
    """It was seen just before the program's patience ended, and the program goes on: the guard steps."""
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    for _ in range(20):
        await rig.turn(rig.estimate(0.0, -16.0), safe=False)
    assert rig.applied["z"] == pytest.approx(8.0) and bench.nc.macros.get(Z) == pytest.approx(0.016)
    ask(bench, 1, kind, Z_AXIS, -0.008 if kind == PROBE else 0.0)
    await rig.control._guarded(rig.control._poll())
    if asks_anew:
        ask(bench, 2, TOOL_CHANGE, 0, 1.0)
    else:
        bench.nc.macros.set(KIND, 0.0)
    bench.nc.safe_point()
    await rig.turn()
    await rig.follow(0.0, -16.0, 40)
    assert rig.state == "ACTIVE" and not rig.control.memory.tools
    assert rig.applied["z"] == pytest.approx(16.0, abs=0.11)


@pytest.mark.parametrize("kind", [PROBE, REFERENCE])
async def test_what_was_measured_before_the_work_was_positioned_anew_moves_nothing_after_it(rig, bench, kind):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, kind, Z_AXIS, 0.003)
    await rig.control._guarded(rig.control._poll())
    old = rig.estimate(0.0, -8.0)
    rig.set_reference("r2", positioning=False)
    await rig.turn(old)
    assert answer(bench) == -1.0
    await rig.follow(0.0, 0.0, 20)
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11)
    assert not rig.control.memory.tools


@pytest.mark.parametrize(
    "changes", [{"confidence": 0.8}, {"held_s": 20.0}, {"fading_um": 1.0}, {"thermal_error_um": np.full(2, np.nan)}]
)
@pytest.mark.parametrize("kind", [PROBE, REFERENCE])
async def test_what_was_measured_is_refused_where_the_next_estimate_is_none_to_count_from(rig, bench, kind, changes):
    await rig.active()
    await rig.follow(0.0, -8.0, 40)
    ask(bench, 1, kind, Z_AXIS, 0.003)
    await rig.control._guarded(rig.control._poll())
    await rig.turn(rig.estimate(0.0, -8.0, **changes))
    await rig.follow(0.0, -8.0, 40)
    assert answer(bench) == -1.0
    assert rig.applied["z"] == pytest.approx(8.0, abs=0.11)
    assert not rig.control.memory.tools
