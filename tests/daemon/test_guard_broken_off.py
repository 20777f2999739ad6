"""RESET in a run of the guard: the offset may have moved by a step of which the echo says nothing yet."""

from pathlib import Path

import pytest
from control_rig import Bench, Rig, running
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, PROBE, REFERENCE, VALUE, Z_AXIS, answer, ask, last_asked

from drivers.guard.text import GuardStatus
from models.control.state import OperatorRequest

BEHIND_UM, AHEAD_UM = 3.0, 11.0


async def broken_off(rig: Rig, bench: Bench, after: int) -> bool:
    """Let the guard apply 3 um, write more, break the next run off after so many blocks; False: it had ended."""
    await rig.active(handshake=True)
    await rig.follow(0.0, -BEHIND_UM, 10)
    for _ in range(10):
        await rig.turn(rig.estimate(0.0, -AHEAD_UM), safe=False)
    interpreter = bench.nc.guard.at(bench.nc.macros, bench.nc.clock_s)
    interpreter.start(bench.nc.guard.programs.guard)
    for _ in range(after):
        if interpreter.running:
            interpreter.step()
    running_still = interpreter.running
    interpreter.reset()
    await rig.turn(rig.estimate(0.0, -AHEAD_UM), safe=False)
    return running_still


async def positioned(rig: Rig, bench: Bench, counter: int) -> float:
    """Position the work and ask for its reference; return what is applied in truth [um]."""
    ask(bench, counter, REFERENCE)
    await rig.turn(rig.estimate(0.0, -AHEAD_UM), safe=False)
    rig.set_reference(last_asked(rig).reference_id, handshake=True)
    stood_um = rig.applied["z"]
    for _ in range(4):
        await rig.turn(safe=False)
    return stood_um


async def test_work_that_is_positioned_then_has_no_reference_until_the_guard_has_run(tmp_path: Path) -> None:
    refused = 0
    for blocks in range(60, 200, 2):
        directory = tmp_path / str(blocks)
        directory.mkdir()
        bench = Bench(directory)
        for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE):
            bench.nc.macros.set(number, 0.0)
        async with running(bench.rig()) as rig:
            more = await broken_off(rig, bench, blocks)
            stood_um = await positioned(rig, bench, 1)
            if answer(bench) == -1.0:
                refused += 1
                assert "the guard has not settled what is applied" in rig.control.reference_ended
                assert rig.state == "HOLD" and rig.control.reference is None
                if not refused % 6:  # the guard runs, and the next positioning counts
                    bench.nc.safe_point()
                    await rig.turn(safe=False)
                    stood_um = await positioned(rig, bench, 2)
                    assert answer(bench) == 2.0
            if rig.control.reference is not None:
                await rig.follow(0.0, 0.0, 12)
                assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(stood_um, abs=1.0), blocks
        if not more:
            break
    assert refused > 5 and not more


async def test_nothing_that_is_measured_then_counts(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE):
        bench.nc.macros.set(number, 0.0)
    async with running(bench.rig()) as rig:
        assert await broken_off(rig, bench, 98)
        assert rig.applied["z"] > BEHIND_UM + 1.0 and rig.control.applied_um()[2] == BEHIND_UM
        for counter, (kind, value_mm) in enumerate(((PROBE, 0.003), (REFERENCE, 0.0)), start=1):
            ask(bench, counter, kind, Z_AXIS, value_mm)
            for _ in range(3):
                await rig.turn(rig.estimate(0.0, -AHEAD_UM), safe=False)
            assert answer(bench) == -counter, kind
        bench.nc.safe_point()
        await rig.follow(0.0, -AHEAD_UM, 4)
        ask(bench, 3, PROBE, Z_AXIS, 0.001)
        await rig.follow(0.0, -AHEAD_UM, 3)
        assert answer(bench) == 3.0


@pytest.mark.parametrize("blocks", [97, 98, 99])
async def test_a_run_in_inches_after_it_does_not_hide_it(tmp_path: Path, blocks: int) -> None:
    bench = Bench(tmp_path)
    for number in (COUNTER, KIND, AXIS, VALUE, ACKNOWLEDGE):
        bench.nc.macros.set(number, 0.0)
    modal = bench.nc.guard.control.modal  # type: ignore[union-attr]
    async with running(bench.rig()) as rig:
        assert await broken_off(rig, bench, blocks)
        modal[6] = 20
        assert bench.nc.safe_point() is GuardStatus.INCH
        modal[6] = 21
        await rig.turn(safe=False)
        assert rig.applied["z"] == 8.0 and rig.control.applied_um()[2] == BEHIND_UM, "the echo is behind"
        await positioned(rig, bench, 1)
        assert answer(bench) == -1.0 and rig.state == "HOLD" and rig.control.reference is None
        bench.nc.safe_point()
        await rig.turn(safe=False)
        stood_um = await positioned(rig, bench, 2)
        assert answer(bench) == 2.0
        await rig.follow(0.0, 0.0, 12)
        assert rig.state == "ACTIVE" and rig.applied["z"] == pytest.approx(stood_um, abs=1.0)


@pytest.mark.parametrize("restart", [False, True])
async def test_a_retreat_does_not_end_by_an_echo_that_is_behind(tmp_path: Path, restart: bool) -> None:
    bench = Bench(tmp_path)
    async with running(bench.rig()) as rig:
        await rig.active()
        for _ in range(10):
            await rig.turn(rig.estimate(0.0, -AHEAD_UM), safe=False)
        interpreter = bench.nc.guard.at(bench.nc.macros, bench.nc.clock_s)
        interpreter.start(bench.nc.guard.programs.guard)
        while bench.nc.guard.applied_um["z"] == 0.0:
            interpreter.step()
        interpreter.reset()
        rig.control.request(OperatorRequest(zero=True), "a person")
        for _ in range(20):
            await rig.turn(safe=False)
        assert rig.applied["z"] > 1.0 and not rig.control.applied_um().any(), "the echo is behind"
        assert rig.state == "RETREAT"
        assert "a run of the guard was broken off (status 14)" in rig.control.journal.alarm
        if not restart:
            await rig.follow(0.0, 0.0, 12)
            assert rig.state == "OFF" and rig.applied["z"] == 0.0 and not rig.control.journal.alarm
    if restart:
        async with running(bench.rig()) as rig:
            await rig.turn(safe=False)
            assert rig.state != "OFF"
            await rig.follow(0.0, 0.0, 12)
            assert rig.state == "OFF" and rig.applied["z"] == 0.0
