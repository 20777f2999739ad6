"""What the columns of a watch say of each other: predictions, departures and distances, from the inverse covariance."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.inputs import Layout

WIDEST = 2.5
"""Limits are widened by this much at most; farther from training a sensor that goes on alone must still be blamed."""


def without_columns(precision: FloatArray, columns: Sequence[int]) -> FloatArray:
    """Return the precision of what is left without some columns; those become zero."""
    out = np.asarray(columns, dtype=np.intp)
    if not len(out):
        return precision
    found = precision - precision[:, out] @ np.linalg.solve(precision[np.ix_(out, out)], precision[out])
    found[out], found[:, out] = 0.0, 0.0
    return found


def departure_maps(
    layout: Layout, precision: FloatArray, gain: FloatArray, skip: Sequence[int] = ()
) -> tuple[FloatArray, FloatArray]:
    """Return what turns scaled columns into the departure of every sensor from its prediction.

    Parameters
    ----------
    layout, precision, gain
        See `SensorWatch`.
    skip
        Sensors that `precision` does not hold any more.

    Returns
    -------
    tuple of numpy.ndarray
        Maps [K], shape (n_sensors, d), zeros for sensors that do not count, and the standard
        deviation that the model itself expects [K], shape (n_sensors,).

    """
    sensors = [s for s in range(layout.sensors) if s not in skip and gain[s] > 0.0]
    maps, expected = np.zeros((layout.sensors, layout.columns)), np.zeros(layout.sensors)
    if not sensors:
        return maps, expected
    own = np.stack([layout.of_sensors([s]) for s in sensors])
    blocks = np.linalg.inv(precision[own[:, :, None], own[:, None, :]])
    maps[sensors] = np.einsum("sj,sjd->sd", blocks[:, 0], precision[own]) / gain[sensors, None]
    expected[sensors] = np.sqrt(blocks[:, 0, 0]) / gain[sensors]
    return maps, expected


def distances(precision: FloatArray, scaled: FloatArray, out: npt.NDArray[np.intp] | None = None) -> FloatArray:
    """Return how far columns have gone, in all directions by their own deviation in training.

    Parameters
    ----------
    precision : shape (d, d)
        Inverse of the damped covariance of the scaled columns.
    scaled : shape (n, d)
        Scaled columns, less their mean.
    out
        Columns that do not count: their block is eliminated. None: all count.

    Returns
    -------
    numpy.ndarray, shape (n,)
        The root of ``x^T P x`` (Mahalanobis).

    """
    mapped = scaled @ precision
    squared = np.einsum("nd,nd->n", mapped, scaled)
    if out is not None and len(out):
        solved = np.linalg.solve(precision[np.ix_(out, out)], mapped[:, out].T)
        squared = squared - np.einsum("nd,dn->n", mapped[:, out], solved)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def limit_factor(distance: FloatArray | float, farthest: float) -> FloatArray:
    """Return by how much limits are widened at a distance of the columns: not at all inside the domain of training.

    Parameters
    ----------
    distance
        See `distances`.
    farthest
        Its largest value in training; 0: limits are never widened.

    Returns
    -------
    numpy.ndarray
        Of the shape of `distance`, 1 to `WIDEST`.

    """
    return np.clip(np.asarray(distance) / farthest, 1.0, WIDEST) if farthest > 0.0 else np.ones_like(distance)


def expected_columns(precision: FloatArray, scaled: FloatArray, out: npt.NDArray[np.intp]) -> FloatArray:
    """Return what the other scaled columns let be expected of some columns, shape (len(out),)."""
    others = scaled.copy()
    others[out] = 0.0
    return np.asarray(-np.linalg.solve(precision[np.ix_(out, out)], precision[out] @ others))
