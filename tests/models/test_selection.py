"""Orders of sensors and the price of each, on a machine of which only two sensors know anything."""

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.features import lag_table
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import build_inputs
from models.thermal.training.selection import Method, SensorComparison


@pytest.fixture(scope="module")
def comparison() -> SensorComparison:
    """T2 and T5 follow the two parts that move the channel; T1 copies T2 badly; the others are noise."""
    rng = np.random.default_rng(4)
    time_min = np.arange(900.0)
    drive = rng.normal(0.0, 1.0, (900, 2)).cumsum(axis=0) / 5.0
    parts = lag_table(time_min, drive, (5.0,))[0]
    noise = rng.normal(0.0, 0.3, (900, 6))
    degc = 20.0 + noise
    degc[:, 0] += 0.3 * parts[:, 0] + rng.normal(0.0, 2.0, 900)
    degc[:, 1] += 2.0 * parts[:, 0]
    degc[:, 4] += 2.0 * parts[:, 1]
    recording = Recording(
        name="r",
        time_s=60.0 * time_min,
        speed_rpm=None,
        temperature_names=tuple(f"T{i + 1}" for i in range(6)),
        temperatures_degc=degc,
        displacement_names=("c1",),
        displacements_um=(5.0 * parts[:, 0] - 4.0 * parts[:, 1])[:, None],
    )
    inputs = build_inputs([recording], sample_s=60.0)
    rows = inputs.trainable()
    return SensorComparison(inputs, rows, inner_folds(inputs, rows)[0])


@pytest.mark.parametrize("method", ["forward", "lasso"])
def test_the_sensors_that_know_something_come_first(comparison: SensorComparison, method: Method) -> None:
    selection = comparison.select(method, 3)
    assert set(selection.sensors[:2]) == {"T2", "T5"}
    assert selection.relative_rmse[1] < 0.8 * selection.relative_rmse[0]
