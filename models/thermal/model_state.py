"""What a thermal model in use remembers from one sample to the next."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.records import FloatArray
from models.thermal.watch import WatchState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelState:
    """State of a model from one sample to the next."""

    time_min: float
    """Time of the latest sample [min], on the caller's clock."""
    degc: FloatArray
    """Latest known temperatures [degC], shape (n_sensors,)."""
    missing: npt.NDArray[np.bool_]
    """Which of them the latest sample did not hold."""
    known_min: FloatArray
    """When each sensor was last known [min], shape (n_sensors,)."""
    since_min: FloatArray
    """Since when each sensor has been known without a longer gap [min], shape (n_sensors,)."""
    unknown: FloatArray
    """Share of each lag, those of speed last, that nobody recorded, when temperature or speed was last known, 0..1."""
    speed_rpm: float
    """Latest known spindle speed [1/min]."""
    speed_known_min: float
    lagged: FloatArray
    """Lags of temperatures [degC], shape (n_lags, n_sensors)."""
    known_lagged: FloatArray
    """Lags of each sensor when it was last known [degC], shape (n_lags, n_sensors)."""
    speed_lagged: FloatArray
    """Lags of the inputs from speed, shape (n_speed_lags, 2)."""
    watch: WatchState | None
    """Memory of the watch of the sensors; None when the model carries none."""
