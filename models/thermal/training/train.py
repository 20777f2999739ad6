"""Fits a thermal model to recordings, and judges it on what it has not seen."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import require_usable, usable_recordings
from models.recordings.jumps import remove_sudden_jumps
from models.records import FloatArray
from models.thermal.model import ThermalModel, TrainingData, make_test_vectors
from models.thermal.training.evaluation import ResidualMetrics
from models.thermal.training.increments import Factor, LinearFit, factorise, fit, increments, mean_square_k2
from models.thermal.training.inputs import averaged_recordings, require_same_columns
from models.thermal.training.validation import TrainingChoices, leave_out, make_folds, training_runs

__all__ = ["TrainingChoices", "TrainingReport", "TrainingResult", "sensor_ids_from_names", "train"]

RELATIVE_PENALTIES = tuple(10.0 ** (half / 2.0) for half in range(-10, 5))
"""Ridge penalties that are tried, per mean summed square of the increments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingReport:
    """What training found."""

    ridge_k2: float
    increments_used: int
    increments_left_out: int
    """Not used, because a value at one end was missing."""
    rank: int
    """How many directions of temperature change the data can tell apart."""
    folds: tuple[str, ...]
    """What was left out in turn."""
    held_out: ResidualMetrics | None
    """Of all folds, each predicted by a model that had not seen it; None when nothing could be left out."""
    warnings: tuple[str, ...]

    score: float
    """Mean over the channels of the held-out RMSE with / without the model; NaN without folds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingResult:
    """A model and how it was found."""

    model: ThermalModel
    report: TrainingReport


Progress = Callable[[int, int], None]


def train(
    recordings: Sequence[Recording], choices: TrainingChoices, *, created: str, progress: Progress | None = None
) -> TrainingResult:
    """Fit a model to recordings and judge it on what it has not seen.

    Parameters
    ----------
    recordings
        Each a run of its own: no difference is taken from one to the next.
    choices
        Kind, interval, intercept, penalty.
    created
        Date and time for the model, ISO 8601.
    progress
        Called with (done, total) steps.

    Returns
    -------
    TrainingResult
        The model of all recordings, with its band from the folds.

    Raises
    ------
    DatasetError
        When the recordings do not fit together or cannot support the model.

    """
    require_same_columns(recordings)
    recordings, warnings = usable_recordings(recordings)
    averaged = averaged_recordings(recordings, choices.sample_s)
    together = sum(recording.rows for recording in averaged)
    for recording in averaged:
        require_usable(recording, together)
    period_s = _common_period_s(averaged)
    cleansed = [_cleansed(recording, choices).downsampled(choices.sample_s) for recording in recordings]
    folds = make_folds(averaged, cleansed, choices, period_s)
    steps = _Steps(progress, len(folds) + 2)

    data = increments(training_runs(cleansed, choices), choices.interval_min, period_s)
    whole = factorise(data)
    steps.advance()
    penalties = _penalties(choices, whole, len(folds))
    candidates = leave_out(folds, choices=choices, penalties=penalties, advance=steps.advance)
    best = int(np.argmin([candidate.score for candidate in candidates])) if candidates else 0
    held_out = candidates[best] if candidates else None
    fitted = fit(whole, intercept=choices.intercept, ridge=penalties[best])
    if fitted.rank == 0:
        raise DatasetError("no temperature changes in these recordings; check that the sensors are connected")
    band_um = np.full(len(fitted.intercept_um), np.nan) if held_out is None else held_out.band_um
    model = _model(recordings, averaged, choices, fitted, penalties[best], band_um, created)
    steps.finish()
    report = TrainingReport(
        ridge_k2=penalties[best],
        increments_used=len(data.temperature_k),
        increments_left_out=data.left_out,
        rank=fitted.rank,
        folds=() if held_out is None else tuple(fold.name for fold in folds),
        held_out=None if held_out is None else held_out.metrics,
        score=float("nan") if held_out is None else held_out.score,
        warnings=warnings,
    )
    return TrainingResult(model=model, report=report)


class _Steps:
    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def advance(self) -> None:
        """Count one more step as done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total)

    def finish(self) -> None:
        """Count every step but the last as done."""
        self._done = self._total - 1
        self.advance()


def _common_period_s(recordings: Sequence[Recording]) -> float:
    periods_s = [recording.sample_s for recording in recordings]
    if max(periods_s) - min(periods_s) > 1e-3 * min(periods_s):
        slowest = recordings[int(np.argmax(periods_s))].name
        raise DatasetError(
            f"{slowest}: has a row every {max(periods_s):g} s, another recording every {min(periods_s):g} s; "
            "raise sample_s so that all are averaged to the same time"
        )
    return periods_s[0]


def _cleansed(recording: Recording, choices: TrainingChoices) -> Recording:
    if recording.speed_rpm is None or choices.jump_threshold_um is None:
        return recording
    without_jumps = remove_sudden_jumps(
        recording.time_s, recording.displacements_um, recording.speed_rpm, choices.jump_threshold_um
    )
    return replace(recording, displacements_um=without_jumps)


def _penalties(choices: TrainingChoices, whole: Factor, folds: int) -> list[float]:
    if choices.kind == "increments":
        return [0.0]
    if choices.ridge_k2 is not None:
        return [choices.ridge_k2]
    if folds < 2:
        raise DatasetError("a ridge penalty can only be chosen with two stretches to leave out; record longer")
    scale_k2 = mean_square_k2(whole)
    return [relative * scale_k2 for relative in RELATIVE_PENALTIES]


def _model(
    recordings: Sequence[Recording],
    averaged: Sequence[Recording],
    choices: TrainingChoices,
    fitted: LinearFit,
    ridge_k2: float,
    band_um: FloatArray,
    created: str,
) -> ThermalModel:
    first = recordings[0]
    drift_um_per_min = fitted.intercept_um / choices.interval_min
    lowest_k, highest_k = increment_range_k(averaged)
    digest = _digest(fitted.coefficients_um_per_k, drift_um_per_min)
    return ThermalModel(
        model_id=f"{choices.kind}-{choices.interval_min:g}min-{digest[:8]}",
        kind=choices.kind,
        channels=first.displacement_names,
        sensor_ids=sensor_ids_from_names(first.temperature_names),
        sensor_names=first.temperature_names,
        coefficients_um_per_k=fitted.coefficients_um_per_k,
        drift_um_per_min=drift_um_per_min,
        interval_min=choices.interval_min,
        ridge_k2=ridge_k2,
        lowest_increment_k=lowest_k,
        highest_increment_k=highest_k,
        band_um=band_um,
        training=tuple(training_data(recording) for recording in recordings),
        created=created,
        axis_positions=first.axis_positions,
        test_vectors=make_test_vectors(fitted.coefficients_um_per_k, drift_um_per_min, _test_pairs(averaged[0])),
    )


def sensor_ids_from_names(names: Sequence[str]) -> tuple[int, ...]:
    """Return the machine's sensor IDs: the number where every column is T<number>, else 1, 2 .. in order."""
    numbers = [int(name[1:]) for name in names if name[:1] in "tT" and name[1:].isascii() and name[1:].isdigit()]
    if len(numbers) == len(names) == len(set(numbers)) and min(numbers, default=1) >= 1:
        return tuple(numbers)
    return tuple(range(1, len(names) + 1))


def increment_range_k(recordings: Sequence[Recording]) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest increment of each sensor since any earlier row of its recording [K]."""
    lowest, highest = [], []
    for recording in recordings:
        temperatures = recording.temperatures_degc
        lowest.append(np.nanmin(temperatures - np.fmax.accumulate(temperatures, axis=0), axis=0))
        highest.append(np.nanmax(temperatures - np.fmin.accumulate(temperatures, axis=0), axis=0))
    return np.asarray(np.min(lowest, axis=0)), np.asarray(np.max(highest, axis=0))


def _test_pairs(recording: Recording) -> tuple[tuple[FloatArray, FloatArray], ...]:
    complete = recording.temperatures_degc[np.isfinite(recording.temperatures_degc).all(axis=1)]
    reference = complete[0].copy()
    return (complete[len(complete) // 2].copy(), reference), (complete[-1].copy(), reference)


def training_data(recording: Recording) -> TrainingData:
    """Return what a recording contributes to a model: its name, checksum and extent."""
    names = "\n".join((*recording.temperature_names, *recording.displacement_names)).encode()
    arrays = [recording.time_s, recording.temperatures_degc, recording.displacements_um]
    return TrainingData(
        name=recording.name,
        sha256=hashlib.sha256(names + bytes.fromhex(_digest(*arrays))).hexdigest(),
        from_hours=float(recording.time_s[0] / 3600.0),
        to_hours=float(recording.time_s[-1] / 3600.0),
        rows=recording.rows,
    )


def _digest(*arrays: FloatArray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return digest.hexdigest()
