"""Fits a recipe to recordings and makes the model that the daemon loads."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from models.recordings.dataset import Recording
from models.recordings.findings import usable_recordings
from models.recordings.plausibility import are_rises
from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.features import BoolArray, IntArray
from models.thermal.model import CHANNEL_SCORES, MACHINE, HyperParameters, TrainingData
from models.thermal.sensor_watch import SensorWatch
from models.thermal.training.advice import indistinct, whole_runs, worse_channels
from models.thermal.training.choice import Choice, ChosenProblem
from models.thermal.training.families import Fit, fold_numbers
from models.thermal.training.inputs import Inputs, temperatures_alone, with_sensors
from models.thermal.training.left_out_sensors import left_out_sensors
from models.thermal.training.making import Fitted, increment_range_k, sensor_ids_from_names, training_data
from models.thermal.training.prepared import Prepared, prepare
from models.thermal.training.recipes import RECIPES, Recipe
from models.thermal.training.regimes import change_of_regime, contradictions, sentences
from models.thermal.training.trust import Trust, independent_folds, judge
from models.thermal.training.watch_fit import fit_watch

MOST_WATCHED = 400
"""A model of more sensors than this does not carry the watch: its file grows with their square."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FamilyTraining:
    """A model, and what training says about it."""

    model: ThermalModel
    trust: Trust
    hyper_parameters: HyperParameters
    left_out: dict[str, str]
    """Temperatures that the model does not use, and why."""
    folds: str
    """What was left out in turn: `run`, `cycle` or `block`."""
    fold_names: tuple[str, ...]
    """Names of what was left out in turn; empty where nothing could be."""
    counts: Mapping[str, int]
    """Of what it was fitted on, see `Fit.counts`."""
    drift_um_per_min: FloatArray
    """b_0 of the fit [um/min], shape (n_channels,)."""
    warnings: tuple[str, ...]
    advice: tuple[str, ...]
    """What to record next, and which recordings do not go with the others."""
    choice: Choice | None = None
    """What was chosen among several families, and why; None where one was asked for by name."""


def train_family(
    recordings: Sequence[Recording],
    family: str | Recipe,
    *,
    sample_s: float,
    created: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    machine: str = "",
) -> FamilyTraining:
    """Fit a recipe on recordings.

    Result: the model of the recipe, and how far it may be trusted. Raises DatasetError when the recordings do not fit
    together or cannot support the model.

    Parameters
    ----------
    recordings
        Each a run of its own.
    family
        A recipe, or its key in `RECIPES`.
    sample_s
        They are averaged to this time between rows [s].
    created
        Date and time for the model, ISO 8601.
    progress
        Called with (done, total) steps.
    machine
        Name of the one machine that the recordings are of; '' where it is not known.

    """
    recipe = RECIPES[family] if isinstance(family, str) else family
    recordings, warnings = usable_recordings(recordings, rows_needed=recipe.rows_needed)
    left_out = left_out_sensors(recordings, sample_s)
    kept = [name for name in recordings[0].temperature_names if name not in left_out]
    used = [with_sensors(recording, kept) for recording in recordings]
    prepared = prepare(used, sample_s, recipe)
    inputs, rows, fold, problem = prepared.inputs, prepared.rows, prepared.fold, prepared.problem
    progress(1, 4)
    fit = problem.fit()
    progress(2, 4)
    trust = judge(inputs, rows, fold, problem)
    progress(3, 4)
    watched = recipe.lags and inputs.layout.sensors <= MOST_WATCHED
    model = recipe.make(
        Fitted(
            name=recipe.name,
            kind=recipe.kind,
            created=created,
            inputs=inputs,
            rows=rows,
            fit=fit,
            trust=trust,
            hyper_parameters=problem.hyper_parameters | _score(trust) | ({MACHINE: machine} if machine else {}),
            training=_training(used, inputs, rows),
            sensor_ids=_ids(recordings[0], kept),
            increments_k=increment_range_k([recording.downsampled(sample_s) for recording in used]),
            pivots_mm=dict(used[0].pivots_mm),
            of_rises=_of_rises(used),
            watch=fit_watch(temperatures_alone(used), sample_s, rows, fold) if watched else None,
        )
    )
    progress(4, 4)
    return FamilyTraining(
        model=model,
        trust=trust,
        hyper_parameters=problem.hyper_parameters,
        left_out=left_out,
        folds=prepared.folds,
        fold_names=() if trust.held_out is None else _fold_names(inputs, rows, fold, prepared.folds),
        counts=fit.counts,
        drift_um_per_min=fit.drift_um_per_min,
        warnings=warnings,
        advice=_advice(recipe, prepared, trust),
        choice=problem.choice if isinstance(problem, ChosenProblem) else None,
    )


def model_of(
    family: str, recordings: Sequence[Recording], prepared: Prepared, fit: Fit, trust: Trust, watch: SensorWatch | None
) -> ThermalModel:
    """Return a fit as the daemon would load it, to be tried: without date, and without the names of what it is from.

    `recordings`: of the sensors that are used; the others: as they were made of them.
    """
    recipe = RECIPES[family]
    return recipe.make(
        Fitted(
            name=recipe.name,
            kind=recipe.kind,
            created="",
            inputs=prepared.inputs,
            rows=prepared.rows,
            fit=fit,
            trust=trust,
            hyper_parameters=prepared.problem.hyper_parameters,
            training=(),
            sensor_ids=sensor_ids_from_names(prepared.inputs.sensor_names, prepared.inputs.axis_positions),
            increments_k=increment_range_k(recordings),
            pivots_mm=dict(recordings[0].pivots_mm),
            of_rises=_of_rises(recordings),
            watch=watch,
        )
    )


def _training(recordings: Sequence[Recording], inputs: Inputs, rows: BoolArray) -> tuple[TrainingData, ...]:
    used = np.unique(inputs.recording[rows])
    return tuple(training_data(recording) for index, recording in enumerate(recordings) if index in used)


def _of_rises(recordings: Sequence[Recording]) -> bool:
    return any(are_rises(one.temperatures_degc[:, : one.sensors]) for one in recordings)


def _score(trust: Trust) -> HyperParameters:
    """Return what a candidate is compared by: RMSE with / without the model on what was left out, mean of channels."""
    score = trust.held_out_relative_rmse
    if trust.held_out is None or not isfinite(score):
        return {}
    of_channels = [round(float(share), 4) for share in trust.held_out.relative_rmse]
    return {"held_out_relative_rmse": round(score, 4), CHANNEL_SCORES: of_channels}


def _advice(recipe: Recipe, prepared: Prepared, trust: Trust) -> tuple[str, ...]:
    inputs, rows, fold, problem = prepared.inputs, prepared.rows, prepared.fold, prepared.problem
    numbers = fold_numbers(rows, fold)
    independent = independent_folds(inputs, rows, len(numbers)) if len(numbers) > 1 else 0
    found = prepared.reversed_runs + recipe.advice(inputs, rows, independent)
    if isinstance(problem, ChosenProblem):
        scores = {one.family: one.relative_rmse for one in problem.choice.candidates if one.refused is None}
        found += indistinct(problem.choice.family, scores, whole_runs(inputs, rows, independent))
    if not np.isfinite(trust.held_out_relative_rmse):
        return found
    against = contradictions(inputs, rows, fold, problem)
    change = None if against else change_of_regime(inputs, rows, fold, problem)
    explained = [name for name in inputs.channels if any(one.startswith(f"channel {name} ") for one in found)]
    explained += [inputs.channels[one.channel] for one in against]
    worse = worse_channels(trust.held_out, explained) if trust.refused is None else ()
    return found + sentences(inputs, against, change) + worse


def _ids(recording: Recording, kept: Sequence[str]) -> tuple[int, ...]:
    """Return the IDs that the kept sensors have among all columns of the recording."""
    all_names = recording.temperature_names
    by_name = dict(zip(all_names, sensor_ids_from_names(all_names, recording.axis_positions), strict=True))
    return tuple(by_name[name] for name in kept)


def _fold_names(inputs: Inputs, rows: BoolArray, fold: IntArray, kind: str) -> tuple[str, ...]:
    """Return the names of what is left out: of the recordings where each is a fold, else numbers."""
    numbers = np.unique(fold[rows & (fold >= 0)])
    held = [set(inputs.recording[rows & (fold == number)].tolist()) for number in numbers]
    if kind == "run" and all(len(each) == 1 for each in held) and len(held) == len(inputs.recording_names):
        return tuple(inputs.recording_names[next(iter(each))] for each in held)
    return tuple(f"{kind} {count}" for count in range(1, len(numbers) + 1))
