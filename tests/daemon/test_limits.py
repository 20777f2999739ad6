"""From configuration and commissioning record to the limits of the output."""

import re

import pytest
from control_rig import machine, record_for

from config.records.commissioning import CommissionedAxis
from config.schema.cnc import RequestMacrosConfig
from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.cnc.limits import CommissionedFactors, guard_programs, output_limits
from daemon.cnc.macro_block import MacroBlock
from drivers.guard.programs import guard_program


def test_where_less_moves_than_is_written_bound_and_step_shrink_with_it(tmp_path):
    configuration = machine(tmp_path)
    plain = output_limits(configuration)
    scaled = output_limits(configuration, {"y": -0.5, "z": 2.0})
    assert scaled.absolute_bound_um == pytest.approx(plain.absolute_bound_um * [1.0, 0.5, 1.0])
    assert scaled.step_um == pytest.approx(plain.step_um * [1.0, 0.5, 1.0])


def test_what_an_axis_may_stand_beside_its_value_goes_with_how_far_it_moves(tmp_path):
    """Rounded within half an increment of 1 um, an axis that moves five times as far was taken for untrusted."""
    cnc = machine(tmp_path).cnc
    coarse = cnc.model_copy(update={"guard": cnc.guard.model_copy(update={"increment_mm": 0.001})})
    configuration, factors = machine(tmp_path).model_copy(update={"cnc": coarse}), {"y": -5.0, "z": 2.0}
    limits, macros = output_limits(configuration, factors), coarse.macros
    assert limits.rounding_um == pytest.approx([0.51, 2.55, 1.02])
    block = MacroBlock(macros, limits.axes, factors)
    values = dict.fromkeys((*macros.values.values(), *macros.echo_applied.values()), 0.0)
    beside = values | {macros.echo_applied["y"]: (limits.step_um[1] + 2.5) / -5.0 / macros.unit_um}
    assert block.implausible_echo(beside, limits) == []
    beside[macros.echo_applied["y"]] *= 1.5
    assert len(block.implausible_echo(beside, limits)) == 1


@pytest.mark.parametrize(
    ("scale", "measured_um", "bound_um", "step_share", "slew_share"),
    [
        (1.0, 10.0, 30.0, 1.0, 1.0),
        (1.0, 11.9, 25.0, 1 / 1.19, 1 / 1.19),  # 25.2 um are no whole number of increments
        (1.0, -11.9, 25.0, 1 / 1.19, 1 / 1.19),
        (1.0, 8.1, 30.0, 1.0, 1.0),
        (2.0, 23.0, 26.0, 1 / 1.15, 1 / 1.15),
        (1.8, 18.0, 28.8, 1.0, 1.0),
        (0.5, 5.5, 15.0, 0.5, 1 / 1.1),
    ],
)
def test_what_was_measured_to_move_stays_within_the_configured_limits(
    tmp_path, scale, measured_um, bound_um, step_share, slew_share
):
    configuration = machine(tmp_path)
    sign = 1 if measured_um > 0 else -1
    proved = CommissionedAxis(sign=sign, scale=scale, written_um=10.0, measured_um=measured_um)
    record = record_for(configuration, axes={"z": proved})
    factors = CommissionedFactors(record, ("x", "y", "z"))
    assert factors == {"z": sign * scale}
    plain, found = output_limits(configuration), output_limits(configuration, factors)
    assert found.absolute_bound_um == pytest.approx([30.0, 30.0, bound_um])
    assert found.step_um == pytest.approx(plain.step_um * [1.0, 1.0, step_share])
    assert found.slew_um_per_min == pytest.approx(plain.slew_um_per_min * [1.0, 1.0, slew_share])


def test_the_programs_that_are_no_part_program(tmp_path):
    configuration = machine(tmp_path)
    assert guard_programs(configuration) == {9010, 9011, 9012, 9013, 9014}
    speed = SpindleSpeedConfig.model_construct(program=9020)
    assert guard_programs(configuration.model_copy(update={"spindle_speed": speed})) == {*range(9010, 9015), 9020}


@pytest.mark.parametrize("dialect", ["fanuc", "sinumerik"])
def test_every_program_that_the_text_of_the_guard_holds_is_known_to_be_none_of_the_part(tmp_path, dialect):
    cnc = machine(tmp_path).cnc
    request = RequestMacrosConfig(counter=520, kind=521, axis=522, value_mm=523, acknowledge=524)
    macros = cnc.macros.model_copy(update={"request": request, "safe_flag": 125})
    guard = cnc.guard.model_copy(update={"dialect": dialect})
    configuration = machine(tmp_path).model_copy(
        update={"cnc": cnc.model_copy(update={"macros": macros, "guard": guard})}
    )
    held = re.findall(r"^(?:O|%_N_TP)(\d+)", guard_program(configuration), re.MULTILINE)
    assert len(held) == (6 if dialect == "sinumerik" else 5)
    assert guard_programs(configuration) == {int(number) for number in held}
