"""The dynamics as a document: the tool point's response, its resonances, lobes, and the working point."""

from typing import Any

from daemon.snapshots import SnapshotBoard
from drivers.clock import Clock
from models.json_values import plain


def dynamics_document(board: SnapshotBoard, clock: Clock) -> dict[str, Any] | None:
    """Return what the operation under way was planned from; None where the tuning is not configured."""
    speed, cnc, now = board.spindle_speed, board.control.cnc, clock.now()
    if speed is None:
        return None
    diagram = speed.diagram
    actual_rpm = cnc.sample.spindle_speed_rpm if cnc is not None else None
    document: dict[str, Any] = {
        "operation": speed.operation,
        "state": speed.state,
        "why": speed.alarm or speed.reason,
        "working_point": {
            "speed_rpm": speed.applied_rpm or speed.programmed_rpm or actual_rpm,
            "target_rpm": speed.target_rpm,
            "depth_mm": diagram.demanded_depth_mm if diagram is not None else None,
            "limiting_depth_mm": speed.limiting_depth_mm,
        },
    }
    if diagram is not None:
        shift_s = now.utc_ahead_s
        document["lobes"] = {"speed_rpm": diagram.speed_rpm, "limiting_depth_mm": diagram.limiting_depth_mm}
        document["response"] = {
            "frequency_hz": diagram.frequency_hz,
            "magnitude_um_per_n": diagram.receptance_um_per_n,
        }
        document["resonance"] = {
            "t": [shift_s + each for each in diagram.resonance_time_s],
            "hz": diagram.resonance_hz,
        }
    cleaned = plain(document)
    assert isinstance(cleaned, dict)
    return cleaned
