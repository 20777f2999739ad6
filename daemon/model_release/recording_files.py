"""Writes what the daemon's history would be trained on as recordings that `toolpoint thermal train` reads."""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import yaml

from config.files import write_whole
from config.recordings.column_units import unit_in
from config.recordings.recording_map import ColumnError, resolve_columns, usual_map
from config.schema import Configuration
from daemon.history.reader import HistoryReader
from daemon.model_release.past_recordings import (
    began_utc_s,
    commissioned_um_per_unit,
    recordings_from_history,
    used_channels,
)
from drivers.files.recording_csv import write_recording
from drivers.guard.sloped_axes import sloped_axes
from models.recordings.dataset import Recording
from models.records import FloatArray

TIME, SPEED = "utc_s", "spindle_speed_rpm"


def write_recordings(
    configuration: Configuration, reader: HistoryReader, output: Path, *, from_utc_s: float, to_utc_s: float
) -> list[Path]:
    """Write every stretch of the history with displacements as a file, with a map where names are unusual."""
    um_per_unit = commissioned_um_per_unit(configuration)
    found = recordings_from_history(
        configuration, reader, um_per_unit, from_utc_s=from_utc_s, to_utc_s=to_utc_s, positions=True
    )
    paths = [output if len(found) == 1 else output.with_stem(f"{output.stem}-{n}") for n in range(1, len(found) + 1)]
    for path, recording in zip(paths, found, strict=True):
        _write(path, recording, configuration.machine, um_per_unit)
    if (keys := _map_keys(found[0], _slopes(configuration, found[0]))) is not None:
        paths.append(output.with_suffix(".map.yaml"))
        write_whole(paths[-1], yaml.safe_dump(keys, sort_keys=False, allow_unicode=True))
    return paths


def _write(path: Path, recording: Recording, machine: str, um_per_unit: Mapping[str, float] | None) -> None:
    begin_s = began_utc_s(recording)
    metadata = {
        "machine": machine,
        "begins": datetime.fromtimestamp(begin_s, UTC).isoformat(),
        "rows": "means of one minute",
        "displacements": "as measured" if um_per_unit is None else "measured minus what the NC has applied",
    }
    columns: dict[str, tuple[FloatArray, int]] = {TIME: (begin_s + recording.time_s, 0)}
    if recording.speed_rpm is not None:
        columns[SPEED] = recording.speed_rpm, 1
    columns |= {n: (v, 4) for n, v in zip(recording.temperature_names, recording.temperatures_degc.T, strict=True)}
    columns |= {n: (v, 4) for n, v in zip(recording.displacement_names, recording.displacements_um.T, strict=True)}
    write_recording(path, metadata, columns)


def _slopes(configuration: Configuration, recording: Recording) -> dict[str, dict[str, object]]:
    """Return which displacements become an offset and a slope: those of axes that have one and are read."""
    found: dict[str, dict[str, object]] = {}
    sloped = sloped_axes(configuration)
    for channel, axis in used_channels(configuration).items():
        one = sloped.get(axis)
        if channel in recording.displacement_names and one is not None and one.position is not None:
            found[channel] = {"position": one.position, "pivot_mm": one.pivot_mm}
    return found


def _map_keys(recording: Recording, slopes: Mapping[str, Mapping[str, object]]) -> dict[str, object] | None:
    """Return the map of a recording's columns; None where they carry the usual names.

    A position that tells a slope is no input of the model: the control itself adds the slope where the axis stands.
    """
    header = [TIME, SPEED, *recording.temperature_names, *recording.displacement_names]
    try:
        usual = resolve_columns(usual_map(header), header)
        if len(usual.displacements) == len(recording.displacement_names) and not recording.axis_positions:
            return None
    except ColumnError:
        pass
    speed = {} if recording.speed_rpm is None else {"speed": SPEED}
    inputs = [name for name in recording.axis_positions if name not in {one["position"] for one in slopes.values()}]
    positions: dict[str, object] = {"axis_positions": inputs} if inputs else {}
    if slopes:
        positions["slopes"] = slopes
    names = {"temperatures": list(recording.temperature_names[: recording.sensors])}
    if coarse := [name for name in recording.displacement_names if unit_in(name) in ("mm", "in")]:
        positions["displacement_units"] = dict.fromkeys(coarse, "um")  # the history holds micrometres
    return {"time": TIME, **speed, **names, "displacements": list(recording.displacement_names), **positions}
