"""A block that is consistent and not ours: restored from a back-up of the control, or another daemon's."""

from pathlib import Path

import pytest
from control_rig import Bench, Rig, running
from nc_requests import TOOL_CHANGE, ask, requesting_bench, tool_2_set

from models.control.state import OperatorRequest

KEPT_AT_POWER_OFF = 500


def restore(bench: Bench, backup: dict[int, float | None], *, volatile: bool) -> None:
    """Put what a back-up of the control holds into its macros, the guard's memory and the counters with the block."""
    for number, value in backup.items():
        if volatile or number >= KEPT_AT_POWER_OFF:
            bench.nc.macros.set(number, value)


async def followed(rig: Rig, bench: Bench) -> dict[int, float | None]:
    """Follow 20 um; return what a back-up held that was made at 10 um."""
    await rig.active()
    await rig.follow(-10.0, -10.0, 30)
    backup = {number: bench.nc.macros.get(number) for number in (*range(100, 200), *range(500, 1000))}
    await rig.follow(-20.0, -20.0, 60)
    assert rig.applied == {"x": 0.0, "y": 20.0, "z": 20.0}
    return backup


@pytest.mark.parametrize("guard_first", [False, True])
@pytest.mark.parametrize("volatile", [False, True], ids=["kept macros", "all macros"])
@pytest.mark.parametrize("away", [False, True], ids=["running", "away"])
async def test_macros_of_a_back_up_of_the_control_move_nothing_and_are_a_fault(
    tmp_path: Path, away: bool, volatile: bool, guard_first: bool
) -> None:
    bench = Bench(tmp_path)
    async with running(bench.rig()) as rig:
        backup = await followed(rig, bench)
        if away:
            await rig.history.flushed()
            rig.alive()
        else:
            await restored_under(rig, bench, backup, volatile=volatile, guard_first=guard_first)
    if away:
        async with running(bench.rig()) as rig:
            await restored_under(rig, bench, backup, volatile=volatile, guard_first=guard_first)


async def restored_under(
    rig: Rig, bench: Bench, backup: dict[int, float | None], *, volatile: bool, guard_first: bool
) -> None:
    restore(bench, backup, volatile=volatile)
    if guard_first:
        bench.nc.safe_point()
    written = len(bench.nc.written)
    await rig.follow(-20.0, -20.0, 5)
    assert rig.state == "FAULT" and "we wrote" in str(rig.control.journal.fault)
    assert rig.applied == {"x": 0.0, "y": 20.0, "z": 20.0} and len(bench.nc.written) == written
    assert rig.acknowledge("a person") == ""
    await rig.follow(-20.0, -20.0, 40)
    assert rig.state == "HOLD" and rig.control.reference is None, "what is applied is not known"
    assert abs(rig.applied["z"] - 20.0) < 1.0


async def test_macros_that_are_emptied_end_the_reference(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    async with running(bench.rig()) as rig:
        await followed(rig, bench)
        for number in (*range(500, 580), *range(590, 600)):
            bench.nc.macros.set(number, 0.0)
        await rig.follow(-20.0, -20.0, 5)
        assert rig.state == "FAULT" and rig.acknowledge("a person") == ""
        await rig.follow(-20.0, -20.0, 60)
        assert rig.state == "HOLD" and "somebody has put back or emptied" in rig.control.reference_ended
        assert rig.applied == {"x": 0.0, "y": 20.0, "z": 20.0}


async def test_they_end_the_tool_settings_too(tmp_path: Path) -> None:
    """Before, T2 counted from what was applied when it was set, and what is applied counted from nothing: 8 um off."""
    bench = requesting_bench(tmp_path)
    async with running(bench.rig()) as rig:
        await tool_2_set(rig, bench)
        for number in (*range(500, 580), *range(590, 600)):
            bench.nc.macros.set(number, 0.0)
        await rig.follow(0.0, -12.0, 5)
        assert rig.state == "FAULT" and rig.acknowledge("a person") == ""
        await rig.follow(0.0, -12.0, 5)
        assert any("settings of T2 have ended" in notice for notice in rig.control.journal.notices)
        rig.set_reference("r2")
        await rig.follow(0.0, 0.0, 5)
        ask(bench, 1, TOOL_CHANGE, 0, 2.0)
        await rig.follow(0.0, 0.0, 40)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(12.0, abs=0.11), "as it was positioned"


@pytest.mark.parametrize("block", [503, 504, 505, 506])
async def test_a_foreign_value_in_the_block_alone_leaves_the_reference(tmp_path: Path, block: int) -> None:
    bench = Bench(tmp_path)
    async with running(bench.rig()) as rig:
        await followed(rig, bench)
        bench.nc.macros.set(block, 0.001)
        await rig.follow(-20.0, -20.0, 5)
        assert rig.state == "FAULT" and rig.acknowledge("a person") == ""
        await rig.follow(-22.0, -22.0, 20)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(22.0, abs=0.11)


@pytest.mark.parametrize("has_a_past", [False, True])
async def test_a_second_daemon_at_the_control_of_the_first_writes_nothing(tmp_path: Path, has_a_past: bool) -> None:
    """A wrong address, and a control that calls itself what its own does: what stands in the block is not its."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    first, second = Bench(tmp_path / "first"), Bench(tmp_path / "second")
    if has_a_past:
        async with running(second.rig()) as rig:
            await rig.active()
            await rig.follow(-5.0, -5.0, 20)
            await rig.history.flushed()
            rig.alive()
    first.clock = first.nc.clock = second.clock
    async with running(first.rig()) as rig:
        await rig.active()
        await rig.follow(-10.0, -10.0, 30)
        second.nc = first.nc
        async with running(second.rig()) as other:
            for _ in range(8):
                written = len(first.nc.written)
                await other.turn(other.estimate(3.0, 3.0))
                other.control.request(OperatorRequest(enable=frozenset({"y", "z"})), "a person")
                assert len(first.nc.written) == written
                await rig.turn(rig.estimate(-10.0, -10.0))
            assert other.state == "FAULT"
        assert rig.state == "ACTIVE" and rig.applied == {"x": 0.0, "y": 10.0, "z": 10.0}
