"""The simulated machine's sensors: places, offsets, lag, quantisation, and the displacement readings."""

import numpy as np
import pytest

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.heat import INDEX
from drivers.sim.machine.parameters import NODES
from drivers.sim.machine.sensors import (
    CONTACT_LAG_S,
    OFFSET_LIMIT_K,
    SensorArray,
    sensor_shares,
)

SENSORS = [
    *(SensorConfig(id=i, component="Ambient", label="Room") for i in (1, 2, 3, 4)),
    SensorConfig(id=56, component="Spindle unit", part="Housing", label="A"),
    SensorConfig(id=93, component="Spindle unit", part="Front cover of the spindle", label="F"),
    *(SensorConfig(id=i, component="Spindle unit", part="Cast metal") for i in range(75, 87)),
    SensorConfig(id=278, component="Cooling circuit of chiller", part="Joint for oil going out from chiller"),
    SensorConfig(id=301, device="MLX90615", component="Spindle unit", part="Spindle nose", label="IR"),
]
CONTACT = [row for row, sensor in enumerate(SENSORS) if sensor.device == "TMP102"]


def array(machine_seed: int = 1, noise_seed: int = 2) -> SensorArray:
    return SensorArray(SENSORS, machine_seed=machine_seed, noise_seed=noise_seed)


def uniform(degc: float) -> np.ndarray:
    return np.full(len(NODES), degc)


def test_offsets_belong_to_the_machine_and_stay_within_the_data_sheet() -> None:
    first, same, other = array(1, 2), array(1, 3), array(2, 2)
    assert np.abs(first.offset_k).max() <= OFFSET_LIMIT_K
    assert np.ptp(first.offset_k) > 0.3
    assert (first.offset_k == same.offset_k).all()
    assert (first.offset_k != other.offset_k).all()


@pytest.mark.parametrize("degc", [25.0, 0.0, -25.0])
def test_codes_are_those_of_the_devices(degc: float) -> None:
    sensors = array()
    codes = sensors.codes(sensors.settled(uniform(degc)), 0.0)
    assert ((codes[CONTACT] >= 0) & (codes[CONTACT] <= 0xFFF)).all()
    assert (codes[CONTACT] >= 0x800).all() == (degc < 0)
    assert codes[-1] * 0.02 - 273.15 == pytest.approx(degc, abs=0.7)
    understood = sensors.degc(codes)
    assert understood == pytest.approx(degc + sensors.offset_k, abs=0.15)
    assert (understood[CONTACT] / 0.0625 == np.rint(understood[CONTACT] / 0.0625)).all()


def test_contact_sensors_lag_and_the_infrared_hardly() -> None:
    sensors = array()
    degc = sensors.settled(uniform(20.0))
    for _ in range(3):
        degc = sensors.advance(degc, uniform(30.0), 10.0)
    reached = (degc - 20.0) / 10.0
    slowest, fastest = (1 - np.exp(-30.0 / lag_s) for lag_s in reversed(CONTACT_LAG_S))
    assert ((reached[CONTACT] >= slowest - 1e-9) & (reached[CONTACT] <= fastest + 1e-9)).all()
    assert reached[-1] > 0.99
    at_once = sensors.advance(sensors.settled(uniform(20.0)), uniform(30.0), 30.0)
    assert at_once == pytest.approx(degc)


def test_neighbours_differ_and_sensors_read_their_own_component() -> None:
    shares = sensor_shares(SENSORS)
    assert shares.sum(axis=1) == pytest.approx(1.0)
    cast = shares[[row for row, sensor in enumerate(SENSORS) if sensor.part == "Cast metal"]]
    assert len({tuple(row) for row in cast}) == len(cast)
    assert shares[0, INDEX["air_low"]] > 0 and shares[0, INDEX["shaft_front"]] == 0
