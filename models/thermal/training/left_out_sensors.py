"""Finds the temperatures that a model is made without: those that say nothing, and those that are missing too often.

While a temperature of the model is missing, the machine follows only what the others can stand for, which beyond little
is nothing. So a model without a sensor that is often missing may give the machine more, though it estimates less well.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from models.recordings.dataset import DatasetError, Recording
from models.thermal.features import BoolArray
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import Inputs, build_inputs, unusable_sensors, with_sensors
from models.thermal.training.left_out_errors import relative_of
from models.thermal.training.reversed_runs import reversed_runs
from models.thermal.training.ridge_member import LEVELS, RidgeMember

SHARES = (0.1, 0.05, 0.02)
"""Those that are missing in more than one of these shares of the training rows are tried to be left out, together."""
NAMED = 5
FEWEST_TIMES = 2
"""What fell silent once, or in the first half of the rows alone, has perhaps been repaired; what whole runs lack was
perhaps built in after them."""


def left_out_sensors(
    recordings: Sequence[Recording], sample_s: float, wanted: BoolArray | None = None
) -> dict[str, str]:
    """Return the temperatures that a model of some training rows is made without, and why.

    Of those that are missing for longer than is bridged, as many are left out as leave least of the error: that which
    a ridge on the other temperatures leaves of left-out folds, and all of it while one of those is missing.

    Raises DatasetError when no temperature is left.

    `recordings`, `sample_s`: see `build_inputs`. `wanted`, shape (n,): rows that may be trained on; None for all.
    """
    inputs = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    wanted = np.ones(inputs.rows, dtype=np.bool_) if wanted is None else wanted
    found = unusable_sensors(inputs, wanted)
    kept = [name for name in inputs.sensor_names if name not in found]
    temperatures = [name for name in kept if name not in inputs.axis_positions]
    if not temperatures:
        said = [f"{name}: {why}" for name, why in found.items()]
        more = [f"and {len(said) - NAMED} more"] if len(said) > NAMED else []
        raise DatasetError(f"no temperature can be used: {'; '.join([*said[:NAMED], *more])}")
    missing = {name: rows for name, rows in _missing(inputs, wanted).items() if name in temperatures}
    best: tuple[str, ...] = ()
    least = np.inf
    for without in _candidates(missing):
        names = [name for name in kept if name not in without]
        some = build_inputs(
            [with_sensors(one, names) for one in recordings], sample_s=sample_s, lags_min=(), speed_lags_min=()
        )
        absent = float(np.any([missing[name] for name in temperatures if name not in without], axis=0).mean())
        if (left := absent + (1.0 - absent) * _remaining(some, wanted) ** 2) < least:
            best, least = without, left
    return found | {
        name: f"missing in {missing[name].mean():.0%} of its training rows, in which the machine would get little of "
        "a model that needs it"
        for name in best
    }


def _missing(inputs: Inputs, wanted: BoolArray) -> dict[str, BoolArray]:
    """Return in which of the wanted rows each temperature was missing, if it fell silent repeatedly, and lately too.

    One that fell silent more seldom counts as well where that was mostly together with those: they share a line.
    """
    found = dict(zip(inputs.sensor_names, inputs.long_missing[wanted].T, strict=True))
    same_run = np.diff(inputs.run[wanted]) == 0
    often = {}
    for name, rows in found.items():
        fell_silent = np.flatnonzero(rows[1:] & ~rows[:-1] & same_run)
        often[name] = len(fell_silent) >= FEWEST_TIMES and fell_silent[-1] >= len(rows) // 2
    of_often = np.zeros(int(wanted.sum()), dtype=np.bool_)
    for name, rows in found.items():
        of_often |= rows & often[name]
    return {
        name: rows if often[name] or 2 * (rows & of_often).sum() > rows.sum() else np.zeros_like(rows)
        for name, rows in found.items()
    }


def _candidates(missing: Mapping[str, BoolArray]) -> list[tuple[str, ...]]:
    """Return which sensors are tried to be left out, none first; [] where none is missing often."""
    found = [tuple(name for name, rows in missing.items() if rows.mean() > share) for share in SHARES]
    some = [each for each in dict.fromkeys(found) if each and len(each) < len(missing)]
    return [(), *some] if some else []


def _remaining(inputs: Inputs, wanted: BoolArray) -> float:
    """Return what a ridge leaves of left-out folds, over the error without it; 1 where that cannot be told.

    A run that reads the wrong way round has no say: with it hardly anything less than everything is left.
    """
    rows = wanted & inputs.trainable()
    rows &= ~np.isin(inputs.run, list(reversed_runs(inputs, rows)))
    fold, _ = inner_folds(inputs, rows)
    try:
        errors = RidgeMember("ridge", inputs, rows, fold, None, LEVELS).errors
    except DatasetError:
        return 1.0
    found = 1.0 if errors is None else relative_of(*errors.scored())
    return min(found, 1.0) if np.isfinite(found) else 1.0
