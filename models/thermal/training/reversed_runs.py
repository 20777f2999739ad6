"""Finds the run in which a channel was measured the wrong way round: turned back it agrees with all others.

Such a run spoils every fit that it is part of, and every score of a family. What a run has that the others do not know
(another speed, a coolant that is off) leaves much as well, but turning its displacements round makes that no better. So
every run is turned round in turn, and the one that helps is it: with ridges on temperatures, each run predicted from
the others.
"""

from collections.abc import Mapping

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray
from models.thermal.training.inputs import Inputs

FEWEST_RUNS = 4
"""With fewer runs nothing says which of them is right."""
MOST_SHARE = 0.25
"""No more of the runs than this are taken to be wrong."""
PENALTIES = (1e-3, 1e-2, 1e-1)
"""Of the ridges, relative to the mean variance of the columns; the best counts, turned round or not."""
LEAST_HELP, MOST_LEFT = 0.7, 0.8
"""Turning a run round must leave less than this of what is left without that, and less than this of all there is; both
as root mean squares of left-out runs."""


def reversed_runs(inputs: Inputs, rows: BoolArray) -> dict[int, tuple[str, ...]]:
    """Return the runs in which channels read the wrong way round, by number, with the names of the channels.

    `inputs`: the recordings. `rows`, shape (n,): training rows.
    """
    runs = np.unique(inputs.run[rows])
    if len(runs) < FEWEST_RUNS:
        return {}
    scale = np.maximum(inputs.degc[rows].std(axis=0), 1e-6)
    xx, xy, yy = [], [], []
    for run in runs:
        part = rows & (inputs.run == run)
        x, y = inputs.degc[part] / scale, inputs.cleansed_um[part]
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        xx.append(x.T @ x / len(x))
        xy.append(x.T @ y / len(x))
        yy.append(y.var(axis=0))
    found = turned_runs(np.stack(xx), np.stack(xy), np.stack(yy))
    return {int(runs[place]): tuple(inputs.channels[at] for at in channels) for place, channels in found.items()}


def turned_runs(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> dict[int, tuple[int, ...]]:
    """Return the runs of which channels are to be turned round, by place, with the places of the channels.

    Mean products about the mean of each run: `xx`, shape (n_runs, d, d), of what estimates, `xy`, shape
    (n_runs, d, n_channels), and `yy`, shape (n_runs, n_channels), with displacements and of them.
    """
    found: dict[int, tuple[int, ...]] = {}
    if len(yy) < FEWEST_RUNS:
        return found
    unit = float(np.trace(xx.sum(axis=0))) / xx.shape[1]
    rest, eye = xx.sum(axis=0) - xx, np.eye(xx.shape[1])
    inverses = np.stack([np.linalg.inv(rest + penalty * unit * eye) for penalty in PENALTIES])
    for channel in range(yy.shape[1]):
        for place in _turned(inverses, xx, xy[:, :, channel], yy[:, channel]):
            found[place] = (*found.get(place, ()), channel)
    return found


def _turned(inverses: FloatArray, covariances: FloatArray, directions: FloatArray, along: FloatArray) -> list[int]:
    """Return the runs (indices) of which one channel is to be turned round.

    `inverses`, shape (n_penalties, n_runs, d, d): without each run. `covariances`, `directions` and `along`: see
    `turned_runs`, of the channel.
    """
    count = len(along)
    signs = np.ones(count)
    left = _left(inverses, covariances, directions, along, signs)
    found: list[int] = []
    while len(found) < int(MOST_SHARE * count):
        tried = {}
        for place in range(count):
            if place not in found:
                turned = signs.copy()
                turned[place] = -1.0
                tried[place] = _left(inverses, covariances, directions, along, turned)
        best = min(tried, key=lambda place: tried[place])
        if not tried[best] < min(LEAST_HELP * left, MOST_LEFT):
            break
        found.append(best)
        signs[best], left = -1.0, tried[best]
    return found


def _left(
    inverses: FloatArray, covariances: FloatArray, directions: FloatArray, along: FloatArray, signs: FloatArray
) -> float:
    """Return the share of the root mean square that is left of runs predicted from the others, by the best penalty."""
    total = float(along.sum())
    if not total > 0.0:
        return 1.0
    seen = directions * signs[:, None]
    rest = seen.sum(axis=0) - seen
    best = np.inf
    for inverse in inverses:
        weights = np.einsum("rij,rj->ri", inverse, rest)
        squares = along - 2.0 * (weights * seen).sum(axis=1)
        squares = squares + np.einsum("ri,rij,rj->r", weights, covariances, weights)
        best = min(best, float(np.sqrt(max(squares.sum(), 0.0) / total)))
    return best


def reversed_sentences(inputs: Inputs, wrong: Mapping[int, tuple[str, ...]]) -> tuple[str, ...]:
    """Return what to do about runs that `reversed_runs` found, one sentence each."""
    sentences = []
    for run, channels in wrong.items():
        name = inputs.recording_names[int(inputs.recording[inputs.run == run][0])]
        hours = inputs.time_min[inputs.run == run][[0, -1]] / 60.0
        whole = len(np.unique(inputs.run[inputs.recording_names.index(name) == inputs.recording])) == 1
        verb = "reads" if len(channels) == 1 else "read"
        place = name if whole else f"{name}, hours {hours[0]:.1f} to {hours[1]:.1f}"
        sentences.append(
            f"{place}: {' and '.join(channels)} {verb} the wrong way round, by what all other runs say; it was left "
            "out of training. Look how its sensor was mounted, change the sign of the column, and train again"
        )
    return tuple(sentences)
