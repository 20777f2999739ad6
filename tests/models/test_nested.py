"""Nested least squares, the dissertation's models and the campaign study against refits from scratch."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression

from models.recordings.dataset import Recording
from models.recordings.jumps import remove_jumps_at_switching
from models.records import FloatArray
from models.thermal.training.campaign_study import nested_fits, random_sensor_order, residual_maps
from models.thermal.training.increments import combine
from models.thermal.training.published import MODELS, PublishedSet, prepare

SENSORS = 9
ROOM = ("T1", "T2")


def recording(seed: int, minutes: int = 60, speed_rpm: float = 6000.0) -> Recording:
    """Warming with noise; Y2 jumps by 5 um with rotation."""
    rng = np.random.default_rng(seed)
    speed = np.where(np.arange(minutes + 1) % 40 < 25, speed_rpm, 0.0)
    speed[0] = 0.0
    degc = 20.0 + np.cumsum(rng.normal(0.02, 0.1, (minutes + 1, SENSORS)), axis=0)
    um = degc @ _TRUE + rng.normal(0.0, 0.3, (minutes + 1, 3))
    um[:, 0] += 5.0 * (speed > 0.0)
    return Recording(
        name=f"set {seed}",
        time_s=60.0 * np.arange(minutes + 1.0),
        speed_rpm=speed,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=degc,
        displacement_names=("Y2", "Z1", "Z2"),
        displacements_um=um,
    )


_TRUE = np.random.default_rng(99).normal(0.0, 2.0, (SENSORS, 3))


def prepared(count: int = 4, minutes: int = 60) -> list[PublishedSet]:
    return [prepare(i, recording(i, minutes, 2000.0 * (9 - i)), ROOM) for i in range(1, count + 1)]


def increments_of(sets: list[PublishedSet], channel: str) -> tuple[FloatArray, FloatArray]:
    """The rows that equation 3-2 sums over, written out."""
    inputs, outputs = [], []
    for each in sets:
        source = each.recording
        assert source.speed_rpm is not None
        values = source.displacements_um[:, source.displacement_names.index(channel)]
        inputs.append(np.diff(source.temperatures_degc, axis=0))
        outputs.append(np.diff(remove_jumps_at_switching(values, source.speed_rpm, 3.0)))
    return np.vstack(inputs), np.concatenate(outputs)


@pytest.mark.parametrize("intercept", [True, False])
@pytest.mark.parametrize("sets", [1, 3])
def test_every_nested_fit_is_scikit_learns(intercept: bool, sets: int) -> None:
    training = prepared(sets)
    order = random_sensor_order(SENSORS, 5)
    fits = nested_fits(combine([each.factor for each in training]), order, intercept=intercept)
    for output, channel in enumerate(("Y2", "Z2", "Z1")):
        inputs, outputs = increments_of(training, channel)
        for count in range(1, SENSORS + 1):
            columns = np.sort(order[:count])
            refit = LinearRegression(fit_intercept=intercept).fit(inputs[:, columns], outputs)
            coefficients, drift = fits.coefficients(count)
            by_sensor = dict(zip(order[:count].tolist(), coefficients[:, output], strict=True))
            assert [by_sensor[column] for column in columns] == pytest.approx(refit.coef_.tolist(), rel=1e-8, abs=1e-10)
            assert drift[output] == pytest.approx(refit.intercept_, rel=1e-8, abs=1e-10)


def test_the_maps_are_those_of_refits_and_raw_tests() -> None:
    *training, test = prepared(4)
    order = random_sensor_order(SENSORS, 2)
    maps = residual_maps(training, {"all": [test]}, order, intercept=True)
    assert set(maps) == {(model, "all") for model in MODELS}
    turning = test.rotating
    for sets, count in ((1, 3), (2, SENSORS), (3, 5)):
        columns = np.sort(order[:count])
        estimate = {}
        for channel in ("Y2", "Z1", "Z2"):
            inputs, outputs = increments_of(training[:sets], channel)
            refit = LinearRegression().fit(inputs[:, columns], outputs)
            steps = refit.predict(np.diff(test.recording.temperatures_degc[:, columns], axis=0))
            estimate[channel] = np.r_[0.0, np.cumsum(steps)]
        residual = (test.error_um("Y2") - estimate["Y2"])[turning]
        found = maps["Y2", "all"]
        assert found.max_um[sets - 1, count - 1] == pytest.approx(np.abs(residual).max(), rel=1e-8)
        assert found.rmse_um[sets - 1, count - 1] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-8)
        assert found.mean_um[sets - 1, count - 1] == pytest.approx(np.abs(residual).mean(), rel=1e-8)
        length = _length_estimate(training[:sets], test)
        residual = (test.error_um("Z2") - (estimate["Z1"] - length))[turning]
        assert maps["Z1+TL", "all"].max_um[sets - 1, count - 1] == pytest.approx(np.abs(residual).max(), rel=1e-7)


def _length_estimate(training: list[PublishedSet], test: PublishedSet) -> FloatArray:
    def inputs_of(each: PublishedSet) -> FloatArray:
        assert each.recording.speed_rpm is not None
        return np.column_stack([each.recording.temperatures_degc[:, :2], each.recording.speed_rpm / 1000.0])

    z1, z2 = (increments_of(training, channel)[1] for channel in ("Z1", "Z2"))
    inputs = np.vstack([np.diff(inputs_of(each), axis=0) for each in training])
    refit = LinearRegression().fit(inputs, z1 - z2)
    steps: FloatArray = refit.predict(np.diff(inputs_of(test), axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])


def test_training_jumps_are_cleansed_and_test_jumps_are_not() -> None:
    each = prepared(1)[0]
    assert np.abs(np.diff(each.error_um("Y2"))).max() > 4.0
    found = nested_fits(each.factor, np.arange(SENSORS), intercept=False).coefficients(SENSORS)[0][:, 0]
    inputs, cleansed = increments_of([each], "Y2")
    raw = np.diff(each.error_um("Y2"))
    assert found == pytest.approx(np.linalg.lstsq(inputs, cleansed, rcond=None)[0], rel=1e-8)
    assert np.abs(found - np.linalg.lstsq(inputs, raw, rcond=None)[0]).max() > 0.1
