"""Properties of the shipped guard text over random histories of daemon, operator, program and accidents."""

import hypothesis.strategies as st
import pytest
from guard_bench import AXES, INCREMENT_UM, MAP, NOISE_UM, GuardBench
from hypothesis import HealthCheck, given, settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from drivers.sim.nc.safe_point import GuardStatus

ANYTHING = st.one_of(st.none(), st.floats(-1e6, 1e6), st.sampled_from([0.0, 1.0, -1.0, 0.004, 7.0, 1e-9]))
INSIDE = {
    axis: st.floats(-config.absolute_bound_um, config.absolute_bound_um, width=32) for axis, config in AXES.items()
}
BLOCK_MACROS = (MAP.sequence_a, *MAP.values.values(), MAP.valid_until, MAP.enable, MAP.sequence_b)
GUARD_MACROS = (*MAP.echo_applied.values(), 590, 591, 592, 593, 594, 595, 596)


class GuardHistory(RuleBasedStateMachine):
    """Whatever happens, the tool moves only as far as a believed block, one step and the bound allow."""

    policy = "keep"
    dialect = "fanuc"

    def __init__(self) -> None:
        super().__init__()
        self.bench = GuardBench(own_um={"x": 17.0, "y": -3.0, "z": 800.0}, on_expiry=self.policy, dialect=self.dialect)
        self.clean = True
        """Nobody has touched the guard's own memory."""

    @rule(um=st.fixed_dictionaries(INSIDE), enable=st.integers(0, 7), valid_for_s=st.sampled_from([30.0, 60.0, -1.0]))
    def daemon_writes(self, um: dict[str, float], enable: int, valid_for_s: float) -> None:
        self.bench.write(enable=float(enable), valid_for_s=valid_for_s, **um)

    @rule(um=st.fixed_dictionaries(INSIDE), count=st.integers(0, 7))
    def daemon_dies_while_writing(self, um: dict[str, float], count: int) -> None:
        for number, value in self.bench.block(**um)[:count]:
            self.bench.macros.set(number, value)

    @rule(number=st.sampled_from(BLOCK_MACROS), value=ANYTHING)
    def somebody_writes_into_the_block(self, number: int, value: float | None) -> None:
        self.bench.macros.set(number, value)

    @rule(number=st.sampled_from(GUARD_MACROS))
    def a_macro_of_the_guard_is_lost(self, number: int) -> None:
        self.bench.macros.set(number, None)
        self.clean = False

    @rule(axis=st.sampled_from(list(AXES)), tenths=st.integers(-5000, 5000))
    def operator_changes_his_offset(self, axis: str, tenths: int) -> None:
        self.bench.nc.change_own_offset(axis, tenths * INCREMENT_UM)

    @rule(seconds=st.floats(0.0, 3000.0))
    def time_passes(self, seconds: float) -> None:
        self.bench.clock_s += seconds

    @rule(absolute=st.booleans(), metric=st.booleans())
    def program_selects_modes(self, absolute: bool, metric: bool) -> None:
        self.bench.modal(3, 90 if absolute else 91)
        self.bench.modal(6, 21 if metric else 20)

    @rule()
    def power_is_switched_off_and_on(self) -> None:
        self.bench.macros.power_off()
        self.bench.nc.power_cycle()
        self.bench.clock_s = 0.0

    @rule(after=st.integers(0, 230))
    def reset_in_the_middle(self, after: int) -> None:
        before = self.bench.applied_um
        self.bench.interrupted(after)
        self._moved_within_limits(before)

    @rule()
    def guard_is_called(self) -> None:
        before, wanted, mode = self.bench.applied_um, self._wanted(), self.bench.modal(3)
        status = self.bench.call()
        self._moved_within_limits(before)
        assert self.bench.modal(3) == mode
        after = self.bench.applied_um
        if status is GuardStatus.APPLIED:
            assert self.clean is False or self.bench.settled()
            for axis, um in after.items():
                if self.clean and wanted[axis] is not None:
                    assert abs(um - wanted[axis]) <= abs(before[axis] - wanted[axis]) + INCREMENT_UM
        elif status is GuardStatus.EXPIRED and self.policy == "zero":
            assert all(abs(after[axis]) <= abs(before[axis]) + NOISE_UM for axis in after)
        elif status is not GuardStatus.UNSETTLED:
            assert after == before

    def _wanted(self) -> dict[str, float | None]:
        enable = self.bench.macros.get(MAP.enable)
        bits = int(enable) if enable is not None and 0 <= enable <= 7 else 0
        found = {}
        for bit, (axis, number) in enumerate(MAP.values.items()):
            value = self.bench.macros.get(number)
            found[axis] = value * 1000.0 if value is not None and bits >> bit & 1 else None
        return found

    def _moved_within_limits(self, before: dict[str, float]) -> None:
        for axis, um in self.bench.applied_um.items():
            assert abs(um - before[axis]) <= AXES[axis].step_um + NOISE_UM
            stood = um == pytest.approx(before[axis], abs=NOISE_UM)
            returned = self.policy == "zero" and min(before[axis], 0.0) <= um <= max(before[axis], 0.0)
            assert stood or returned or self._wanted()[axis] is not None

    @precondition(lambda self: self.clean)
    @invariant()
    def bound_holds_and_the_echo_is_near_the_truth(self) -> None:
        for axis, um in self.bench.applied_um.items():
            assert abs(um) <= AXES[axis].absolute_bound_um + NOISE_UM
            assert abs(um - self.bench.echo_um[axis]) <= AXES[axis].step_um + NOISE_UM


class GuardHistoryToZero(GuardHistory):
    policy = "zero"


class SinumerikHistory(GuardHistory):
    dialect = "sinumerik"


class SinumerikHistoryToZero(GuardHistoryToZero):
    dialect = "sinumerik"


OFTEN = settings(max_examples=50, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck))
TestGuardHistory = GuardHistory.TestCase
TestGuardHistory.settings = OFTEN
TestGuardHistoryToZero = GuardHistoryToZero.TestCase
TestGuardHistoryToZero.settings = OFTEN
TestSinumerikHistory = SinumerikHistory.TestCase
TestSinumerikHistory.settings = OFTEN
TestSinumerikHistoryToZero = SinumerikHistoryToZero.TestCase
TestSinumerikHistoryToZero.settings = OFTEN


@settings(max_examples=60, deadline=None)
@given(um=st.fixed_dictionaries(INSIDE), calls=st.integers(1, 20))
def test_repeated_calls_reach_the_value_one_step_at_a_time(um: dict[str, float], calls: int) -> None:
    bench = GuardBench()
    bench.write(**um)
    for count in range(1, calls + 1):
        assert bench.call() is GuardStatus.APPLIED
        for axis, config in AXES.items():
            reachable = min(abs(um[axis]), count * config.step_um)
            assert abs(abs(bench.applied_um[axis]) - reachable) <= INCREMENT_UM / 2 + NOISE_UM
            assert bench.applied_um[axis] * um[axis] >= -NOISE_UM
