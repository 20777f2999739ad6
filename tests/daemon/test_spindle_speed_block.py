"""The block of the spindle speed: whose it is at the start and after a connection, and what never leaves."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from control_rig import running
from speed_machine import MACROS, speed_machine
from speed_rig import CUT, SAFE, SpeedRig, acknowledge, turned

from daemon.cnc.commissionable import without_text
from daemon.spindle_speed.macro_block import DISABLED, OperationKey, SpeedBlock, SpeedPair
from daemon.spindle_speed.writer import SpeedWriteError, SpeedWriter
from drivers.guard.speed_text import SpeedStatus

bench = turned

PROGRAMMED = (9000.0, 1800.0)
APPLIED = SpeedStatus.APPLIED


# --- what stands in the macros at the start and after a connection -------------------------


def fill(bench: SpeedRig, *, valid_for_s: float | None = None, **changes: float) -> None:
    made_for = OperationKey(
        tool_number=1.0, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=2.0, radial_mm=0.0, kind=1.0
    )
    pair = SpeedPair(made_for=made_for, speed_rpm=10500.0, feed_mm_min=2100.0, enable=valid_for_s is not None)
    groups = SpeedBlock(MACROS).encode(pair, after=3, valid_until_s=bench.nc.clock_s + (valid_for_s or 0.0))
    for number, value in (each for group in groups for each in group):
        bench.nc.macros.set(number, value)
    for name, value in changes.items():
        bench.nc.macros.set(getattr(MACROS, name), value)


@pytest.mark.parametrize(
    "found,sentence",
    [
        ({"valid_for_s": 500.0}, "the daemon has not written the block, and it is enabled and valid"),
        ({"valid_for_s": -5.0, "sequence_a": 9.0}, "its sequence numbers differ"),
        ({"valid_for_s": 500.0, "enable": 3.0}, "enabled and valid"),
    ],
)
async def test_a_block_that_nobody_here_has_written_is_a_fault(tmp_path: Path, found: dict, sentence: str) -> None:
    bench = SpeedRig(tmp_path)
    fill(bench, **found)
    before = [bench.nc.macros.get(number) for number in MACROS.ours]
    async with running(bench.rig):
        await bench.rig.turn()
        await bench.pass_by(3.0, SAFE)
        await bench.operation()
        assert sentence in str(bench.rig.control.journal.fault)
        assert [bench.nc.macros.get(number) for number in MACROS.ours] == before
        await acknowledge(bench)
        await bench.pass_by(20.0, SAFE)
        assert (await bench.operation())[2] is APPLIED


@pytest.mark.parametrize("found", [{}, {"valid_for_s": -5.0}])
async def test_a_whole_block_that_the_nc_does_not_follow_is_taken_over(tmp_path: Path, found: dict) -> None:
    bench = SpeedRig(tmp_path)
    fill(bench, **found)
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[2] is APPLIED
        assert bench.rig.control.journal.fault is None


async def test_vacant_macros_are_a_fault_that_names_the_command(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    bench.nc.macros.set(MACROS.feed, None)
    async with running(bench.rig):
        await bench.rig.turn()
        await bench.operation()
        assert "#538 vacant; `toolpoint commission --initialise-only`" in str(bench.rig.control.journal.fault)
        await acknowledge(bench)
        await bench.pass_by(2.0, SAFE)
        assert "#538 vacant" in str(bench.rig.control.journal.fault)
        assert not any(bench.written())
        bench.nc.macros.set(MACROS.feed, 0.0)
        await acknowledge(bench)
        assert (await bench.operation())[2] is APPLIED


async def test_what_somebody_wrote_while_the_link_was_away_is_a_fault(bench: SpeedRig) -> None:
    await bench.operation()
    bench.nc.reachable = False
    await bench.pass_by(2.0, CUT)
    bench.nc.macros.set(MACROS.speed, 11000.0)
    bench.nc.reachable = True
    await bench.rig.connected()
    count = len(bench.nc.written)
    await bench.pass_by(15.0, CUT)
    assert "macro #537 holds 11000" in str(bench.rig.control.journal.fault)
    assert len(bench.nc.written) == count


@pytest.mark.parametrize("torn", [False, True])
async def test_a_restart_within_a_cut_goes_on_with_the_pair(tmp_path: Path, torn: bool) -> None:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        speed_rpm, *_ = await bench.operation()
        await bench.pass_by(3.0, CUT)
        if torn:
            bench.nc.groups_until_lost = 1
            await bench.pass_by(12.0, CUT)
    count = len(bench.nc.written)
    async with running(bench.new_rig()) as rig:
        await rig.turn(safe=False)
        await bench.pass_by(25.0, CUT)
        assert rig.control.journal.fault is None
        written = {value for number, value in bench.nc.written[count:] if number == MACROS.speed}
        assert written <= ({speed_rpm, 0.0} if torn else {speed_rpm})
        if not torn:
            assert bench.call()[::2] == (speed_rpm, APPLIED)
        bench.degc += 14.0
        await bench.pass_by(30.0, CUT)
        await bench.pass_by(30.0, SAFE)
        assert 0.0 <= abs(bench.call()[0] - speed_rpm) <= 200.5


async def test_switching_the_control_off_and_on_expires_the_pair_and_is_no_fault(bench: SpeedRig) -> None:
    speed_rpm, *_ = await bench.operation()
    await bench.pass_by(3.0, CUT)
    bench.nc.power_cycle()
    assert bench.call()[2] is SpeedStatus.EXPIRED
    await bench.pass_by(4.0, CUT)
    assert bench.rig.control.journal.fault is None
    assert bench.call()[::2] == (speed_rpm, APPLIED)
    assert (await bench.operation())[2] is APPLIED


async def test_without_a_check_no_speed_is_tuned_and_status_says_why(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    tuning = bench.configuration.spindle_speed
    assert tuning is not None
    unchecked = tuning.model_copy(update={"macros": MACROS.model_copy(update={"check": None})})
    bench.configuration = bench.configuration.model_copy(update={"spindle_speed": unchecked})
    async with running(bench.new_rig()):
        await bench.rig.turn()
        await bench.operation()
        await bench.pass_by(30.0, CUT)
        assert (await bench.operation())[:2] == PROGRAMMED
        assert "spindle_speed.macros.check names no variable" in bench.picture()["alarm"]
        assert bench.rig.control.journal.fault is None
    assert "spindle_speed.macros.check names no variable" in without_text(bench.configuration)


# --- the bounds of the writer --------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"speed_rpm": 12001.0, "feed_mm_min": 2400.2},
        {"speed_rpm": 10000.0, "feed_mm_min": 1800.0},
        {"speed_rpm": 9400.0, "feed_mm_min": float("nan")},
        {"speed_rpm": float("nan"), "feed_mm_min": 1800.0},
        {"speed_rpm": 9900.0, "feed_mm_min": 1980.0},
    ],
)
async def test_a_pair_out_of_bounds_never_leaves(tmp_path: Path, change: dict) -> None:
    tuning = speed_machine(tmp_path).spindle_speed
    assert tuning is not None
    writer = SpeedWriter(tuning, SpeedBlock(MACROS), tmp_path / "store.sqlite")
    made_for = OperationKey(
        tool_number=1.0, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=2.0, radial_mm=0.0, kind=1.0
    )
    pair = replace(DISABLED, made_for=made_for, enable=True, **change)
    operation = tuning.operations[0].model_copy(update={"highest_rpm": 9800.0})
    with pytest.raises(SpeedWriteError, match="out of bounds"):
        await writer.write(None, pair, operation, {}, clock_s=0.0, now_s=0.0)  # type: ignore[arg-type]


# --- values that no program writes ---------------------------------------------------------


@pytest.mark.parametrize("value", [None, math.inf, -math.inf, 1e300, 2.5, 1e-9, -3.0, -0.0])
def test_whatever_a_macro_holds_no_number_is_made_of_it(value: float | None) -> None:
    block, told = SpeedBlock(MACROS), dict.fromkeys(MACROS.numbers, 1.0)
    assert block.call(told) is not None
    for number in MACROS.numbers:
        found = told | {number: value}
        assert block.pair(found) is not None
        assert block.sequence(found) == (0 if number == MACROS.sequence_b else 1)
        whole = value is not None and value.is_integer()
        assert number != MACROS.echo_status or block.status(found) == (value if whole or value is None else -1)
        if number in (MACROS.calls, MACROS.called_tool) and not whole:
            assert block.call(found) is None
