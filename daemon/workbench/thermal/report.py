"""Report on a recording in the words of ISO 230-3, with and without compensation, as JSON."""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from daemon.workbench.thermal.estimates import RecordedEstimates
from models.json_values import finite_or_none
from models.recordings.dataset import DatasetError, Recording
from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.training.distortion import (
    Stretch,
    distortion,
    rotations,
    settled_stretches,
    stable_after_min,
    value_range_um,
)
from models.thermal.training.energy import Process, energy_efficiency, productivity_per_h
from models.thermal.training.warm_up import fit_warm_up

_AXIS = re.compile(r"^([XYZABC])(?![A-Za-z])|(?<![A-Za-z])[dD]?([XYZ])\d*(?![A-Za-z])")
"""A channel is of the axis that it begins with, or whose letter stands in it by itself: `Z1`, `Weg Z [µm]`; `Channel 1`
is of none."""
CONSTANT_SPEED = 0.05
"""A rotation is at constant speed when its speeds differ by less than this share."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportChoices:
    ahead_min: float
    """Time ahead over which a drift counts [min]."""
    tolerance_um: float
    """Largest drift in it [um]."""
    settled_h: float
    """Standstill after a rotation that does not count for the environment [h]."""
    standing: bool
    """The spindle stood all the time, although no speed was recorded."""
    ambient: tuple[str, ...]
    """Names or patterns of the temperatures of the air."""
    chiller_kw: float
    process: Process | None
    """Energy and time of a part, for equations 1-1 and 1-2."""


class _Series:
    """The displacements of a recording, and what a model leaves of them."""

    def __init__(self, recording: Recording, model: ThermalModel | None) -> None:
        self.recording = recording
        self.time_min: FloatArray = recording.time_s / 60.0
        self._estimates = None if model is None else RecordedEstimates(model, recording)
        if self._estimates is not None and not self._estimates.estimates(recording.displacement_names):
            raise DatasetError(f"{recording.name}: the model estimates none of its displacements")

    def error_um(self, channel: str, stretch: Stretch) -> FloatArray:
        """Return the raw displacement of a stretch [um]."""
        place = self.recording.displacement_names.index(channel)
        return self.recording.displacements_um[stretch.first : stretch.stop, place]

    def residual_um(self, channel: str, stretch: Stretch) -> FloatArray | None:
        """Return what the model leaves of it, with its reference at the stretch's first row; None without a model."""
        if self._estimates is None or channel not in self._estimates.model.channels:
            return None
        return self.error_um(channel, stretch) - self._estimates.since_um(channel, stretch.first, stretch.stop)

    def both(self, channel: str, stretch: Stretch) -> dict[str, FloatArray]:
        """Return both by `without` and `with`."""
        found = {"without": self.error_um(channel, stretch)}
        residual_um = self.residual_um(channel, stretch)
        return found if residual_um is None else found | {"with": residual_um}


def thermal_report(recording: Recording, model: ThermalModel | None, choices: ReportChoices) -> dict[str, Any]:
    """Return the report; raises DatasetError when the recording or the model does not allow it."""
    series = _Series(recording, model)
    turns = [] if recording.speed_rpm is None else rotations(recording.speed_rpm)
    stands: list[Stretch] = []
    if recording.speed_rpm is not None or choices.standing:
        stands = settled_stretches(series.time_min, recording.speed_rpm, 60.0 * choices.settled_h)
    channels = {name: _channel(series, name, turns, stands, choices) for name in recording.displacement_names}
    return {
        "standard": "ISO 230-3",
        "recording": recording.name,
        "hours": round(float(series.time_min[-1] - series.time_min[0]) / 60.0, 4),
        "model": None if model is None else model.model_id,
        "seen_in_training": model is not None
        and any(data.name.rpartition("/")[2] == recording.name for data in model.training),
        "rotations": [_rotation(series, stretch) for stretch in turns],
        "environment": _environment(recording, series.time_min, stands, choices),
        "drift": {"ahead_min": choices.ahead_min, "tolerance_um": choices.tolerance_um},
        "channels": channels,
        "axes": _axes(channels),
        "energy": _energy(recording, series.time_min, choices),
    }


def _rotation(series: _Series, stretch: Stretch) -> dict[str, Any]:
    speed = series.recording.speed_rpm
    assert speed is not None
    turning = speed[stretch.first + 1 : stretch.stop]
    return {
        "from_h": round(float(series.time_min[stretch.first]) / 60.0, 4),
        "minutes": round(float(series.time_min[stretch.stop - 1] - series.time_min[stretch.first]), 2),
        "lowest_rpm": _rounded(float(np.nanmin(turning))) if len(turning) else None,
        "highest_rpm": _rounded(float(np.nanmax(turning))) if len(turning) else None,
    }


def _channel(
    series: _Series, name: str, turns: Sequence[Stretch], stands: Sequence[Stretch], choices: ReportChoices
) -> dict[str, Any]:
    spindle = [_spindle(series, name, stretch, choices) for stretch in turns]
    axis = _AXIS.search(name)
    found: dict[str, Any] = {
        "axis": None if axis is None else axis[1] or axis[2],
        "distortion_by_rotating_spindle": spindle,
    }
    for kind in ("without", "with"):
        ranges = [value_range_um(both[kind]) for both in (series.both(name, s) for s in stands) if kind in both]
        found[f"worst_{kind}"] = {
            "first_60_min_um": _largest([turn[kind]["first_60_min_um"] for turn in spindle if kind in turn]),
            "whole_period_um": _largest([turn[kind]["whole_period_um"] for turn in spindle if kind in turn]),
            "environmental_temperature_variation_error_um": _largest([_rounded(each) for each in ranges]),
        }
    return found


def _spindle(series: _Series, name: str, stretch: Stretch, choices: ReportChoices) -> dict[str, Any]:
    time_min = series.time_min[stretch.first : stretch.stop]
    found: dict[str, Any] = {}
    for kind, values in series.both(name, stretch).items():
        ranges = distortion(time_min, values)
        stable = stable_after_min(time_min, values, ahead_min=choices.ahead_min, tolerance_um=choices.tolerance_um)
        found[kind] = {
            "first_60_min_um": _rounded(ranges.first_60_min_um),
            "whole_period_um": _rounded(ranges.whole_um),
            "end_um": _rounded(ranges.end_um),
            "time_to_stability_min": _rounded(stable),
        }
    found["warm_up"] = _advice(series, stretch, time_min, series.error_um(name, stretch), choices)
    return found


def _advice(
    series: _Series, stretch: Stretch, time_min: FloatArray, error_um: FloatArray, choices: ReportChoices
) -> dict[str, Any]:
    speed = series.recording.speed_rpm
    assert speed is not None
    # The rows next to the spindle's start and stop may be means over both.
    inner = speed[stretch.first + 2 : stretch.stop - 1]
    if not len(inner) or np.nanmax(inner) - np.nanmin(inner) > CONSTANT_SPEED * np.nanmax(inner):
        return {"wait_min": None, "why_not": "the spindle did not turn at one constant speed"}
    try:
        fitted = fit_warm_up(time_min, error_um)
    except DatasetError as error:
        return {"wait_min": None, "why_not": str(error)}
    wait = fitted.wait_min(ahead_min=choices.ahead_min, tolerance_um=choices.tolerance_um)
    end_min = time_min[-1:] - time_min[0]
    return {
        "wait_min": _rounded(wait),
        "expected_drift_at_the_end_um": round(float(fitted.drift_um(end_min, choices.ahead_min)[0]), 3),
        "fit_rmse_um": round(fitted.rmse_um, 3),
        "beyond_what_was_measured": bool(wait > end_min[0]),
        "why_not": "the drift does not fall below the tolerance within a day" if math.isnan(wait) else None,
    }


def _environment(
    recording: Recording, time_min: FloatArray, stands: Sequence[Stretch], choices: ReportChoices
) -> dict[str, Any]:
    names = [name for name in recording.temperature_names if any(fnmatchcase(name, each) for each in choices.ambient)]
    if choices.ambient and not names:
        raise DatasetError(f"{recording.name}: no temperature matches {', '.join(choices.ambient)}")
    places = [recording.temperature_names.index(name) for name in names]
    stretches = []
    for stretch in stands:
        degc = recording.temperatures_degc[stretch.first : stretch.stop, places]
        air = np.nanmean(degc, axis=1) if places else np.array([])
        stretches.append(
            {
                "from_h": round(float(time_min[stretch.first]) / 60.0, 4),
                "minutes": round(float(time_min[stretch.stop - 1] - time_min[stretch.first]), 2),
                "temperature_range_k": _rounded(value_range_um(air)),
            }
        )
    why = None
    if recording.speed_rpm is None and not choices.standing:
        why = "no spindle speed was recorded; --standing says that the spindle stood all the time"
    elif not stands:
        why = f"the spindle never stood still for longer than {choices.settled_h:g} h after a rotation"
    return {"ambient": names, "settled_hours": choices.settled_h, "stretches": stretches, "why_not": why}


def _axes(channels: dict[str, Any]) -> dict[str, Any]:
    """Return the worst channel of each axis."""
    found: dict[str, dict[str, dict[str, float | None]]] = {}
    for each in channels.values():
        if each["axis"] is None:
            continue
        axis = found.setdefault(each["axis"], {"without": {}, "with": {}})
        for kind, worst in axis.items():
            for name, value in each[f"worst_{kind}"].items():
                worst[name] = _largest([worst.get(name), value])
    return dict(sorted(found.items()))


def _energy(recording: Recording, time_min: FloatArray, choices: ReportChoices) -> dict[str, Any]:
    hours = float(time_min[-1] - time_min[0]) / 60.0
    rotating_h = None
    if recording.speed_rpm is not None:
        rotating_h = sum(
            float(time_min[turn.stop - 1] - time_min[turn.first]) for turn in rotations(recording.speed_rpm)
        )
        rotating_h /= 60.0
    power = choices.chiller_kw
    found: dict[str, Any] = {
        "chiller_kw": power,
        "recording_h": round(hours, 4),
        "rotating_h": _rounded(rotating_h),
        "chiller_kwh": {
            "always_on": round(power * hours, 4),
            "idle_reduction": None if rotating_h is None else round(power * rotating_h, 4),
            "off": 0.0,
        },
        "process": None,
    }
    if choices.process is not None:
        share = None if rotating_h is None or not hours else rotating_h / hours
        found["process"] = _process(choices.process, power, share)
    return found


def _process(process: Process, chiller_kw: float, rotating_share: float | None) -> dict[str, Any]:
    runs = {"always_on": 1.0, "idle_reduction": rotating_share, "off": 0.0}
    return {
        **asdict(process),
        "productivity_per_h": round(productivity_per_h(process), 4),
        "energy_efficiency": {
            name: None
            if share is None
            else round(energy_efficiency(process, chiller_kw=chiller_kw, chiller_h=share * process.time_h), 5)
            for name, share in runs.items()
        },
    }


def _largest(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return max(known) if known else None


def _rounded(value: float | None) -> float | None:
    return finite_or_none(value, 4)
