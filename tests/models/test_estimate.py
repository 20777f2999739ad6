"""The estimate: telescoped, imputed, in domain or not, never NaN."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.records import FloatArray
from models.thermal.estimation import Estimation
from models.thermal.estimator import DOMAIN_MARGIN_K, LinearEstimator
from models.thermal.linear import LinearModel
from models.thermal.model import TrainingData
from models.thermal.training.making import increment_model

COEFFICIENTS = np.array([[1.0, 2.0, -1.0, 0.0], [0.5, 0.0, 0.0, -0.5]])
DRIFT = np.array([0.1, 0.0])
COMPONENTS = ("Column", "Column", "Column", "Bed")
REFERENCE = np.array([20.0, 20.0, 20.0, 20.0])
MODEL = increment_model(
    model_id="m",
    kind="ridge",
    channels=("Y1", "Z1"),
    sensor_ids=(11, 12, 13, 14),
    sensor_names=("T11", "T12", "T13", "T14"),
    coefficients_um_per_k=COEFFICIENTS,
    drift_um_per_min=DRIFT,
    lowest_increment_k=np.array([0.0, -2.0, -2.0, 0.0]),
    highest_increment_k=np.array([4.0, 6.0, 6.0, 0.0]),
    band_um=np.array([1.0, 1.0]),
    training=(TrainingData(name="d", sha256="00", from_hours=0.0, to_hours=1.0, rows=60),),
    created="2026-01-01T00:00:00+00:00",
    test_pairs=[(REFERENCE, REFERENCE)],
)
INCREMENTS = st.lists(st.one_of(st.just(np.nan), st.floats(-30.0, 30.0)), min_size=4, max_size=4)


def estimate(model: LinearModel, degc: FloatArray, reference_degc: FloatArray, elapsed_min: float) -> Estimation | None:
    estimator = LinearEstimator(model, COMPONENTS)
    reference = estimator.begin(0.0, reference_degc)
    return estimator.estimate(estimator.begin(elapsed_min, degc), reference)


def at(increment_k: list[float], elapsed_min: float = 0.0, model: LinearModel = MODEL) -> Estimation:
    outcome = estimate(model, REFERENCE + np.array(increment_k), REFERENCE, elapsed_min)
    assert outcome is not None
    return outcome


def test_the_estimate_is_drift_times_minutes_plus_coefficients_times_increments() -> None:
    outcome = at([1.0, 2.0, 3.0, 0.25], elapsed_min=30.0)
    np.testing.assert_allclose(outcome.thermal_error_um, [1.0 + 4.0 - 3.0 + 3.0, 0.5 - 0.125])
    assert (outcome.confidence, outcome.in_domain, outcome.imputed, outcome.outside) == (1.0, True, (), ())


def test_a_missing_sensor_takes_the_mean_increment_of_its_component() -> None:
    outcome = at([1.0, np.nan, 3.0, 0.0])
    np.testing.assert_allclose(outcome.thermal_error_um, [1.0 + 2.0 * 2.0 - 3.0, 0.5])
    assert outcome.imputed == (12,)
    assert outcome.confidence == pytest.approx(1.0 - 2.0 / 4.0)


def test_a_component_without_any_sensor_takes_the_mean_of_all() -> None:
    outcome = at([1.0, 2.0, 3.0, np.nan])
    np.testing.assert_allclose(outcome.thermal_error_um[1], 0.5 * 1.0 - 0.5 * 2.0)
    assert outcome.imputed == (14,)
    assert outcome.confidence == pytest.approx(0.5)  # half of Z1's weight, nothing of Y1's


def test_a_mean_may_be_as_far_off_as_the_one_beside_it_that_departs_farthest() -> None:
    assert at([1.0, 2.0, 3.0, 0.5]).imputed_um == 0.0
    known = at([1.0, np.nan, 3.0, 0.5])
    assert known.imputed_um == pytest.approx(2.0 * 1.0 * np.sqrt(1.0 + 1.0 / 2.0)), "2 um/K, and 1 K from the mean"
    assert at([2.0, np.nan, 2.0, 0.5]).imputed_um == 0.0, "those beside it agree"
    alone = at([np.nan, 2.0, np.nan, 0.5])
    assert alone.imputed_um == pytest.approx(2.0 * np.sqrt(1.0 + 1.0 + 0.0)), "all of the change of the only one"
    np.testing.assert_allclose(known.band_factor, [np.sqrt(1.0 + 6.0), 1.0])


def test_a_sensor_without_a_value_at_the_reference_is_imputed_as_well() -> None:
    reference = REFERENCE.copy()
    reference[0] = np.nan
    outcome = estimate(MODEL, REFERENCE + 1.0, reference, 0.0)
    assert outcome is not None
    assert outcome.imputed == (11,)
    np.testing.assert_allclose(outcome.thermal_error_um, [2.0, 0.0])


def test_without_any_sensor_there_is_no_estimate() -> None:
    assert estimate(MODEL, np.full(4, np.nan), REFERENCE, 0.0) is None


def test_the_domain_is_a_range_wider_than_training_on_both_sides_and_never_narrower_than_the_margin() -> None:
    assert at([8.0, 0.0, 0.0, DOMAIN_MARGIN_K]).in_domain
    assert at([-4.0, -8.0, 0.0, -DOMAIN_MARGIN_K]).in_domain
    beyond = at([8.01, 0.0, 15.01, 0.0])
    assert (beyond.in_domain, beyond.outside) == (False, (11, 13))
    assert at([0.0, 0.0, 0.0, -DOMAIN_MARGIN_K - 0.01]).outside == (14,)


@given(increment_k=INCREMENTS, elapsed_min=st.floats(0.0, 1e5))
def test_the_estimate_is_finite_whenever_one_sensor_is_usable(increment_k: list[float], elapsed_min: float) -> None:
    outcome = estimate(MODEL, REFERENCE + np.array(increment_k), REFERENCE, elapsed_min)
    if np.isnan(increment_k).all():
        assert outcome is None
        return
    assert outcome is not None
    assert np.isfinite(outcome.thermal_error_um).all()
    assert 0.0 <= outcome.confidence <= 1.0
    missing = tuple(i for i, k in zip(MODEL.sensor_ids, increment_k, strict=True) if np.isnan(k))
    assert outcome.imputed == missing
    assert (outcome.confidence == 1.0) == (not missing)


def test_a_model_without_weight_on_a_channel_keeps_its_confidence() -> None:
    nothing = replace(MODEL.solutions[0], weights=np.zeros((4, 2)))
    proof = tuple(replace(v, thermal_error_um=v.elapsed_min * DRIFT) for v in MODEL.test_vectors)
    empty = replace(MODEL, solutions=(nothing,), test_vectors=proof)
    assert at([np.nan, 0.0, 0.0, 0.0], model=empty).confidence == 1.0


@pytest.mark.parametrize(
    ("speed_rpm", "confidence", "in_domain"),
    [(np.nan, 1.0, True), (7500.0, 1.0, True), (11250.0, 0.5, True), (15000.0, 0.0, False), (1e9, 0.0, False)],
)
def test_faster_than_in_training_confidence_fades_until_the_output_holds(
    speed_rpm: float, confidence: float, in_domain: bool
) -> None:
    domain = replace(MODEL.domain, highest_speed_rpm=5000.0)
    estimator = LinearEstimator(replace(MODEL, domain=domain), COMPONENTS)
    found = estimator.estimate(estimator.begin(1.0, REFERENCE, speed_rpm), estimator.begin(0.0, REFERENCE))
    assert found is not None
    assert (found.confidence, found.in_domain) == (pytest.approx(confidence), in_domain)
    unrecorded = LinearEstimator(MODEL, COMPONENTS)
    found = unrecorded.estimate(unrecorded.begin(1.0, REFERENCE, speed_rpm), unrecorded.begin(0.0, REFERENCE))
    assert found is not None and (found.confidence, found.in_domain) == (1.0, True)
