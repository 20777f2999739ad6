"""The shipped text of the guard when it is broken off: clocks, power-off, reset in the middle, a lost memory."""

import itertools

import guard_bench
import pytest
from guard_bench import AXES, CLOCK_S, MAP, NOISE_UM, GuardBench

from drivers.sim.nc.nc import CLOCK_WRAP_S
from drivers.sim.nc.safe_point import GuardStatus

MEMORY = range(590, 597)


@pytest.fixture(params=["fanuc", "sinumerik"], autouse=True)
def dialect(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Both texts are held to the same."""
    monkeypatch.setattr(guard_bench, "DIALECT", request.param)
    return str(request.param)


@pytest.fixture
def bench(dialect: str) -> GuardBench:
    return GuardBench(own_um={"x": 12.0, "y": -250.0, "z": 1234.5})


def test_a_clock_that_wraps_expires_the_block_and_never_revives_it() -> None:
    bench = GuardBench(dialect="fanuc")  # a timer of a SINUMERIK does not wrap
    bench.clock_s = CLOCK_WRAP_S - 10.0
    bench.write(z=3.0, valid_for_s=30.0)
    assert bench.call() is GuardStatus.APPLIED
    bench.clock_s = 5.0
    assert bench.call() is GuardStatus.EXPIRED
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.APPLIED
    bench.clock_s = 200.0
    assert bench.call() is GuardStatus.EXPIRED
    bench.clock_s = 20.0  # 24.9 days later the clock reads again what it read while the block was good
    bench.macros.set(MAP.values["z"], 0.009)
    assert bench.call() is GuardStatus.EXPIRED
    assert bench.applied_um["z"] == pytest.approx(5.0)


def test_power_off_keeps_the_offset_and_waits_for_the_daemon(bench: GuardBench) -> None:
    bench.write(x=2.0, z=6.0)
    bench.call()
    bench.macros.power_off()
    bench.nc.power_cycle()
    bench.clock_s = 3.0
    assert bench.call() is GuardStatus.EXPIRED
    assert bench.applied_um == pytest.approx({"x": 2.0, "y": 0.0, "z": 6.0})
    bench.write(x=2.0, z=7.0)
    assert bench.call() is GuardStatus.APPLIED
    assert bench.applied_um["z"] == pytest.approx(7.0)


@pytest.mark.parametrize("power_off", [False, True])
def test_reset_or_power_off_at_every_block_applies_nothing_twice(power_off: bool) -> None:
    target = {"x": -4.0, "y": 5.0, "z": 9.0}
    for after in itertools.count():
        bench = GuardBench(own_um={"x": 50.0, "z": -20.0})
        bench.write(**target)
        if not bench.interrupted(after):
            break
        if power_off:
            bench.power_cycle()
        for axis, um in bench.applied_um.items():
            assert um == pytest.approx(0.0) or um == pytest.approx(target[axis])
            assert abs(um - bench.echo_um[axis]) <= AXES[axis].step_um + NOISE_UM
        bench.write(**target)
        assert bench.call() is GuardStatus.APPLIED
        assert bench.applied_um == pytest.approx(target)
        assert bench.settled()
    assert after > 100


def test_reset_again_while_a_reset_is_being_settled() -> None:
    target = {"x": 4.0, "y": -5.0, "z": 9.0}
    for first in range(0, 230, 4):
        for second in range(0, 230, 9):
            bench = GuardBench()
            bench.write(**target)
            bench.interrupted(first)
            bench.interrupted(second)
            assert bench.call() is GuardStatus.APPLIED
            assert bench.applied_um == pytest.approx(target)
            assert bench.settled()


def test_an_offset_changed_by_hand_after_a_reset_in_the_middle_needs_a_person() -> None:
    refused = 0
    for after in itertools.count():
        bench = GuardBench()
        bench.write(z=8.0)
        if not bench.interrupted(after):
            break
        applied = bench.applied_um["z"]
        bench.nc.change_own_offset("z", 33.0)
        status = bench.call()
        if status is GuardStatus.UNSETTLED:
            refused += 1
            assert bench.applied_um["z"] == applied
            assert bench.message == "TOOLPOINT OFFSET UNSETTLED"
            assert bench.call() is GuardStatus.UNSETTLED
        else:
            assert status is GuardStatus.APPLIED
            assert bench.applied_um["z"] == pytest.approx(8.0)
    assert refused > 3


def test_a_control_with_a_coarser_increment_than_told_is_noticed() -> None:
    bench = GuardBench()
    bench.nc.control.increment_mm = 0.001
    bench.write(z=2.4)
    assert bench.call() is GuardStatus.UNSETTLED
    assert bench.applied_um["z"] == pytest.approx(2.0)
    bench.write(z=9.0)
    assert bench.call() is GuardStatus.UNSETTLED
    assert bench.applied_um["z"] == pytest.approx(2.0)


def test_initialising_forgets_only_on_demand(bench: GuardBench) -> None:
    interpreter = bench.nc.at(bench.macros, CLOCK_S)
    bench.write(z=5.0)
    bench.call()
    interpreter.run(bench.nc.programs.initialise)
    assert bench.nc.control.alarm == (110, "TOOLPOINT SWITCH OFF FIRST")
    bench.write(enable=0.0, valid_for_s=None)
    interpreter.run(bench.nc.programs.initialise)
    assert bench.nc.control.alarm == (111, "TOOLPOINT OFFSET APPLIED")
    assert bench.echo_um["z"] == pytest.approx(5.0)
    for lost in (0.0, None):  # the echo was written over, or lies elsewhere in a new text: the memory tells
        bench.nc.control.alarm = None
        bench.macros.set(MAP.echo_applied["z"], lost)
        interpreter.run(bench.nc.programs.initialise)
        assert bench.nc.control.alarm == (111, "TOOLPOINT OFFSET APPLIED")
    bench.nc.control.alarm = None
    interpreter.run(bench.nc.programs.initialise, A=1.0)
    assert bench.nc.control.alarm is None
    assert bench.echo_um == {"x": 0.0, "y": 0.0, "z": 0.0}


def test_an_uninitialised_control_is_never_moved() -> None:
    bench = GuardBench()
    for number in (*MAP.block, *MEMORY):
        bench.macros.set(number, None)
    assert bench.call() is GuardStatus.TORN
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.MEMORY
    assert bench.applied_um["z"] == 0.0
    bench.write(enable=0.0)
    bench.nc.at(bench.macros, CLOCK_S).run(bench.nc.programs.initialise)
    assert bench.nc.control.alarm is None
    bench.write(z=5.0)
    assert bench.call() is GuardStatus.APPLIED


@pytest.mark.parametrize("argument", [0.0, 0.001, 2.0, -1.0])
def test_initialising_with_another_argument_changes_nothing(bench: GuardBench, argument: float) -> None:
    interpreter = bench.nc.at(bench.macros, CLOCK_S)
    bench.write(enable=0.0, valid_for_s=None)
    before = {number: bench.macros.get(number) for number in (*MAP.block, *MEMORY, MAP.echo_time)}
    interpreter.run(bench.nc.programs.initialise, A=argument)
    assert bench.nc.control.alarm is not None and bench.nc.control.alarm[1] == "TOOLPOINT A IS NOT 1"
    assert {number: bench.macros.get(number) for number in before} == before
