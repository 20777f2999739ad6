"""A thermal model for the machine of the control rig."""

import numpy as np
from control_rig import SENSOR_IDS

from models.thermal.linear import LinearModel
from models.thermal.training.making import increment_model


def model(name: str = "ridge-1", band_um: float = 2.0) -> LinearModel:
    """Every sensor counts the same; the band is as wide on both channels."""
    count = len(SENSOR_IDS)
    coefficients = np.vstack([np.full(count, 0.5), np.full(count, 1.0)])
    pair = (np.full(count, 21.0), np.full(count, 20.0))
    return increment_model(
        model_id=name,
        kind="ridge",
        channels=("Y1", "Z1"),
        sensor_ids=SENSOR_IDS,
        sensor_names=tuple(f"t{i}" for i in SENSOR_IDS),
        coefficients_um_per_k=coefficients,
        drift_um_per_min=np.zeros(2),
        lowest_increment_k=np.full(count, -20.0),
        highest_increment_k=np.full(count, 20.0),
        band_um=np.full(2, band_um),
        training=(),
        created="2026-01-01T00:00:00Z",
        test_pairs=[pair],
    )
