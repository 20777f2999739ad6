"""The parts of a thermal model that is linear in its features; its test vectors are checked whenever it is made.

Features are temperatures, their first-order lags and lagged spindle speed. The model of increments since a
reference, telescoped, is the one without lags.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from models.model_file import ModelError, Numbers
from models.records import FloatArray
from models.thermal.bias import Wander
from models.thermal.features import IntArray, Layout
from models.thermal.sensor_watch import SensorWatch
from models.thermal.solution import Solution
from models.thermal.start import StartDeviation

CHANNEL_SCORES = "held_out_relative_rmse_by_channel"
"""Hyper-parameter: RMSE with / without the model on what was left out, of each channel in the model's order."""
MEAN_S = "mean_s"
"""Hyper-parameter: time over which its inputs must be means [s], where rows lie farther apart than that."""
MACHINE = "machine"
"""Hyper-parameter: name of the machine whose recordings it was trained on, where they name one alone."""
READS = "reads"
"""Hyper-parameter: what its sensors read when the history was written that it was trained on, if that is known."""
HyperParameters = dict[str, float | int | str | bool | list[float]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TestVector:
    """Features and what the model made of them when it was fitted; checked again whenever it is loaded."""

    __test__ = False

    features: Numbers
    """Temperatures [degC], lags and lagged speed, shape (layout.columns,)."""
    reference: Numbers
    """The same at the reference."""
    elapsed_min: float
    """Time since the reference [min]."""
    thermal_error_um: Numbers
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
class Domain:
    """How far training went."""

    of_increments: bool
    """The range is one of increments since any earlier instant [K], not of temperatures [degC]."""
    lowest: Numbers
    """Lowest value seen in training [degC or K], shape (n_sensors,)."""
    highest: Numbers
    highest_speed_rpm: float = 0.0
    """Highest spindle speed seen in training [1/min]; 0 without speed."""
    leverage_limit: float | None = None
    """Largest leverage of a change between two training rows, summed over the ridges; beyond it confidence fades."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearParameters:
    """The mean of linear maps from the change of features since a reference to thermal error, and a drift.

    ``thermal_error_um = (features - features at the reference) @ coefficients + drift_um_per_min * elapsed_min``

    Raises ModelError when shapes, names or numbers do not fit together, or a test vector is not met.
    """

    test_tolerance_um: ClassVar[float] = 1e-6
    """Within what its test vectors are met [um]; summation order differs between computers."""
    model_id: str
    kind: str
    """How it was fitted: `default`, `increments`, `ridge` .."""
    channels: tuple[str, ...]
    """Displacement channels that it estimates."""
    sensor_ids: tuple[int, ...]
    """Sensor IDs of the machine, in the order of the columns."""
    sensor_names: tuple[str, ...]
    """Column names of the same sensors in the training data."""
    layout: Layout
    speed_scale_rpm: float
    """Speed that stands for 1 in the features [1/min]."""
    period_min: float
    """Time between the rows it was fitted on [min]."""
    solutions: tuple[Solution, ...]
    """Its thermal error is their mean; sensors can be left out of each."""
    drift_um_per_min: Numbers
    """b_0 [um/min], shape (n_channels,); zeros when there is none."""
    centre: Numbers
    """Mean of each feature in training, shape (layout.columns,); zeros where it is not known."""
    domain: Domain
    band_um: Numbers
    """Half width of the prediction band inside the domain [um], shape (n_channels,); NaN where nothing was held out."""
    watch: SensorWatch | None
    """The watch of its temperatures, which come before axis positions; None where it carries none."""
    hyper_parameters: HyperParameters
    refused: str | None
    """Why the gate refuses it; None when it may be activated."""
    training: tuple[TrainingData, ...]
    created: str
    """Date and time of the fit, ISO 8601."""
    test_vectors: tuple[TestVector, ...]
    axis_positions: tuple[str, ...] = ()
    """The last of `sensor_names`, when they are axis positions [mm], which the control must give."""
    pivots_mm: dict[str, float] = field(default_factory=dict)
    """Channels that are slopes along an axis, so that their unit is um/m, and where each adds nothing [mm]."""
    start: StartDeviation | None = None
    """How wrong it may be while the past is not known; None without lags, and in files of versions before."""
    probing: Wander | None = None
    """How what it misses wanders between probes, per channel; None where nothing was held out, and in files of versions
    before: every probe then resets the offset fully."""

    def __post_init__(self) -> None:
        _check_names(self)
        _check_solutions(self)
        _check_arrays(self)
        _check_test_vectors(self)

    @property
    def period_s(self) -> float | None:
        """Time over which its inputs must be means [s]; None where it does not matter, without lags."""
        if not (self.layout.lags_min or self.layout.speed_lags_min):
            return None
        mean_s = self.hyper_parameters.get(MEAN_S)
        return float(mean_s) if isinstance(mean_s, int | float) else self.period_min * 60.0

    @property
    def needs_speed(self) -> bool:
        """Whether it estimates from spindle speed, which the control must give."""
        return bool(self.layout.speed_lags_min)

    def coefficients(self, without: tuple[int, ...] = (), beside: IntArray | None = None) -> FloatArray:
        """Return [um per unit of the feature], fitted without some sensors (indices), shape (d, n_channels)."""
        return np.asarray(np.mean([one.coefficients(without, beside) for one in self.solutions], axis=0))

    @property
    def shares(self) -> FloatArray:
        """How much each of its solutions counts, shape (n_solutions,)."""
        return np.full(len(self.solutions), 1.0 / len(self.solutions))

    def thermal_error_um(self, change: FloatArray, elapsed_min: float | FloatArray) -> FloatArray:
        """Return the thermal error since the reference.

        Result of shape (n_channels,) or (n, n_channels): actual minus nominal [um].

        `change`, shape (d,) or (n, d): features minus features at the reference. `elapsed_min`, scalar or shape (n,):
        time since the reference [min].
        """
        drift_um = np.multiply.outer(np.asarray(elapsed_min), self.drift_um_per_min)
        return np.asarray(change @ self.coefficients() + drift_um)

    def error_since_um(
        self, features: FloatArray, reference: FloatArray, elapsed_min: float | FloatArray
    ) -> FloatArray:
        """Return the thermal error since the reference [um], shape (n_channels,) or (n, n_channels).

        `features`, shape (d,) or (n, d), and `reference`, shape (d,): features now and at the reference. `elapsed_min`:
        see `thermal_error_um`.
        """
        return self.thermal_error_um(features - reference, elapsed_min)


def _check_names(model: LinearParameters) -> None:
    if not model.model_id.strip():
        raise ModelError("model_id", "is empty; history and audit need a name")
    named: tuple[tuple[str, tuple[str | int, ...]], ...] = (
        ("channels", model.channels),
        ("sensor_ids", model.sensor_ids),
    )
    for key, items in named:
        if not items:
            raise ModelError(key, "is empty; a model needs at least one")
        if twice := sorted({str(item) for item in items if items.count(item) > 1}):
            raise ModelError(key, f"{', '.join(twice)} appears twice")
    if strange := sorted(set(model.pivots_mm) - set(model.channels)):
        raise ModelError("pivots_mm", f"{strange[0]} is no channel")
    if not np.isfinite(list(model.pivots_mm.values())).all():
        raise ModelError("pivots_mm", "holds a number that is not finite")
    if min(model.sensor_ids) < 1:
        raise ModelError("sensor_ids", f"{min(model.sensor_ids)} is not a sensor ID; they count from 1")
    for key, count in (("sensor_names", len(model.sensor_names)), ("layout.sensors", model.layout.sensors)):
        if count != len(model.sensor_ids):
            raise ModelError(key, f"{count} for {len(model.sensor_ids)} sensors in sensor_ids")
    for key, constants in (("lags_min", model.layout.lags_min), ("speed_lags_min", model.layout.speed_lags_min)):
        if not all(0.0 < constant < np.inf for constant in constants):
            raise ModelError(f"layout.{key}", "a time constant is positive and finite")


def _check_solutions(model: LinearParameters) -> None:
    if not model.solutions:
        raise ModelError("solutions", "is empty; a model needs at least one")
    for one in model.solutions:
        if one.layout != model.layout or one.weights.shape[1] != len(model.channels):
            raise ModelError("solutions", f"has shape {one.weights.shape}, or another layout than the model")
    temperatures = model.layout.sensors - len(model.axis_positions)
    if model.watch is not None and model.watch.layout.sensors != temperatures:
        raise ModelError("watch.layout.sensors", f"{model.watch.layout.sensors} where the model has {temperatures}")
    if (start := model.start) is not None:
        lags = len(model.layout.lags_min) + len(model.layout.speed_lags_min)
        if (start.covariance_um2.shape[-1], len(start.rest_degc)) != (lags, model.layout.sensors):
            raise ModelError("start.covariance_um2", f"is not of {lags} lags and {model.layout.sensors} sensors")
        if len(start.signal_um) != len(model.channels):
            raise ModelError("start.signal_um", f"holds {len(start.signal_um)} for {len(model.channels)} channels")


def _check_arrays(model: LinearParameters) -> None:
    sensors, columns, channels = model.layout.sensors, model.layout.columns, len(model.channels)
    domain = model.domain
    for key, array, shape in (
        ("drift_um_per_min", model.drift_um_per_min, (channels,)),
        ("centre", model.centre, (columns,)),
        ("domain.lowest", domain.lowest, (sensors,)),
        ("domain.highest", domain.highest, (sensors,)),
        ("band_um", model.band_um, (channels,)),
    ):
        if array.shape != shape:
            raise ModelError(key, f"has shape {array.shape}, but {shape} is needed")
        if key != "band_um" and not np.isfinite(array).all():
            raise ModelError(key, "holds a number that is not finite")
        array.flags.writeable = False
    if model.probing is not None and model.probing.um2_per_min.shape != (channels,):
        raise ModelError("probing", f"has shape {model.probing.um2_per_min.shape}, but {(channels,)} is needed")
    if not np.all(np.isnan(model.band_um) | (model.band_um >= 0.0)) or np.isinf(model.band_um).any():
        raise ModelError("band_um", "a band is not negative and finite, or null where nothing was held out")
    if np.any(domain.lowest > domain.highest):
        sensor = model.sensor_ids[int(np.argmax(domain.lowest > domain.highest))]
        raise ModelError("domain.lowest", f"sensor {sensor}: lies above domain.highest")
    limit = 1.0 if domain.leverage_limit is None else domain.leverage_limit
    for key, value in (
        ("speed_scale_rpm", model.speed_scale_rpm),
        ("period_min", model.period_min),
        ("domain.leverage_limit", limit),
    ):
        if not 0.0 < value < np.inf:
            raise ModelError(key, f"{value} must be positive and finite")
    if not 0.0 <= domain.highest_speed_rpm < np.inf:
        raise ModelError("domain.highest_speed_rpm", f"{domain.highest_speed_rpm} is not a speed")


def _check_test_vectors(model: LinearParameters) -> None:
    if not model.test_vectors:
        raise ModelError("test_vectors", "is empty; without one nothing proves the evaluation")
    columns, channels = model.layout.columns, len(model.channels)
    for index, vector in enumerate(model.test_vectors):
        key = f"test_vectors[{index}]"
        shapes = (vector.features.shape, vector.reference.shape, vector.thermal_error_um.shape)
        if shapes != ((columns,), (columns,), (channels,)):
            raise ModelError(key, f"has shapes {shapes}; {columns} columns and {channels} channels are needed")
        given = model.error_since_um(vector.features, vector.reference, vector.elapsed_min)
        differs = ~(np.abs(given - vector.thermal_error_um) <= model.test_tolerance_um)
        if differs.any():
            channel = int(np.argmax(differs))
            raise ModelError(
                key,
                f"channel {model.channels[channel]}: the model gives {given[channel]:.6g} um where "
                f"{vector.thermal_error_um[channel]:.6g} um were written down; train it again",
            )
