"""A speed that was decided long ago: the NC does not take it where the dynamics of now ask for another one."""

import pytest
from speed_rig import CUT, SAFE, SpeedRig, turned

from drivers.guard.speed_text import SpeedStatus
from models.records import CncRun

bench = turned

PROGRAMMED = (9000.0, 1800.0)
HYSTERESIS_RPM = 50.0
WARM, NOTHING_STABLE = 40.0, 150.0
"""Spindles for which another speed is chosen [degC], and none."""


async def announced(bench: SpeedRig) -> float:
    """Call once; return the speed that is decided then [1/min], which the NC has not taken."""
    bench.nc.sequence_number = SAFE
    bench.call()
    await bench.pass_by(8.0, SAFE)
    commanded_rpm: float = bench.picture()["commanded_rpm"]
    assert commanded_rpm != PROGRAMMED[0]
    return commanded_rpm


@pytest.mark.parametrize("cuts", [True, False])
async def test_a_change_that_was_not_taken_is_decided_anew_before_it_can_be(bench: SpeedRig, cuts: bool) -> None:
    """One call before each pass: the first pass is cut as programmed, while the spindle warms."""
    before_rpm = await announced(bench)
    bench.degc = WARM
    await bench.pass_by(90.0, CUT if cuts else SAFE)
    await bench.pass_by(30.0, SAFE)
    speed_rpm, _, status = bench.call()
    assert status is SpeedStatus.APPLIED
    target_rpm = bench.picture()["target_rpm"]
    assert abs(speed_rpm - target_rpm) <= HYSTERESIS_RPM < abs(before_rpm - target_rpm)
    await bench.pass_by(30.0, SAFE)
    assert bench.call()[0] == speed_rpm


async def test_a_change_that_was_not_taken_is_taken_back_where_no_speed_is_stable(bench: SpeedRig) -> None:
    await announced(bench)
    bench.degc = NOTHING_STABLE
    await bench.pass_by(90.0, CUT)
    await bench.pass_by(30.0, SAFE)
    assert bench.picture()["state"] == "NO_STABLE_SPEED"
    assert bench.call()[:2] == PROGRAMMED


async def test_an_operation_that_comes_again_does_not_begin_at_a_change_that_was_not_taken(bench: SpeedRig) -> None:
    await announced(bench)
    await bench.pass_by(20.0, CUT)
    await bench.operation(D=1.5)
    bench.degc = NOTHING_STABLE
    await bench.pass_by(90.0, CUT)
    assert (await bench.operation())[:2] == PROGRAMMED


@pytest.mark.parametrize("run", [CncRun.RESET, CncRun.STOP])
async def test_what_a_standing_machine_has_outgrown_is_not_taken_when_it_goes_on(bench: SpeedRig, run: CncRun) -> None:
    """The evening's last part, and the morning's first: the same operation."""
    first = await bench.operation()
    await bench.pass_by(5.0, CUT)
    bench.nc.run = run
    bench.degc = NOTHING_STABLE
    await bench.pass_by(150.0, 0)
    assert "waiting for a safe block" in bench.picture()["reason"]
    assert bench.picture()["commanded_rpm"] is None
    bench.nc.run = CncRun.START
    assert bench.call() == (*PROGRAMMED, SpeedStatus.DISABLED)
    await bench.pass_by(20.0, SAFE)
    assert bench.call()[:2] == PROGRAMMED
    bench.degc = 28.0
    await bench.pass_by(150.0, CUT)
    await bench.pass_by(30.0, SAFE)
    assert bench.call() == first
