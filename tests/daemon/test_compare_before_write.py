"""What somebody else puts into a macro of ours between a poll and a write is noticed, and not written over."""

from pathlib import Path

import pytest
from control_rig import BLOCK, VALID_UNTIL, Bench, Rig, Z, running
from speed_rig import MACROS, SAFE, SpeedRig

from daemon.cnc.audited_write import LOOK_LASTS_S
from daemon.history.reader import HistoryReader
from daemon.messages import EstimateComing
from daemon.spindle_speed.macro_block import DISABLED
from daemon.spindle_speed.writer import SpeedWriteError
from models.control.state import OperatorRequest
from models.records import WriteOutcome

FOREIGN = [(Z, -0.02), (Z, 1e9), *((number, 1e9) for number in BLOCK if number != Z), (Z, None)]
ACKNOWLEDGE = 524


def audited(rig: Rig):
    with HistoryReader(rig.history.path) as reader:
        return reader.writes(0.0, 2.0**40)


async def poll(rig: Rig) -> None:
    await rig.control._guarded(rig.control._poll())


async def act(rig: Rig, estimate=None) -> None:
    await rig.control._guarded(rig.control._act(estimate))


@pytest.mark.parametrize(
    ("number", "value", "cause"), [*((*each, "estimate") for each in FOREIGN), (*FOREIGN[0], "tick")]
)
async def test_a_value_put_there_between_poll_and_write_is_a_fault_and_stays(rig, bench, number, value, cause):
    await rig.active()
    await rig.follow(0.0, -10.0, 30)
    applied = dict(rig.applied)
    for _ in range(11):  # the block is due even without an estimate
        bench.clock.monotonic_s += 1.0
        await poll(rig)
    estimate = rig.estimate(0.0, -12.0)
    if cause == "tick":
        rig.control.deliver(estimate)
        rig.control._fresh = None
    await poll(rig)
    assert rig.control.journal.fault is None
    bench.nc.macros.set(number, value)
    bench.nc.written.clear()
    await act(rig, estimate if cause == "estimate" else None)
    found = "is vacant" if value is None else f"holds {value:g}, we wrote"
    assert bench.nc.written == [] and bench.nc.macros.get(number) == value
    assert f"a write was refused: macro #{number} {found}" in rig.control.journal.fault
    assert rig.control.writer.counts["refused"] == 1
    await rig.history.flushed()
    refused = audited(rig)[-1]
    assert refused.outcome is WriteOutcome.REFUSED and refused.cause == cause
    assert f"macro #{number} {found}" in refused.detail and "nothing was written" in refused.detail
    for _ in range(5):
        await rig.turn(rig.estimate(0.0, -12.0), safe=False)
    assert rig.state == "FAULT" and bench.nc.written == [] and rig.applied == applied


async def test_valid_until_may_be_vacant_because_power_off_clears_it(rig, bench):
    await rig.active()
    await poll(rig)
    bench.nc.macros.set(VALID_UNTIL, None)
    await act(rig, rig.estimate(0.0, -5.0))
    assert rig.control.journal.fault is None and bench.nc.macros.get(VALID_UNTIL) is not None


async def test_a_value_put_into_a_vacant_valid_until_is_foreign(rig, bench):
    await rig.active()
    bench.nc.macros.set(VALID_UNTIL, None)
    await poll(rig)
    assert rig.control.journal.fault is None
    bench.nc.macros.set(VALID_UNTIL, bench.nc.clock_s + 100.0)
    bench.nc.written.clear()
    await act(rig, rig.estimate(0.0, -5.0))
    assert bench.nc.written == [] and f"macro #{VALID_UNTIL} holds" in rig.control.journal.fault


async def test_after_the_fault_is_acknowledged_what_the_control_holds_is_ours(rig, bench):
    await rig.active()
    await poll(rig)
    bench.nc.macros.set(Z, -0.004)
    await act(rig, rig.estimate(0.0, -5.0))
    await rig.turn(safe=False)
    assert rig.state == "FAULT"
    assert rig.acknowledge("p") == ""
    await rig.follow(0.0, -5.0, 20)
    assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(5.0, abs=0.11)


async def test_one_request_more_and_it_is_the_last_before_the_write(rig, bench):
    await rig.active()
    await poll(rig)
    asked: list[tuple[int, ...]] = []
    bench.nc.after_read = lambda numbers: asked.append((len(bench.nc.written), *numbers))
    before = len(bench.nc.written)
    await act(rig, rig.estimate(0.0, -5.0))
    assert [entry[0] for entry in asked] == [before, len(bench.nc.written)]
    assert set(asked[0][1:]) == set(BLOCK)


async def coming(rig: Rig) -> None:
    rig.control.deliver(EstimateComing(line="spindle"))
    await rig.control._guarded(rig.control._take_messages())


async def test_what_was_looked_at_while_the_estimate_was_made_is_the_comparison(rig, bench):
    await rig.active()
    await poll(rig)
    asked: list[tuple[int, ...]] = []
    bench.nc.after_read = lambda numbers: asked.append((len(bench.nc.written), *numbers))
    before = len(bench.nc.written)
    await coming(rig)
    await act(rig, rig.estimate(0.0, -5.0))
    assert [entry[0] for entry in asked] == [before, len(bench.nc.written)]
    assert set(asked[0][1:]) == set(BLOCK)
    await act(rig, rig.estimate(0.0, -6.0))
    assert len(asked) == 4, "it counts for one write"


@pytest.mark.parametrize(("number", "value"), [FOREIGN[0], (VALID_UNTIL, 1e9), (Z, None)])
async def test_a_foreign_value_that_is_seen_while_the_estimate_is_made_is_a_fault_and_stays(rig, bench, number, value):
    await rig.active()
    await poll(rig)
    bench.nc.macros.set(number, value)
    bench.nc.written.clear()
    await coming(rig)
    await act(rig, rig.estimate(0.0, -5.0))
    assert bench.nc.written == [] and bench.nc.macros.get(number) == value
    assert "a write was refused" in rig.control.journal.fault


@pytest.mark.parametrize("between", ["late", "polled", "written apart"])
async def test_a_look_that_is_not_the_last_or_too_old_is_taken_again(rig, bench, between):
    await rig.active()
    await poll(rig)
    await coming(rig)
    if between == "late":
        bench.clock.monotonic_s += 1.01 * LOOK_LASTS_S
    elif between == "polled":
        await poll(rig)
    else:
        await rig.control.session.write_one(ACKNOWLEDGE, 0.0, cause="test")
    bench.nc.macros.set(Z, -0.02)
    bench.nc.written.clear()
    await act(rig, rig.estimate(0.0, -5.0))
    assert bench.nc.written == [] and f"macro #{Z} holds -0.02" in rig.control.journal.fault


async def test_nothing_is_looked_at_ahead_while_nothing_is_written(rig, bench):
    asked: list[object] = []
    bench.nc.after_read = asked.append
    await coming(rig)
    await rig.active()
    assert rig.control.request(OperatorRequest(zero=True), "p") == ""
    await rig.follow(0.0, 0.0, 60)
    assert rig.state == "OFF"
    asked.clear()
    await coming(rig)
    assert asked == []


# --- the answers to the NC program ---------------------------------------------------------


def ask(bench: Bench, counter: int) -> None:
    for number, value in ((521, 3.0), (522, 0.0), (523, 2.0), (520, float(counter))):
        bench.nc.macros.set(number, value)


@pytest.mark.parametrize("value", [77.0, None])
@pytest.mark.parametrize("answered", [False, True])
async def test_a_foreign_answer_is_a_fault_and_is_not_written_over(rig, bench, value, answered):
    await rig.active()
    if answered:
        ask(bench, 1)
        await rig.turn()
        assert bench.nc.macros.get(ACKNOWLEDGE) == 1.0
    ask(bench, 2 if answered else 1)
    await poll(rig)
    bench.nc.macros.set(ACKNOWLEDGE, value)
    await act(rig)
    assert bench.nc.macros.get(ACKNOWLEDGE) == value
    assert f"macro #{ACKNOWLEDGE}" in rig.control.journal.fault
    assert "an answer to the NC program could not be written" in rig.control.journal.fault


async def test_the_answer_is_compared_with_what_was_written_not_with_what_a_poll_saw(rig, bench):
    await rig.active()
    ask(bench, 1)
    await rig.turn()
    bench.nc.macros.set(ACKNOWLEDGE, 77.0)
    await rig.turn()
    ask(bench, 2)
    await rig.turn()
    assert bench.nc.macros.get(ACKNOWLEDGE) == 77.0
    assert "holds 77, we wrote 1" in rig.control.journal.fault
    assert rig.acknowledge("p") == ""
    await rig.turn()
    await rig.turn()
    assert bench.nc.macros.get(ACKNOWLEDGE) == 2.0 and rig.control.journal.fault is None


async def test_what_an_answer_may_hold_is_known_to_the_next_session(rig, bench):
    await rig.active()
    ask(bench, 1)
    await rig.turn()
    bench.nc.reachable = False
    await rig.turn()
    bench.nc.macros.set(ACKNOWLEDGE, 77.0)
    bench.nc.reachable = True
    await rig.connected()
    await rig.turn()
    ask(bench, 2)
    await rig.turn()
    assert "holds 77, we wrote 1" in rig.control.journal.fault


# --- the block of the spindle speed ----------------------------------------------------------


async def test_a_value_put_into_the_speed_block_after_it_was_read_is_refused(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        await bench.operation()
        session, follower = bench.rig.link.session, bench.speed.follower
        found = await session.cnc.read_macros(MACROS.numbers)
        for number in MACROS.ours:
            was = bench.nc.macros.get(number)
            bench.nc.macros.set(number, 4711.5)
            bench.nc.written.clear()
            with pytest.raises(SpeedWriteError, match=f"macro #{number} holds 4711.5, .*; nothing was written"):
                await follower.writer.write(
                    session, DISABLED, None, found, clock_s=bench.nc.clock_s, now_s=bench.clock.monotonic_s
                )
            assert bench.nc.written == [] and bench.nc.macros.get(number) == 4711.5
            bench.nc.macros.set(number, was)
        bench.nc.macros.set(MACROS.speed, 4711.5)
        await bench.pass_by(3.0, SAFE)
        assert f"#{MACROS.speed} holds 4711.5" in str(bench.rig.control.journal.fault)
