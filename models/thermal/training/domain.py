"""How far features have gone from a reference, against the farthest that training went: beyond that they extrapolate.

A ridge with penalty p on columns with cross products G says of a change x how little training knows of it:
``p x^T (G + p)^-1 x``, its leverage. With Gaussian weights that is the variance of the estimate but for a
constant, so its root is a length, and a residual beyond the domain is expected to grow with it.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.features import BoolArray, design_columns
from models.thermal.solution import Solution
from models.thermal.training.inputs import Inputs

REFERENCES = 30
"""So many instants of every stretch are tried as its reference."""


def leverage_positions(ridges: Sequence[Solution], features: FloatArray) -> FloatArray:
    """Return features as points whose squared distance is the leverage of their difference, shape (n, k).

    `ridges`: the fitted ridges; without any, or without directions, the points have no coordinates, and no distance.
    `features`, shape (n, d): temperatures, lags and lagged speed.
    """
    points = [
        (design_columns(features, ridge.layout, ridge.design) * ridge.gain)
        @ (ridge.directions * np.sqrt(ridge.remaining))
        for ridge in ridges
        if ridge.directions is not None and ridge.remaining is not None
    ]
    return np.hstack(points) if points else np.zeros((len(features), 0))


def farthest_leverage(inputs: Inputs, rows: BoolArray, ridges: Sequence[Solution]) -> float:
    """Return the largest leverage of what followed on instants of training that could have been the reference.

    Parameters
    ----------
    inputs
        The recordings.
    rows : shape (n,)
        Rows that the ridges were fitted on.
    ridges
        The fitted ridges.

    """
    largest = 1e-12
    for run in np.unique(inputs.run[rows]):
        points = leverage_positions(ridges, inputs.features[rows & (inputs.run == run)])
        for first in range(0, len(points), max(1, len(points) // REFERENCES)):
            largest = max(largest, float(np.square(points[first:] - points[first]).sum(axis=1).max()))
    return largest
