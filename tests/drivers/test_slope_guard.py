"""The guard's text for a SINUMERIK applies offset and slope, never more together than the axis may have."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sloped_machine import FARTHEST_M, GUARD, MAP, PIVOT_MM, SLOPE, TRAVEL_MM, PlacedGuard, SlopedGuard, Z

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig, CompensationConfig
from drivers.guard.programs import guard_text
from drivers.guard.text import GuardStatus

ENDS_MM = (*TRAVEL_MM, PIVOT_MM)
ROUNDING_UM = 1e-4


@pytest.fixture
def guard() -> SlopedGuard:
    return SlopedGuard(own_um=7.0, own_um_per_m=30.0)


def test_a_slope_moves_the_axis_by_where_it_stands_and_the_operator_s_own_stays(guard: SlopedGuard) -> None:
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.APPLIED
    assert guard.echo_um() == (pytest.approx(4.0), pytest.approx(15.0))
    assert guard.moved_um(PIVOT_MM) == pytest.approx(11.0)
    assert guard.moved_um(500.0) == pytest.approx(11.0 + 0.25 * 45.0)
    assert guard.moved_um(0.0) == pytest.approx(11.0 - 0.25 * 45.0)
    guard.write(0.0, 0.0)
    guard.call()
    assert guard.moved_um(500.0) == pytest.approx(7.0 + 0.25 * 30.0)


def test_a_slope_beyond_its_bound_moves_nothing(guard: SlopedGuard) -> None:
    guard.write(4.0, 121.0)
    assert guard.call() is GuardStatus.OVERSIZE
    assert guard.moved_um(500.0) == pytest.approx(7.0 + 0.25 * 30.0)


def test_the_check_covers_the_slope(guard: SlopedGuard) -> None:
    guard.write(4.0, 15.0)
    guard.macros.set(503, 0.016)
    assert guard.call() is GuardStatus.CHECK
    assert guard.echo_um() == (0.0, 0.0)


def test_a_slope_that_is_not_enabled_stays_where_it_is(guard: SlopedGuard) -> None:
    guard.write(4.0, 15.0, enable=1.0)
    assert guard.call() is GuardStatus.APPLIED
    assert guard.echo_um() == (pytest.approx(4.0), 0.0)


@pytest.mark.parametrize(("kind", "value"), [("type", 1), ("type", 2), ("pivot", 249.0), ("velocity", 0.0)])
def test_a_control_that_would_not_act_on_the_slope_or_about_another_pivot_is_noticed(
    guard: SlopedGuard, kind: str, value: float
) -> None:
    if kind == "type":
        guard.nc.control.compensation_types["Z"] = int(value)
    elif kind == "velocity":
        guard.nc.control.velocity_factors["Z"] = value
    else:
        guard.nc.control.pivots_mm[guard.nc.control.axis("Z")] = value
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.SWITCHED_OFF
    assert guard.echo_um() == (0.0, 0.0)
    assert guard.nc.control.messages[-1] == "TOOLPOINT MD32750 MD32760 SD43920"


def test_an_expired_block_keeps_or_takes_offset_and_slope_out() -> None:
    for policy, left in (("keep", (4.0, 15.0)), ("zero", (0.0, 0.0))):
        guard = SlopedGuard(on_expiry=policy)
        guard.write(4.0, 15.0)
        guard.call()
        guard.write(4.0, 15.0, valid_s=-1.0)
        assert guard.call() is GuardStatus.EXPIRED
        assert guard.echo_um() == (pytest.approx(left[0]), pytest.approx(left[1]))


def test_a_reset_after_any_block_is_settled_by_the_next_call() -> None:
    for after in range(400):
        guard = SlopedGuard(own_um=7.0, own_um_per_m=30.0)
        guard.write(4.0, 15.0)
        interpreter = guard.nc.at(guard.macros, 1000.0)
        interpreter.start(guard.nc.programs.guard)
        for _ in range(after):
            if interpreter.running:
                interpreter.step()
        if not interpreter.running:
            break
        interpreter.reset()
        assert guard.call() is GuardStatus.APPLIED
        applied = guard.nc.applied_um
        assert (applied["z"], applied["z_slope"]) == (pytest.approx(4.0), pytest.approx(15.0)), after
        assert guard.echo_um() == (pytest.approx(4.0), pytest.approx(15.0)), after
    else:
        pytest.fail("the guard never ends")


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(-200.0, 200.0), st.floats(-200.0, 200.0), st.sampled_from((0.0, 1.0, 2.0, 3.0)), st.booleans()
        ),
        max_size=8,
    )
)
def test_whatever_is_written_no_place_of_the_travel_exceeds_the_axis_bound_or_moves_by_more_than_its_step(
    blocks: list[tuple[float, float, float, bool]],
) -> None:
    guard = SlopedGuard()
    for z_um, z_um_per_m, enable, checked in blocks:
        guard.write(z_um, z_um_per_m, enable=enable)
        if not checked:
            guard.macros.set(506, 1.0)
        before = [guard.moved_um(at_mm) for at_mm in ENDS_MM]
        guard.call()
        after = [guard.moved_um(at_mm) for at_mm in ENDS_MM]
        assert max(map(abs, after)) <= Z["absolute_bound_um"] + ROUNDING_UM
        assert max(abs(a - b) for a, b in zip(after, before, strict=True)) <= Z["step_um"] + ROUNDING_UM


def test_the_largest_offset_and_slope_together_reach_the_axis_bound() -> None:
    guard = SlopedGuard()
    alone_um = Z["absolute_bound_um"] - FARTHEST_M * SLOPE["absolute_bound_um"]
    for _ in range(20):
        guard.write(alone_um, SLOPE["absolute_bound_um"])
        guard.call()
    assert guard.moved_um(500.0) == pytest.approx(Z["absolute_bound_um"])
    guard.write(alone_um + 1.0, SLOPE["absolute_bound_um"])
    assert guard.call() is GuardStatus.OVERSIZE


def test_the_text_says_what_it_was_made_for_and_without_a_slope_nothing_of_one() -> None:
    macros = MacroMapConfig.model_validate(MAP)
    axes = {name: AxisConfig.model_validate(axis) for name, axis in (("z", Z), ("z_slope", SLOPE))}
    text = guard_text(macros, CompensationConfig(axes=axes).outputs, GUARD)
    assert ";AXIS Z BOUND 0.02 STEP 0.005 MM\n" in text
    assert ";AXIS Z SLOPE BOUND 0.12 STEP 0.02 MM PER M, 0 AT 250. (SD43920)\n" in text
    plain = MacroMapConfig.model_validate(MAP | {"values": {"z": 502}, "echo_applied": {"z": 512}})
    without = guard_text(plain, {"z": axes["z"]}, GUARD)
    assert "SLOPE" not in without and "REF_POSITION" not in without and "SD43920" not in without


@pytest.mark.parametrize("made", [SlopedGuard, PlacedGuard])
def test_a_text_that_was_made_for_another_pivot_applies_nothing_of_the_daemon_s_block(made: type[SlopedGuard]) -> None:
    guard = made()
    guard.pivots_mm = {"z_slope": PIVOT_MM + 0.1}
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.CHECK
    assert guard.echo_um() == (0.0, 0.0)
    guard.pivots_mm = {"z_slope": PIVOT_MM}
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.APPLIED
