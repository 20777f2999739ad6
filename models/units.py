"""The only place where units are converted."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Length = TypeVar("Length", float, npt.NDArray[np.float64])

TMP102_DEGC_PER_LSB = 0.0625
"""Resolution of the TMP102 (12 and 13 bit) [degC]."""
MLX90615_K_PER_LSB = 0.02
"""Resolution of the MLX90615 [K]."""
ZERO_CELSIUS_K = 273.15


def um_from_mm(mm: float) -> float:
    """Return millimetres [mm] as micrometres [um]."""
    return mm * 1e3


def mm_from_m(metres: Length) -> Length:
    """Return metres [m] as millimetres [mm]; a number or an array."""
    return metres * 1e3


def m_from_mm(millimetres: Length) -> Length:
    """Return millimetres [mm] as metres [m]; a number or an array."""
    return millimetres * 1e-3


def degc_from_kelvin(kelvin: float) -> float:
    """Return kelvin [K] as degrees Celsius [degC]."""
    return kelvin - ZERO_CELSIUS_K


def int16_from_degc(degc: npt.NDArray[np.float64]) -> npt.NDArray[np.int16]:
    """Return temperatures [degC] as counts of 1/160 degC, NaN as -32768.

    1/160 degC divides the TMP102 step of 0.0625 degC exactly (10 counts) and holds the
    MLX90615 step of 0.02 degC to within half a count (0.0031 degC); range -204.7..+204.7 degC.
    """
    counts = np.where(np.isfinite(degc), np.clip(np.rint(degc * 160.0), -32767, 32767), -32768)
    return counts.astype(np.int16)


def degc_from_int16(counts: npt.NDArray[np.int16]) -> npt.NDArray[np.float64]:
    """Return counts of 1/160 degC as temperatures [degC], -32768 as NaN."""
    degc = counts.astype(np.float64) / 160.0
    degc[counts == -32768] = np.nan
    return degc
