"""Exclusion and return of sensors: no step, no trace of what was wrong, no NaN."""

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.thermal.estimate import LinearEstimator
from models.thermal.rebase import first_mean_increment, rebased_reference_degc, renewed_mean_increment

SENSORS = 6
COMPONENTS = ("head", "head", "head", "column", "column", "column")
temperature = st.floats(-20.0, 80.0, allow_nan=False)
vectors = st.lists(temperature, min_size=SENSORS, max_size=SENSORS).map(np.array)
masks = st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS).map(lambda bits: np.array(bits, dtype=bool))


class _Coefficients:
    """What an estimator needs of a model."""

    def __init__(self, coefficients):
        self.model_id = hashlib.sha256(coefficients.tobytes()).hexdigest()[:8]
        self.sensor_ids = tuple(range(1, SENSORS + 1))
        self.coefficients_um_per_k = coefficients
        self.drift_um_per_min = np.zeros(len(coefficients))
        self.lowest_increment_k, self.highest_increment_k = np.full(SENSORS, -1e3), np.full(SENSORS, 1e3)


def estimator(coefficients):
    return LinearEstimator(_Coefficients(np.asarray(coefficients, dtype=float)), COMPONENTS)


coefficients = st.lists(st.floats(-5, 5), min_size=SENSORS, max_size=SENSORS).map(lambda row: np.array([row]))


@given(rows=coefficients, reference=vectors, now=vectors, gone=masks, back=masks)
@settings(max_examples=300, deadline=None)
def test_the_return_of_sensors_moves_the_estimate_by_nothing(rows, reference, now, gone, back):
    family, back = estimator(rows), back & gone
    before = family.renew(np.where(gone, np.nan, now), reference, 1.0)
    if before is None:
        return
    rebased = rebased_reference_degc(family, np.where(gone & ~back, np.nan, now), reference, back, 1.0)
    after = family.renew(np.where(gone & ~back, np.nan, now), rebased, 1.0)
    assert after is not None and np.all(np.isfinite(after.thermal_error_um))
    assert after.thermal_error_um == pytest.approx(before.thermal_error_um, abs=1e-6)


@given(rows=coefficients, reference=vectors, now=vectors, wrong=st.floats(-200, 200))
@settings(max_examples=200, deadline=None)
def test_what_an_excluded_sensor_said_leaves_no_trace(rows, reference, now, wrong):
    family = estimator(rows)
    drifted, missing = now.copy(), now.copy()
    drifted[0], missing[0] = wrong, np.nan
    assert np.all(np.isfinite(family.renew(drifted, reference, 1.0).thermal_error_um))
    excluded = family.renew(missing, reference, 1.0)
    increments = now - reference
    increments[0] = increments[1:3].mean()
    assert excluded.thermal_error_um == pytest.approx(rows @ increments, abs=1e-6)
    assert excluded.imputed == (1,)


def test_a_sensor_missing_at_the_reference_counts_from_its_first_value():
    family, now = estimator(np.ones((1, SENSORS))), np.full(SENSORS, 21.0)
    reference = np.array([np.nan, 20.0, 20.0, 20.0, 20.0, 20.0])
    rebased = rebased_reference_degc(family, now, reference, np.arange(SENSORS) == 0, 1.0)
    assert rebased[0] == pytest.approx(20.0)
    later = now.copy()
    later[0] += 2.0
    assert family.renew(later, rebased, 1.0).thermal_error_um == pytest.approx([8.0])


def test_without_any_other_sensor_nothing_is_rebased():
    family, reference = estimator(np.ones((1, SENSORS))), np.full(SENSORS, 20.0)
    now = np.full(SENSORS, 25.0)
    assert rebased_reference_degc(family, now, reference, np.ones(SENSORS, dtype=bool), 1.0) is reference


@given(
    reference=vectors, here=st.lists(masks, min_size=1, max_size=12), wrong=st.lists(vectors, min_size=12, max_size=12)
)
@settings(max_examples=200, deadline=None)
def test_neither_leaving_nor_a_wrong_return_moves_the_mean_increment(reference, here, wrong):
    """Sensors that stay stand still; those that come back say anything at all."""
    mean, said, was_here = first_mean_increment(reference), reference + 3.0, np.ones(SENSORS, dtype=bool)
    mean = renewed_mean_increment(mean, said)
    for mask, values in zip(here, wrong, strict=False):
        said = np.where(mask & ~was_here, values, said)
        mean, was_here = renewed_mean_increment(mean, np.where(mask, said, np.nan)), mask
        assert mean.mean_k == pytest.approx(3.0, abs=1e-6) if mask.any() else np.isnan(mean.mean_k)


@given(reference=vectors, now=vectors, gone=masks, rise_k=st.floats(-5.0, 5.0))
@settings(max_examples=200, deadline=None)
def test_a_sensor_that_left_goes_on_with_the_others_and_keeps_its_distance_from_them(reference, now, gone, rise_k):
    whole = renewed_mean_increment(first_mean_increment(reference), now)
    part = renewed_mean_increment(whole, np.where(gone, np.nan, now))
    later = renewed_mean_increment(part, np.where(gone, np.nan, now + rise_k))
    back = renewed_mean_increment(later, np.where(gone, 99.0, now + rise_k))
    assert whole.mean_k == pytest.approx((now - reference).mean(), abs=1e-9)
    if gone.all():
        assert np.isnan(later.mean_k) and back.mean_k == pytest.approx(whole.mean_k, abs=1e-6)
    else:
        assert later.mean_k == pytest.approx(whole.mean_k + rise_k, abs=1e-6)
        assert back.mean_k == pytest.approx(later.mean_k, abs=1e-6)


def test_a_sensor_missing_at_the_reference_joins_the_mean_without_a_step():
    mean = first_mean_increment(np.array([20.0, np.nan]))
    mean = renewed_mean_increment(mean, np.array([24.0, np.nan]))
    assert mean.mean_k == pytest.approx(4.0)
    mean = renewed_mean_increment(mean, np.array([24.0, 50.0]))
    assert mean.mean_k == pytest.approx(4.0)
    assert renewed_mean_increment(mean, np.array([24.0, 52.0])).mean_k == pytest.approx(5.0), "and then it counts"


def test_without_any_value_at_the_reference_the_mean_is_unknown_for_good():
    mean = renewed_mean_increment(first_mean_increment(np.full(2, np.nan)), np.array([21.0, 22.0]))
    assert np.isnan(mean.mean_k)
