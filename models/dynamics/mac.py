"""Modal assurance criterion."""

import numpy as np
import numpy.typing as npt

from models.records import FloatArray


def modal_assurance(first: npt.NDArray[np.generic], second: npt.NDArray[np.generic]) -> float:
    """Return how alike two shapes are, 0 to 1 (4-39, with the conjugates that complex vectors need).

    Parameters
    ----------
    first, second
        Real or complex displacements at the same points, shape (n,).

    Raises
    ------
    ValueError
        When a shape is zero everywhere or the numbers of points differ.

    """
    one, two = np.asarray(first, dtype=np.complex128), np.asarray(second, dtype=np.complex128)
    if one.shape != two.shape or one.ndim != 1:
        raise ValueError(f"two shapes at the same points are needed, got {one.shape} and {two.shape}")
    size = float(np.vdot(one, one).real * np.vdot(two, two).real)
    if not size > 0.0:
        raise ValueError("a shape that is zero everywhere is like nothing")
    return float(abs(np.vdot(one, two)) ** 2 / size)


def at_points(position_m: FloatArray, shape: FloatArray, wanted_m: FloatArray) -> FloatArray:
    """Return a shape at other points [m] by linear interpolation between its own, shape (len(wanted_m),)."""
    return np.interp(wanted_m, position_m, shape)
