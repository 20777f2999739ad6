"""Exclusion and return of sensors: no step, no trace of what was wrong, no NaN."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.thermal.estimation import UNSURE_UM, Machine, OnlineReference
from models.thermal.estimator import LinearEstimator
from models.thermal.linear import LinearModel
from models.thermal.mean_increment import first_mean_increment, renewed_mean_increment
from models.thermal.rebase import estimate_since, rebased, returning, state_reference
from models.thermal.training.making import increment_model

SENSORS = 6
COMPONENTS = ("head", "head", "head", "column", "column", "column")
temperature = st.floats(-20.0, 80.0, allow_nan=False)
vectors = st.lists(temperature, min_size=SENSORS, max_size=SENSORS).map(np.array)
masks = st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS).map(lambda bits: np.array(bits, dtype=bool))


def estimator(coefficients):
    rows = np.asarray(coefficients, dtype=float)
    model = increment_model(
        model_id="m",
        kind="increments",
        channels=("Z1",),
        sensor_ids=tuple(range(1, SENSORS + 1)),
        sensor_names=tuple(f"t{i}" for i in range(SENSORS)),
        coefficients_um_per_k=rows,
        drift_um_per_min=np.zeros(1),
        lowest_increment_k=np.full(SENSORS, -1e3),
        highest_increment_k=np.full(SENSORS, 1e3),
        band_um=np.ones(1),
        training=(),
        created="2026-01-01T00:00:00Z",
        test_pairs=[(np.full(SENSORS, 1.0), np.zeros(SENSORS))],
    )
    return LinearEstimator(model, COMPONENTS)


def at(family, time_min, degc):
    return family.begin(time_min, np.asarray(degc))


coefficients = st.lists(st.floats(-5, 5), min_size=SENSORS, max_size=SENSORS).map(lambda row: np.array([row]))


@given(rows=coefficients, reference=vectors, now=vectors, gone=masks, back=masks)
@settings(max_examples=100, deadline=None)
def test_the_return_of_sensors_moves_the_estimate_by_nothing(rows, reference, now, gone, back):
    family, back = estimator(rows), back & gone
    counted = state_reference(family, at(family, 0.0, reference))
    before = estimate_since(family, at(family, 1.0, np.where(gone, np.nan, now)), counted)
    if before is None or not back.any():
        return
    state = at(family, 1.0, np.where(gone & ~back, np.nan, now))
    found = rebased(family, state, counted, np.flatnonzero(back).tolist())
    assert found is not None
    after = estimate_since(family, *found)
    assert after is not None and np.all(np.isfinite(after.thermal_error_um))
    assert after.thermal_error_um == pytest.approx(before.thermal_error_um, abs=1e-6)


@given(rows=coefficients, reference=vectors, now=vectors, wrong=st.floats(-200, 200))
@settings(max_examples=100, deadline=None)
def test_what_an_excluded_sensor_said_leaves_no_trace(rows, reference, now, wrong):
    family = estimator(rows)
    drifted, missing = now.copy(), now.copy()
    drifted[0], missing[0] = wrong, np.nan
    then = at(family, 0.0, reference)
    assert np.all(np.isfinite(family.estimate(at(family, 1.0, drifted), then).thermal_error_um))
    excluded = family.estimate(at(family, 1.0, missing), then)
    increments = now - reference
    increments[0] = increments[1:3].mean()
    assert excluded.thermal_error_um == pytest.approx(rows @ increments, abs=1e-6)
    assert excluded.imputed == (1,)


def test_a_sensor_missing_at_the_reference_counts_from_its_first_value():
    family, now = estimator(np.ones((1, SENSORS))), np.full(SENSORS, 21.0)
    counted = state_reference(family, at(family, 0.0, [np.nan, 20.0, 20.0, 20.0, 20.0, 20.0]))
    state = at(family, 1.0, now)
    assert returning(family, state, counted, []) == (0,)
    found = rebased(family, state, counted, (0,))
    assert found is not None and found[1].state.degc[0] == pytest.approx(20.0)
    later = now.copy()
    later[0] += 2.0
    assert estimate_since(family, at(family, 2.0, later), found[1]).thermal_error_um == pytest.approx([8.0])


def test_what_a_sensor_was_imputed_with_until_it_was_set_anew_stays_in_doubt_over_restarts_without_lags():
    """The reference holds where it counts from, and not how far off that may be."""
    model, told = estimator([[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]]).model, Machine(components={})
    nobody = np.zeros(SENSORS, dtype=bool)

    def begun(degc, kept):
        online = LinearModel.runtime(model, told)
        online.on_sample(0.0, degc, np.nan)
        online.set_reference(OnlineReference(time_min=0.0, now_min=1.0, degc=degc, excluded={}, kept=kept))
        return online

    def estimated(online, degc, absent=nobody):
        online.on_sample(2.0, degc, np.nan)
        return online.estimate(2.0, degc, absent)[0]

    online = begun(np.array([np.nan, 20.0, 20.0, 20.0, 20.0, 20.0]), None)
    now = np.array([25.0, 21.0, 22.0, 23.0, 24.0, 20.0])
    unsure_um = estimated(online, now).imputed_um
    assert unsure_um > UNSURE_UM
    for _ in range(2):
        online = begun(online.reference_degc, json.loads(json.dumps(online.kept)))
        assert estimated(online, now).imputed_um == pytest.approx(unsure_um)
    other = LinearModel.runtime(replace(model, model_id="other"), told)
    other.on_sample(0.0, now, np.nan)
    then = OnlineReference(time_min=0.0, now_min=1.0, degc=online.reference_degc, excluded={}, kept=online.kept)
    other.set_reference(then)
    assert estimated(other, now).imputed_um == pytest.approx(unsure_um), "another model counts from the same"
    online.set_reference(OnlineReference(time_min=3.0, now_min=3.0, degc=now))
    assert online.kept is None and estimated(online, now).imputed_um == 0.0


@given(
    reference=vectors, here=st.lists(masks, min_size=1, max_size=12), wrong=st.lists(vectors, min_size=12, max_size=12)
)
@settings(max_examples=100, deadline=None)
def test_neither_leaving_nor_a_wrong_return_moves_the_mean_increment(reference, here, wrong):
    """Sensors that stay stand still; those that come back say anything at all."""
    mean, said, was_here = first_mean_increment(reference), reference + 3.0, np.ones(SENSORS, dtype=bool)
    mean = renewed_mean_increment(mean, said)
    for mask, values in zip(here, wrong, strict=False):
        said = np.where(mask & ~was_here, values, said)
        mean, was_here = renewed_mean_increment(mean, np.where(mask, said, np.nan)), mask
        assert mean.mean_k == pytest.approx(3.0, abs=1e-6) if mask.any() else np.isnan(mean.mean_k)


@given(reference=vectors, now=vectors, gone=masks, rise_k=st.floats(-5.0, 5.0))
@settings(max_examples=100, deadline=None)
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
