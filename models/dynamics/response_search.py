"""Looks for every set of parameters that fits a measured response, not for the nearest alone.

A descent from the told start may end where the fit is poor, or good and yet wrong. So the fit is looked at in evenly
spread points of parameter space, at some of the frequencies, and descents begin at the best of them. The best set of
values counts; others that fit as well (`RIVAL`) are told beside it, for the data cannot tell them apart.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.dynamics.beam import ComplexArray
from models.dynamics.response_fit import ASSUMED_ERROR, BOUNDS, Descent, Model, Problem, descend
from models.records import FloatArray

MOST_EVALUATIONS = 200
"""Of the response, from the told start."""
SEARCH_LINES = 160
"""About how many frequencies the search looks at."""
SEARCH_POINTS = 128
"""Points of parameter space at which the fit is looked at."""
SEARCH_STARTS = 6
"""How many of them a descent begins at."""
SEARCH_EVALUATIONS = 25
"""Of the response at the frequencies of the search, from one start."""
POLISHING_EVALUATIONS = 40
"""Of the whole response, from where a descent of the search ended."""
SEARCH_RANGE = {"kt": (1e6, 1e9), "ct": (3.0, 1e5), "kr": (3e3, 3e7), "cr": (1e-2, 1e3)}
"""Where other sets of values are looked for, by kind of parameter, in SI units."""
RIVAL = 1.1
"""A set of values fits as well when its error is at most this many times the best, or within `ASSUMED_ERROR`."""
CLOSE_ENOUGH = 2.0
"""A descent of the search goes on with all frequencies when its error is at most this many times the best there."""
APART = 0.1
"""Sets of values that differ by less than this in every logarithm are the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Coarse:
    """The model at some of the frequencies."""

    lines: slice
    """Which of them."""
    model: Model
    many: Callable[[Mapping[str, FloatArray]], ComplexArray]
    """Values of the free parameters, shape (k,) -> responses, shape (k, len(lines))."""


def lines_of_search(lines: int) -> slice:
    """Return which of so many frequencies the search looks at."""
    return slice(None, None, max(1, lines // SEARCH_LINES))


def least_squares_fit(
    task: Problem, begin: Mapping[str, float], coarse: Coarse, table: Mapping[str, float] | None = None
) -> Descent:
    """Return the parameters that minimise the squares of log(H / H_meas), and others that do as well.

    `begin`: where to begin, by name. `coarse`: the same model at some of the frequencies. `table`: another start to
    try, by name.
    """
    thin = Problem(
        model=coarse.model,
        measured=task.measured[coarse.lines],
        weight=task.weight[coarse.lines],
        free=task.free,
    )
    found = [descend(task, begin, MOST_EVALUATIONS)]
    told = [found[0].values] + ([{**begin, **table}] if table else [])
    ends = [descend(thin, start, SEARCH_EVALUATIONS) for start in (*told, *_starts(thin, coarse))]
    ends.sort(key=lambda end: end.log_error)
    worst = max(CLOSE_ENOUGH * ends[0].log_error, ASSUMED_ERROR)
    tried: list[Mapping[str, float]] = [found[0].values]
    for end in ends:
        if end.log_error <= worst and all(_apart(end.values, other) for other in tried):
            found.append(descend(task, end.values, POLISHING_EVALUATIONS))
            tried += [end.values, found[-1].values]
    best = min(found, key=lambda each: each.log_error)
    as_good = max(RIVAL * best.log_error, ASSUMED_ERROR)
    rivals: list[dict[str, float]] = []
    for each in found:
        if each.log_error <= as_good and all(_apart(each.values, other) for other in (best.values, *rivals)):
            rivals.append(each.values)
    return Descent(best.values, best.log_error, sum(each.evaluations for each in found), tuple(rivals))


def _starts(thin: Problem, coarse: Coarse) -> list[dict[str, float]]:
    """Return further starts, the most promising first."""
    ends = np.log([SEARCH_RANGE.get(name.partition("_")[0], BOUNDS["kt"]) for name in thin.free])
    points = np.exp(ends[:, 0] + evenly_spread(SEARCH_POINTS, len(thin.free)) * (ends[:, 1] - ends[:, 0]))
    computed = coarse.many(dict(zip(thin.free, points.T, strict=True)))
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.nanmean(thin.weight * np.abs(np.log(computed / thin.measured)), axis=1)
    order = np.argsort(errors, kind="stable")[:SEARCH_STARTS]
    return [dict(zip(thin.free, points[k].tolist(), strict=True)) for k in order]


def _apart(values: Mapping[str, float], other: Mapping[str, float]) -> bool:
    return any(abs(np.log(max(value, 1e-300) / max(other[name], 1e-300))) > APART for name, value in values.items())


def evenly_spread(points: int, dimensions: int) -> FloatArray:
    """Return points of the unit cube that lie evenly (additive recurrence of the generalised golden ratio).

    Shape (points, dimensions), from 0 to 1.
    """
    ratio = 2.0
    for _ in range(40):
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    steps = ratio ** -np.arange(1, dimensions + 1)
    return np.asarray((0.5 + np.outer(np.arange(1, points + 1), steps)) % 1.0)


def one_by_one(model: Model, names: Sequence[str]) -> Callable[[Mapping[str, FloatArray]], ComplexArray]:
    """Return a model for many sets of values that computes one after the other."""

    def many(values: Mapping[str, FloatArray]) -> ComplexArray:
        """Return the responses, shape (k, n)."""
        rows = zip(*(values[name].tolist() for name in names), strict=True)
        return np.array([model(dict(zip(names, row, strict=True)))[0] for row in rows], dtype=np.complex128)

    return many
