"""Macro variables of the simulated NC, and what it takes over at a safe point."""

import math

import pytest

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from drivers.guard.check import block_check
from drivers.sim.nc.nc import MacroTable, NumericalControl, RunCode
from drivers.sim.nc.safe_point import GUARD_VERSION, GuardStatus, SafePointApplication

MAP = MacroMapConfig(
    writable=["100-149", "500-549"],
    sequence_a=510,
    sequence_b=511,
    check=513,
    valid_until=100,
    enable=512,
    values={"x": 501, "y": 502, "z": 503},
    echo_applied={"x": 521, "y": 522, "z": 523},
    echo_time=524,
    echo_status=525,
    echo_guard_version=526,
)
AXES = {axis: AxisConfig(absolute_bound_um=50.0, slew_um_per_min=2.0, step_um=5.0) for axis in ("x", "y", "z")}
CLOCK_S = 1000.0


class Guarded:
    """A guard with a whole, valid block that asks for +3 um in Z."""

    def __init__(self) -> None:
        self.macros = MacroTable()
        self.guard = SafePointApplication(MAP, AXES)
        self.guard.initialise(self.macros, CLOCK_S - 1.0)
        self.write(z=3.0)

    def write(
        self, *, sequence: float = 1.0, enable: float = 7.0, valid_until: float | None = None, **um: float
    ) -> None:
        self.macros.set(MAP.sequence_a, sequence)
        for axis, number in MAP.values.items():
            self.macros.set(number, um.get(axis, 0.0) / MAP.unit_um)
        self.macros.set(MAP.valid_until, CLOCK_S + 30.0 if valid_until is None else valid_until)
        self.macros.set(MAP.enable, enable)
        self.macros.set(MAP.sequence_b, sequence)
        self.check()

    def check(self) -> None:
        held = {number: self.macros.get(number) for number in MAP.block}
        self.macros.set(MAP.check, block_check(MAP, AXES, held))

    def run(self, clock_s: float = CLOCK_S) -> GuardStatus:
        status = self.guard.run(self.macros, clock_s)
        assert self.macros.get(MAP.echo_status) == float(status)
        assert self.macros.get(MAP.echo_time) == clock_s
        assert self.macros.get(MAP.echo_guard_version) == GUARD_VERSION
        for axis, number in MAP.echo_applied.items():
            assert self.macros.get(number) == pytest.approx(self.guard.applied_um[axis] / MAP.unit_um)
        return status


@pytest.fixture
def guarded() -> Guarded:
    return Guarded()


def test_whole_block_is_applied_and_echoed(guarded: Guarded) -> None:
    assert guarded.run() is GuardStatus.APPLIED
    assert guarded.guard.applied_um == pytest.approx({"x": 0.0, "y": 0.0, "z": 3.0})
    assert guarded.macros.get(523) == pytest.approx(0.003)


def test_torn_block_moves_nothing(guarded: Guarded) -> None:
    guarded.macros.set(MAP.sequence_a, 2.0)
    assert guarded.run() is GuardStatus.TORN
    guarded.macros.set(MAP.sequence_b, None)
    assert guarded.run() is GuardStatus.TORN
    assert guarded.guard.applied_um["z"] == 0.0


@pytest.mark.parametrize("ahead_s", [None, -1.0, 0.0, 120.0 + 1.0])
def test_expired_block_keeps_what_is_applied(guarded: Guarded, ahead_s: float | None) -> None:
    guarded.run()
    guarded.write(z=-3.0, sequence=2.0)
    guarded.macros.set(MAP.valid_until, None if ahead_s is None else CLOCK_S + ahead_s)
    assert guarded.run() is GuardStatus.EXPIRED
    assert guarded.guard.applied_um["z"] == pytest.approx(3.0)


def test_oversize_value_refuses_the_whole_block(guarded: Guarded) -> None:
    guarded.write(x=2.0, z=50.1)
    assert guarded.run() is GuardStatus.OVERSIZE
    assert guarded.guard.applied_um == {"x": 0.0, "y": 0.0, "z": 0.0}


def test_vacant_value_refuses_the_block_unless_its_axis_is_disabled(guarded: Guarded) -> None:
    guarded.macros.set(MAP.values["y"], None)
    assert guarded.run() is GuardStatus.VACANT
    assert guarded.guard.applied_um["z"] == 0.0
    guarded.macros.set(MAP.enable, 0b101)
    guarded.check()
    assert guarded.run() is GuardStatus.APPLIED
    guarded.macros.set(MAP.enable, None)
    assert guarded.run() is GuardStatus.VACANT


def test_change_is_limited_per_application(guarded: Guarded) -> None:
    guarded.write(z=-12.0)
    reached = []
    for _ in range(4):
        assert guarded.run() is GuardStatus.APPLIED
        reached.append(guarded.guard.applied_um["z"])
    assert reached == pytest.approx([-5.0, -10.0, -12.0, -12.0])


def test_macro_table_rules() -> None:
    macros = MacroTable()
    assert macros.get(0) is None
    assert macros.get(100) is None and macros.get(999) is None
    for number in (1, 33, 99, 200, 499, 1000, 5221, -1):
        with pytest.raises(KeyError, match=f"#{number} "):
            macros.get(number)
        with pytest.raises(KeyError, match=f"#{number} "):
            macros.set(number, 1.0)
    with pytest.raises(KeyError, match="#0 "):
        macros.set(0, 1.0)
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="#500"):
            macros.set(500, bad)
    macros.set(500, 1.5)
    macros.set(500, None)
    assert macros.get(500) is None


def test_power_cycle_clears_the_volatile_variables_only() -> None:
    nc = NumericalControl(program=1000, clock_s=5000.0, clock_ppm=20.0, power_on_count=7, tool_number=1)
    for number in (100, 199, 500, 999):
        nc.macros.set(number, 4.0)
    nc.run, nc.sequence_number = RunCode.START, 200
    assert nc.clock_at(100000.0) == pytest.approx(105002.0)
    nc.power_cycle(100000.0)
    assert [nc.macros.get(number) for number in (100, 199, 500, 999)] == [None, None, 4.0, 4.0]
    assert nc.power_on_count == 8
    assert nc.clock_at(100000.0) == 0.0
    assert (nc.run, nc.sequence_number) == (RunCode.RESET, 0)
