"""Chatter and roughness from files."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daemon.workbench.stability.csv_rows import csv_rows
from drivers.files.accelerometer_recording import AccelerationRecording
from models.errors import StabilityError
from models.json_values import finite_or_none
from models.records import FloatArray
from models.stability.chatter import ChatterVerdict, detect_chatter
from models.stability.roughness import roughness_per_depth
from models.stability.signal_checks import check_clipping


@dataclass(frozen=True, slots=True, kw_only=True)
class Passage:
    """A part of a recording, cut at one depth."""

    from_s: float
    to_s: float
    depth_mm: float


def judge_recording(
    recording: AccelerationRecording, speed_rpm: float, teeth: int, passages: Sequence[Passage]
) -> dict[str, Any]:
    """Return the verdict of the whole recording, or of each depth; raises StabilityError."""
    signal, rate_hz = recording.acceleration_m_s2, recording.sample_rate_hz
    check_clipping(signal)
    if not passages:
        return _content(detect_chatter(signal, rate_hz, speed_rpm, teeth), recording, 0.0)
    depths = []
    for passage in passages:
        part, begin_s = _part(recording, passage)
        try:
            verdict = detect_chatter(part, rate_hz, speed_rpm, teeth)
        except StabilityError as error:
            raise StabilityError(
                f"{passage.from_s:g} to {passage.to_s:g} s, {passage.depth_mm:g} mm: {error}"
            ) from None
        depths.append({"depth_mm": passage.depth_mm, **_content(verdict, recording, begin_s)})
    chattering = [entry for entry in depths if entry["chatter"]]
    first = min(chattering, key=lambda entry: float(entry["depth_mm"])) if chattering else depths[0]
    whole = {name: value for name, value in first.items() if name != "depth_mm"}
    lowest = {"lowest_chatter_depth_mm": first["depth_mm"] if chattering else None}
    return {**whole, **lowest, "depths": depths}


def _part(recording: AccelerationRecording, passage: Passage) -> tuple[FloatArray, float]:
    rate_hz, start_s = recording.sample_rate_hz, recording.start_s
    length = len(recording.acceleration_m_s2)
    places = [(time_s - start_s) * rate_hz for time_s in (passage.from_s, passage.to_s)]
    first, last = (round(min(max(place, -1.0), length + 2.0)) for place in places)
    if not 0 <= first < last <= length + 1:
        raise StabilityError(
            f"the passage from {passage.from_s:g} to {passage.to_s:g} s is not inside the recording, which runs from "
            f"{start_s:g} to {start_s + length / rate_hz:g} s"
        )
    return recording.acceleration_m_s2[first:last], (first / rate_hz)


def _content(verdict: ChatterVerdict, recording: AccelerationRecording, begin_s: float) -> dict[str, Any]:
    offset_s = recording.start_s + begin_s
    return {
        "chatter": verdict.chatter,
        "frequency_hz": verdict.frequency_hz,
        "onset_s": None if verdict.onset_s is None else verdict.onset_s + offset_s,
        "share": verdict.share,
        "power_ratio": finite_or_none(verdict.power_ratio),
        "tooth_passing_hz": verdict.tooth_passing_hz,
        "sample_rate_hz": recording.sample_rate_hz,
        "frames": [
            {name: value for name, value in asdict(frame).items() if name != "tooth_passing_hz"}
            | {"time_s": frame.time_s + offset_s}
            for frame in verdict.frames
        ],
    }


PROFILE_COLUMNS = ("position_mm", "height_um")
DEPTH_COLUMN = "depth_mm"


def judge_profile(path: Path, cutoff_mm: float | None) -> list[dict[str, Any]]:
    """Return the roughness per depth of a profile (CSV: position_mm,height_um[,depth_mm]); raises StabilityError."""
    with csv_rows(path, "profile") as reader:
        names = reader.fieldnames or []
        if missing := [name for name in PROFILE_COLUMNS if name not in names]:
            raise StabilityError(f"{path}:1: there is no column {' and '.join(missing)} in {', '.join(names)}")
        rows = [_profile_row(path, number, row) for number, row in enumerate(reader, start=2)]
    if not rows:
        raise StabilityError(f"{path}: holds no points after its header")
    table = np.array(rows)
    try:
        found = roughness_per_depth(table[:, 2], table[:, 0], table[:, 1], cutoff_mm)
    except StabilityError as error:
        raise StabilityError(f"{path}: {error}") from None
    return [
        {"depth_mm": depth if DEPTH_COLUMN in names else None, **asdict(roughness)}
        for depth, roughness in found.items()
    ]


def _profile_row(path: Path, number: int, row: dict[str, str | None]) -> tuple[float, float, float]:
    try:
        values = [float(row[name] or "") for name in PROFILE_COLUMNS]
        depth = float(row[DEPTH_COLUMN] or "") if DEPTH_COLUMN in row else 0.0
    except ValueError:
        raise StabilityError(f"{path}:{number}: a field is no number; remove the row or measure again") from None
    if not all(math.isfinite(value) for value in (*values, depth)):
        raise StabilityError(f"{path}:{number}: a value is not finite; remove the row or measure again")
    return values[0], values[1], depth
