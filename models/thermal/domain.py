"""How far features have gone from a reference, against the farthest that training went: where estimates are guesses.

A ridge with penalty p on columns with cross products G says of a change x how little training knows of it:
``p x^T (G + p)^-1 x``, its leverage. With Gaussian weights that is the variance of the estimate but for a
constant, so its root is a length, and a residual beyond the domain is expected to grow with it.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.inputs import BoolArray, Inputs
from models.thermal.ridge import RidgeSolution, design_columns

REFERENCES = 30
"""So many instants of every stretch are tried as its reference."""


def leverage(ridges: Sequence[RidgeSolution], change: FloatArray) -> FloatArray:
    """Return the summed leverage of changes of the features, shape (n,): how little training says about them.

    Parameters
    ----------
    ridges
        The fitted ridges.
    change : shape (n, d)
        Features minus features at a reference.

    """
    total = np.zeros(len(change))
    for ridge in ridges:
        scores = (design_columns(change, ridge.layout, ridge.design) * ridge.gain) @ ridge.directions
        total += np.square(scores) @ ridge.remaining
    return total


def leverage_positions(ridges: Sequence[RidgeSolution], features: FloatArray) -> FloatArray:
    """Return features as points whose squared distance is the leverage of their difference, shape (n, k).

    Parameters
    ----------
    ridges
        The fitted ridges; without any the points have no coordinates, and no distance.
    features : shape (n, d)
        Temperatures, lags and lagged speed.

    """
    points = [
        (design_columns(features, ridge.layout, ridge.design) * ridge.gain)
        @ (ridge.directions * np.sqrt(ridge.remaining))
        for ridge in ridges
    ]
    return np.hstack(points) if points else np.zeros((len(features), 0))


def farthest_leverage(inputs: Inputs, rows: BoolArray, ridges: Sequence[RidgeSolution]) -> float:
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


def band_factor(distance: FloatArray | float) -> FloatArray:
    """Return by how much a band is widened at a distance from the reference: not at all inside the domain.

    Parameters
    ----------
    distance
        The root of leverage over its largest value in training: 1 at the farthest that training went.

    Returns
    -------
    numpy.ndarray
        Of the same shape; beyond the domain the distance itself, because the deviation of the estimate
        is proportional to it.

    """
    return np.maximum(1.0, distance)
