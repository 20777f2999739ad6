"""A fitted thermal model, which proves itself whenever it is made."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

KINDS = ("increments", "ridge", "pls", "lasso")
"""Families of models that end in one coefficient per temperature."""


TEST_TOLERANCE_UM = 1e-6
"""Test vectors are met within this [um]; summation order differs between computers."""


class ModelError(ValueError):
    """A model is refused; the text names the file, the key, what is wrong and what to do."""

    def __init__(self, key: str, sentence: str, source: str = "model") -> None:
        self.key = key
        self.sentence = sentence
        super().__init__(f"{source}: {key}: {sentence}" if key else f"{source}: {sentence}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TestVector:
    """Input and output of the model when it was fitted; checked again whenever it is loaded."""

    __test__ = False

    degc: FloatArray
    """Temperatures [degC], shape (n_sensors,)."""
    reference_degc: FloatArray
    elapsed_min: float
    thermal_error_um: FloatArray
    """What the model must give [um], shape (n_channels,)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingData:
    """What one recording contributed to a model."""

    name: str
    sha256: str
    """Of the times, names and values that were used."""
    from_hours: float
    to_hours: float
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThermalModel:
    """A linear thermal model in the telescoped form.

    Raises
    ------
    ModelError
        When shapes, names or numbers do not fit together, or a test vector is not met.

    """

    model_id: str
    kind: str
    """How it was fitted: one of `KINDS`."""
    channels: tuple[str, ...]
    """Displacement channels that it estimates."""
    sensor_ids: tuple[int, ...]
    """Sensor IDs of the machine, in the order of the coefficients."""
    sensor_names: tuple[str, ...]
    """Column names of the same sensors in the training data."""
    coefficients_um_per_k: FloatArray
    """b [um/K], shape (n_channels, n_sensors)."""
    drift_um_per_min: FloatArray
    """b_0 [um/min], shape (n_channels,); zeros when it is off."""
    interval_min: float
    """Interval of the increments that it was fitted on [min]."""
    ridge_k2: float
    """Ridge penalty [K^2]; 0 is ordinary least squares."""
    lowest_increment_k: FloatArray
    """Lowest increment since any earlier instant seen in training [K], shape (n_sensors,)."""
    highest_increment_k: FloatArray
    band_um: FloatArray
    """Half width of the prediction band [um], shape (n_channels,); NaN where nothing was held out."""
    training: tuple[TrainingData, ...]
    created: str
    """Date and time of the fit, ISO 8601."""
    test_vectors: tuple[TestVector, ...]
    axis_positions: tuple[str, ...] = ()
    """The last of `sensor_names`, when they are axis positions [mm], which the running daemon does not read."""

    def __post_init__(self) -> None:
        _check_names(self)
        _check_arrays(self)
        _check_test_vectors(self)
        for array in (
            self.coefficients_um_per_k,
            self.drift_um_per_min,
            self.lowest_increment_k,
            self.highest_increment_k,
            self.band_um,
        ):
            array.flags.writeable = False


def check_identity(model_id: str, channels: tuple[str, ...], sensor_ids: tuple[int, ...]) -> None:
    """Refuse a model without a name, without channels or sensors, or with one of them twice; raises ModelError."""
    if not model_id.strip():
        raise ModelError("model_id", "is empty; history and audit need a name")
    named: tuple[tuple[str, tuple[str | int, ...]], ...] = (("channels", channels), ("sensor_ids", sensor_ids))
    for key, items in named:
        if not items:
            raise ModelError(key, "is empty; a model needs at least one")
        if twice := sorted({str(item) for item in items if items.count(item) > 1}):
            raise ModelError(key, f"{', '.join(twice)} appears twice")
    if min(sensor_ids) < 1:
        raise ModelError("sensor_ids", f"{min(sensor_ids)} is not a sensor ID; they count from 1")


def check_band(band_um: FloatArray) -> None:
    """Refuse a prediction band [um] that is no half width, shape (n_channels,); raises ModelError."""
    if not np.all(np.isnan(band_um) | (band_um >= 0.0)) or np.isinf(band_um).any():
        raise ModelError("band_um", "a band is not negative and finite, or null where nothing was held out")


def _check_names(model: ThermalModel) -> None:
    check_identity(model.model_id, model.channels, model.sensor_ids)
    if len(model.sensor_names) != len(model.sensor_ids):
        raise ModelError(
            "sensor_names", f"{len(model.sensor_names)} names for {len(model.sensor_ids)} sensors in sensor_ids"
        )
    if model.kind not in KINDS:
        raise ModelError("kind", f"{model.kind!r} is unknown; this version knows {', '.join(KINDS)}")


def _check_arrays(model: ThermalModel) -> None:
    channels, sensors = len(model.channels), len(model.sensor_ids)
    shapes: dict[str, tuple[int, ...]] = {
        "coefficients_um_per_k": (channels, sensors),
        "drift_um_per_min": (channels,),
        "lowest_increment_k": (sensors,),
        "highest_increment_k": (sensors,),
        "band_um": (channels,),
    }
    for key, shape in shapes.items():
        array = getattr(model, key)
        if array.shape != shape:
            raise ModelError(
                key, f"has shape {array.shape}, but {channels} channels and {sensors} sensors need {shape}"
            )
        if key != "band_um" and not np.isfinite(array).all():
            raise ModelError(key, "holds a number that is not finite")
    check_band(model.band_um)
    if not (np.isfinite(model.interval_min) and model.interval_min > 0.0):
        raise ModelError("interval_min", f"{model.interval_min} is not a positive time")
    if not (np.isfinite(model.ridge_k2) and model.ridge_k2 >= 0.0):
        raise ModelError("ridge_k2", f"{model.ridge_k2} is not a penalty")
    if np.any(model.lowest_increment_k > model.highest_increment_k):
        sensor = model.sensor_ids[int(np.argmax(model.lowest_increment_k > model.highest_increment_k))]
        raise ModelError("lowest_increment_k", f"sensor {sensor}: lies above highest_increment_k")


def _check_test_vectors(model: ThermalModel) -> None:
    if not model.test_vectors:
        raise ModelError("test_vectors", "is empty; without one nothing proves the evaluation")
    sensors, channels = len(model.sensor_ids), len(model.channels)
    for index, vector in enumerate(model.test_vectors):
        key = f"test_vectors[{index}]"
        shapes = (vector.degc.shape, vector.reference_degc.shape, vector.thermal_error_um.shape)
        if shapes != ((sensors,), (sensors,), (channels,)):
            raise ModelError(key, f"has shapes {shapes}; {sensors} sensors and {channels} channels are needed")
        given = thermal_error_um(
            model.coefficients_um_per_k, model.drift_um_per_min, vector.degc - vector.reference_degc, vector.elapsed_min
        )
        differs = ~(np.abs(given - vector.thermal_error_um) <= TEST_TOLERANCE_UM)
        if differs.any():
            channel = int(np.argmax(differs))
            raise ModelError(
                key,
                f"channel {model.channels[channel]}: the model gives {given[channel]:.6g} um where "
                f"{vector.thermal_error_um[channel]:.6g} um were written down; train it again",
            )


def make_test_vectors(
    coefficients_um_per_k: FloatArray, drift_um_per_min: FloatArray, pairs: tuple[tuple[FloatArray, FloatArray], ...]
) -> tuple[TestVector, ...]:
    """Return test vectors for pairs of (temperatures now, at the reference) [degC], 1, 2 .. hours apart."""
    vectors = []
    for hours, (degc, reference_degc) in enumerate(pairs, start=1):
        elapsed_min = 60.0 * hours
        error = thermal_error_um(coefficients_um_per_k, drift_um_per_min, degc - reference_degc, elapsed_min)
        vectors.append(
            TestVector(degc=degc, reference_degc=reference_degc, elapsed_min=elapsed_min, thermal_error_um=error)
        )
    return tuple(vectors)


def thermal_error_um(
    coefficients_um_per_k: FloatArray,
    drift_um_per_min: FloatArray,
    increment_k: FloatArray,
    elapsed_min: float | FloatArray,
) -> FloatArray:
    """Return the thermal error since the reference.

    Parameters
    ----------
    coefficients_um_per_k : shape (n_channels, n_sensors)
        b [um/K].
    drift_um_per_min : shape (n_channels,)
        b_0 per minute [um/min].
    increment_k : shape (n_sensors,) or (n, n_sensors)
        Temperatures now minus at the reference [K].
    elapsed_min : scalar or shape (n,)
        Time since the reference [min].

    Returns
    -------
    numpy.ndarray, shape (n_channels,) or (n, n_channels)
        Actual minus nominal [um].

    """
    drift_um = np.multiply.outer(np.asarray(elapsed_min), drift_um_per_min)
    error: FloatArray = increment_k @ coefficients_um_per_k.T + drift_um
    return error
