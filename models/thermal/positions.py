"""How far training knows the axis positions that a model is given on line."""

import numpy as np

from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.model import Domain

FADES_OVER = 0.1
"""Beyond the positions of training confidence fades to 0 within this share of their range."""
LEAST_WIDTH_MM = 1.0
"""... and within this at least [mm]."""


def beyond_positions(model: ThermalModel, mean_mm: FloatArray, then_mm: FloatArray) -> FloatArray:
    """Return how far each position lies beyond those of training, in shares of the range over which trust fades.

    Result: of the shape of `mean_mm`; 0 within training, infinite where the model does not tell how far that went.

    `model`: its last inputs are the axis positions. `mean_mm`, shape (n_axes,) or (n, n_axes): positions in the mean
    [mm], NaN where not known. `then_mm`, shape (n_axes,): where the axes stood at the reference [mm].
    """
    domain: Domain | None = getattr(model, "domain", None)
    if domain is None:
        return np.full(mean_mm.shape, np.inf)
    of_axes = slice(len(domain.lowest) - len(then_mm), None)
    lowest, highest = domain.lowest[of_axes], domain.highest[of_axes]
    seen = mean_mm - then_mm if domain.of_increments else mean_mm
    width = np.maximum(FADES_OVER * (highest - lowest), LEAST_WIDTH_MM)
    return np.asarray(np.maximum(np.maximum(lowest - seen, seen - highest), 0.0) / width)


def trust_in_positions(beyond: FloatArray) -> FloatArray:
    """Return how far an estimate may be followed at such positions, 0..1, of the last axis the worst."""
    return np.asarray(np.clip(1.0 - beyond.max(axis=-1, initial=0.0), 0.0, 1.0))
