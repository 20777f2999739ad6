"""What each sensor adds to an estimate: together with drift it is the estimate, and nothing without a reference."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_model import model

from models.thermal.estimation import Machine, OnlineReference
from models.thermal.left_out import LeftOut

MODEL = model()
SENSORS = len(MODEL.sensor_ids)


@given(
    degc=arrays(np.float64, SENSORS, elements=st.floats(15.0, 30.0)),
    then=arrays(np.float64, SENSORS, elements=st.floats(15.0, 30.0)),
    minutes=st.floats(1.0, 600.0),
)
def test_contributions_and_drift_are_the_estimate(degc, then, minutes):
    online = MODEL.runtime(Machine(components={}))
    assert online.contributions_um() is None
    online.on_sample(0.0, then, float("nan"))
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=then))
    online.on_sample(minutes, degc, float("nan"))
    estimate, _ = online.estimate(minutes, degc, np.zeros(SENSORS, dtype=bool))
    found = online.contributions_um()()
    assert found.shape == (SENSORS, len(MODEL.channels))
    np.testing.assert_allclose(
        found.sum(axis=0) + minutes * MODEL.drift_um_per_min, estimate.thermal_error_um, rtol=1e-9, atol=1e-9
    )


def test_a_sensor_that_does_not_count_adds_nothing():
    online = MODEL.runtime(Machine(components={}))
    then = np.full(SENSORS, 20.0)
    online.on_sample(0.0, then, float("nan"))
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=then))
    now = then + 1.0
    now[0] = np.nan
    online.on_sample(1.0, now, float("nan"))
    absent = np.zeros(SENSORS, dtype=bool)
    absent[0] = True
    online.estimate(1.0, now, absent)
    assert not online.contributions_um()()[0].any()


class EmptiedMeanwhile(dict[tuple[int, ...], Any]):
    """What is kept at hand, which another thread empties as soon as anything is in it."""

    def __setitem__(self, key: tuple[int, ...], value: Any) -> None:
        super().__setitem__(key, value)
        self.clear()


def test_coefficients_that_another_thread_lets_go_meanwhile_are_told_all_the_same():
    """The monitor asks for contributions while the thermal task estimates: the estimate of that cycle was lost."""
    left_out = LeftOut(MODEL, None)
    left_out._coefficients = EmptiedMeanwhile()
    np.testing.assert_array_equal(left_out.coefficients((0,)), LeftOut(MODEL, None).coefficients((0,)))
