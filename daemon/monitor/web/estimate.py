"""The estimate as a document: per channel the band, what sensors contribute, and what is measured beside it."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from config.schema import Configuration
from daemon.history.reader import HistoryReader
from daemon.snapshots import Contributions, ControlSnapshot, SnapshotBoard
from drivers.guard.sloped_axes import SAME_PLACE_MM, SlopedAxis, added_um, sloped_axes
from models.json_values import plain
from models.records import ThermalErrorEstimate

AROUND_S = 30.0
"""What is measured at an instant is the mean so long before and after it [s]."""
STOOD_MM = 1.0
"""An axis that moves by more while something is measured is nowhere [mm]."""
Measured = Mapping[str, float]


def estimate_document(
    configuration: Configuration,
    board: SnapshotBoard,
    then_um: Measured,
    now_um: Measured,
    then_mm: Measured = MappingProxyType({}),
    now_mm: Measured = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the estimate now, channel by channel; displacements at the reference and now [um] by channel.

    `then_mm`, `now_mm`: where axes with a slope stood meanwhile, by axis: what is measured there is judged there.
    """
    estimate = board.thermal.estimate
    if estimate is None:
        why = (board.model.problem if board.model is not None else "") or "no estimate has been made yet"
        unknown: dict[str, Any] = dict.fromkeys(("time", "model_id", "reference", "confidence", "in_domain"))
        return unknown | {"imputed": [], "channels": {}, "why": why}
    axes, sloped = configuration.compensation.axes, sloped_axes(configuration)
    channels = {}
    for i, channel in enumerate(estimate.channels):
        own = [name for name, axis in axes.items() if axis.estimate == channel]
        estimated_um = float(estimate.thermal_error_um[i])
        measured_um = math.nan
        if channel in then_um and channel in now_um:
            measured_um = now_um[channel] - then_um[channel] - _applied_since_um(board.control, own)
        there: dict[str, Any] = {}
        if own and (one := sloped.get(own[0])) is not None:
            stood = then_mm.get(one.axis, math.nan), now_mm.get(one.axis, math.nan)
            there, said_um, applied_um = _there(configuration, board, one, estimate, stood)
            measured_um, estimated_um = measured_um - applied_um, estimated_um + said_um
            if channel not in then_um or channel not in now_um:
                there["not_judged"] = ""  # nothing was measured
        channels[channel] = {
            "thermal_error_um": float(estimate.thermal_error_um[i]),
            "band_um": float(estimate.band_um[i]),
            "measured_um": measured_um,
            "residual_um": measured_um - estimated_um,
            **there,
            "axes": own,
            **({"unit": "um/m"} if channel in configuration.compensation.slope_channels else {}),
            "contributions": _contributions(configuration, board.thermal.contributions, channel),
        }
    return plain(
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


def _there(
    configuration: Configuration,
    board: SnapshotBoard,
    one: SlopedAxis,
    estimate: ThermalErrorEstimate,
    stood_mm: tuple[float, float],
) -> tuple[dict[str, Any], float, float]:
    """Return what is told of where an axis with a slope stands, and what that adds to estimate and compensation [um].

    NaN where nobody knows; `stood_mm`: where it stood at the reference, and where it stands now.
    """
    channel, now_mm = configuration.compensation.axes[one.slope].estimate, stood_mm[1]
    known = channel in estimate.channels
    per_m = float(estimate.thermal_error_um[estimate.channels.index(channel)]) if known and channel else 0.0
    applied_per_m = _applied_since_um(board.control, [one.slope])
    along_m = one.along_m(now_mm)
    said_um = float(added_um(per_m, along_m))
    applied_um = float(added_um(applied_per_m, along_m if one.follows else math.nan))
    why = "" if math.isfinite(said_um + applied_um) else one.why_unknown(applied_per_m)
    if math.inf in stood_mm:
        why = (
            f"axis {one.axis} moved within {AROUND_S:g} s of the reference or of now: let it stand while it is measured"
        )
    if not why and math.isnan(stood_mm[0]) != math.isnan(now_mm):
        why = one.silent
    if not why and abs(now_mm - stood_mm[0]) > SAME_PLACE_MM:
        why = (
            f"axis {one.axis} stood at {stood_mm[0]:.0f} mm at the reference and stands at {now_mm:.0f} mm now, and "
            "how the machine errs along it when cold is not known"
        )
    told = {"pivot_mm": one.pivot_mm, "position_mm": now_mm, "not_judged": why}
    return told, said_um, math.nan if why else applied_um


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


def positions_around(
    configuration: Configuration, reader: HistoryReader, time_s: float, within_s: float
) -> dict[str, float]:
    """Return where each axis with a slope stood around a time [mm]: infinite where it moved, none where nobody says."""
    if not (sloped := sloped_axes(configuration)):
        return {}
    found, stood = reader.cnc(time_s - within_s, time_s + within_s).positions_mm, {}
    for name, one in sloped.items():
        mm = found.get(one.position or "", np.empty(0))
        mm = mm[np.isfinite(mm)]
        if mm.size:
            stood[name] = float(mm.mean()) if np.ptp(mm) <= STOOD_MM else math.inf
    return stood


def displacements_around(reader: HistoryReader, time_s: float, within_s: float) -> dict[str, float]:
    """Return the mean displacement of each channel around a time [um]; channels without a value are left out."""
    found = reader.displacements(time_s - within_s, time_s + within_s)
    known = {name: values[np.isfinite(values)] for name, values in found.um.items()}
    return {name: float(values.mean()) for name, values in known.items() if values.size}
