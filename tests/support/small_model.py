"""A thermal model for the machine of the control rig."""

from typing import Any

import numpy as np
from control_rig import SENSOR_IDS

from models.thermal.linear import LinearModel
from models.thermal.training.making import FIRST_POSITION_ID, increment_model


def model(
    name: str = "ridge-1", band_um: float = 2.0, axis_positions: tuple[str, ...] = (), **changes: Any
) -> LinearModel:
    """Every sensor counts the same, an axis position 0.02 and 0.03 um/mm; the band is as wide on both channels."""
    count = len(SENSOR_IDS) + len(axis_positions)
    coefficients = np.vstack([np.full(count, 0.5), np.full(count, 1.0)])
    coefficients[:, len(SENSOR_IDS) :] = [[0.02], [0.03]]
    reach = np.array([20.0] * len(SENSOR_IDS) + [400.0] * len(axis_positions))
    content: dict[str, Any] = {
        "model_id": name,
        "kind": "ridge",
        "channels": ("Y1", "Z1"),
        "sensor_ids": (*SENSOR_IDS, *range(FIRST_POSITION_ID, FIRST_POSITION_ID + len(axis_positions))),
        "sensor_names": (*(f"t{i}" for i in SENSOR_IDS), *axis_positions),
        "axis_positions": axis_positions,
        "coefficients_um_per_k": coefficients,
        "drift_um_per_min": np.zeros(len(changes.get("channels", "YZ"))),
        "lowest_increment_k": -reach,
        "highest_increment_k": reach,
        "band_um": np.full(len(changes.get("channels", "YZ")), band_um),
        "training": (),
        "created": "2026-01-01T00:00:00Z",
        "test_pairs": [(np.full(count, 21.0), np.full(count, 20.0))],
    }
    return increment_model(**(content | changes))
