"""The spindle speed over real wires: sensors on lines, the CNC over OPC UA, the NC program as it is shipped."""

import hashlib
import os
import signal
from pathlib import Path

import pytest
from milling_wires import CUT, SAFE, MillingWires, milling, tuned
from speed_machine import MACROS, speed_machine

from daemon.history.reader import HistoryReader
from drivers.guard.speed_text import SpeedStatus
from models.records import WriteOutcome

pytestmark = pytest.mark.wires

ROUGH = {"S": 9000.0, "F": 1800.0, "D": 2.0}
FINE = {"S": 9000.0, "F": 1800.0, "D": 1.5}
STEP_RPM = 200.0


async def cut(wires: MillingWires, seconds: float) -> set[float]:
    """Cut for so long of the machine's time; return the speeds that the block has held meanwhile."""
    wires.machine.nc.sequence_number = CUT
    held, end_s = set(), wires.machine.time_s + seconds
    while wires.machine.time_s < end_s:
        held.add(wires.macro(MACROS.speed) or 0.0)
        await wires.clock.sleep(0.2)
    return held


def target_is_off(wires: MillingWires) -> bool:
    """The target has left the command by more than the hysteresis, and has waited long enough."""
    return "waiting for a safe block" in wires.picture()["reason"]


async def run_without_and_again(wires: MillingWires, before_rpm: float) -> None:
    """Without a daemon the pair runs out, and the programmed one counts; the next one takes its own block over."""
    assert wires.machine.call(**ROUGH)[2] is SpeedStatus.APPLIED
    wires.machine.nc.clock_s += 601.0
    assert wires.machine.call(**ROUGH) == (9000.0, 1800.0, SpeedStatus.EXPIRED)
    async with tuned(wires) as daemon:
        await wires.until("the first poll", lambda: daemon.control.memory is not None)
        speed_rpm, _, status = await wires.operation(**ROUGH)
        assert status is SpeedStatus.APPLIED
        assert abs(speed_rpm - before_rpm) <= STEP_RPM + 1.0
        assert daemon.control.journal.fault is None


async def test_a_part_is_milled_while_the_spindle_warms(tmp_path: Path) -> None:
    operation = speed_machine(tmp_path).spindle_speed.operations[0]
    tools = [operation, operation.model_copy(update={"tool_number": 2, "highest_rpm": 11000.0})]
    async with milling(tmp_path, operations=tools, validity_s=600.0, stale_after_s=600.0) as wires:
        nc = wires.machine.nc
        async with tuned(wires) as daemon:
            await wires.until("the first poll", lambda: daemon.control.phase == "cutting" and daemon.control.memory)
            rough_rpm, feed_mm_min, status = await wires.operation(**ROUGH)
            assert status is SpeedStatus.APPLIED
            assert rough_rpm != 9000.0
            assert feed_mm_min == pytest.approx(1800.0 * rough_rpm / 9000.0, rel=1e-5)
            assert nc.spindle_speed_rpm == rough_rpm

            # Within the cut the spindle warms and the target moves: the command stays.
            for _ in range(40):  # 2 K/min: what jumps is not believed
                wires.machine.degc += 0.2
                assert await cut(wires, 6.0) == {rough_rpm}
            await wires.until("another target", lambda: target_is_off(wires))
            assert wires.macro(MACROS.speed) == rough_rpm

            # At the next safe block it follows, by a step at most.
            nc.sequence_number = SAFE
            assert wires.machine.call(**ROUGH)[::2] == (rough_rpm, SpeedStatus.APPLIED)
            await wires.until("a step", lambda: wires.picture()["commanded_rpm"] not in (None, rough_rpm))
            stepped_rpm, _, status = wires.machine.call(**ROUGH)
            assert status is SpeedStatus.APPLIED
            assert 0.0 < abs(stepped_rpm - rough_rpm) <= STEP_RPM + 1.0
            assert await cut(wires, 15.0) == {stepped_rpm}

            # Another tool with the same speed and feed does not take it, and gets one of its own.
            nc.tool_number = 2
            nc.sequence_number = SAFE
            assert wires.machine.call(**ROUGH)[::2] == (9000.0, SpeedStatus.ANOTHER)
            fine_rpm, _, status = await wires.operation(**FINE)
            assert status is SpeedStatus.APPLIED
            await cut(wires, 10.0)

            # The link is lost in the cut, and comes back: nothing changes.
            await wires.relay.stop()
            await wires.until("the loss", lambda: wires.picture()["commanded_rpm"] is None)
            assert wires.picture()["alarm"] == "no link to the CNC"
            assert await cut(wires, 20.0) == {fine_rpm}
            await wires.relay.start()
            await wires.until("the link", lambda: wires.picture()["commanded_rpm"] == fine_rpm)
            assert await cut(wires, 10.0) == {fine_rpm}
            nc.sequence_number = SAFE
            assert wires.machine.call(**FINE)[::2] == (fine_rpm, SpeedStatus.APPLIED)
            await cut(wires, 5.0)

            # The first tool comes back and goes on from where it was.
            nc.tool_number = 1
            again_rpm, _, status = await wires.operation(**ROUGH)
            assert status is SpeedStatus.APPLIED
            assert abs(again_rpm - stepped_rpm) <= STEP_RPM + 1.0
            await cut(wires, 5.0)

            # The program switches it off for the next operation.
            nc.sequence_number = SAFE
            assert wires.machine.call(**ROUGH, K=0.0) == (9000.0, 1800.0, SpeedStatus.NOT_WANTED)
            await wires.until("the end", lambda: wires.macro(MACROS.enable) == 0.0)
            assert wires.picture()["state"] == "OFF"
            assert await cut(wires, 5.0) == {0.0}
            await wires.operation(**ROUGH)
            assert daemon.control.journal.fault is None

        await run_without_and_again(wires, again_rpm)
    with HistoryReader(wires.configuration.history.path) as reader:
        audit = [record for record in reader.writes(0.0, 1e11) if record.cause == "spindle speed"]
    assert len(audit) > 5
    lost = [record for record in audit if record.outcome is not WriteOutcome.VERIFIED]
    assert len(lost) <= 1  # the one, if any, that was under way when the link was lost


async def test_a_case_that_has_changed_when_the_planner_is_started_again_is_told(tmp_path: Path) -> None:
    async with milling(tmp_path) as wires, tuned(wires) as daemon:
        planner, case = daemon._planner, tmp_path / "case.yaml"
        for change in ("", "", "# changed\n"):
            case.write_text(case.read_text("utf-8") + change, encoding="utf-8")
            await wires.until("the planner", lambda: planner.opened is not None)
            os.kill(planner.process_id, signal.SIGKILL)
            await wires.until("its end", lambda: planner.opened is None)
            await wires.until("another one", lambda: planner.opened is not None)
        await daemon._history.flushed()
        with HistoryReader(wires.configuration.history.path) as reader:
            told = [event.text for event in reader.events(0.0, 1e11) if event.text.startswith("bearings: ")]
    assert len(told) == 2 and hashlib.sha256(case.read_bytes()).hexdigest() in told[1]
    assert all(f"{case}, sha256" in text for text in told) and "simulated_machine.yaml, sha256" in told[0]
