"""What is held out, and how well it is predicted by what was not: whole stretches, never single rows.

Neighbouring rows are nearly equal, so a random split would test on what was trained on: there is
none here. With several recordings each is left out in turn; with one, each of its spindle on/off
cycles, or each of five blocks.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.thermal.model import thermal_error_um
from models.thermal.training.evaluation import ResidualMetrics, residual_metrics
from models.thermal.training.increments import Factor, combine, factorise, fit_each, increments

BLOCKS = 5
"""One recording without spindle cycles is cut into so many blocks."""
MOST_CYCLES = 12
"""With more spindle cycles than this they are tool changes, not warm-up cycles."""
BAND_QUANTILE = 0.9
"""The band is the largest of the folds' quantiles of the absolute held-out residual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingChoices:
    """What a person decides before training."""

    kind: Literal["increments", "ridge"] = "increments"
    """The source's ordinary least squares, or with a ridge penalty."""
    interval_min: float = 1.0
    """Interval of the increments [min]."""
    intercept: bool = False
    """Fit b_0; it integrates into a linear drift."""
    ridge_k2: float | None = None
    """Ridge penalty [K^2]; None chooses it on what is left out. Only with kind ridge."""
    sample_s: float = 60.0
    """Recordings are averaged to this time between rows [s]."""
    split_at_speed_changes: bool = False
    """Take no difference across a change of spindle speed."""
    jump_threshold_um: float | None = 3.0
    """Remove larger jumps at spindle on/off from the training displacements [um]; None: never."""

    def __post_init__(self) -> None:
        if self.kind == "increments" and self.ridge_k2 is not None:
            raise ValueError("a ridge penalty needs kind ridge")
        for name in ("interval_min", "sample_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Fold:
    """A stretch that is left out as a whole."""

    name: str
    measured: Recording
    """Averaged, with displacements as measured: residuals are judged on these."""
    factor: Factor
    """Of its increments, with displacements cleansed: this is trained on when another is left out."""


def training_runs(recordings: Sequence[Recording], choices: TrainingChoices) -> list[Recording]:
    """Return the stretches within which differences are taken."""
    if not choices.split_at_speed_changes:
        return list(recordings)
    return [run for recording in recordings for run in recording.split_at_speed_changes()]


def make_folds(
    measured: Sequence[Recording], cleansed: Sequence[Recording], choices: TrainingChoices, period_s: float
) -> list[Fold]:
    """Return what is left out in turn; a stretch without a single increment is no fold.

    Parameters
    ----------
    measured, cleansed
        The same averaged recordings with displacements as measured, and as trained on.
    choices
        Interval and whether to split at changes of speed.
    period_s
        Time between rows [s].

    Returns
    -------
    list of Fold
        In order of recordings and of time.

    """
    folds = []
    for name, raw, train_on in _stretches(measured, cleansed):
        try:
            data = increments(training_runs([train_on], choices), choices.interval_min, period_s)
        except DatasetError:
            continue
        folds.append(Fold(name=name, measured=raw, factor=factorise(data)))
    return folds


def _stretches(averaged: Sequence[Recording], cleansed: Sequence[Recording]) -> list[tuple[str, Recording, Recording]]:
    if len(averaged) > 1:
        return [(raw.name, raw, train_on) for raw, train_on in zip(averaged, cleansed, strict=True)]
    raw, train_on = averaged[0], cleansed[0]
    starts = _cycle_starts(raw)
    kind = "cycle"
    if not 3 <= len(starts) <= MOST_CYCLES:
        starts = [round(raw.rows * block / BLOCKS) for block in range(BLOCKS)]
        kind = "block"
    bounds = [0, *starts[1:], raw.rows]
    return [
        (f"{kind} {number}", raw.part(a, b), train_on.part(a, b))
        for number, (a, b) in enumerate(pairwise(bounds), start=1)
    ]


def _cycle_starts(recording: Recording) -> list[int]:
    if recording.speed_rpm is None:
        return []
    on = np.nan_to_num(np.abs(recording.speed_rpm)) > 0.0
    starts: list[int] = (np.flatnonzero(on[1:] & ~on[:-1]) + 1).tolist()
    return [0, *starts] if on[0] else starts


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """How one candidate predicts every fold from the others."""

    metrics: ResidualMetrics
    """Over all folds, each referenced to its own first row."""
    band_um: FloatArray
    """Half width of the prediction band [um], shape (n_channels,)."""

    @property
    def score(self) -> float:
        """Mean over the channels of the RMSE with / without the model."""
        return float(np.nanmean(1.0 - self.metrics.rmse_reduction))


def leave_out(
    folds: Sequence[Fold],
    *,
    choices: TrainingChoices,
    penalties: Sequence[float],
    advance: Callable[[], None] = lambda: None,
) -> list[HeldOut]:
    """Predict every fold by a model of the others, for each ridge penalty.

    Parameters
    ----------
    folds
        What is left out in turn.
    choices
        Interval and intercept.
    penalties
        Candidates [K^2].
    advance
        Called after each fold.

    Returns
    -------
    list of HeldOut
        One per penalty; empty when the folds cannot be predicted from each other, because there
        is only one or the others hold fewer rows than variables.

    """
    measured_um: list[FloatArray] = []
    estimated_um: list[list[FloatArray]] = [[] for _ in penalties]
    for fold in folds if len(folds) > 1 else []:
        rest = combine([other.factor for other in folds if other is not fold])
        try:
            fits = fit_each(rest, intercept=choices.intercept, penalties=penalties)
        except DatasetError:
            return []
        referenced_um, increment_k, elapsed_min = _since_start(fold.measured)
        measured_um.append(referenced_um)
        for estimates, fitted in zip(estimated_um, fits, strict=True):
            drift_um_per_min = fitted.intercept_um / choices.interval_min
            estimates.append(thermal_error_um(fitted.coefficients_um_per_k, drift_um_per_min, increment_k, elapsed_min))
        advance()
    if not measured_um:
        return []
    channels = folds[0].measured.displacement_names
    return [
        HeldOut(metrics=_pooled(channels, measured_um, estimates), band_um=_band_um(measured_um, estimates))
        for estimates in estimated_um
    ]


def _since_start(recording: Recording) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return displacements [um], temperatures [K] and time [min] since the first complete row."""
    known = np.isfinite(recording.temperatures_degc).all(axis=1) & np.isfinite(recording.displacements_um).all(axis=1)
    displacements_um = recording.displacements_um[known]
    temperatures_degc = recording.temperatures_degc[known]
    time_s = recording.time_s[known]
    return (
        displacements_um - displacements_um[0],
        temperatures_degc - temperatures_degc[0],
        (time_s - time_s[0]) / 60.0,
    )


def _pooled(
    channels: tuple[str, ...], measured: Sequence[FloatArray], estimated: Sequence[FloatArray]
) -> ResidualMetrics:
    """Return the metrics over several folds, each referenced to its own start."""
    each = [residual_metrics(channels, m, e) for m, e in zip(measured, estimated, strict=True)]
    rows = np.array([len(m) for m in measured], dtype=np.float64)[:, None]

    def pooled_rmse(values: list[FloatArray]) -> FloatArray:
        """Return the root of the mean square over all rows of the folds [um]."""
        return np.asarray(np.sqrt((np.square(np.array(values)) * rows).sum(axis=0) / rows.sum()))

    return ResidualMetrics(
        channels=channels,
        rmse_without_um=pooled_rmse([m.rmse_without_um for m in each]),
        max_without_um=np.max([m.max_without_um for m in each], axis=0),
        rmse_with_um=pooled_rmse([m.rmse_with_um for m in each]),
        max_with_um=np.max([m.max_with_um for m in each], axis=0),
    )


def _band_um(measured_um: Sequence[FloatArray], estimated_um: Sequence[FloatArray]) -> FloatArray:
    residuals_um = [np.abs(m - e) for m, e in zip(measured_um, estimated_um, strict=True)]
    return np.asarray(np.max([np.quantile(residual, BAND_QUANTILE, axis=0) for residual in residuals_um], axis=0))
