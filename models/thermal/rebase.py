"""A sensor that returns goes on from where it was imputed."""

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.estimate import Estimator


def rebased_reference_degc(
    estimator: Estimator,
    degc: FloatArray,
    reference_degc: FloatArray,
    returned: npt.NDArray[np.bool_],
    elapsed_min: float,
) -> FloatArray:
    """Return the reference temperatures with which returned sensors count on from their imputed increments.

    The return of a sensor then moves nothing, however wrong its temperature was before or is now;
    what it says from then on counts. A sensor that was missing at the reference gets its first
    value to count from in the same way.

    Parameters
    ----------
    estimator
        Of the model in use; imputes what has no increment.
    degc, reference_degc : shape (n_sensors,)
        Temperatures now and at the reference [degC], NaN where there is none.
    returned : shape (n_sensors,)
        Sensors that were imputed until now and have a temperature again.
    elapsed_min
        Time since the reference [min].

    Returns
    -------
    numpy.ndarray, shape (n_sensors,)
        Temperatures at the reference [degC]; unchanged when no other sensor is left to impute from.

    """
    if not returned.any():
        return reference_degc
    without = estimator.renew(np.where(returned, np.nan, degc), reference_degc, elapsed_min)
    if without is None:
        return reference_degc
    return np.where(returned, degc - without.increment_k, reference_degc)
