"""How good a family is on what was left out, and how sure the difference between two families is."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.evaluation import moving
from models.thermal.training.families import Fit, fold_numbers, held_out_um
from models.thermal.training.inputs import Inputs
from models.thermal.training.probing import probed_residual_um

ALIKE_IN_LENGTH = 3.0
"""One run that has more than so many times the rows of the other is rather one run than two."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOutErrors:
    """Measured errors and what a family leaves of them, stretch by stretch of what was left out."""

    folds: IntArray
    """Fold of each stretch, shape (n_stretches,)."""
    measured_um: tuple[FloatArray, ...]
    """Of each stretch, since its first row [um], shape (n, n_channels)."""
    residual_um: tuple[FloatArray, ...]
    """Measured minus estimated, without probes [um]."""
    period_min: float
    probe_min: float | None

    def squares(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the sums of squares without and with the family, and the rows, by fold.

        Result of shapes (n_folds, n_channels) [um^2] twice, and (n_folds,).
        """
        numbers = np.unique(self.folds)
        channels = self.measured_um[0].shape[1] if self.measured_um else 0
        without, left, count = np.zeros((len(numbers), channels)), np.zeros((len(numbers), channels)), []
        for place, number in enumerate(numbers):
            of_fold = np.flatnonzero(self.folds == number)
            count.append(sum(len(self.measured_um[index]) for index in of_fold))
            for index in of_fold:
                without[place] += np.square(self.measured_um[index]).sum(axis=0)
                left[place] += np.square(self.probed_um(int(index))).sum(axis=0)
        return without, left, np.array(count, dtype=np.float64)

    def scored(self, moves: BoolArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the sums of squares of `squares` of the channels that move; `moves`: these, where they are known."""
        without, left, _ = self.squares()
        moves = moving(self.measured_um) if moves is None else moves
        return without[:, moves], left[:, moves]

    def probed_um(self, index: int) -> FloatArray:
        """Return the residual of a stretch as probes leave it [um], shape (n, n_channels)."""
        residual_um = self.residual_um[index]
        if self.probe_min is None:
            return residual_um
        times_min = self.period_min * np.arange(len(residual_um), dtype=np.float64)
        return probed_residual_um(times_min, residual_um, self.probe_min)


def left_out_errors(
    inputs: Inputs, rows: BoolArray, fold: IntArray, fits: Mapping[int, Fit], probe_min: float | None
) -> LeftOutErrors:
    """Return what each fit leaves of the fold that it has not seen, from the first row of each stretch on.

    `inputs`, `rows`, `fold`: training rows and their folds. `fits`: fold -> the fit without it. `probe_min`: time
    between probes that reset the offset [min]; None without.
    """
    folds: list[int] = []
    measured: list[FloatArray] = []
    residual: list[FloatArray] = []
    for number, fit in fits.items():
        for error_um, estimated_um in zip(*held_out_um(inputs, rows & (fold == number), fit), strict=True):
            folds.append(number)
            measured.append(error_um)
            residual.append(error_um - estimated_um)
    return LeftOutErrors(
        folds=np.array(folds, dtype=np.intp),
        measured_um=tuple(measured),
        residual_um=tuple(residual),
        period_min=inputs.step_min(rows),
        probe_min=probe_min,
    )


def of_two_runs(
    inputs: Inputs, rows: BoolArray, fold: IntArray, fit: Callable[[frozenset[int]], Fit]
) -> dict[int, Fit] | None:
    """Return the fit without each of exactly two runs, by the number of the run; None where there are no such.

    Cycles and blocks of a run are alike in what differs between two days, and say too little of another one.

    `inputs`, `rows`, `fold`: see `left_out_errors`. `fit`: the fit without some folds.
    """
    runs, count = np.unique(inputs.run[rows], return_counts=True)
    if len(runs) != 2 or count.max() > ALIKE_IN_LENGTH * count.min():
        return None
    held = {int(run): frozenset(fold[rows & (inputs.run == run)].tolist()) for run in runs}
    if any(held_of_one.issuperset(fold_numbers(rows, fold)) for held_of_one in held.values()):
        return None
    return {run: fit(folds) for run, folds in held.items()}


def together(parts: Sequence[LeftOutErrors]) -> LeftOutErrors:
    """Return the stretches of several, each of other folds."""
    return replace(
        parts[0],
        folds=np.concatenate([part.folds for part in parts]),
        measured_um=tuple(each for part in parts for each in part.measured_um),
        residual_um=tuple(each for part in parts for each in part.residual_um),
    )


def of_channel(errors: LeftOutErrors, channel: int) -> LeftOutErrors:
    """Return what is left of one channel, by its index from 0."""
    column = slice(channel, channel + 1)
    return replace(
        errors,
        measured_um=tuple(each[:, column] for each in errors.measured_um),
        residual_um=tuple(each[:, column] for each in errors.residual_um),
    )


def beside(channels: Sequence[LeftOutErrors]) -> LeftOutErrors:
    """Return the errors of all channels from those of each, of the same stretches."""
    return replace(
        channels[0],
        measured_um=tuple(np.hstack(each) for each in zip(*(one.measured_um for one in channels), strict=True)),
        residual_um=tuple(np.hstack(each) for each in zip(*(one.residual_um for one in channels), strict=True)),
    )


def only(errors: LeftOutErrors, fold: int) -> LeftOutErrors:
    """Return the stretches of one fold."""
    places = np.flatnonzero(errors.folds == fold)
    return replace(
        errors,
        folds=errors.folds[places],
        measured_um=tuple(errors.measured_um[place] for place in places),
        residual_um=tuple(errors.residual_um[place] for place in places),
    )


def mean_errors(members: Sequence[LeftOutErrors], weights: Sequence[float]) -> LeftOutErrors:
    """Return what the weighted mean of several families leaves of the same stretches; the weights sum to 1."""
    first = members[0]
    stretches = zip(*(member.residual_um for member in members), strict=True)
    return LeftOutErrors(
        folds=first.folds,
        measured_um=first.measured_um,
        residual_um=tuple(np.asarray(np.tensordot(weights, np.stack(each), axes=1)) for each in stretches),
        period_min=first.period_min,
        probe_min=first.probe_min,
    )


def rmse_um(errors: LeftOutErrors) -> tuple[FloatArray, FloatArray]:
    """Return the RMSE of each channel without and with the family [um], each of shape (n_channels,)."""
    without, left, rows = errors.squares()
    count = max(float(rows.sum()), 1.0)
    return np.sqrt(without.sum(axis=0) / count), np.sqrt(left.sum(axis=0) / count)


def relative(errors: LeftOutErrors) -> float:
    """Return the mean over the channels that move of the RMSE with / without the family; NaN when none moves."""
    return relative_of(*errors.scored())


def relative_of(without: FloatArray, left: FloatArray) -> float:
    """Return `relative` from sums of squares by fold, each of shape (n_folds, n_channels) [um^2]."""
    total, rest = without.sum(axis=0), left.sum(axis=0)
    moves = total > 0.0
    return float(np.sqrt(rest[moves] / total[moves]).mean()) if moves.any() else float("nan")


def advantage(errors: LeftOutErrors, other: LeftOutErrors) -> tuple[float, float]:
    """Return by how much the first leaves less than the other, and the standard error of that.

    Result: difference of `relative`, and its standard error by the jackknife over folds: both families are scored on
    the same folds, so that what makes a fold hard for both does not count. Infinite with fewer than three folds,
    because scores then say nothing of other days.
    """
    without, mine = errors.scored()
    _, theirs = other.scored()
    difference = relative_of(without, theirs) - relative_of(without, mine)
    folds = len(without)
    if folds < 3:
        return difference, float("inf")
    rest = [np.arange(folds) != out for out in range(folds)]
    each = np.array(
        [relative_of(without[kept], theirs[kept]) - relative_of(without[kept], mine[kept]) for kept in rest]
    )
    return difference, float(np.sqrt((folds - 1) / folds * np.square(each - each.mean()).sum()))
