"""When the NC is to take no pair although it may be written: another tool, another program, no dynamics, a person."""

from pathlib import Path
from typing import Any

from control_rig import running
from nc_requests import TOOL_CHANGE, ask
from speed_machine import CASE
from speed_rig import CUT, SAFE, SpeedRig, turned

from config.schema.cnc_drivers import FocasConfig
from config.schema.spindle_speed import SpeedOperationConfig
from daemon.monitor.commands import CommandDesk
from drivers.guard.speed_text import SpeedStatus
from models.records import CncRun

bench = turned

PROGRAMMED = (9000.0, 1800.0)
APPLIED, DISABLED = SpeedStatus.APPLIED, SpeedStatus.DISABLED


def operation(program: int, case: Path) -> SpeedOperationConfig:
    spindles: Any = {"x": Path("simulated_machine"), "y": Path("simulated_machine")}
    return SpeedOperationConfig(tool_number=1, program=program, spindles=spindles, case=case, depth_mm=0.4)


async def reset_into(bench: SpeedRig, program: int) -> None:
    """Reset, select a program, start it."""
    bench.nc.run = CncRun.RESET
    await bench.pass_by(2.0, 0)
    bench.nc.program = program
    await bench.pass_by(3.0, 0)
    bench.nc.run = CncRun.START
    await bench.pass_by(3.0, CUT)


# --- another tool ----------------------------------------------------------------------------


async def test_a_tool_that_is_got_ready_lends_its_pair_to_none_in_the_spindle(bench: SpeedRig) -> None:
    assert (await bench.operation())[2] is APPLIED
    await bench.pass_by(3.0, CUT)
    bench.nc.tool_number = 2
    await bench.pass_by(5.0, CUT)
    assert "T2 is in the spindle" in bench.picture()["reason"]
    bench.nc.tool_number = 1  # what #4120 says when T1 is prepared while T2 cuts
    assert bench.call() == (*PROGRAMMED, DISABLED)


async def test_where_the_latest_t_word_alone_is_told_no_speed_is_given_until_the_program_has_named_its_tool(
    tmp_path: Path,
) -> None:
    """Call and polls both said T1 while T1 was prepared and T2 cut, which then took the speed of T1."""
    bench = SpeedRig(tmp_path)
    cnc = bench.configuration.cnc.model_copy(update={"focas": FocasConfig(host="192.168.10.20")})
    bench.configuration = bench.configuration.model_copy(update={"cnc": cnc})
    async with running(bench.new_rig()) as rig:
        await rig.turn()
        assert await bench.operation() == (*PROGRAMMED, DISABLED)
        assert "T1 is the latest T word, which may only prepare a tool" in bench.picture()["alarm"]
        ask(bench, 1, TOOL_CHANGE, 0, 1.0)
        await bench.pass_by(3.0, SAFE)
        assert (await bench.operation())[2] is APPLIED
        for counter, prepared in (
            (None, 2),
            (2, 2),
            (None, 1),
        ):  # T2 is prepared, comes and is named; so is T1 prepared
            bench.nc.tool_number = prepared
            if counter is not None:
                ask(bench, counter, TOOL_CHANGE, 0, 2.0)
            await bench.pass_by(3.0, CUT)
        assert bench.call() == (*PROGRAMMED, DISABLED)
        assert await bench.operation() == (*PROGRAMMED, DISABLED)


# --- another program -------------------------------------------------------------------------


async def test_the_same_numbers_in_another_program_do_not_take_the_pair(tmp_path: Path) -> None:
    tough = tmp_path / "tough.yaml"
    tough.write_text(CASE.replace("8.0e8", "2.0e9"), encoding="utf-8")
    bench = SpeedRig(tmp_path, operations=[operation(1000, tmp_path / "case.yaml"), operation(2000, tough)])
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[2] is APPLIED
        await bench.pass_by(3.0, CUT)
        await reset_into(bench, 2000)
        assert "is over" in bench.picture()["reason"]
        assert bench.call() == (*PROGRAMMED, DISABLED)


async def test_a_start_of_the_daemon_in_reset_knows_of_no_operation(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[2] is APPLIED
        bench.nc.run, bench.nc.program = CncRun.RESET, 2000
    async with running(bench.new_rig()) as rig:
        await rig.turn(safe=False)
        await bench.pass_by(5.0, 0)
        bench.nc.run = CncRun.START
        assert bench.call() == (*PROGRAMMED, DISABLED)
        assert (await bench.operation())[2] is APPLIED


# --- no dynamics of now ----------------------------------------------------------------------


async def test_a_speed_of_before_a_restart_is_not_commanded_without_a_temperature(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    async with running(bench.rig):
        await bench.rig.turn()
        speed_rpm, *_ = await bench.operation()
        await bench.pass_by(3.0, CUT)
    bench.clock.monotonic_s += 3000.0
    async with running(bench.new_rig()) as rig:
        await rig.turn(safe=False)
        bench.nc.sequence_number = SAFE
        bench.call()
        await bench.pass_by(20.0, SAFE, temperatures=False)
        assert bench.call()[:2] == PROGRAMMED
        await bench.pass_by(10.0, SAFE)
        assert bench.call()[::2] == (speed_rpm, APPLIED)


async def test_without_dynamics_for_an_hour_the_programmed_speed_is_taken(bench: SpeedRig) -> None:
    first = await bench.operation()
    bench.degc = float("nan")
    await bench.pass_by(200.0, CUT)
    assert bench.call() == first
    bench.clock.monotonic_s += 3600.0
    await bench.pass_by(10.0, CUT)
    assert bench.call()[:2] == PROGRAMMED
    assert "for an hour, so the programmed speed" in bench.picture()["alarm"]
    assert bench.picture()["commanded_rpm"] is None


# --- numbers -----------------------------------------------------------------------------------


async def test_the_programmed_speed_counts_as_taken_also_where_the_nc_refuses_it_as_a_pair(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path, highest_rpm=10300.0)
    async with running(bench.rig):
        await bench.rig.turn()
        tuned = await bench.operation(S=10400.0)
        assert tuned[2] is APPLIED
        await bench.pass_by(3.0, CUT)
        bench.degc = 150.0  # nothing is stable to the depth any more
        await bench.pass_by(40.0, SAFE)
        assert bench.picture()["state"] == "NO_STABLE_SPEED"
        assert bench.call(S=10400.0)[::2] == (10400.0, SpeedStatus.OUT_OF_BOUNDS)
        await bench.pass_by(5.0, CUT)
        bench.degc = 28.0
        await bench.pass_by(150.0, SAFE)
        assert bench.call(S=10400.0)[2] is APPLIED


# --- a person ----------------------------------------------------------------------------------


def desk(bench: SpeedRig) -> CommandDesk:
    return bench.rig.desk()


async def test_a_person_switches_it_off_and_on(tmp_path: Path) -> None:
    bench = SpeedRig(tmp_path)
    off, on = ({"command": each, "spindle_speed": True} for each in ("disable", "enable"))
    async with running(bench.rig):
        await bench.rig.turn()
        first = await bench.operation()
        await bench.pass_by(3.0, CUT)
        assert (await desk(bench).handle(off, "a person"))["decided"] is False  # the link has not been served yet
        await bench.pass_by(2.0, CUT)
        told = await desk(bench).handle(off, "a person")
        assert told["decided"]
        assert told["state"] == "OFF"
        assert "switched off by a person" in told["reason"]
        assert bench.call() == (*PROGRAMMED, DISABLED)
        assert bench.picture()["switched_on"] is False
    async with running(bench.new_rig()) as rig:
        await rig.turn(safe=False)
        assert (await bench.operation())[:2] == PROGRAMMED
        assert (await desk(bench).handle(on, "another"))["decided"]
        bench.nc.sequence_number = CUT
        await bench.pass_by(5.0, CUT)
        assert bench.call()[:2] == PROGRAMMED
        await bench.pass_by(8.0, SAFE)
        assert bench.call() == first
