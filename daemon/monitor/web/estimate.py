"""The estimate as a document: per channel the band, what sensors contribute, and what is measured beside it."""

from typing import Any

from config.schema import Configuration
from daemon.snapshots import SnapshotBoard
from models.json_values import plain


def estimate_document(configuration: Configuration, board: SnapshotBoard) -> dict[str, Any]:
    """Return the estimate now, channel by channel."""
    estimate = board.thermal.estimate
    if estimate is None:
        why = (board.model.problem if board.model is not None else "") or "no estimate has been made yet"
        unknown: dict[str, Any] = dict.fromkeys(("time", "model_id", "reference", "confidence", "in_domain"))
        return unknown | {"imputed": [], "channels": {}, "why": why}
    axes = configuration.compensation.axes
    channels = {
        channel: {
            "thermal_error_um": float(estimate.thermal_error_um[i]),
            "band_um": float(estimate.band_um[i]),
            "measured_um": None,
            "residual_um": None,
            "axes": [name for name, axis in axes.items() if axis.estimate == channel],
            "contributions": None,
        }
        for i, channel in enumerate(estimate.channels)
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
