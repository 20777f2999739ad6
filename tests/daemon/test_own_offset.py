"""The external offset is changed by another than the guard while an offset is compensated."""

from pathlib import Path

import pytest
from control_rig import Bench, Rig, running
from pydantic import ValidationError

from config.schema.cnc import CncConfig
from config.schema.guard import GuardConfig
from daemon.state_store.documents import OwnOffsets
from daemon.state_store.store import KEYS


def watching(directory: Path) -> Bench:
    bench = Bench(directory)
    guard = GuardConfig(watch_offset=True, increment_mm=0.0001)
    cnc = bench.configuration.cnc.model_copy(update={"guard": guard})
    bench.configuration = bench.configuration.model_copy(update={"cnc": cnc})
    return bench


async def followed(rig: Rig, bench: Bench) -> list[float]:
    """Follow 20 um; return the register as a back-up held it that was made at 10 um."""
    await rig.active()
    await rig.follow(-10.0, -10.0, 30)
    backup = list(bench.nc.guard.control.external_mm)
    await rig.follow(-20.0, -20.0, 60)
    assert rig.state == "ACTIVE" and rig.applied == {"x": 0.0, "y": 20.0, "z": 20.0}
    return backup


async def holds(rig: Rig, bench: Bench) -> None:
    """The output says that it does not know, and stays where it is although the machine goes on warming."""
    stands = rig.applied
    await rig.follow(-25.0, -25.0, 10)
    assert rig.state == "HOLD" and rig.applied == stands
    assert "the external offset was changed beside the guard, axis y by -10.0 um, axis z" in str(
        rig.control.reference_ended
    )


@pytest.mark.parametrize("guard_first", [False, True])
async def test_a_restored_external_offset_holds_the_output(tmp_path: Path, guard_first: bool) -> None:
    bench = watching(tmp_path)
    async with running(bench.rig()) as rig:
        bench.nc.guard.control.external_mm[:] = await followed(rig, bench)
        if guard_first:
            bench.nc.safe_point()
        await holds(rig, bench)


async def test_it_is_noticed_when_the_link_or_the_daemon_is_back(tmp_path: Path) -> None:
    bench = watching(tmp_path)
    async with running(bench.rig()) as rig:
        backup = await followed(rig, bench)
        await rig.history.flushed()
        rig.alive()
    bench.nc.guard.control.external_mm[:] = backup
    async with running(bench.rig()) as rig:
        await rig.turn()
        assert rig.control.reference is None
        await holds(rig, bench)


async def test_a_store_that_has_lost_what_it_was_ends_the_reference(tmp_path: Path) -> None:
    """Whether somebody has changed it meanwhile nobody knows."""
    bench = watching(tmp_path)
    compensation = bench.configuration.compensation
    dwell = compensation.reference.model_copy(update={"positioning_dwell_s": 60.0})
    compensation = compensation.model_copy(update={"reference": dwell})
    bench.configuration = bench.configuration.model_copy(update={"compensation": compensation})
    async with running(bench.rig()) as rig:
        backup = await followed(rig, bench)
        await rig.history.flushed()
        kept = rig.history.get_state(KEYS[OwnOffsets])
        rig.history.put_state(KEYS[OwnOffsets], kept | {"mm": {"y": 0.125, "z": 0.125}})
        rig.alive()
    bench.nc.guard.control.external_mm[:] = backup
    async with running(bench.rig()) as rig:
        await rig.turn()
        await rig.turn()
        stands = rig.applied
        await rig.follow(-25.0, -25.0, 10)
        assert rig.state == "HOLD" and rig.applied == stands
        assert "what the external offset was cannot be read" in rig.control.reference_ended
        rig.set_reference("again")
        await rig.follow(-1.0, -1.0, 20)
        assert rig.state == "ACTIVE", "it is known from then on"


async def test_the_guard_s_own_changes_are_none_wherever_it_is_looked_at_and_broken_off(tmp_path: Path) -> None:
    bench = watching(tmp_path)
    async with running(bench.rig()) as rig:
        await rig.active()
        for blocks in range(3, 300):
            wished_um = -5.0 - blocks % 5
            await rig.turn(rig.estimate(wished_um, wished_um), safe=False)
            interpreter = bench.nc.guard.at(bench.nc.macros, bench.nc.clock_s)
            interpreter.start(bench.nc.guard.programs.guard)
            for _ in range(blocks):
                if interpreter.running:
                    interpreter.step()
            over = not interpreter.running
            await rig.turn(rig.estimate(wished_um, wished_um), safe=False)
            assert rig.state == "ACTIVE" and rig.control.reference is not None, blocks
            interpreter.reset()
            if over:
                break
            await rig.turn(rig.estimate(wished_um, wished_um))
        assert over and max(rig.applied.values()) > 0.0


def test_a_control_without_the_register_is_refused(tmp_path: Path) -> None:
    cnc = Bench(tmp_path).configuration.cnc.model_dump(exclude_none=True)
    guard = {"watch_offset": True, "dialect": "sinumerik"}
    with pytest.raises(ValidationError, match="no system variable"):
        CncConfig.model_validate(cnc | {"opcua": cnc["opcua"] | {"preset": "sinumerik"}, "guard": guard})


async def test_in_inches_nothing_is_judged(tmp_path: Path) -> None:
    bench = watching(tmp_path)
    async with running(bench.rig()) as rig:
        await followed(rig, bench)
        bench.nc.guard.control.modal[6] = 20
        await rig.follow(-20.0, -20.0, 3)
        bench.nc.guard.control.modal[6] = 21
        await rig.follow(-20.0, -20.0, 3)
        assert rig.state == "ACTIVE"
