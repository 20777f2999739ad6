"""How far a sensor scatters is told by its readings, and by nothing that it does otherwise."""

import numpy as np
import pytest

from models.cleanse import CleansingRules, cleanse_cycle, initial_state, rules_of_period
from models.quality import Quality, Reason
from models.sensor_noise import WIDEST, SensorNoise

SENSORS = np.arange(40)


def wider(deviation_k: float, *, readings: int = 400, every_s: float = 10.0, step_k: float = 0.0625) -> np.ndarray:
    """Return what was told after each reading, shape (readings, 40), of sensors that warm by 1 K/min."""
    noise, rng = SensorNoise(len(SENSORS)), np.random.default_rng(3)
    told = []
    for reading in range(readings):
        at_s = reading * every_s
        degc = 20.0 + at_s / 60.0 + rng.normal(0.0, deviation_k, len(SENSORS))
        told.append(noise.wider(SENSORS, np.round(degc / step_k) * step_k, at_s))
    return np.array(told)


@pytest.mark.parametrize("step_k", [0.0625, 0.1])
def test_limits_of_quiet_sensors_are_those_of_the_configuration(step_k: float) -> None:
    assert (wider(0.02, step_k=step_k)[100:] == 1.0).all()


@pytest.mark.parametrize("every_s", [1.0, 10.0, 60.0])
def test_a_sensor_that_scatters_has_wider_limits_within_a_minute_of_cycles_and_none_beyond_the_widest(
    every_s: float,
) -> None:
    told = wider(0.3, every_s=every_s)
    assert (told[:9] == 1.0).all(), "too few readings say nothing"
    assert np.median(told[60:]) > 2.0 and told.max() == WIDEST


def test_minutes_of_flipped_bits_make_no_noisy_sensor() -> None:
    noise, rng = SensorNoise(len(SENSORS)), np.random.default_rng(4)
    for reading in range(300):
        codes = np.round((20.0 + rng.normal(0.0, 0.03, len(SENSORS))) / 0.0625).astype(int)
        hit = (rng.random(len(SENSORS)) < 0.3) & (reading >= 264)
        codes = np.where(hit, codes ^ (1 << rng.integers(0, 11, len(SENSORS))), codes)
        told = noise.wider(SENSORS, codes * 0.0625, reading * 10.0)
    assert told.max() < 1.5


QUICK = (
    (28.3, 28.5, 28.1, 26.9, 26.5, 27.0, 27.4, 27.7),
    (28.8, 28.9, 28.3, 27.7, 28.4, 29.1),
    (27.3, 26.8, 26.4, 26.1, 26.9, 27.7, 28.3, 28.6),
    (26.8, 25.9, 25.3, 24.9, 25.6, 26.7, 27.5, 27.9),
)
"""A bearing that is read once in a minute, as the spindle stops and starts."""


@pytest.mark.parametrize("degc", QUICK)
def test_a_bearing_that_is_read_once_in_a_minute_is_never_missing_and_at_no_other_level(
    degc: tuple[float, ...],
) -> None:
    rules, now_s = rules_of_period(CleansingRules(), 60.0), 0.0
    state = initial_state(1)
    for number, value in enumerate((*degc[:1] * 4, *degc)):
        now_s = 60.0 * number
        codes = np.array([Quality.GOOD], dtype=np.uint8), np.array([Reason.NONE], dtype=np.uint8)
        result = cleanse_cycle(rules, state, np.array([0]), np.array([value]), *codes, now_s, 60.0)
        state = result.state
        assert number < 3 or result.quality[0] != Quality.MISSING, number
        assert not result.new_level[0] and (number < 3 or not result.returned[0])
