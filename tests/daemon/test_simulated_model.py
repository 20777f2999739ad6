"""The model that ships for the simulated machine, on days it has not seen."""

import numpy as np
import pytest

from config.machines import shipped_file
from daemon.simulation.simulated_model import (
    CHANNELS,
    MODEL_NAME,
    TRAINING_SEEDS,
    UNSEEN_SEEDS,
    judge,
    published_sensors,
    simulated_recording,
)
from daemon.simulation.simulation import DEMO_SEED
from drivers.sim.nc.program import PartProgram, demo_program, rotation_program
from models.thermal.family import ThermalModel, model_from_json


@pytest.fixture(scope="module")
def model() -> ThermalModel:
    path = shipped_file(MODEL_NAME)
    assert path.stat().st_size < 300_000
    return model_from_json(path.read_text(encoding="utf-8"), str(path))


def test_the_shipped_model_is_of_this_machine_and_of_other_days_than_the_demo(model: ThermalModel) -> None:
    assert model.channels == CHANNELS
    assert model.sensor_ids == tuple(sensor.id for sensor in published_sensors())
    seeds = [int(data.name.removeprefix("simulated day ").split(",")[0]) for data in model.training]
    assert seeds == list(TRAINING_SEEDS)
    assert DEMO_SEED not in seeds
    assert not set(seeds) & set(UNSEEN_SEEDS)
    assert not any(f"O{demo_program().number}" in data.name for data in model.training)


@pytest.mark.parametrize("program", [demo_program(), rotation_program(speed_rpm=11000.0)], ids=["demo", "rotation"])
def test_most_of_the_error_of_an_unseen_day_is_predicted(model: ThermalModel, program: PartProgram) -> None:
    sensors = published_sensors()
    judgement = judge(model, simulated_recording(4711, program, sensors, hours=1.5), sensors)
    metrics = judgement.metrics
    remaining = dict(zip(CHANNELS, metrics.rmse_with_um / metrics.rmse_without_um, strict=True))
    assert remaining["Z1"] < 0.5
    assert remaining["Y1"] < 0.5
    assert judgement.metrics.max_without_um[CHANNELS.index("Z1")] > 3.0
    assert judgement.in_domain_share > 0.95
    assert np.isfinite(model.band_um).all()
