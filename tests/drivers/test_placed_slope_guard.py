"""On a FANUC the guard's text puts a slope into the offset for where the axis stands, never more than the axis may."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nc_requests import ACKNOWLEDGE, AXIS, COUNTER, KIND, VALUE
from sloped_machine import FARTHEST_M, GUARD, MAP, PIVOT_MM, SLOPE, TRAVEL_MM, PlacedGuard, Z, configured, content

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig, CompensationConfig
from drivers.guard.programs import guard_text
from drivers.guard.sheet import sheet_markdown
from drivers.guard.text import GuardStatus, GuardTextError

INCREMENT_UM = 0.1
ROUNDING_UM = 1e-4


@pytest.fixture
def guard() -> PlacedGuard:
    return PlacedGuard(own_um=7.0)


def settled(guard: PlacedGuard) -> None:
    """Call the guard until it has nothing left to do."""
    for _ in range(40):
        before = (guard.offset_um(), *guard.echo_um())
        if guard.call() is GuardStatus.APPLIED and before == (guard.offset_um(), *guard.echo_um()):
            return
    pytest.fail("the guard never gets there")


def test_a_slope_counts_for_where_the_axis_stands_and_the_operator_s_own_stays(guard: PlacedGuard) -> None:
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.APPLIED
    assert guard.echo_um() == (pytest.approx(4.0), pytest.approx(15.0))
    assert guard.offset_um() == pytest.approx(7.0 + 4.0), "at the pivot a slope adds nothing"
    for at_mm, slope_um in ((500.0, 3.75), (0.0, -3.75), (330.0, 1.2), (PIVOT_MM, 0.0)):
        guard.stand(at_mm)
        settled(guard)
        assert guard.offset_um() == pytest.approx(11.0 + slope_um, abs=INCREMENT_UM / 2 + ROUNDING_UM)
        assert guard.echo_um() == (pytest.approx(4.0), pytest.approx(15.0))
    guard.stand(500.0)
    guard.write(0.0, 0.0)
    settled(guard)
    assert guard.offset_um() == pytest.approx(7.0) and guard.echo_um() == (0.0, 0.0)


class RequestingGuard(PlacedGuard):
    """The same with the program by which the NC asks."""

    macros_used = MAP | {
        "writable": ["120", "500-507", "524"],
        "request": {"counter": COUNTER, "kind": KIND, "axis": AXIS, "value_mm": VALUE, "acknowledge": ACKNOWLEDGE},
    }

    def ask(self, **arguments: float) -> int:
        """Ask and give up at once; return the number of the alarm that stopped it, 0: it has asked."""
        assert self.nc.programs.request is not None
        control, asked = self.nc.control, self.macros.get(COUNTER) or 0.0
        control.alarm = None
        interpreter = self.nc.at(self.macros, 1000.0)
        interpreter.start(self.nc.programs.request, **arguments)
        while interpreter.running and self.macros.get(COUNTER) == asked and control.alarm is None:
            interpreter.step()
        interpreter.reset()
        assert (control.alarm is None) == (self.macros.get(COUNTER) != asked)
        return 0 if control.alarm is None else control.alarm[0]


@pytest.mark.parametrize("arguments", [{"K": 1.0}, {"K": 1.0, "A": 1.0}, {"K": 2.0, "A": 1.0, "V": 0.004}])
def test_what_is_measured_far_from_where_the_guard_was_called_is_not_asked_for(arguments: dict[str, float]) -> None:
    """With 15 um/m work that is positioned 0.5 m from there would be 7.5 um beside as soon as the guard is called."""
    guard = RequestingGuard()
    guard.write(4.0, 15.0)
    guard.stand(500.0)
    settled(guard)
    assert guard.ask(**arguments) == 0
    guard.stand(440.0)
    assert guard.ask(**arguments) == 0, "not more than 1 um"
    guard.stand(0.0)
    then_um = guard.offset_um()
    assert guard.ask(**arguments) == 124 and guard.ask(K=3.0, V=2.0) == 0
    settled(guard)
    assert abs(guard.offset_um() - then_um) == pytest.approx(7.5, abs=0.2)
    assert guard.ask(**arguments) == 0
    guard.write(4.0, 0.0)
    settled(guard)
    guard.stand(500.0)
    assert guard.ask(**arguments) == 0, "without a slope an offset is the same everywhere"


@pytest.mark.parametrize("at_mm", [None, -0.01, 500.01])
def test_a_place_that_is_vacant_or_outside_the_travel_refuses_the_whole_block(
    guard: PlacedGuard, at_mm: float | None
) -> None:
    guard.stand(at_mm)
    guard.write(4.0, 15.0)
    assert guard.call() is GuardStatus.PLACE
    assert guard.offset_um() == pytest.approx(7.0) and guard.echo_um() == (0.0, 0.0)
    assert guard.nc.control.messages[-1] == "TOOLPOINT OUTSIDE TRAVEL"
    guard.write(4.0, 15.0, enable=1.0)
    assert guard.call() is GuardStatus.APPLIED, "an offset alone is the same everywhere"


@pytest.mark.parametrize(("policy", "left_um"), [("keep", 4.0 - 3.75), ("zero", 0.0)])
def test_an_expired_block_keeps_or_takes_both_out_wherever_the_axis_stands(policy: str, left_um: float) -> None:
    guard = PlacedGuard(on_expiry=policy)
    guard.stand(0.0)
    guard.write(4.0, 15.0)
    settled(guard)
    guard.write(4.0, 15.0, valid_s=-1.0)
    guard.stand(None)
    assert guard.call() is GuardStatus.EXPIRED
    assert guard.offset_um() == pytest.approx(left_um, abs=INCREMENT_UM / 2 + ROUNDING_UM)
    assert (guard.echo_um() == (0.0, 0.0)) is (policy == "zero")


def test_a_slope_that_is_foreign_too_large_or_not_enabled_moves_nothing(guard: PlacedGuard) -> None:
    guard.stand(500.0)
    guard.write(4.0, 15.0)
    guard.macros.set(503, 0.016)
    assert guard.call() is GuardStatus.CHECK
    guard.write(4.0, 121.0)
    assert guard.call() is GuardStatus.OVERSIZE
    assert guard.offset_um() == pytest.approx(7.0)
    guard.write(4.0, 15.0, enable=1.0)
    assert guard.call() is GuardStatus.APPLIED
    assert guard.offset_um() == pytest.approx(11.0) and guard.echo_um() == (pytest.approx(4.0), 0.0)


@pytest.mark.parametrize("memory", [597, 596])
def test_a_memory_that_is_not_what_it_can_be_is_noticed(guard: PlacedGuard, memory: int) -> None:
    """#594, #595 what is applied, #596 the place to come, #597 the place."""
    guard.write(4.0, 15.0)
    guard.call()
    before = guard.offset_um()
    guard.macros.set(memory, 251.0)
    guard.write(5.0, 15.0)
    assert guard.call() is (GuardStatus.MEMORY if memory == 597 else GuardStatus.APPLIED)
    assert guard.offset_um() == pytest.approx(before if memory == 597 else before + 1.0)


def test_a_reset_after_any_block_is_settled_by_the_next_call() -> None:
    for after in range(400):
        guard = PlacedGuard(own_um=7.0)
        guard.stand(400.0)
        guard.write(2.0, 10.0)
        guard.call()
        guard.stand(100.0)
        guard.write(4.0, 15.0)
        interpreter = guard.nc.at(guard.macros, 1000.0)
        interpreter.start(guard.nc.programs.guard)
        for _ in range(after):
            if interpreter.running:
                interpreter.step()
        if not interpreter.running:
            break
        interpreter.reset()
        settled(guard)
        assert guard.offset_um() == pytest.approx(7.0 + 4.0 - 2.2, abs=INCREMENT_UM), after
        assert guard.echo_um() == (pytest.approx(4.0), pytest.approx(15.0)), after
        guard.write()
        settled(guard)
        assert guard.offset_um() == pytest.approx(7.0), after
    else:
        pytest.fail("the guard never ends")


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from((0.001, 0.0001)),
    st.lists(
        st.tuples(
            st.floats(-200.0, 200.0),
            st.floats(-200.0, 200.0),
            st.sampled_from((0.0, 1.0, 2.0, 3.0)),
            st.booleans(),
            st.floats(-20.0, 520.0),
        ),
        max_size=8,
    ),
)
def test_whatever_is_written_and_wherever_it_is_called_the_offset_keeps_to_bound_and_step_and_to_its_echo(
    increment_mm: float, blocks: list[tuple[float, float, float, bool, float]]
) -> None:
    guard = PlacedGuard(increment_mm=increment_mm)
    for z_um, z_um_per_m, enable, checked, at_mm in blocks:
        guard.write(z_um, z_um_per_m, enable=enable)
        guard.stand(at_mm)
        if not checked:
            guard.macros.set(506, 1.0)
        before = guard.offset_um()
        status = guard.call()
        assert abs(guard.offset_um()) <= Z["absolute_bound_um"] + ROUNDING_UM
        assert abs(guard.offset_um() - before) <= Z["step_um"] + ROUNDING_UM
        if status is GuardStatus.APPLIED and enable >= 2.0:
            z, slope = guard.echo_um()
            there_um = z + slope * (at_mm - PIVOT_MM) / 1000.0
            assert guard.offset_um() == pytest.approx(there_um, abs=increment_mm * 500.0 + 0.01)
    for _ in range(40):
        guard.write()
        guard.stand(TRAVEL_MM[0])
        guard.call()
    assert guard.offset_um() == pytest.approx(0.0, abs=ROUNDING_UM) and guard.echo_um() == (0.0, 0.0)


def test_the_largest_offset_and_slope_together_reach_the_axis_bound(guard: PlacedGuard) -> None:
    guard = PlacedGuard()
    alone_um = Z["absolute_bound_um"] - FARTHEST_M * SLOPE["absolute_bound_um"]
    guard.stand(500.0)
    guard.write(alone_um, SLOPE["absolute_bound_um"])
    settled(guard)
    assert guard.offset_um() == pytest.approx(Z["absolute_bound_um"])


def test_the_text_says_what_it_was_made_for_and_without_a_slope_nothing_of_one() -> None:
    macros = MacroMapConfig.model_validate(MAP)
    axes = {name: AxisConfig.model_validate(axis) for name, axis in (("z", Z), ("z_slope", SLOPE))}
    fanuc = GUARD.model_copy(update={"dialect": "fanuc", "increment_mm": 0.0001})
    text = guard_text(macros, CompensationConfig(axes=axes).outputs, fanuc)
    assert "(AXIS Z BOUND 0.02 STEP 0.005 MM)\n" in text
    assert "(AXIS Z SLOPE BOUND 0.12 STEP 0.02 MM PER M)\n(  0 AT 250., TRAVEL 0. TO 500. MM)\n" in text
    plain = MacroMapConfig.model_validate(MAP | {"values": {"z": 502}, "echo_applied": {"z": 512}})
    without = guard_text(plain, {"z": axes["z"]}, fanuc)
    assert not any(word in without for word in ("SLOPE", "#5023", "TRAVEL", "STATUS 13"))


def test_a_control_that_is_too_coarse_for_the_slope_is_refused_by_its_key() -> None:
    macros = MacroMapConfig.model_validate(MAP)
    axes = {"z": AxisConfig.model_validate(Z), "z_slope": AxisConfig.model_validate(SLOPE | {"step_um": 3.0})}
    with pytest.raises(GuardTextError, match=r"compensation.axes.z_slope.step_um: 3 um/m move .* by 0.75 um"):
        guard_text(macros, CompensationConfig(axes=axes).outputs, GUARD.model_copy(update={"dialect": "fanuc"}))


def test_the_sheet_asks_for_what_the_slope_needs_and_its_tests_hold_on_the_simulated_control(tmp_path: Path) -> None:
    given = content(tmp_path)
    given["cnc"]["guard"] = {"increment_mm": 0.0001}
    given["cnc"]["opcua"].update(preset="fanuc", namespace_uri="urn:a:b")
    sheet = sheet_markdown(configured(given))
    assert "| #590 to #597 | guard alone |" in sheet
    assert "| #5023 is the machine position of Z [mm] |" in sheet
    assert "#513=0.02, #5203 as before: the pivot" in sheet
    assert "| z at 500 mm, again until the status is no longer 13 | #515=0, #5203 moved by +0.005 mm |" in sheet
    guard = PlacedGuard()
    guard.write(0.0, 20.0, enable=2.0)
    guard.call()
    assert guard.call() is GuardStatus.APPLIED
    assert guard.echo_um()[1] == pytest.approx(20.0) and guard.offset_um() == 0.0
    guard.stand(500.0)
    settled(guard)
    assert guard.offset_um() == pytest.approx(5.0)
