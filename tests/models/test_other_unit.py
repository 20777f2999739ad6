"""An input that goes over to another unit is told by where all its numbers go, not by how far."""

import numpy as np
import pytest

from daemon.estimation.memory_watch import other_unit

BEFORE = np.array([21.0, 24.5, 33.0, 20.2])


def fahrenheit(degc):
    return 1.8 * np.asarray(degc) + 32.0


@pytest.mark.parametrize("drift_k", [-4.0, 0.0, 4.0])
@pytest.mark.parametrize(
    ("configured", "unit", "read"),
    [
        ("degC", "degF", lambda t: 1.8 * t + 32.0),
        ("degC", "K", lambda t: t + 273.15),
        ("degF", "degC", lambda t: (t - 32.0) / 1.8),
        ("K", "degC", lambda t: t - 273.15),
        ("K", "degF", lambda t: 1.8 * t + 32.0 - 273.15),
    ],
)
def test_a_box_that_is_switched_is_found_in_every_direction(configured, unit, read, drift_k):
    assert other_unit(BEFORE, read(BEFORE + drift_k), configured, "") == unit
    assert other_unit(BEFORE, read(BEFORE + 3.0 * drift_k), configured, unit) == unit, "it stays so while it warms"
    assert other_unit(BEFORE, BEFORE + 3.0 * drift_k, configured, unit) == "", "until it is set back"


def test_one_broken_sensor_of_four_hides_nothing_and_a_silent_one_neither():
    read = fahrenheit(BEFORE)
    read[2] = 20.0
    assert other_unit(BEFORE, read, "degC", "") == "degF"
    assert other_unit(BEFORE, np.where([0, 1, 1, 1], read, np.nan), "degC", "") == ""
    read[2] = np.nan
    assert other_unit(BEFORE, read, "degC", "") == "degF"
    assert other_unit(BEFORE, np.full(4, np.nan), "degC", "degF") == "degF"


def test_a_machine_that_warms_offsets_and_single_jumps_are_no_other_unit():
    rng = np.random.default_rng(4)
    for _ in range(2000):
        before = rng.uniform(10.0, 45.0, 4)
        real = before + rng.uniform(-25.0, 25.0) + rng.normal(0.0, 2.0, 4)
        assert other_unit(before, real, "degC", "") == ""
    one = BEFORE.copy()
    one[0] = fahrenheit(one[0])
    assert other_unit(BEFORE, one, "degC", "") == ""
    assert other_unit(np.full(4, np.nan), fahrenheit(BEFORE), "degC", "") == ""
