"""The telescoped form of the increment model.

The sum 3-5 of the increments 3-1 leaves only its ends: R = b_0 t + b . (T_now - T_reference).
It needs no running sum, loses nothing over a gap, and can be renewed with every sensor cycle.
"""

import numpy as np

from models.records import FloatArray


def thermal_error_um(
    coefficients_um_per_k: FloatArray,
    drift_um_per_min: FloatArray,
    increment_k: FloatArray,
    elapsed_min: float | FloatArray,
) -> FloatArray:
    """Return the thermal error since the reference.

    Parameters
    ----------
    coefficients_um_per_k : shape (n_channels, n_sensors)
        b [um/K].
    drift_um_per_min : shape (n_channels,)
        b_0 per minute [um/min].
    increment_k : shape (n_sensors,) or (n, n_sensors)
        Temperatures now minus at the reference [K].
    elapsed_min : scalar or shape (n,)
        Time since the reference [min].

    Returns
    -------
    numpy.ndarray, shape (n_channels,) or (n, n_channels)
        Actual minus nominal [um].

    """
    drift_um = np.multiply.outer(np.asarray(elapsed_min), drift_um_per_min)
    error: FloatArray = increment_k @ coefficients_um_per_k.T + drift_um
    return error
