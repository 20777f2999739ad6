"""The families of thermal models behind one interface: prepared on training rows, chosen by leaving folds out.

Every family ends in coefficients of the same features (temperatures, their lags, lagged speed) and
a drift, so that the estimate is always the difference of the features since the reference.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.gaussian import Mixture
from models.thermal.model import HyperParameters
from models.thermal.solution import Solution, imputed_mean
from models.thermal.training.evaluation import ResidualMetrics, moving
from models.thermal.training.folds import fold_segments
from models.thermal.training.inputs import Inputs
from models.thermal.training.probing import probed_residual_um

MOST_AT_ONCE = 256
"""Rows that are estimated at a time: with hundreds of sensors all rows together would take hundreds of megabytes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A fitted model, as coefficients of features."""

    coefficients: FloatArray
    """[um per unit of the feature], shape (layout.columns, n_channels)."""
    drift_um_per_min: FloatArray
    """b_0 [um/min], shape (n_channels,)."""
    refit: Callable[[tuple[int, ...]], "Fit"]
    """Returns the fit of the same rows and hyper-parameters without some sensors (indices from 0)."""
    solutions: tuple[Solution, ...] = ()
    """The ridges whose mean it is, where it is one."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Of what it was fitted on, by name; for the report."""
    mixture: Mixture | None = None
    """What makes one estimate of solutions that bend; None: it is linear."""
    centre: FloatArray | None = None
    """Mean of the features in training, shape (layout.columns,), of a mixture."""
    without: tuple[int, ...] = ()
    """Sensors left out of a mixture (indices from 0), which imputes them."""

    def estimate_um(self, features: FloatArray, reference: FloatArray, elapsed_min: FloatArray | float) -> FloatArray:
        """Return the thermal error since the reference [um], shape (n_channels,) or (n, n_channels)."""
        drift = np.multiply.outer(np.asarray(elapsed_min), self.drift_um_per_min)
        if features.ndim == 1:
            return np.asarray(self._since_um(features[None], reference)[0] + drift)
        parts = [features[at : at + MOST_AT_ONCE] for at in range(0, len(features), MOST_AT_ONCE)] or [features]
        return np.asarray(np.vstack([self._since_um(part, reference) for part in parts]) + drift)

    def _since_um(self, features: FloatArray, reference: FloatArray) -> FloatArray:
        """Return the thermal error of some rows since the reference without the drift [um], shape (n, n_channels)."""
        change = features - reference
        linear_um = np.asarray(change @ self.coefficients)
        if self.mixture is None:
            return linear_um
        far_um = change @ self.solutions[self.mixture.outside].coefficients(self.without)
        both = np.vstack([features, reference])
        if self.centre is not None:
            both -= self.centre
        both = imputed_mean(self.solutions, both, self.without)
        return self.mixture.bent_um(self.solutions, both[:-1], both[-1], linear_um, far_um)


class Problem(Protocol):
    """A family that is prepared on some rows."""

    hyper_parameters: HyperParameters
    """What was chosen inside the training rows."""

    def fit(self, left_out: frozenset[int] = frozenset()) -> Fit:
        """Return the fit on everything but some folds."""


Prepare = Callable[[Inputs, BoolArray, IntArray, float | None], Problem]
"""Inputs, training rows, their folds, and the time between probes [min] (None without) -> the prepared family."""


def _complete(inputs: Inputs, rows: BoolArray) -> list[IntArray]:
    """Return the stretches of some rows in which every channel was measured."""
    return fold_segments(inputs, rows & np.isfinite(inputs.measured_um).all(axis=1))


def held_out_um(inputs: Inputs, rows: BoolArray, fit: Fit) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return measured and estimated thermal errors of each stretch of some rows, from its own first row on [um]."""
    measured, estimated = [], []
    for segment in _complete(inputs, rows):
        first = segment[0]
        measured.append(inputs.measured_um[segment] - inputs.measured_um[first])
        elapsed_min = inputs.time_min[segment] - inputs.time_min[first]
        estimated.append(fit.estimate_um(inputs.features[segment], inputs.features[first], elapsed_min))
    return measured, estimated


def held_out_metrics(
    inputs: Inputs, rows: BoolArray, fold: IntArray, fits: Mapping[int, Fit], probe_min: float | None = None
) -> ResidualMetrics:
    """Return the residuals with and without the model [um], every fold predicted by its fit, from its own first row.

    With a time between probes [min], they reset the offset that often: a model is chosen for how it is used.
    """
    squares, largest, count = np.zeros((2, len(inputs.channels))), np.zeros((2, len(inputs.channels))), 0
    for number, fit in fits.items():
        for measured, estimated in zip(*held_out_um(inputs, rows & (fold == number), fit), strict=True):
            residual: FloatArray = measured - estimated
            if probe_min is not None:
                times_min = inputs.step_min(rows) * np.arange(len(residual), dtype=np.float64)
                residual = probed_residual_um(times_min, residual, probe_min)
            both = np.stack([measured, residual])
            squares += np.square(both).sum(axis=1)
            largest = np.maximum(largest, np.abs(both).max(axis=1))
            count += len(residual)
    rmse_um = np.sqrt(squares / max(count, 1))
    return ResidualMetrics(
        channels=inputs.channels,
        rmse_without_um=rmse_um[0],
        max_without_um=largest[0],
        rmse_with_um=rmse_um[1],
        max_with_um=largest[1],
    )


def relative_rmse(
    inputs: Inputs, rows: BoolArray, fold: IntArray, fits: Mapping[int, Fit], probe_min: float | None = None
) -> float:
    """Return the mean over the channels that move of the RMSE with / without the model, see `held_out_metrics`."""
    found = held_out_metrics(inputs, rows, fold, fits, probe_min)
    held_out = [part for number in fits for part in _complete(inputs, rows & (fold == number))]
    moves = (found.rmse_without_um > 0.0) & moving([inputs.measured_um[part] for part in held_out])
    if not moves.any():
        return float("nan")
    return float((found.rmse_with_um[moves] / found.rmse_without_um[moves]).sum() / moves.sum())


def fold_numbers(rows: BoolArray, fold: IntArray) -> list[int]:
    """Return the numbers of the folds that training rows have, without -1."""
    return [int(number) for number in np.unique(fold[rows]) if number >= 0]


def chosen(
    inputs: Inputs,
    rows: BoolArray,
    fold: IntArray,
    probe_min: float | None,
    candidates: Callable[[int], Sequence[Fit]],
) -> int:
    """Return the index of the candidate that predicts left-out folds best; the middle one without two folds."""
    numbers = fold_numbers(rows, fold)
    fits = {number: candidates(number) for number in numbers}
    if len(numbers) < 2:
        return len(next(iter(fits.values()))) // 2 if fits else 0
    scores = [
        relative_rmse(inputs, rows, fold, {number: fits[number][index] for number in numbers}, probe_min)
        for index in range(len(fits[numbers[0]]))
    ]
    return int(np.nanargmin(scores)) if np.isfinite(scores).any() else len(scores) - 1


def ridge_fit(solutions: Sequence[Solution], without: tuple[int, ...] = ()) -> Fit:
    """Return the mean of several ridges as a fit."""
    mean = np.mean([solution.coefficients(without) for solution in solutions], axis=0)
    return Fit(
        coefficients=mean,
        drift_um_per_min=np.zeros(mean.shape[1]),
        refit=lambda sensors: ridge_fit(solutions, tuple(sorted({*without, *sensors}))),
        solutions=tuple(solutions),
    )


MEMBER_FACTOR = 1.3
"""A ridge that leaves more than so many times what the best one leaves of the left-out error is not in the mean ..."""
MEMBER_SLACK = 0.02
"""... unless it leaves no more than this share of the error more: that is no difference."""


def members(left_out_rmse: Sequence[float]) -> list[int]:
    """Return which ridges enter the mean.

    Result: indices from 0 of all that are nearly as good as the best; of all where no score is known.

    `left_out_rmse`: RMSE with / without each ridge on what was left out; NaN where nothing could be.
    """
    scores = np.asarray(left_out_rmse, dtype=np.float64)
    if not np.isfinite(scores).any():
        return list(range(len(scores)))
    best = float(np.nanmin(scores))
    return [int(index) for index in np.flatnonzero(scores <= max(MEMBER_FACTOR * best, best + MEMBER_SLACK))]


def require_enough(inputs: Inputs, rows: BoolArray) -> None:
    """Raise DatasetError unless training rows outnumber the temperatures."""
    count, variables = int(rows.sum()), inputs.layout.sensors
    if count <= variables:
        raise DatasetError(
            f"{', '.join(inputs.recording_names)}: {count} complete rows cannot determine {variables} variables; "
            "record longer or choose fewer temperatures"
        )
