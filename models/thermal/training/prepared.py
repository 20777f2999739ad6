"""A family prepared on the training rows of recordings, with spindle speed among its inputs where that helps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.families import Problem, fold_numbers, relative_rmse
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import Inputs, build_inputs
from models.thermal.training.recipes import Recipe

SPEED_MUST_LEAVE = 0.9
"""Spindle speed counts when it leaves less than this share of the left-out error: speeds that training did not see
are extrapolated with the square of the speed, so an input that hardly helps is a risk."""
LARGEST_INCOMPLETE_SHARE = 0.5
"""When fewer training rows than this are complete, that is said instead of fitting the rest."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepared:
    """What a model is fitted on, and the family with what was chosen."""

    inputs: Inputs
    rows: BoolArray
    """Training rows that are complete, shape (n,)."""
    fold: IntArray
    """What is left out in turn, shape (n,), see `inner_folds`."""
    folds: str
    """What the folds are: `run`, `cycle` or `block`."""
    problem: Problem


def prepare(
    recordings: Sequence[Recording],
    sample_s: float,
    recipe: Recipe,
    wanted: BoolArray | None = None,
    probe_min: float | None = None,
) -> Prepared:
    """Return a family prepared on recordings.

    A family that works on lags is prepared with and without lagged spindle speed; that helps on
    a machine whose sensors do not see all heat, and only extrapolates on one whose sensors do.
    What predicts left-out folds better is taken.

    Raises DatasetError when too few rows are complete.

    Parameters
    ----------
    recordings, sample_s
        See `build_inputs`.
    recipe
        How the family is prepared.
    wanted : shape (n,)
        Rows that may be trained on; None for all.
    probe_min
        Time between probes [min] for which it is chosen; None without probes.

    """
    inputs = build_inputs(recordings, sample_s=sample_s) if recipe.lags else _plain(recordings, sample_s)
    wanted = np.ones(inputs.rows, dtype=np.bool_) if wanted is None else wanted
    rows = wanted & inputs.trainable()
    require_rows(inputs, wanted, rows)
    fold, folds = inner_folds(inputs, rows, recipe.fewest_runs)

    def prepared(one: Inputs) -> Prepared:
        """Return the family on some inputs of the same rows."""
        problem = recipe.prepare(one, rows, fold, probe_min)
        return Prepared(inputs=one, rows=rows, fold=fold, folds=folds, problem=problem)

    found = prepared(inputs)
    if not inputs.layout.speed_lags_min:
        return found
    without = prepared(build_inputs(recordings, sample_s=sample_s, speed_lags_min=()))
    hardly_helps = _left_out_rmse(found, probe_min) > SPEED_MUST_LEAVE * _left_out_rmse(without, probe_min)
    return without if hardly_helps else found


def _plain(recordings: Sequence[Recording], sample_s: float) -> Inputs:
    return build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())


def _left_out_rmse(prepared: Prepared, probe_min: float | None) -> float:
    """Return the RMSE with / without the model on what is left out; NaN where nothing can be."""
    numbers = fold_numbers(prepared.rows, prepared.fold)
    if len(numbers) < 2:
        return float("nan")
    try:
        fits = {number: prepared.problem.fit(frozenset({number})) for number in numbers}
    except DatasetError:
        return float("nan")
    return relative_rmse(prepared.inputs, prepared.rows, prepared.fold, fits, probe_min)


def require_rows(inputs: Inputs, wanted: BoolArray, rows: BoolArray) -> None:
    """Raise DatasetError unless enough of the wanted rows are complete, naming the worst column."""
    if rows.sum() > inputs.layout.sensors and rows.sum() >= LARGEST_INCOMPLETE_SHARE * wanted.sum():
        return
    missing = (~np.isfinite(inputs.measured_um[wanted])).mean(axis=0)
    worst = int(np.argmax(missing))
    complaints = []
    if missing[worst] > 0.0:
        complaints.append(f"column {inputs.channels[worst]} misses {missing[worst]:.0%} of them")
    if inputs.speed_missing[wanted].any():
        complaints.append(f"spindle speed misses {inputs.speed_missing[wanted].mean():.0%}")
    because = f" ({', '.join(complaints)})" if complaints else ""
    raise DatasetError(
        f"{', '.join(inputs.recording_names)}: of {int(wanted.sum())} training rows {int(rows.sum())} are complete, "
        f"for {inputs.layout.sensors} temperatures{because}; record longer, or take incomplete columns out of the map"
    )
