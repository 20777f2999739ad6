"""Receptance coupling at many points: rigid (4-31), elastic (4-38), side by side (C-5), to ground (4-35).

Receptance matrices have the shape (n, 2 p, 2 p): n frequencies, p points, at each the displacement [m] and the
rotation [rad] against the force [N] and the moment [Nm], ordered (y_1, theta_1, y_2, ...). Entries are H, L; N, P
of 4-18. The product condenses stiffness (`models.dynamics.chain`); this is the dissertation's own way, and the product
is tested against it.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from models.dynamics.beam import ComplexArray, Segment
from models.dynamics.chain import SpringDamper
from models.dynamics.modes import segment_matrix
from models.records import FloatArray

POINT = 2
"""Coordinates of one point."""


def segment_receptance(segment: Segment, frequency_hz: FloatArray, offsets_m: list[float]) -> ComplexArray:
    """Return the receptance matrix of points of a free segment (4-16 to 4-18, summed over all modes).

    Parameters
    ----------
    segment
        The segment with its structural damping.
    frequency_hz
        Frequencies [Hz], shape (n,), positive.
    offsets_m
        Two or more points from its front [m], ascending, the first 0 and the last its length.

    Returns
    -------
    ndarray
        Shape (n, 2 p, 2 p).

    """
    each = [np.linalg.inv(segment_matrix(segment, float(at), offsets_m, damped=True)) for at in frequency_hz]
    return np.array(each, dtype=np.complex128)


def couple_rigid(first: ComplexArray, second: ComplexArray) -> ComplexArray:
    """Return two substructures joined rigidly, the last point of one to the first of the other (4-31).

    Parameters
    ----------
    first, second
        Shapes (n, 2 p_A, 2 p_A) and (n, 2 p_B, 2 p_B).

    Returns
    -------
    ndarray
        Shape (n, 2 (p_A + p_B - 1), ...); the common point appears once, among those of the first.

    """
    whole = _joined(first, second, np.linalg.inv(first[:, -POINT:, -POINT:] + second[:, :POINT, :POINT]))
    size = first.shape[1]
    kept = [*range(size), *range(size + POINT, whole.shape[1])]
    return whole[:, kept][:, :, kept]


def couple_elastic(
    first: ComplexArray, second: ComplexArray, joint: SpringDamper, frequency_hz: FloatArray
) -> ComplexArray:
    """Return two substructures joined by springs and dampers (4-38); both ends of the joint are kept.

    Written with K instead of its inverse, so that a joint may leave a coordinate free.

    Parameters
    ----------
    first, second
        Shapes (n, 2 p_A, 2 p_A) and (n, 2 p_B, 2 p_B).
    joint
        K_ab of 4-37 between the last point of the first and the first of the second.
    frequency_hz
        Frequencies [Hz], shape (n,).

    Returns
    -------
    ndarray
        Shape (n, 2 (p_A + p_B), ...).

    """
    stiffness = spring_matrix(joint, frequency_hz)
    flexible = first[:, -POINT:, -POINT:] + second[:, :POINT, :POINT]
    return _joined(first, second, np.linalg.solve(np.eye(POINT) + stiffness @ flexible, stiffness))


def couple_sideways(first: ComplexArray, second: ComplexArray) -> ComplexArray:
    """Return two substructures side by side, each point of one tied to the same point of the other (C-5).

    Parameters
    ----------
    first, second
        Both of shape (n, 2 p, 2 p).

    Returns
    -------
    ndarray
        The same shape.

    """
    return first @ np.linalg.inv(first + second) @ second


def ground(receptance: ComplexArray, stiffness: ComplexArray) -> ComplexArray:
    """Return a substructure whose points are tied to the ground (4-35, with K used directly).

    Parameters
    ----------
    receptance
        Of the free substructure, shape (n, 2 p, 2 p).
    stiffness
        Of the ties, shape (n, 2 p, 2 p); zero where a point is free (`ground_stiffness`).

    """
    size = receptance.shape[1]
    return np.asarray(np.linalg.solve(np.eye(size) + receptance @ stiffness, receptance), dtype=np.complex128)


def ground_stiffness(springs: list[SpringDamper | None], frequency_hz: FloatArray) -> ComplexArray:
    """Return the block-diagonal K of 4-32 and 4-33 for p points, None where there is no bearing."""
    size = POINT * len(springs)
    total = np.zeros((len(frequency_hz), size, size), dtype=np.complex128)
    for index, spring in enumerate(springs):
        if spring is not None:
            at = slice(POINT * index, POINT * index + POINT)
            total[:, at, at] = spring_matrix(spring, frequency_hz)
    return total


def spring_matrix(spring: SpringDamper, frequency_hz: FloatArray) -> ComplexArray:
    """Return K of 4-33 and 4-37, shape (n, 2, 2)."""
    rows = spring.stiffness(frequency_hz, damped=True)
    matrix = np.zeros((len(frequency_hz), POINT, POINT), dtype=np.complex128)
    matrix[:, 0, 0], matrix[:, 1, 1] = rows[0], rows[2]
    return matrix


def _joined(first: ComplexArray, second: ComplexArray, core: npt.NDArray[Any]) -> ComplexArray:
    """Return the common form of 4-31 and 4-38; `core` is the inverse of what the joint adds up."""
    size, rest = first.shape[1], second.shape[1]
    whole = np.zeros((len(first), size + rest, size + rest), dtype=np.complex128)
    from_first, to_first = first[:, :, -POINT:] @ core, first[:, -POINT:, :]
    from_second, to_second = second[:, :, :POINT] @ core, second[:, :POINT, :]
    whole[:, :size, :size] = first - from_first @ to_first
    whole[:, :size, size:] = from_first @ to_second
    whole[:, size:, :size] = from_second @ to_first
    whole[:, size:, size:] = second - from_second @ to_second
    return whole
