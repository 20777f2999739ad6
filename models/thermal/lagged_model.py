"""A fitted model with lags, as the daemon loads it: it proves itself whenever it is made."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray
from models.thermal.layout import Layout, RidgeSolution
from models.thermal.model import TEST_TOLERANCE_UM, ModelError, TrainingData, check_band, check_identity
from models.thermal.watch import SensorWatch


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureTestVector:
    """Features and what the model made of them when it was fitted; checked again whenever it is loaded."""

    features: FloatArray
    """Temperatures, lags and lagged speed, shape (layout.columns,)."""
    reference: FloatArray
    """The same at the reference."""
    thermal_error_um: FloatArray
    """What the model must give [um], shape (n_channels,)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaggedModel:
    """The mean of ridges on temperatures, their first-order lags and lagged spindle speed.

    Raises
    ------
    ModelError
        When shapes, names or numbers do not fit together, or a test vector is not met.

    """

    model_id: str
    kind: str
    """Name of the family: `default`."""
    channels: tuple[str, ...]
    sensor_ids: tuple[int, ...]
    """Sensor IDs of the machine, in the order of the columns."""
    sensor_names: tuple[str, ...]
    layout: Layout
    speed_scale_rpm: float
    """Speed that stands for 1 in the features [1/min]."""
    period_min: float
    """Time between the rows it was fitted on [min]: its input is filtered as theirs was."""
    ridges: tuple[RidgeSolution, ...]
    """Its thermal error is their mean; sensors can be left out of each."""
    centre: FloatArray
    """Mean of each feature in training, shape (layout.columns,)."""
    leverage_limit: float
    """Largest leverage of a change between two training rows, summed over the ridges; beyond it confidence fades."""
    lowest_degc: FloatArray
    """Lowest temperature seen in training [degC], shape (n_sensors,)."""
    highest_degc: FloatArray
    highest_speed_rpm: float
    """Highest spindle speed seen in training [1/min]; 0 without speed."""
    band_um: FloatArray
    """Half width of the prediction band inside the domain [um], shape (n_channels,); NaN where nothing was held out."""
    watch: SensorWatch | None
    """The watch of its sensors; None where there are too many to carry it."""
    hyper_parameters: dict[str, float | int | str | bool | list[float]]
    refused: str | None
    """Why the gate refuses it; None when it may be activated."""
    training: tuple[TrainingData, ...]
    created: str
    """Date and time of the fit, ISO 8601."""
    test_vectors: tuple[FeatureTestVector, ...]
    axis_positions: tuple[str, ...] = ()
    """The last of `sensor_names`, when they are axis positions [mm], which the running daemon does not read."""

    def __post_init__(self) -> None:
        _check_names(self)
        _check_arrays(self)
        _check_ridges(self)
        _check_watch(self)
        _check_test_vectors(self)

    def coefficients(self, without: tuple[int, ...] = ()) -> FloatArray:
        """Return [um per unit of the feature], fitted without some sensors (indices), shape (d, n_channels)."""
        return np.asarray(np.mean([ridge.coefficients(without) for ridge in self.ridges], axis=0))


def _check_names(model: LaggedModel) -> None:
    check_identity(model.model_id, model.channels, model.sensor_ids)
    for key, count in (("sensor_names", len(model.sensor_names)), ("layout.sensors", model.layout.sensors)):
        if count != len(model.sensor_ids):
            raise ModelError(key, f"{count} where sensor_ids has {len(model.sensor_ids)}")
    for key, constants in (("lags_min", model.layout.lags_min), ("speed_lags_min", model.layout.speed_lags_min)):
        if not all(0.0 < constant < np.inf for constant in constants):
            raise ModelError(f"layout.{key}", "a time constant is positive and finite")


def _check_arrays(model: LaggedModel) -> None:
    sensors, columns = model.layout.sensors, model.layout.columns
    for key, shape in (
        ("centre", (columns,)),
        ("lowest_degc", (sensors,)),
        ("highest_degc", (sensors,)),
        ("band_um", (len(model.channels),)),
    ):
        array = getattr(model, key)
        if array.shape != shape:
            raise ModelError(key, f"has shape {array.shape}, but {shape} is needed")
        if key != "band_um" and not np.isfinite(array).all():
            raise ModelError(key, "holds a number that is not finite")
        array.flags.writeable = False
    check_band(model.band_um)
    if np.any(model.lowest_degc > model.highest_degc):
        sensor = model.sensor_ids[int(np.argmax(model.lowest_degc > model.highest_degc))]
        raise ModelError("lowest_degc", f"sensor {sensor}: lies above highest_degc")
    for key in ("speed_scale_rpm", "period_min", "leverage_limit"):
        if not 0.0 < getattr(model, key) < np.inf:
            raise ModelError(key, f"{getattr(model, key)} must be positive and finite")
    if not 0.0 <= model.highest_speed_rpm < np.inf:
        raise ModelError("highest_speed_rpm", f"{model.highest_speed_rpm} is not a speed")


def _check_ridges(model: LaggedModel) -> None:
    if not model.ridges:
        raise ModelError("ridges", "is empty; a model needs at least one")
    columns, channels = model.layout.columns, len(model.channels)
    for index, ridge in enumerate(model.ridges):
        directions = ridge.directions.shape[1] if ridge.directions.ndim == 2 else -1
        shapes = (ridge.gain.shape, ridge.weights.shape, ridge.directions.shape, ridge.remaining.shape)
        if shapes != ((columns,), (columns, channels), (columns, directions), (directions,)):
            raise ModelError(
                f"ridges[{index}]", f"has shapes {shapes}; {columns} columns, {channels} channels are needed"
            )
        for array in (ridge.gain, ridge.weights, ridge.directions, ridge.remaining):
            if not np.isfinite(array).all():
                raise ModelError(f"ridges[{index}]", "holds a number that is not finite")
            array.flags.writeable = False
        if np.any(ridge.gain < 0.0) or np.any(ridge.remaining < 0.0) or np.any(ridge.remaining > 1.0):
            raise ModelError(f"ridges[{index}]", "a gain is not negative, and a remaining share lies between 0 and 1")


def _check_watch(model: LaggedModel) -> None:
    watch = model.watch
    if watch is None:
        return
    sensors, columns = model.layout.sensors, watch.layout.columns
    shapes = {
        "centre": (columns,),
        "gain": (columns,),
        "precision": (columns, columns),
        "threshold_k": (sensors,),
        "slew_k_per_min": (sensors,),
        "flat_min": (sensors,),
    }
    if watch.layout.sensors != sensors:
        raise ModelError("watch.layout.sensors", f"{watch.layout.sensors} where the model has {sensors}")
    for key, shape in shapes.items():
        array = getattr(watch, key)
        if array.shape != shape or not np.isfinite(array).all():
            raise ModelError(f"watch.{key}", f"has shape {array.shape}; {shape} of finite numbers is needed")
        if key in ("threshold_k", "slew_k_per_min", "flat_min") and np.any(array <= 0.0):
            raise ModelError(f"watch.{key}", "a limit is positive")
        array.flags.writeable = False
    if not 0.0 < watch.speed_scale_rpm < np.inf:
        raise ModelError("watch.speed_scale_rpm", f"{watch.speed_scale_rpm} must be positive and finite")


def _check_test_vectors(model: LaggedModel) -> None:
    if not model.test_vectors:
        raise ModelError("test_vectors", "is empty; without one nothing proves the evaluation")
    columns, channels = model.layout.columns, len(model.channels)
    coefficients = model.coefficients()
    for index, vector in enumerate(model.test_vectors):
        key = f"test_vectors[{index}]"
        shapes = (vector.features.shape, vector.reference.shape, vector.thermal_error_um.shape)
        if shapes != ((columns,), (columns,), (channels,)):
            raise ModelError(key, f"has shapes {shapes}; {columns} columns and {channels} channels are needed")
        given = (vector.features - vector.reference) @ coefficients
        differs = ~(np.abs(given - vector.thermal_error_um) <= TEST_TOLERANCE_UM)
        if differs.any():
            channel = int(np.argmax(differs))
            raise ModelError(
                key,
                f"channel {model.channels[channel]}: the model gives {given[channel]:.6g} um where "
                f"{vector.thermal_error_um[channel]:.6g} um were written down; train it again",
            )
