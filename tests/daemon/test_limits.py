"""From configuration and commissioning record to the limits of the output."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from control_rig import machine

from daemon.output.limits import echo_slack_um, output_limits


def test_where_less_moves_than_is_written_bound_and_step_shrink_with_it(tmp_path):
    configuration = machine(tmp_path)
    plain = output_limits(configuration)
    scaled = output_limits(configuration, {"y": -0.5, "z": 2.0})
    assert scaled.absolute_bound_um == pytest.approx(plain.absolute_bound_um * [1.0, 0.5, 1.0])
    assert scaled.step_um == pytest.approx(plain.step_um * [1.0, 0.5, 1.0])


def test_the_slack_of_the_echo_is_half_an_increment_of_the_control(tmp_path):
    configuration = machine(tmp_path)
    coarse = configuration.cnc.guard.model_copy(update={"increment_mm": 0.001})
    fine = configuration.cnc.guard.model_copy(update={"increment_mm": 0.00001})
    for guard, expected in ((coarse, 0.51), (fine, 0.05)):
        cnc = configuration.cnc.model_copy(update={"guard": guard})
        assert echo_slack_um(configuration.model_copy(update={"cnc": cnc})) == pytest.approx(expected)
