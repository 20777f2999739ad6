"""What is imputed may be off: the estimate knows by how much, and above a micrometre the output holds.

The machine is the simulated one with 16 sensors, of which one, in the hall, is not told by the others. Every sensor in
turn drifts until the watch leaves it out; the truth is a twin that hears all of them as they are.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from daemon.simulation.faults.script import WATCHED_SENSORS
from daemon.simulation.simulated_model import published_sensors, simulated_recording, training_programmes
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.estimation import UNSURE_UM, Machine, OnlineReference
from models.thermal.linear import LinearModel
from models.thermal.training.train_family import train_family

DRIFT_K_PER_MIN = 11.6 / 60.0
REFERENCE, FAULT, RIGHT = 60, 100, 220
"""Minutes: the work is positioned, a sensor begins to drift, it is right again."""
PASSED_MIN = 10
UNTIL = 330
"""The minute until which is judged."""


def day(seed: int, hours: float) -> Recording:
    sensors = [sensor for sensor in published_sensors() if sensor.id in WATCHED_SENSORS]
    programmes = training_programmes()
    return simulated_recording(seed, programmes[(seed - 1) % len(programmes)], sensors, hours=hours)


@pytest.fixture(scope="module")
def model() -> LinearModel:
    recordings = [day(seed, 8.0) for seed in range(1, 5)]
    made = train_family(recordings, "lags", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(made, LinearModel) and made.watch is not None
    return made


@dataclass(frozen=True)
class Followed:
    um: FloatArray
    imputed: list[tuple[int, ...]]
    unsure_um: FloatArray
    band_um: FloatArray
    """The widest of the channels."""


def follow(model: LinearModel, table: FloatArray, speed_rpm: FloatArray) -> Followed:
    """Follow a model minute by minute; rows before the reference are its history."""
    online = model.runtime(Machine(components={}))
    online.rebuild((float(k), table[k], float(speed_rpm[k])) for k in range(REFERENCE))
    absent = np.zeros(table.shape[1], dtype=bool)
    um, imputed, unsure_um, band_um = [], [], [], []
    for minute in range(REFERENCE, len(table)):
        online.on_sample(float(minute), table[minute], float(speed_rpm[minute]))
        if minute == REFERENCE:
            online.set_reference(OnlineReference(time_min=float(minute), now_min=float(minute), degc=table[minute]))
        found, _ = online.estimate(float(minute), table[minute], absent)
        assert found is not None
        absent = np.isin(model.sensor_ids, found.imputed)
        um.append(found.thermal_error_um)
        imputed.append(found.imputed)
        unsure_um.append(found.imputed_um)
        band_um.append((model.band_um * found.band_factor).max())
    return Followed(np.array(um), imputed, np.array(unsure_um), np.array(band_um))


def recorded(seed: int, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """One-minute means of temperatures and speed of a simulated day."""
    found = day(seed, 8.0)
    every = round(60.0 / found.sample_s)
    rows = found.rows // every * every
    assert found.speed_rpm is not None
    table = found.temperatures_degc[:rows, [found.temperature_names.index(name) for name in names]]
    means: FloatArray = table.reshape(-1, every, len(names)).mean(axis=1)
    return means, found.speed_rpm[:rows].reshape(-1, every).mean(axis=1)


def drifting(model: LinearModel, seed: int) -> tuple[FloatArray, FloatArray]:
    """How far the estimate is off, and what is in doubt, after each sensor in turn was wrong [um], (n_sensors, n)."""
    table, speed_rpm = (one[:UNTIL] for one in recorded(seed, model.sensor_names))
    twin = follow(model, table, speed_rpm)
    drift_k = np.zeros(len(table))
    drift_k[FAULT:RIGHT] = DRIFT_K_PER_MIN * np.arange(RIGHT - FAULT)
    after = slice(RIGHT + PASSED_MIN - REFERENCE, None)
    off_um, unsure_um = [], []
    for sensor, sensor_id in enumerate(model.sensor_ids):
        found = follow(model, table + np.outer(drift_k, np.arange(table.shape[1]) == sensor), speed_rpm)
        assert sensor_id in found.imputed[-1], "the watch has left it out"
        off_um.append(np.abs(found.um - twin.um).max(axis=1)[after])
        unsure_um.append(found.unsure_um[after])
    return np.array(off_um), np.array(unsure_um)


def test_a_sensor_that_was_wrong_leaves_the_estimate_at_the_truth_or_in_doubt(model: LinearModel) -> None:
    off, unsure = drifting(model, 48)
    assert off.max() > 2.0, "one of them is not told by the others"
    assert not ((off > 1.0) & (unsure <= UNSURE_UM)).any(), "more than a micrometre off, and followed"
    covered = (off <= unsure).mean()
    print(f"covered: {covered:.3f}, held: {(unsure > UNSURE_UM).mean():.3f}")
    assert covered >= 0.85, "90 % are meant, of each channel; this is the worst of five"
    assert (unsure > UNSURE_UM).mean() <= 0.15, "the others are followed on"


def test_what_is_imputed_is_in_little_doubt_while_little_has_moved(model: LinearModel) -> None:
    table, speed_rpm = recorded(42, model.sensor_names)
    table[REFERENCE + 5 :, -1] = np.nan
    found = follow(model, table, speed_rpm)
    missing = np.array([bool(imputed) for imputed in found.imputed])
    assert found.unsure_um[missing][0] < UNSURE_UM
    assert found.unsure_um[missing].max() > UNSURE_UM
    assert not found.unsure_um[~missing].any()
    assert (found.band_um[missing] >= found.unsure_um[missing]).all()
