"""The estimate as a document: per channel the band, what sensors contribute, and what is measured beside it."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from config.schema import Configuration
from daemon.history.reader import HistoryReader
from daemon.snapshots import Contributions, ControlSnapshot, SnapshotBoard
from models.json_values import plain


def estimate_document(
    configuration: Configuration, board: SnapshotBoard, then_um: Mapping[str, float], now_um: Mapping[str, float]
) -> dict[str, Any]:
    """Return the estimate now, channel by channel; displacements at the reference and now [um] by channel."""
    estimate = board.thermal.estimate
    if estimate is None:
        why = (board.model.problem if board.model is not None else "") or "no estimate has been made yet"
        unknown: dict[str, Any] = dict.fromkeys(("time", "model_id", "reference", "confidence", "in_domain"))
        return unknown | {"imputed": [], "channels": {}, "why": why}
    axes = configuration.compensation.axes
    channels = {}
    for i, channel in enumerate(estimate.channels):
        own = [name for name, axis in axes.items() if axis.estimate == channel]
        estimated_um = float(estimate.thermal_error_um[i])
        measured_um = math.nan
        if channel in then_um and channel in now_um:
            measured_um = now_um[channel] - then_um[channel] - _applied_since_um(board.control, own)
        channels[channel] = {
            "thermal_error_um": estimated_um,
            "band_um": float(estimate.band_um[i]),
            "measured_um": measured_um,
            "residual_um": measured_um - estimated_um,
            "axes": own,
            **({"unit": "um/m"} if channel in configuration.compensation.slope_channels else {}),
            "contributions": _contributions(configuration, board.thermal.contributions, channel),
        }
    document = plain(
        {
            "time": (estimate.trace.estimated or estimate.trace.last_byte).utc_s,
            "model_id": estimate.model_id,
            "reference": estimate.reference_id,
            "confidence": estimate.confidence,
            "in_domain": estimate.in_domain,
            "imputed": list(estimate.imputed),
            "channels": channels,
            "why": estimate.inhibit,
        }
    )
    assert isinstance(document, dict)
    return document


def _applied_since_um(control: ControlSnapshot, axes: list[str]) -> float:
    """Return what was applied since the reference on the axis that a channel measures [um]: its sensor feels that."""
    if not axes:
        return 0.0
    place = control.axes.index(axes[0])
    return float(control.applied_um[place] - control.baseline_um[place])


def _contributions(
    configuration: Configuration, found: Contributions | None, channel: str
) -> list[dict[str, Any]] | None:
    """Return what sensors add to a channel, the largest first; None where the model does not tell."""
    if found is None or channel not in found.channels:
        return None
    um = found.um[:, found.channels.index(channel)]
    sensors = {sensor.id: sensor for sensor in configuration.temperatures.every_sensor}
    return [
        {
            "sensor": sensor_id,
            "component": sensors[sensor_id].component,
            "part": None if sensors[sensor_id].part == "-" else sensors[sensor_id].part,
            "um": round(float(um[i]), 4),
        }
        for i in np.argsort(-np.abs(um), kind="stable").tolist()
        if (sensor_id := found.sensor_ids[i]) in sensors
    ]


def displacements_around(reader: HistoryReader, time_s: float, within_s: float) -> dict[str, float]:
    """Return the mean displacement of each channel around a time [um]; channels without a value are left out."""
    found = reader.displacements(time_s - within_s, time_s + within_s)
    known = {name: values[np.isfinite(values)] for name, values in found.um.items()}
    return {name: float(values.mean()) for name, values in known.items() if values.size}
