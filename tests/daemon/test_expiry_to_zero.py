"""A guard under the policy `zero` takes an expired offset out; the daemon must know that and not call it false."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from control_rig import Bench, Rig, Z, running

from drivers.sim.nc.safe_point import GuardStatus, SafePointApplication, simulated_guard
from models.records import CncRun


def zero_bench(directory: Path) -> Bench:
    """A machine whose guard, and whose configuration, says `zero`."""
    bench = Bench(directory)
    configuration = bench.configuration
    axes = configuration.compensation.axes
    cnc = configuration.cnc.model_copy(update={"guard": simulated_guard(axes).model_copy(update={"on_expiry": "zero"})})
    # work lies so long at its positioning that none is missed while the computer stalls
    lasting = configuration.compensation.reference.model_copy(update={"positioning_dwell_s": 600.0})
    compensation = configuration.compensation.model_copy(update={"reference": lasting})
    bench.configuration = configuration.model_copy(update={"cnc": cnc, "compensation": compensation})
    bench.nc.guard = SafePointApplication(cnc.macros, axes, cnc.guard)
    bench.nc.guard.initialise(bench.nc.macros, bench.nc.clock_s)
    return bench


@asynccontextmanager
async def following(directory: Path, um: float) -> AsyncIterator[tuple[Bench, Rig]]:
    """The machine, and its daemon that has long followed an error [um]."""
    bench = zero_bench(directory)
    async with running(bench.rig()) as rig:
        await rig.active()
        await rig.follow(0.0, um, 80)
        yield bench, rig


async def expire(bench: Bench, rig: Rig, *, calls: int) -> None:
    """The machine stands idle while the daemon's computer stalls, and the guard is called so often."""
    bench.nc.run = CncRun.STOP
    await rig.turn(rig.estimate(0.0, -25.0))
    for _ in range(calls):
        bench.clock.monotonic_s += 60.0
        assert bench.nc.safe_point() is GuardStatus.EXPIRED


async def test_the_way_back_of_an_expired_block_is_no_fault_and_the_guard_catches_up(tmp_path: Path) -> None:
    async with following(tmp_path, -25.0) as (bench, rig):
        assert rig.applied["z"] == pytest.approx(25.0)
        await expire(bench, rig, calls=3)
        assert rig.applied["z"] == 0.0
        await rig.turn(rig.estimate(0.0, -25.0), safe=False)
        assert rig.control.journal.fault is None
        bench.nc.run = CncRun.START
        for expected_um in (10.0, 20.0, 25.0):
            await rig.turn(rig.estimate(0.0, -25.0))
            assert (rig.applied["z"], rig.state) == (pytest.approx(expected_um), "ACTIVE")


async def test_a_new_session_and_a_new_daemon_find_the_guard_on_its_way(tmp_path: Path) -> None:
    async with following(tmp_path, -25.0) as (bench, rig):
        await expire(bench, rig, calls=3)
        await rig.turn(rig.estimate(0.0, -25.0), safe=False)
    again = bench.rig()
    async with running(again):
        await again.turn(safe=False)
        assert again.control.journal.fault is None


async def test_what_lies_on_no_way_to_zero_is_a_fault_as_before(tmp_path: Path) -> None:
    async with following(tmp_path, -12.0) as (bench, rig):
        await expire(bench, rig, calls=1)
        bench.nc.macros.set(bench.configuration.cnc.macros.echo_applied["z"], -0.011)
        await rig.turn(rig.estimate(0.0, -12.0), safe=False)
        assert "the CNC says that it applies -11.000 um" in (rig.control.journal.fault or "")


async def test_once_the_guard_has_caught_up_a_loss_without_expiry_is_a_fault_again(tmp_path: Path) -> None:
    async with following(tmp_path, -25.0) as (bench, rig):
        bench.nc.macros.set(bench.configuration.cnc.macros.echo_applied["z"], 0.0)
        await rig.turn(rig.estimate(0.0, -25.0), safe=False)
        assert "the CNC says that it applies 0.000 um" in (rig.control.journal.fault or "")


@pytest.mark.parametrize("calls", [1, 3])
async def test_an_output_that_holds_stays_where_the_guard_has_gone(tmp_path: Path, calls: int) -> None:
    """Going back to what was applied before would move the tool without an estimate."""
    async with following(tmp_path, -25.0) as (bench, rig):
        await expire(bench, rig, calls=calls)
        stands_um = rig.applied["z"]
        assert stands_um == {1: 15.0, 3: 0.0}[calls]
        bench.nc.run = CncRun.START
        for _ in range(5):
            await rig.turn(rig.estimate(0.0, -25.0, confidence=0.1))
            assert (rig.state, rig.applied["z"]) == ("HOLD", stands_um)
        await rig.follow(0.0, -25.0, 80)
        assert (rig.state, rig.applied["z"]) == ("ACTIVE", pytest.approx(25.0)), "an estimate leads back"


async def test_after_a_stall_it_is_looked_first_where_the_guard_has_gone(tmp_path: Path) -> None:
    """An estimate is acted on before the next poll; what was seen before the stall is no longer where the tool is."""
    async with following(tmp_path, -8.0) as (bench, rig):
        session = rig.control.session
        assert session is not None and not session.lapsed
        await expire(bench, rig, calls=1)
        assert (rig.applied["z"], session.lapsed) == (0.0, True)
        working = asyncio.create_task(rig.control.run())
        rig.control.deliver(rig.estimate(0.0, -8.0, confidence=0.1))
        while rig.state != "HOLD":
            await asyncio.sleep(0.001)
        rig.control.stop()
        await working
        assert bench.nc.macros.get(Z) == 0.0
