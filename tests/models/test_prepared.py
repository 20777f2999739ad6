"""Whether lagged spindle speed is among the inputs of a model is told by what is left out."""

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.features import lag_table
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES

SPEEDS_RPM = (3000.0, 5000.0, 2000.0, 4000.0, 6000.0, 2500.0)


def machine(*, sensors_see_the_heat: bool) -> Recording:
    """Six cycles of 3 h: heat comes from the load, which the sensors see, or from the speed, which they miss."""
    rng = np.random.default_rng(2)
    rpm = np.concatenate([np.r_[np.full(90, speed), np.zeros(90)] for speed in SPEEDS_RPM])
    load = np.repeat([0.3, 1.0, 1.6, 0.5, 0.9, 1.3], 180)
    time_min = np.arange(float(len(rpm)))
    heat = (rpm / 5000.0) ** 1.5 * (load if sensors_see_the_heat else 1.0)
    body = lag_table(time_min, heat[:, None], (15.0,))[0, :, 0]
    ambient = np.sin(time_min / 100.0)
    seen = body if sensors_see_the_heat else np.zeros_like(body)
    degc = 21.0 + np.column_stack([10.0 * seen + ambient, 4.0 * seen + ambient, ambient])
    um = 30.0 * body
    return Recording(
        name="machine",
        time_s=60.0 * time_min,
        speed_rpm=rpm,
        temperature_names=("t1", "t2", "t3"),
        temperatures_degc=degc + rng.normal(0.0, 0.02, degc.shape),
        displacement_names=("c1",),
        displacements_um=um[:, None] + rng.normal(0.0, 0.05, (len(rpm), 1)),
    )


@pytest.mark.parametrize("sensors_see_the_heat", [True, False])
def test_speed_counts_only_where_it_helps(sensors_see_the_heat: bool) -> None:
    prepared = prepare([machine(sensors_see_the_heat=sensors_see_the_heat)], 60.0, RECIPES["default"])
    assert prepared.folds == "cycle"
    assert bool(prepared.inputs.layout.speed_lags_min) is not sensors_see_the_heat
    assert bool(prepared.problem.hyper_parameters["speed_lags_min"]) is not sensors_see_the_heat


def test_families_on_temperatures_alone_have_no_speed() -> None:
    prepared = prepare([machine(sensors_see_the_heat=False)], 60.0, RECIPES["ridge"])
    assert (prepared.inputs.layout.lags_min, prepared.inputs.layout.speed_lags_min) == ((), ())
