"""Makes the model that the daemon loads from what was fitted."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.bias import Wander
from models.thermal.features import BoolArray, Design, Layout, speed_inputs
from models.thermal.gaussian import GaussianModel
from models.thermal.linear import LinearModel
from models.thermal.model import MEAN_S, Domain, HyperParameters, TestVector, TrainingData
from models.thermal.sensor_watch import SensorWatch
from models.thermal.solution import Solution
from models.thermal.start import StartDeviation
from models.thermal.training.domain import farthest_leverage
from models.thermal.training.families import Fit
from models.thermal.training.inputs import Inputs
from models.thermal.training.trust import Trust

FEWEST_BEGINNINGS = 3
"""With fewer runs it is not known how differently the machine begins."""


def fit_start(inputs: Inputs, rows: BoolArray, coefficients: FloatArray) -> StartDeviation:
    """Return what training says of lags that begin at equilibrium, those of the watch of the sensors too.

    `inputs`, `rows`: training rows. `coefficients`, shape (layout.columns, n_channels): of a model that is linear in
    the features, or nearly so [um per unit of the feature].
    """
    layout, features, sensors = inputs.layout, inputs.features[rows], inputs.layout.sensors
    degc, added = features[:, :sensors], []
    for first in range(sensors, layout.temperature_columns, sensors):
        added.append((features[:, first : first + sensors] - degc) @ coefficients[first : first + sensors])
    if layout.speed_lags_min:
        assert inputs.speed_rpm is not None
        speed = speed_inputs(inputs.speed_rpm[rows], inputs.speed_scale_rpm)
        for first in range(layout.temperature_columns, layout.columns, 2):
            added.append((features[:, first : first + 2] - speed) @ coefficients[first : first + 2])
    table = np.stack(added) if added else np.zeros((0, len(features), len(inputs.channels)))  # lag, row, channel
    moments = np.einsum("lnc,mnc->clm", table, table) / max(table.shape[1], 1)
    pattern = degc - degc.mean(axis=1, keepdims=True)
    run = inputs.run[rows]
    begins = np.flatnonzero(np.concatenate([[True], np.diff(run) != 0]))
    rest = pattern[begins].mean(axis=0)
    return StartDeviation(
        covariance_um2=moments.reshape(len(added) * len(inputs.channels), len(added)),
        signal_um=_signal_um(inputs, rows),
        rest_degc=rest,
        spread_k=float(np.sqrt(np.mean(np.square(pattern - rest)))),
        begun_k=float(np.std(pattern[begins] - rest, axis=1).max()) if len(begins) >= FEWEST_BEGINNINGS else 0.0,
    )


def _signal_um(inputs: Inputs, rows: BoolArray) -> FloatArray:
    """Return the root mean square thermal error between two instants of a run [um], shape (n_channels,)."""
    total, count = np.zeros(len(inputs.channels)), 0
    for run in np.unique(inputs.run[rows]):
        measured = inputs.cleansed_um[rows & (inputs.run == run)]
        total += 2.0 * np.square(measured - measured.mean(axis=0)).sum(axis=0)
        count += len(measured)
    return np.asarray(np.sqrt(total / max(count, 1)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fitted:
    """What a model is made of."""

    name: str
    kind: str
    created: str
    inputs: Inputs
    rows: BoolArray
    """Training rows, shape (n,)."""
    fit: Fit
    trust: Trust
    hyper_parameters: HyperParameters
    training: tuple[TrainingData, ...]
    sensor_ids: tuple[int, ...]
    increments_k: tuple[FloatArray, FloatArray]
    """Lowest and highest increment of each sensor since any earlier instant [K], shape (n_sensors,)."""
    pivots_mm: dict[str, float]
    """Channels that are slopes, and where each adds nothing [mm]."""
    of_rises: bool
    """It was fitted on rises since the start: what temperatures the machine has is not known."""
    watch: SensorWatch | None
    """Of its sensors, where the recipe works on lags, or found that they are not worth it."""

    @property
    def proof_rows(self) -> tuple[int, int, int]:
        """Return the first, the middle and the last training row, of which test vectors are made."""
        used = np.flatnonzero(self.rows)
        return int(used[0]), int(used[len(used) // 2]), int(used[-1])


def make_linear_model(fitted: Fitted) -> LinearModel:
    """Return the model of a fit: with its ridges, and what bends, or telescoped where nothing but ridges is in it."""
    inputs, fit, trust = fitted.inputs, fitted.fit, fitted.trust
    lagged = bool(inputs.layout.lags_min or inputs.layout.speed_lags_min)
    if not (fit.solutions and (lagged or fit.mixture is not None or fitted.watch is not None)):
        return _telescoped(fitted)
    features, rows = inputs.features, fitted.rows
    first, *others = fitted.proof_rows
    speed_rpm = inputs.speed_rpm if inputs.speed_rpm is not None else np.zeros(inputs.rows)
    make = LinearModel if fit.mixture is None else partial(GaussianModel, mixture=fit.mixture)
    return make(
        model_id=f"{fitted.name}-{digest(fit.coefficients)[:8]}",
        kind=fitted.kind,
        channels=inputs.channels,
        sensor_ids=fitted.sensor_ids,
        sensor_names=inputs.sensor_names,
        layout=inputs.layout,
        speed_scale_rpm=inputs.speed_scale_rpm,
        period_min=inputs.period_min,
        solutions=tuple(in_single_precision(solution) for solution in fit.solutions),
        drift_um_per_min=fit.drift_um_per_min.copy(),
        centre=features.mean(axis=0, where=rows[:, None]),
        domain=Domain(
            of_increments=fitted.of_rises,
            lowest=fitted.increments_k[0] if fitted.of_rises else inputs.degc[rows].min(axis=0),
            highest=fitted.increments_k[1] if fitted.of_rises else inputs.degc[rows].max(axis=0),
            highest_speed_rpm=float(np.abs(speed_rpm[rows]).max()),
            leverage_limit=farthest_leverage(inputs, rows, fit.solutions),
        ),
        band_um=trust.band_um.copy(),
        probing=_wander(trust),
        watch=None if fitted.watch is None else replace(fitted.watch, precision=_single(fitted.watch.precision)),
        hyper_parameters=fitted.hyper_parameters | _means(inputs),
        refused=trust.refused,
        training=fitted.training,
        created=fitted.created,
        axis_positions=inputs.axis_positions,
        pivots_mm=fitted.pivots_mm,
        start=fit_start(inputs, rows, fit.coefficients),
        test_vectors=tuple(
            TestVector(
                features=features[row].copy(),
                reference=features[first].copy(),
                elapsed_min=0.0,
                thermal_error_um=fit.estimate_um(features[row], features[first], 0.0),
            )
            for row in others
        ),
    )


def _means(inputs: Inputs) -> HyperParameters:
    """Return over how long its inputs must be means, where that is not the time between rows."""
    return {MEAN_S: inputs.mean_s} if inputs.mean_s < 60.0 * inputs.period_min - 1e-6 else {}


def _wander(trust: Trust) -> Wander | None:
    found = trust.bias_filter
    if found is None or found.correlation_min is None:
        return None
    return Wander(um2_per_min=found.wander_um2_per_min.copy(), correlation_min=found.correlation_min.copy())


def _telescoped(fitted: Fitted) -> LinearModel:
    inputs, fit = fitted.inputs, fitted.fit
    coefficients = np.ascontiguousarray(fit.coefficients.T)
    first, *others = fitted.proof_rows
    return increment_model(
        model_id=f"{fitted.name}-{digest(coefficients, fit.drift_um_per_min)[:8]}",
        kind=fitted.kind,
        channels=inputs.channels,
        sensor_ids=fitted.sensor_ids,
        sensor_names=inputs.sensor_names,
        coefficients_um_per_k=coefficients,
        drift_um_per_min=fit.drift_um_per_min.copy(),
        lowest_increment_k=fitted.increments_k[0],
        highest_increment_k=fitted.increments_k[1],
        band_um=fitted.trust.band_um.copy(),
        probing=_wander(fitted.trust),
        training=fitted.training,
        created=fitted.created,
        test_pairs=[(inputs.degc[row].copy(), inputs.degc[first].copy()) for row in others],
        hyper_parameters=fitted.hyper_parameters,
        period_min=inputs.period_min,
        refused=fitted.trust.refused,
        axis_positions=inputs.axis_positions,
        pivots_mm=fitted.pivots_mm,
    )


def increment_model(
    *,
    model_id: str,
    kind: str,
    channels: tuple[str, ...],
    sensor_ids: tuple[int, ...],
    sensor_names: tuple[str, ...],
    coefficients_um_per_k: FloatArray,
    drift_um_per_min: FloatArray,
    lowest_increment_k: FloatArray,
    highest_increment_k: FloatArray,
    band_um: FloatArray,
    training: tuple[TrainingData, ...],
    created: str,
    test_pairs: Sequence[tuple[FloatArray, FloatArray]],
    hyper_parameters: HyperParameters | None = None,
    period_min: float = 1.0,
    refused: str | None = None,
    axis_positions: tuple[str, ...] = (),
    probing: Wander | None = None,
    pivots_mm: dict[str, float] | None = None,
) -> LinearModel:
    """Return the telescoped model of increments since the reference: a linear model without lags.

    Parameters
    ----------
    coefficients_um_per_k : shape (n_channels, n_sensors)
        b [um/K].
    drift_um_per_min : shape (n_channels,)
        b_0 [um/min].
    lowest_increment_k, highest_increment_k : shape (n_sensors,)
        Range of increments since any earlier instant of training [K].
    test_pairs
        Temperatures now and at the reference [degC], of which test vectors are made, 1, 2 .. hours apart.
    model_id, kind, channels, sensor_ids, sensor_names, band_um, training, created, hyper_parameters, period_min, \
refused, axis_positions, pivots_mm
        See `LinearParameters`.

    """
    layout = Layout(sensors=len(sensor_ids), lags_min=(), speed_lags_min=())
    weights = np.ascontiguousarray(coefficients_um_per_k.T)
    return LinearModel(
        model_id=model_id,
        kind=kind,
        channels=channels,
        sensor_ids=sensor_ids,
        sensor_names=sensor_names,
        layout=layout,
        speed_scale_rpm=1.0,
        period_min=period_min,
        solutions=(
            Solution(
                layout=layout,
                design=Design(departures=False),
                gain=np.ones(layout.columns),
                weights=weights,
            ),
        ),
        drift_um_per_min=drift_um_per_min,
        centre=np.zeros(layout.columns),
        domain=Domain(of_increments=True, lowest=lowest_increment_k, highest=highest_increment_k),
        band_um=band_um,
        watch=None,
        hyper_parameters=hyper_parameters or {},
        refused=refused,
        training=training,
        created=created,
        test_vectors=tuple(
            TestVector(
                features=now,
                reference=then,
                elapsed_min=60.0 * hours,
                thermal_error_um=(now - then) @ weights + 60.0 * hours * drift_um_per_min,
            )
            for hours, (now, then) in enumerate(test_pairs, start=1)
        ),
        axis_positions=axis_positions,
        pivots_mm=pivots_mm or {},
    )


def in_single_precision(solution: Solution) -> Solution:
    """Return the ridge with the directions that its file holds; they only serve to leave sensors out."""
    assert solution.directions is not None
    return replace(solution, directions=_single(solution.directions))


def _single(matrix: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
    """Return a matrix rounded to single precision, as the file holds it."""
    return matrix.astype(np.float32)


FIRST_POSITION_ID = 1_000_001
"""Axis positions have IDs from here on, which are no sensor's."""


def sensor_ids_from_names(names: Sequence[str], axis_positions: Sequence[str] = ()) -> tuple[int, ...]:
    """Return the machine's sensor IDs: the number where every column is T<number> or <number>, else 1, 2 .. in order.

    The last of the names may be axis positions, which have IDs of their own.
    """
    if axis_positions:
        of_sensors = sensor_ids_from_names(names[: len(names) - len(axis_positions)])
        return (*of_sensors, *range(FIRST_POSITION_ID, FIRST_POSITION_ID + len(axis_positions)))
    texts = [name[1:] if name[:1] in {"t", "T"} else name for name in names]
    numbers = [int(text) for text in texts if text.isascii() and text.isdigit()]
    if len(numbers) == len(names) == len(set(numbers)) and min(numbers, default=1) >= 1:
        return tuple(numbers)
    return tuple(range(1, len(names) + 1))


def increment_range_k(recordings: Sequence[Recording]) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest increment of each sensor since any earlier row of its recording [K]."""
    lowest, highest = [], []
    for recording in recordings:
        temperatures = recording.temperatures_degc
        lowest.append(np.fmin.reduce(temperatures - np.fmax.accumulate(temperatures, axis=0), axis=0))
        highest.append(np.fmax.reduce(temperatures - np.fmin.accumulate(temperatures, axis=0), axis=0))
    return np.asarray(np.fmin.reduce(lowest, axis=0)), np.asarray(np.fmax.reduce(highest, axis=0))


def training_data(recording: Recording) -> TrainingData:
    """Return what a recording contributes to a model: its name, checksum and extent."""
    names = "\n".join((*recording.temperature_names, *recording.displacement_names)).encode()
    arrays = [recording.time_s, recording.temperatures_degc, recording.displacements_um]
    return TrainingData(
        name=recording.name,
        sha256=hashlib.sha256(names + bytes.fromhex(digest(*arrays))).hexdigest(),
        from_hours=float(recording.time_s[0] / 3600.0),
        to_hours=float(recording.time_s[-1] / 3600.0),
        rows=recording.rows,
    )


def digest(*arrays: FloatArray) -> str:
    """Return a checksum of numbers, the same on every computer."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return found.hexdigest()
