"""The simulated machine calls the speed program before a cut, and turns at what it has taken."""

from pathlib import Path

import pytest
from speed_machine import MACROS, in_dialect, speed_machine

from daemon.spindle_speed.macro_block import OperationKey, SpeedBlock, SpeedPair
from drivers.guard.speed_text import SpeedStatus, speed_program
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.program import SAFE, Block, PartProgram, SpeedCall
from drivers.sim.nc.safe_point import SafePointApplication, SpeedProgram
from drivers.sim.nc.sinumerik import SinumerikControl

ROUGH = SpeedCall(speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=4.5, radial_mm=5.0)
FINE = SpeedCall(speed_rpm=7000.0, feed_mm_min=1400.0, depth_mm=1.0, radial_mm=5.0)
MADE_FOR = OperationKey(tool_number=1.0, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=4.5, radial_mm=5.0, kind=1.0)
PAIR = SpeedPair(made_for=MADE_FOR, speed_rpm=9400.0, feed_mm_min=1880.0, enable=True)
PROGRAM = PartProgram(
    number=77,
    blocks=(
        Block(sequence_number=200, kind="cut", duration_s=30.0, spindle_speed_rpm=9000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=5.0, spindle_speed_rpm=9000.0, speed_call=ROUGH),
        Block(sequence_number=210, kind="cut", duration_s=30.0, spindle_speed_rpm=9000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=5.0, spindle_speed_rpm=9000.0, speed_call=FINE),
        Block(sequence_number=220, kind="cut", duration_s=30.0, spindle_speed_rpm=7000.0),
    ),
)


@pytest.fixture(params=["fanuc", "sinumerik"])
def simulated(request: pytest.FixtureRequest, tmp_path: Path) -> CfrpMachine:
    configuration = in_dialect(speed_machine(tmp_path), request.param)
    speed = SpeedProgram(number=9020, text=speed_program(configuration), macros=MACROS)
    machine = CfrpMachine(
        Day.draw(5, start="cold"),
        PROGRAM,
        configuration.temperatures.sensors,
        SafePointApplication(
            configuration.cnc.macros, configuration.compensation.outputs, configuration.cnc.guard, speed
        ),
    )
    for number in set(MACROS.numbers) - set(MACROS.ours):
        machine.nc.macros.set(number, 0.0)
    return machine


def status(simulated: CfrpMachine) -> SpeedStatus:
    return SpeedStatus(round(simulated.nc.macros.get(MACROS.echo_status) or 0.0))


def test_a_pair_of_the_block_is_taken_until_the_program_has_another_speed(simulated: CfrpMachine) -> None:
    simulated.advance(25.0)
    assert simulated.nc.spindle_speed_rpm == 9000.0
    control = simulated.guard.control
    clock_s = control.timer(1) if isinstance(control, SinumerikControl) else simulated.nc.clock_s
    for group in SpeedBlock(MACROS).encode(PAIR, after=5, valid_until_s=clock_s + 20.0):
        for number, value in group:
            simulated.nc.macros.set(number, value)
    simulated.advance(34.0)
    assert simulated.nc.spindle_speed_rpm == 9400.0
    assert status(simulated) is SpeedStatus.APPLIED
    simulated.advance(60.0)
    assert (simulated.nc.sequence_number, simulated.nc.spindle_speed_rpm) == (210, 9400.0)
    simulated.advance(69.0)
    assert status(simulated) is SpeedStatus.ANOTHER
    simulated.advance(90.0)
    assert (simulated.nc.sequence_number, simulated.nc.spindle_speed_rpm) == (220, 7000.0)
    simulated.advance(103.0)
    assert (simulated.nc.sequence_number, simulated.nc.spindle_speed_rpm) == (200, 9000.0)


def test_without_a_pair_it_turns_as_programmed(simulated: CfrpMachine) -> None:
    simulated.advance(60.0)
    assert simulated.nc.spindle_speed_rpm == 9000.0
    assert status(simulated) is SpeedStatus.DISABLED
