"""Fits a family of models to recordings and makes the model that the daemon loads."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import usable_recordings
from models.records import FloatArray
from models.thermal.lagged_model import FeatureTestVector, LaggedModel
from models.thermal.layout import BoolArray, RidgeSolution
from models.thermal.model import ThermalModel, TrainingData, make_test_vectors
from models.thermal.training.domain import farthest_leverage
from models.thermal.training.families import Fit, HyperParameters
from models.thermal.training.inputs import Inputs, build_inputs, unusable_sensors, with_sensors
from models.thermal.training.prepared import prepare
from models.thermal.training.train import increment_range_k, sensor_ids_from_names, training_data
from models.thermal.training.trust import Trust, judge
from models.thermal.training.watch_fit import fit_watch
from models.thermal.watch import SensorWatch

MOST_WATCHED = 400
"""A model of more sensors than this does not carry the watch: its file grows with their square.

Nor does one with axis positions, which the running daemon does not read.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FamilyTraining:
    """A model of a family, and what training says about it."""

    model: LaggedModel | ThermalModel
    trust: Trust
    hyper_parameters: HyperParameters
    left_out: dict[str, str]
    """Temperatures that the model does not use, and why."""
    folds: str
    """What was left out in turn: `run`, `cycle` or `block`."""
    warnings: tuple[str, ...]


def train_family(
    recordings: Sequence[Recording],
    family: str,
    *,
    sample_s: float,
    created: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FamilyTraining:
    """Fit a family of models on recordings.

    Parameters
    ----------
    recordings
        Each a run of its own.
    family
        A key of `FAMILIES`.
    sample_s
        They are averaged to this time between rows [s].
    created
        Date and time for the model, ISO 8601.
    progress
        Called with (done, total) steps.

    Returns
    -------
    FamilyTraining
        A `LaggedModel` for families with lags, else a `ThermalModel`.

    Raises
    ------
    DatasetError
        When the recordings do not fit together or cannot support the model.

    """
    recordings, warnings = usable_recordings(recordings)
    plain = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    left_out = unusable_sensors(plain, np.ones(plain.rows, dtype=np.bool_))
    kept = [name for name in plain.sensor_names if name not in left_out]
    if not kept:
        raise DatasetError("no temperature can be used; every one is constant or mostly missing")
    used = [with_sensors(recording, kept) for recording in recordings]
    prepared = prepare(used, sample_s, family)
    inputs, rows, fold, problem = prepared.inputs, prepared.rows, prepared.fold, prepared.problem
    progress(1, 4)
    fit = problem.fit()
    progress(2, 4)
    trust = judge(inputs, rows, fold, problem)
    progress(3, 4)
    fitted = _Fitted(
        family=family,
        created=created,
        inputs=inputs,
        rows=rows,
        fit=fit,
        trust=trust,
        training=tuple(training_data(recording) for recording in used),
        sensor_ids=_ids(recordings[0].temperature_names, kept),
    )
    model: LaggedModel | ThermalModel
    if fit.solutions and inputs.layout.lags_min:
        watched = inputs.layout.sensors <= MOST_WATCHED and not inputs.axis_positions
        watch = fit_watch(used, sample_s, rows, fold) if watched else None
        model = _lagged_model(fitted, problem.hyper_parameters, watch)
    else:
        model = _plain_model(fitted, increment_range_k([recording.downsampled(sample_s) for recording in used]))
    progress(4, 4)
    return FamilyTraining(
        model=model,
        trust=trust,
        hyper_parameters=problem.hyper_parameters,
        left_out=left_out,
        folds=prepared.folds,
        warnings=warnings,
    )


def _ids(all_names: Sequence[str], kept: Sequence[str]) -> tuple[int, ...]:
    """Return the IDs that the kept sensors have among all columns of the recording."""
    by_name = dict(zip(all_names, sensor_ids_from_names(all_names), strict=True))
    return tuple(by_name[name] for name in kept)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fitted:
    """What both kinds of model are made of."""

    family: str
    created: str
    inputs: Inputs
    rows: BoolArray
    fit: Fit
    trust: Trust
    training: tuple[TrainingData, ...]
    sensor_ids: tuple[int, ...]

    @property
    def proof_rows(self) -> tuple[int, int, int]:
        """Return the first, the middle and the last training row, of which test vectors are made."""
        chosen = np.flatnonzero(self.rows)
        return int(chosen[0]), int(chosen[len(chosen) // 2]), int(chosen[-1])


def _lagged_model(fitted: _Fitted, hyper_parameters: HyperParameters, watch: SensorWatch | None) -> LaggedModel:
    inputs, rows, fit = fitted.inputs, fitted.rows, fitted.fit
    features = inputs.features
    centre = features[rows].mean(axis=0)
    first, *others = fitted.proof_rows
    speed_rpm = inputs.speed_rpm if inputs.speed_rpm is not None else np.zeros(inputs.rows)
    return LaggedModel(
        model_id=f"{fitted.family}-{_digest(fit.coefficients)[:8]}",
        kind=fitted.family,
        channels=inputs.channels,
        sensor_ids=fitted.sensor_ids,
        sensor_names=inputs.sensor_names,
        layout=inputs.layout,
        speed_scale_rpm=inputs.speed_scale_rpm,
        period_min=inputs.period_min,
        ridges=tuple(_in_single_precision(solution) for solution in fit.solutions),
        centre=centre,
        leverage_limit=farthest_leverage(inputs, rows, fit.solutions),
        lowest_degc=inputs.degc[rows].min(axis=0),
        highest_degc=inputs.degc[rows].max(axis=0),
        highest_speed_rpm=float(np.abs(speed_rpm[rows]).max()),
        band_um=fitted.trust.band_um.copy(),
        watch=None if watch is None else replace(watch, precision=_single(watch.precision)),
        hyper_parameters=hyper_parameters,
        refused=fitted.trust.refused,
        training=fitted.training,
        created=fitted.created,
        axis_positions=inputs.axis_positions,
        test_vectors=tuple(
            FeatureTestVector(
                features=features[row].copy(),
                reference=features[first].copy(),
                thermal_error_um=(features[row] - features[first]) @ fit.coefficients,
            )
            for row in others
        ),
    )


def _in_single_precision(solution: RidgeSolution) -> RidgeSolution:
    """Return the ridge with the directions that its file holds; they only serve to leave sensors out."""
    return replace(solution, directions=_single(solution.directions))


def _single(matrix: FloatArray) -> FloatArray:
    """Return a matrix rounded to single precision, as the file holds it."""
    return matrix.astype(np.float32).astype(np.float64)


def _plain_model(fitted: _Fitted, range_k: tuple[FloatArray, FloatArray]) -> ThermalModel:
    inputs, fit = fitted.inputs, fitted.fit
    coefficients = np.ascontiguousarray(fit.coefficients.T)
    first, *others = fitted.proof_rows
    pairs = tuple((inputs.degc[row].copy(), inputs.degc[first].copy()) for row in others)
    return ThermalModel(
        model_id=f"{fitted.family}-{_digest(coefficients, fit.drift_um_per_min)[:8]}",
        kind="increments" if fitted.family.startswith("increments") else fitted.family,
        channels=inputs.channels,
        sensor_ids=fitted.sensor_ids,
        sensor_names=inputs.sensor_names,
        coefficients_um_per_k=coefficients,
        drift_um_per_min=fit.drift_um_per_min.copy(),
        interval_min=inputs.period_min,
        ridge_k2=0.0,
        lowest_increment_k=range_k[0],
        highest_increment_k=range_k[1],
        band_um=fitted.trust.band_um.copy(),
        training=fitted.training,
        created=fitted.created,
        axis_positions=inputs.axis_positions,
        test_vectors=make_test_vectors(coefficients, fit.drift_um_per_min, pairs),
    )


def _digest(*arrays: FloatArray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()
