"""Chatter and roughness from files."""

import csv
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daemon.workbench.stability.csv_rows import csv_rows, field, line_of
from drivers.files.accelerometer_recording import AccelerationRecording
from models.errors import StabilityError
from models.json_values import finite_or_none
from models.records import FloatArray
from models.stability.chatter import ChatterVerdict, detect_chatter, speed_warning
from models.stability.signal_checks import check_clipping, check_length
from models.stability.spectra import machine_spectrum, standing_spectrum, window_samples

GROWTH = 1.25
"""Depths that differ by this factor tell what the cut makes from what the machine makes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Passage:
    """A part of a recording, cut at one depth."""

    from_s: float
    to_s: float
    depth_mm: float


def judge_recording(
    recording: AccelerationRecording,
    speed_rpm: float,
    teeth: int,
    passages: Sequence[Passage],
    idle: AccelerationRecording | None = None,
) -> dict[str, Any]:
    """Return the verdict of the whole recording, or of each depth; `idle`: without a cut. Raises StabilityError."""
    signal, rate_hz = recording.acceleration_m_s2, recording.sample_rate_hz
    check_clipping(signal)
    machine = None if idle is None else _machine(idle, rate_hz)
    if not passages:
        verdict = detect_chatter(signal, rate_hz, speed_rpm, teeth, machine=machine)
        return _content(verdict, recording, 0.0) | _warnings([verdict], speed_rpm, teeth)
    depths, verdicts = [], []
    parts = [_part(recording, passage) for passage in passages]
    if machine is None and max(one.depth_mm for one in passages) >= GROWTH * min(one.depth_mm for one in passages):
        machine = _standing(passages, [part for part, _ in parts], rate_hz)
    for passage, (part, begin_s) in zip(passages, parts, strict=True):
        with _named(passage):
            verdicts.append(detect_chatter(part, rate_hz, speed_rpm, teeth, machine=machine))
        depths.append({"depth_mm": passage.depth_mm, **_content(verdicts[-1], recording, begin_s)})
    chattering = [entry for entry in depths if entry["chatter"]]
    first = min(chattering, key=lambda entry: float(entry["depth_mm"])) if chattering else depths[0]
    whole = {name: value for name, value in first.items() if name != "depth_mm"}
    lowest = {"lowest_chatter_depth_mm": first["depth_mm"] if chattering else None}
    return {**whole, **lowest, "depths": depths} | _warnings(verdicts, speed_rpm, teeth)


def _machine(idle: AccelerationRecording, rate_hz: float) -> FloatArray:
    if not math.isclose(idle.sample_rate_hz, rate_hz, rel_tol=1e-3):
        raise StabilityError(
            f"the idle recording has {idle.sample_rate_hz:g} samples a second, the cut {rate_hz:g}; record both alike"
        )
    return machine_spectrum(idle.acceleration_m_s2, rate_hz)


def _standing(passages: Sequence[Passage], parts: Sequence[FloatArray], rate_hz: float) -> FloatArray:
    """Return what stands still between the shallowest and the deepest cut, and those between."""
    for passage, part in zip(passages, parts, strict=True):
        with _named(passage):
            check_length(len(part), rate_hz, window_samples(rate_hz))
    return standing_spectrum(parts, rate_hz)


@contextmanager
def _named(passage: Passage) -> Iterator[None]:
    """Say in a refusal which passage it is about."""
    try:
        yield
    except StabilityError as error:
        raise StabilityError(f"{passage.from_s:g} to {passage.to_s:g} s, {passage.depth_mm:g} mm: {error}") from None


def _warnings(verdicts: Sequence[ChatterVerdict], speed_rpm: float, teeth: int) -> dict[str, list[str]]:
    found = [speed_warning(verdict, speed_rpm, teeth) for verdict in verdicts]
    return {"warnings": list(dict.fromkeys(warning for warning in found if warning is not None))}


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
LARGEST = 1e6
"""No position or depth [mm] and no height [um] of a profile is larger."""


def read_profile(path: Path) -> tuple[FloatArray, bool]:
    """Return position [mm], height [um], depth [mm], shape (n, 3), and whether depths are given; a CSV file."""
    with csv_rows(path, "profile") as reader:
        names = reader.fieldnames or []
        if missing := [name for name in PROFILE_COLUMNS if name not in names]:
            raise StabilityError(f"{path}:1: there is no column {' and '.join(missing)} in {', '.join(names)}")
        rows = [_profile_row(path, reader, row) for row in reader]
    if not rows:
        raise StabilityError(f"{path}: holds no points after its header")
    return np.array(rows), DEPTH_COLUMN in names


def _profile_row(path: Path, reader: "csv.DictReader[str]", row: dict[str, str | None]) -> tuple[float, float, float]:
    try:
        values = [field(reader, row, name) for name in PROFILE_COLUMNS]
        depth = field(reader, row, DEPTH_COLUMN) if DEPTH_COLUMN in row else 0.0
    except ValueError:
        raise StabilityError(
            f"{path}:{line_of(reader)}: a field is no number; remove the row or measure again"
        ) from None
    if not all(abs(value) <= LARGEST for value in (*values, depth)):
        raise StabilityError(
            f"{path}:{line_of(reader)}: a value is not finite or beyond {LARGEST:g}, which no surface has; remove "
            "the row or measure again"
        )
    return values[0], values[1], depth
