"""Compares the temperature sensors of recordings: which few are worth having, what each one removed costs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from models.recordings.dataset import Recording
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import build_inputs, unusable_sensors, with_sensors
from models.thermal.training.prepared import require_rows
from models.thermal.training.selection import Method, SensorComparison


def compare_sensors(
    recordings: Sequence[Recording], sample_s: float, hours: tuple[float, float] | None, method: Method, most: int
) -> dict[str, Any]:
    """Return the order of sensors and their prices for JSON; raises DatasetError."""
    plain = build_inputs(recordings, sample_s=sample_s, lags_min=(), speed_lags_min=())
    wanted = np.ones(plain.rows, dtype=np.bool_) if hours is None else plain.rows_between(*hours)
    require_rows(plain, wanted, wanted & np.isfinite(plain.cleansed_um).all(axis=1))
    left_out = unusable_sensors(plain, wanted)
    kept = [name for name in plain.sensor_names if name not in left_out]
    inputs = build_inputs([with_sensors(recording, kept) for recording in recordings], sample_s=sample_s)
    rows = wanted & inputs.trainable()
    require_rows(inputs, wanted, rows)
    fold, kind = inner_folds(inputs, rows)
    comparison = SensorComparison(inputs, rows, fold)
    selection = comparison.select(method, most)
    return {
        "method": method,
        "folds": kind,
        "all_sensors": comparison.score(range(inputs.layout.sensors)),
        "selected": [
            {"count": count, "relative_rmse": score} for count, score in enumerate(selection.relative_rmse, start=1)
        ],
        "order": list(selection.sensors),
        "prices": [
            {"sensor": price.sensor, "relative_rmse": price.relative_rmse, "rise": price.rise}
            for price in comparison.prices()
        ],
        "temperatures_left_out": left_out,
    }
