"""How far features have gone from a reference, against the farthest that training went: beyond that they extrapolate.

A ridge with penalty p on columns with cross products G says of a change x how little training knows of it:
``p x^T (G + p)^-1 x``, its leverage. With Gaussian weights that is the variance of the estimate but for a
constant, so its root is a length, and a residual beyond the domain is expected to grow with it.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray, design_columns
from models.thermal.solution import Solution
from models.thermal.training.inputs import Inputs

REFERENCES = 30
"""So many instants of every stretch are tried as its reference."""
MOST_AT_ONCE = 256
"""Rows that are looked at together: with hundreds of sensors all of them would take hundreds of megabytes."""


def leverage_positions(ridges: Sequence[Solution], features: FloatArray, rows: IntArray | None = None) -> FloatArray:
    """Return features as points whose squared distance is the leverage of their difference, shape (n, k).

    `ridges`: the fitted ridges; without any, or without directions, the points have no coordinates, and no distance.
    `features`, shape (n, d): temperatures, lags and lagged speed. `rows`: which of them; None for all.
    """
    rows = np.arange(len(features)) if rows is None else rows
    maps = [
        (ridge, ridge.gain[:, None] * ridge.directions * np.sqrt(ridge.remaining))
        for ridge in ridges
        if ridge.directions is not None and ridge.remaining is not None
    ]
    points = np.empty((len(rows), sum(each.shape[1] for _, each in maps)))
    for at in range(0, len(rows), MOST_AT_ONCE):
        part, column = features[rows[at : at + MOST_AT_ONCE]], 0
        for ridge, each in maps:
            place = slice(column, column := column + each.shape[1])
            points[at : at + MOST_AT_ONCE, place] = design_columns(part, ridge.layout, ridge.design) @ each
    return points


def farthest_leverage(inputs: Inputs, rows: BoolArray, ridges: Sequence[Solution]) -> float:
    """Return the largest leverage of what followed on instants of training that could have been the reference.

    `rows`, shape (n,): rows that the ridges were fitted on. `ridges`: the fitted ridges.
    """
    largest = 1e-12
    for run in np.unique(inputs.run[rows]):
        points = leverage_positions(ridges, inputs.features, np.flatnonzero(rows & (inputs.run == run)))
        for first in range(0, len(points), max(1, len(points) // REFERENCES)):
            largest = max(largest, float(np.square(points[first:] - points[first]).sum(axis=1).max()))
    return largest
