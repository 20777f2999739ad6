"""A family prepared on the training rows of recordings, with the lags that these can teach."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.choice import ChosenProblem
from models.thermal.training.families import Problem
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import Inputs, build_inputs
from models.thermal.training.lags import offered_lags, part_of
from models.thermal.training.recipes import Recipe
from models.thermal.training.reversed_runs import reversed_runs, reversed_sentences

LARGEST_INCOMPLETE_SHARE = 0.5
"""When fewer of the training rows in which any displacement was measured are complete, that is said instead of fitting
the rest."""


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
    reversed_runs: tuple[str, ...] = ()
    """Sentences on runs that were left out, because a channel reads the wrong way round in them."""


def prepare(
    recordings: Sequence[Recording],
    sample_s: float,
    recipe: Recipe,
    wanted: BoolArray | None = None,
    probe_min: float | None = None,
) -> Prepared:
    """Return a family prepared on recordings.

    A family that works on lags is given all that the training rows can teach, and keeps what it uses. Runs in which a
    channel reads the wrong way round are left out, and named.

    Raises DatasetError when too few rows are complete.

    `recordings`, `sample_s`: see `build_inputs`. `recipe`: how the family is prepared. `wanted`, shape (n,): rows that
    may be trained on; None for all. `probe_min`: time between probes [min] for which it is chosen; None without probes.
    """
    inputs = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    wanted = np.ones(inputs.rows, dtype=np.bool_) if wanted is None else wanted
    if recipe.lags:
        lags = offered_lags(inputs, wanted & inputs.trainable())
        lags_min, speed_lags_min = recipe.needed_lags_min or (lags.all_min, lags.all_speed_min)
        inputs = build_inputs(recordings, sample_s=sample_s, lags_min=lags_min, speed_lags_min=speed_lags_min)
    rows = wanted & inputs.trainable()
    require_rows(inputs, wanted, rows, fewest=None if recipe.rows_needed else 1)
    wrong = reversed_runs(inputs, rows) if recipe.lags else {}
    rows &= ~np.isin(inputs.run, list(wrong))
    fold, folds = inner_folds(inputs, rows, recipe.fewest_runs)
    problem = recipe.prepare(inputs, rows, fold, probe_min)
    left_out = reversed_sentences(inputs, wrong)
    if isinstance(problem, ChosenProblem):
        inputs = part_of(inputs, problem.layout.lags_min, problem.layout.speed_lags_min)
    return Prepared(inputs=inputs, rows=rows, fold=fold, folds=folds, problem=problem, reversed_runs=left_out)


def require_rows(inputs: Inputs, wanted: BoolArray, rows: BoolArray, *, fewest: int | None = None) -> None:
    """Raise DatasetError unless enough of the wanted rows are complete, naming the worst column.

    `fewest`: so many must be; None: more than there are temperatures.
    """
    fewest = inputs.layout.sensors + 1 if fewest is None else fewest
    measured = wanted & np.isfinite(inputs.measured_um).any(axis=1)
    if rows.sum() >= fewest and rows.sum() >= LARGEST_INCOMPLETE_SHARE * measured.sum():
        return
    missing = (~np.isfinite(inputs.measured_um[wanted])).mean(axis=0)
    worst = int(np.argmax(missing))
    complaints = []
    if missing[worst] > 0.0:
        complaints.append(f"column {inputs.channels[worst]} misses {missing[worst]:.0%} of them")
    if inputs.speed_missing[wanted].any():
        complaints.append(f"spindle speed misses {inputs.speed_missing[wanted].mean():.0%}")
    because = f" ({', '.join(complaints)})" if complaints else ""
    known = np.isfinite(inputs.measured_um[wanted])
    advice = "record longer, or take incomplete columns out of the map"
    if 2 * known.all(axis=1).sum() < known.sum(axis=0).min():
        advice = "the channels were measured in different rows: name one at a time under displacements in the map"
    raise DatasetError(
        f"{', '.join(inputs.recording_names)}: of {int(wanted.sum())} training rows {int(rows.sum())} are complete, "
        f"for {inputs.layout.sensors} temperatures{because}; {advice}"
    )
