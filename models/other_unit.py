"""Whether an input of temperatures has gone over to another unit: all its numbers are where that unit puts them."""

import numpy as np

from models.records import FloatArray

UNITS = {"degF": (1.8, 32.0), "K": (1.0, 273.15)}
"""Unit -> what it is per kelvin, and at 0 degC."""
LEAST_JUMP_K = 10.0
"""A number that goes by less is in no other unit [K]."""
NEAR_K = 5.0
"""So near to where it was at least half of the sensors are, taken in the other unit [K]."""
FEWEST, SHARE = 2, 0.75
"""So many sensors tell it, and such a share of all is nearer to where it was in the other unit than in its own."""


def other_unit(before_degc: FloatArray, read: FloatArray, configured: str, said: str) -> str:
    """Return in which unit an input now says its temperatures, '' in the one that is configured.

    Parameters
    ----------
    before_degc : shape (n_sensors,)
        What counted last of each sensor [degC], NaN where nothing did.
    read : shape (n_sensors,)
        Its latest number [degC if the input says what is configured], NaN where there is none.
    configured
        What is taken for its unit: 'degC', 'degF' or 'K'.
    said
        What was returned before: it stays so until the numbers are nearer in the configured unit, however far the
        machine has warmed or cooled meanwhile.

    """
    jump_k = np.abs(read - before_degc)
    if not said and int((jump_k > LEAST_JUMP_K).sum()) < FEWEST:
        return ""
    known = np.isfinite(jump_k)
    if not known.any():
        return said
    gain, zero = UNITS.get(configured, (1.0, 0.0))
    for unit, (other_gain, other_zero) in {"degC": (1.0, 0.0), **UNITS}.items():
        if unit == configured:
            continue
        off_k = np.abs((read[known] * gain + zero - other_zero) / other_gain - before_degc[known])
        nearer = (off_k < jump_k[known]) & (said == unit or jump_k[known] > LEAST_JUMP_K)
        enough = nearer.sum() >= max(FEWEST, SHARE * known.sum())
        if enough and (said == unit or 2 * (off_k <= NEAR_K).sum() >= known.sum()):
            return unit
    return ""
