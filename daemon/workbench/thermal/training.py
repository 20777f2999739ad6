"""Trains a thermal model from recordings on disk, and reports what came of it."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from config.files import write_whole
from config.recordings.recording_map import RecordingMap
from config.schema.base import NAME_PATTERN
from daemon.telemetry.metrics import keep_one_heap
from daemon.workbench.thermal.reading import names_of, read_alike
from drivers.files.recording_origin import machine_of
from models.json_values import finite_or_none
from models.recordings.dataset import DatasetError, Recording
from models.thermal.family import ThermalModel
from models.thermal.model import LinearParameters
from models.thermal.training.choice import Choice
from models.thermal.training.evaluation import ResidualMetrics
from models.thermal.training.recipes import Recipe
from models.thermal.training.train_family import FamilyTraining, train_family
from models.thermal.training.watch_fit import unnoticed_um


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Which part of the recordings is trained on."""

    hours: tuple[float, float] | None = None
    """First and last hour, counted from each recording's first row [h]; None: all."""
    channels: tuple[str, ...] | None = None
    """Displacement channels; None: all."""
    common_columns: bool = False
    """Columns that not all recordings have are left out, not refused."""
    without: tuple[str, ...] = ()
    """File names of recordings that are left out on request."""
    recent: int | None = None
    """Only the last so many recordings, in the order in which they are given; None: all."""


def train_from_files(
    paths: Sequence[Path],
    recording_map: RecordingMap | None,
    selection: Selection,
    recipe: str | Recipe,
    progress: Callable[[str, int, int], None],
) -> FamilyTraining:
    """Read the recordings and train; raises RecordingFileError or DatasetError."""
    keep_one_heap()  # else the heap keeps a tenth of what training needs at most
    return train_family(
        selected_recordings(paths, recording_map, selection, progress),
        recipe,
        sample_s=60.0 if recording_map is None else recording_map.sample_s,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        progress=lambda done, total: progress("training", done, total),
        machine=machine_named_by(kept_paths(paths, selection), recording_map),
    )


def machine_named_by(paths: Sequence[Path], recording_map: RecordingMap | None) -> str:
    """Return the machine that every one of these recordings names, '' where they do not name one alone."""
    named = {machine_of(path, "utf-8" if recording_map is None else recording_map.encoding) for path in paths}
    return named.pop() if len(named) == 1 else ""


def selected_recordings(
    paths: Sequence[Path],
    recording_map: RecordingMap | None,
    selection: Selection,
    progress: Callable[[str, int, int], None],
) -> list[Recording]:
    """Read the part of the recordings that is trained on; raises RecordingFileError or DatasetError."""
    kept = kept_paths(paths, selection)
    read = read_alike(kept, recording_map, progress, common=selection.common_columns)
    return [_selected(recording, selection) for recording in read]


def kept_paths(paths: Sequence[Path], selection: Selection) -> list[Path]:
    """Return the recordings that are trained on; raises DatasetError where a name is unknown or nothing is left."""
    names = names_of(paths)
    if unknown := [name for name in selection.without if name not in names]:
        raise DatasetError(f"--without {unknown[0]}: there is no such recording; there are {', '.join(names)}")
    kept = [path for path, name in zip(paths, names, strict=True) if name not in selection.without]
    if selection.recent is not None:
        if selection.recent > len(kept):
            raise DatasetError(f"--recent {selection.recent}: there are {len(kept)} recordings; name a smaller number")
        kept = kept[-selection.recent :]
    if not kept:
        raise DatasetError("every recording is left out by --without; leave one of them in")
    return kept


def _selected(recording: Recording, selection: Selection) -> Recording:
    if selection.hours is not None:
        recording = recording.between_hours(*selection.hours)
    if selection.channels is not None:
        recording = recording.with_channels(_whole_names(selection.channels, recording.displacement_names))
    return recording


def _whole_names(parts: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return names that were separated at commas, those with a comma of their own put together again."""
    found, rest = [], list(parts)
    while rest:
        ends = range(len(rest), 1, -1)
        joined = ((end, mark.join(rest[:end])) for end in ends for mark in (", ", ","))
        end, name = next(((end, name) for end, name in joined if name in known), (1, rest[0]))
        found.append(name)
        del rest[:end]
    return tuple(found)


def write_model_file(model: ThermalModel, path: Path) -> None:
    """Write a model's file in one step, so that it is never read half-written; raises OSError."""
    write_whole(path, model.to_json())


def summary(result: FamilyTraining, path: Path) -> dict[str, Any]:
    """Return what was trained, and how good it is on what it had not seen, for JSON."""
    model, trust = result.model, result.trust
    return {
        "model": {
            "file": str(path),
            "model_id": model.model_id,
            "kind": model.kind,
            "sensors": len(model.sensor_ids),
            "sensor_ids": {
                name: number
                for name, number in zip(model.sensor_names, model.sensor_ids, strict=True)
                if name not in model.axis_positions
            },
            "band_um": {c: finite_or_none(b) for c, b in zip(model.channels, model.band_um.tolist(), strict=True)},
        },
        "hyper_parameters": result.hyper_parameters,
        "chosen": None if result.choice is None else _chosen(result.choice),
        "advice": list(result.advice),
        "refused": trust.refused,
        "training": [
            {"name": data.name, "from_hours": data.from_hours, "to_hours": data.to_hours, "rows": data.rows}
            for data in model.training
        ],
        "held_out": {
            "folds": result.folds,
            "relative_rmse": finite_or_none(trust.held_out_relative_rmse),
            "forward_skill": [finite_or_none(value) for value in trust.forward_skill],
            "channels": {} if trust.held_out is None else channel_figures(trust.held_out),
        },
        "noticed_late": _noticed_late(model),
        "temperatures_left_out": result.left_out,
        "warnings": [*_not_nameable(model), *result.warnings],
    }


def _noticed_late(model: ThermalModel) -> list[dict[str, Any]]:
    """Return the sensors that make more than the band before the others tell that they are wrong, the worst first."""
    if not isinstance(model, LinearParameters) or model.watch is None:
        return []
    made_um, limits_k = np.abs(unnoticed_um(model)), model.watch.threshold_k
    over = np.where(np.isfinite(model.band_um), made_um / np.maximum(model.band_um, 1e-9), 0.0)
    worst = over.argmax(axis=1)
    found = []
    for sensor in np.argsort(-over.max(axis=1)):
        channel = int(worst[sensor])
        if over[sensor, channel] > 1.0:
            found.append(
                {
                    "sensor": model.sensor_names[sensor],
                    "from_k": float(limits_k[sensor]),
                    "channel": model.channels[channel],
                    "error_um": float(made_um[sensor, channel]),
                    "band_um": float(model.band_um[channel]),
                }
            )
    return found


def _not_nameable(model: ThermalModel) -> list[str]:
    """Return what is said of axis positions that no configuration can name."""
    return [
        f"axis position {name!r}: no key of cnc.axis_positions may be called so, and the key must be the model's name "
        "for it, so that neither a machine nor a replay can use this model: call the column "
        f"{re.sub('[^A-Za-z0-9]+', '_', name).strip('_')} in the recordings and in the map, and train again"
        for name in model.axis_positions
        if re.fullmatch(NAME_PATTERN, name) is None
    ]


def _chosen(choice: Choice) -> dict[str, Any]:
    remains = {one.family: one.relative_rmse for one in choice.candidates}.get(choice.family, math.nan)
    return {"family": choice.family, "why": choice.why, "relative_rmse": finite_or_none(remains)}


def increments_summary(result: FamilyTraining, path: Path) -> dict[str, Any]:
    """Return `summary` with the figures of the dissertation's model on increments."""
    found, chosen = summary(result, path), result.hyper_parameters
    drift = zip(result.model.channels, result.drift_um_per_min.tolist(), strict=True)
    found["model"] |= {"interval_min": chosen["interval_min"], "ridge_k2": chosen["ridge_k2"]}
    found["model"]["drift_um_per_min"] = dict(drift)
    found["held_out"]["folds"] = list(result.fold_names)
    return found | {"increments": dict(result.counts)}


def channel_figures(metrics: ResidualMetrics) -> dict[str, dict[str, dict[str, float | None]]]:
    """Return ``{channel: {without: {rmse_um, max_um}, with: {rmse_um, max_um}}}`` for JSON."""
    return {
        channel: {
            "without": {
                "rmse_um": finite_or_none(float(metrics.rmse_without_um[index])),
                "max_um": finite_or_none(float(metrics.max_without_um[index])),
            },
            "with": {
                "rmse_um": finite_or_none(float(metrics.rmse_with_um[index])),
                "max_um": finite_or_none(float(metrics.max_with_um[index])),
            },
        }
        for index, channel in enumerate(metrics.channels)
    }
