"""Words of ISO 230-3, warm-up advice and energy on responses that are known."""

import math

import numpy as np
import pytest

from models.records import FloatArray
from models.thermal.training.distortion import (
    Stretch,
    distortion,
    rotations,
    stable_after_min,
    value_range_um,
)
from models.thermal.training.energy import Process, energy_efficiency, productivity_per_h
from models.thermal.training.warm_up import fit_warm_up

MINUTES = np.arange(121.0)


def response(constant_min: float, amplitude_um: float) -> FloatArray:
    return np.asarray(amplitude_um * -np.expm1(-MINUTES / constant_min))


def test_rotations_begin_with_the_last_row_at_standstill() -> None:
    speed = np.array([0.0, 0.0, 500.0, 500.0, 0.0, 0.0, 900.0])
    assert rotations(speed) == [Stretch(first=1, stop=4), Stretch(first=5, stop=7)]
    assert rotations(np.array([300.0, 300.0, 0.0])) == [Stretch(first=0, stop=2)]
    assert rotations(np.array([0.0, np.nan, 300.0, np.nan, 0.0])) == [Stretch(first=1, stop=4)]
    assert rotations(np.zeros(4)) == []


def test_distortion_is_the_range_of_60_minutes_and_of_the_whole_period() -> None:
    error_um = -0.1 * MINUTES
    error_um[5] = 1.0
    error_um[7] = np.nan
    found = distortion(MINUTES + 700.0, error_um)
    assert found.first_60_min_um == pytest.approx(7.0)
    assert found.whole_um == pytest.approx(13.0)
    assert found.end_um == pytest.approx(-12.0)
    assert math.isnan(value_range_um(np.array([np.nan])))


def test_what_was_probed_once_an_hour_says_nothing_of_less_than_that() -> None:
    error_um = np.where(MINUTES % 60.0 == 30.0, 0.1 * MINUTES, np.nan)
    found = distortion(MINUTES, error_um)
    assert math.isnan(found.first_60_min_um), "one value in the first hour is no range of 0 um"
    assert found.whole_um == pytest.approx(6.0)
    assert math.isnan(distortion(MINUTES[:60], error_um[:60]).end_um)
    assert math.isnan(stable_after_min(MINUTES, error_um, ahead_min=15.0, tolerance_um=2.0))


@pytest.mark.parametrize("constant_min", [10.0, 25.0])
def test_time_to_stability_is_that_of_the_response(constant_min: float) -> None:
    found = stable_after_min(MINUTES, response(constant_min, -20.0), ahead_min=15.0, tolerance_um=2.0)
    exact = constant_min * math.log(20.0 * -math.expm1(-15.0 / constant_min) / 2.0)
    assert found == math.ceil(exact)


def test_the_adviser_knows_when_a_response_has_settled() -> None:
    rng = np.random.default_rng(1)
    error_um = 4.0 + response(12.0, -15.0) + response(60.0, -10.0) + rng.normal(0.0, 0.05, len(MINUTES))
    error_um[0] = 0.0
    fitted = fit_warm_up(MINUTES, error_um)
    assert fitted.rmse_um < 0.1

    def drift_um(at_min: float) -> float:
        return sum(
            amplitude * math.exp(-at_min / constant) * -math.expm1(-20.0 / constant)
            for constant, amplitude in ((12.0, 15.0), (60.0, 10.0))
        )

    exact = next(minute for minute in range(500) if drift_um(minute) < 1.0)
    assert fitted.wait_min(ahead_min=20.0, tolerance_um=1.0) == pytest.approx(exact, abs=8.0)
    assert fitted.drift_um(np.array([30.0]), 20.0)[0] == pytest.approx(-drift_um(30.0), abs=0.2)
    assert fitted.wait_min(ahead_min=20.0, tolerance_um=100.0) == 0.0


def test_energy_efficiency_and_productivity_by_hand() -> None:
    process = Process(cut_kwh=0.3, motor_kwh=0.9, time_h=0.5)
    assert energy_efficiency(process, chiller_kw=1.2, chiller_h=0.5) == pytest.approx(0.3 / 1.5)
    assert energy_efficiency(process, chiller_kw=1.2, chiller_h=0.0) == pytest.approx(1.0 / 3.0)
    assert productivity_per_h(process) == 2.0
    with pytest.raises(ValueError, match="the motors bring the cutting energy"):
        Process(cut_kwh=1.0, motor_kwh=0.5, time_h=1.0)
    with pytest.raises(ValueError, match=r"cannot run 0\.6 h"):
        energy_efficiency(process, chiller_kw=1.2, chiller_h=0.6)
