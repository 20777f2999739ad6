"""How far features have gone from a reference, against the farthest that training went: where estimates are guesses.

A ridge with penalty p on columns with cross products G says of a change x how little training knows of it:
``p x^T (G + p)^-1 x``, its leverage. With Gaussian weights that is the variance of the estimate but for a
constant, so its root is a length, and a residual beyond the domain is expected to grow with it.
"""

from collections.abc import Sequence

import numpy as np

from models.records import FloatArray
from models.thermal.layout import RidgeSolution, design_columns


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
