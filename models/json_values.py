"""Values as JSON can carry them: no NaN, no infinity, no number of NumPy."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def finite_or_none(value: float | None, decimals: int | None = None) -> float | None:
    """Return a number, rounded where decimals are given; None for NaN, infinity and None."""
    if value is None or not math.isfinite(value):
        return None
    return float(value) if decimals is None else round(float(value), decimals)


def plain(value: Any) -> Any:
    """Return nested mappings, sequences, arrays and numbers as JSON can carry them; NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    return finite_or_none(value) if isinstance(value, float) else value
