"""Plays a recording over real wires while the whole daemon runs: its configuration and its result."""

import json
import re
from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from config.recordings.recording_map import ColumnError, RecordingMap, load_recording_map, usual_map
from config.records.commissioning import macro_map_digest
from config.schema.cnc import MacroMapConfig
from config.schema.temperatures import LONGEST_CHAIN
from daemon.model_release.loading import read_model
from drivers.contract import SIMULATED_CNC_IDENTITY
from drivers.files.recording_csv import read_header
from drivers.sim.machine.recorded import LEAD_IN_S
from drivers.sim.nc.safe_point import GUARD_VERSION
from models.recordings.dataset import Recording

MOST_CHANNELS = 20
LINE = "recording"
LIMITS = {"absolute_bound_um": 200.0, "slew_um_per_min": 20.0, "step_um": 50.0, "deadband_um": 0.0}
"""Wide enough not to hide what the model does; a real machine gets its own."""


def map_of(recording: Path, map_path: Path | None) -> RecordingMap:
    """Return the given map, or the usual one for the column names; raises ValueError, RecordingFileError."""
    if map_path is not None:
        return load_recording_map(map_path)
    try:
        return usual_map(read_header(recording))
    except ColumnError as error:
        raise ValueError(f"{recording}: {error}") from error


def check_model(path: Path, recording: Recording) -> None:
    """Raise ValueError, saying why, for a model that cannot be read or was not made for these columns."""
    names = recording.temperature_names
    if recording.axis_positions:
        raise ValueError(f"{recording.name}: a replay plays no axis positions; take axis_positions out of the map")
    model, inhibit = read_model(path, range(1, len(names) + 1), recording.displacement_names)
    if model is None:
        raise ValueError(inhibit)
    for sensor_id, name in zip(model.sensor_ids, model.sensor_names, strict=True):
        if name != names[sensor_id - 1]:
            raise ValueError(
                f"{path}: sensor {sensor_id} of the model is {name}, of the recording {names[sensor_id - 1]}"
            )


def playing_time_s(recording: Recording) -> float:
    """Return how long the simulated machine plays it, the lead-in included [s]."""
    return LEAD_IN_S + float(recording.time_s[-1] - recording.time_s[0])


def replay_machine(recording: Recording, model_file: Path, record_file: Path) -> dict[str, Any]:
    """Return a machine description for one recording: one line, a channel and an axis per displacement."""
    channels = recording.displacement_names
    if len(channels) > MOST_CHANNELS:
        raise ValueError(
            f"a replay takes at most {MOST_CHANNELS} displacement channels, the recording has {len(channels)}"
        )
    axes = axis_names(channels)
    period_s = float(np.median(np.diff(recording.time_s)))
    sensors = [
        {"id": number, "component": "recording", "part": name}
        for number, name in enumerate(recording.temperature_names, start=1)
    ]
    macros = _macro_map(tuple(axes))
    record_file.write_text(json.dumps(_commissioning(macros)), encoding="utf-8")
    return {
        "machine": f"recording {recording.name}",
        "temperatures": {
            "lines": [
                {
                    "name": name,
                    "port": "",
                    "baud": 115200,
                    "cycle_period_s": period_s,
                    "chain": [f"{part[0]}-{part[-1]}"],
                }
                for name, part in _lines(len(sensors)).items()
            ],
            "sensors": sensors,
            "cleansing": {"stale_after_s": max(300.0, 5 * period_s)},
        },
        "displacements": {
            "file": {"path": ""},
            "channels": [{"name": channel, "column": axis} for axis, channel in axes.items()],
        },
        "cnc": {"macros": macros, "guard": _guard(tuple(axes))},
        "compensation": {
            "model_file": str(model_file.resolve()),
            "commissioning_file": str(record_file),
            "axes": {axis: {"estimate": channel, **LIMITS} for axis, channel in axes.items()},
            "reference": {"sequence_numbers": [100], "mean_s": max(60.0, period_s)},
            "output": {"safe_sequence_numbers": [900]},
        },
    }


def _lines(sensors: int) -> dict[str, list[int]]:
    """Return the sensors of each line, as few lines as can carry them."""
    lines = -(-sensors // LONGEST_CHAIN)
    parts = np.array_split(np.arange(1, sensors + 1), lines)
    return {LINE if n == 1 else f"{LINE}_{n}": part.tolist() for n, part in enumerate(parts, start=1)}


def axis_names(channels: Sequence[str]) -> dict[str, str]:
    """Return the axis that stands for each channel: the channel's name as far as a name may be written so."""
    found: dict[str, str] = {}
    for channel in channels:
        letters = re.sub(r"[^A-Za-z0-9]+", "_", channel).strip("_")[:30]
        wanted = letters if letters[:1].isalpha() and letters[:1].isascii() else f"c{letters}"
        name = next(name for name in chain([wanted], (f"{wanted}_{n}" for n in count(2))) if name not in found)
        found[name] = channel
    return found


def _macro_map(channels: tuple[str, ...]) -> dict[str, Any]:
    values = {name: 510 + index for index, name in enumerate(channels)}
    return {
        "writable": ["120", "500-540"],
        "sequence_a": 500,
        "values": values,
        "valid_until": 120,
        "enable": 501,
        "sequence_b": 502,
        "check": 503,
        "echo_applied": {name: 550 + index for index, name in enumerate(channels)},
        "echo_time": 580,
        "echo_status": 581,
        "echo_guard_version": 582,
    }


def _guard(channels: tuple[str, ...]) -> dict[str, Any]:
    """Return the settings of a control that has an axis for every channel."""
    axes = {
        name: {"letter": letter, "number": number}
        for number, (name, letter) in enumerate(zip(channels, "XYZABCUVW", strict=False), start=1)
    }
    return {"increment_mm": 0.0001, "axes": axes}


def _commissioning(macros: dict[str, Any]) -> dict[str, Any]:
    """Return the record of the simulated control, whose sign is known by construction."""
    axis = {"sign": 1, "scale": 1.0, "written_um": 10.0, "measured_um": 10.0}
    return {
        "cnc_identity": SIMULATED_CNC_IDENTITY,
        "macro_map_sha256": macro_map_digest(MacroMapConfig.model_validate(macros)),
        "guard_version": GUARD_VERSION,
        "person": "replay of a recording on the simulated control",
        "date": "2026-01-01",
        "axes": dict.fromkeys(macros["values"], axis),
    }
