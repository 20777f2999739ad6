"""Trains a machine's model from its recordings and the type that its sisters taught."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from config.files import read_whole
from config.recordings.machine_map import sensors_of
from config.recordings.recording_map import RecordingMap
from daemon.telemetry.metrics import keep_one_heap
from daemon.workbench.thermal.fleet import parts_of
from daemon.workbench.thermal.training import Selection, kept_paths, machine_named_by, selected_recordings
from models.model_file import ModelError
from models.recordings.dataset import DatasetError
from models.thermal.training.fleet.machine_type import MachineType, machine_type_from_json
from models.thermal.training.fleet.places import matching
from models.thermal.training.fleet.prior import mean_of_type, prior_recipe
from models.thermal.training.inputs import temperatures_alone, with_sensors
from models.thermal.training.train_family import FamilyTraining, train_family


def read_machine_type(path: Path) -> MachineType:
    """Return the type that a file holds; raises ModelError."""
    try:
        return machine_type_from_json(read_whole(path), str(path))
    except OSError as error:
        sentence = f"cannot be read ({error.strerror}); `toolpoint fleet train -o` writes one"
        raise ModelError("", sentence, str(path)) from error


def train_with_prior(
    paths: Sequence[Path],
    recording_map: RecordingMap | None,
    selection: Selection,
    of_type: MachineType,
    configuration: Path,
    progress: Callable[[str, int, int], None],
) -> FamilyTraining:
    """Read the recordings, none for `mean_on_machine`, and train the channels of the type; raises DatasetError."""
    if not paths:
        return mean_on_machine(of_type, configuration)
    keep_one_heap()
    recordings = temperatures_alone(selected_recordings(paths, recording_map, selection, progress))
    names = recordings[0].temperature_names
    parts = dict(zip(names, parts_of(names, configuration, paths[0]), strict=True))
    read = matching(of_type.parts, list(parts.values()), str(configuration)).sum(axis=0)
    kept = [name for at, name in enumerate(names) if read[at] > 0.0]
    channels = tuple(name for name in recordings[0].displacement_names if name in of_type.channels)
    if not channels:
        raise DatasetError(
            f"{recordings[0].name}: the type {of_type.type_id} has none of its channels; it has "
            f"{', '.join(of_type.channels)}"
        )
    chosen = [with_sensors(recording, kept) for recording in recordings]
    if selection.channels is None:
        chosen = [recording.with_channels(channels) for recording in chosen]
    return train_family(
        chosen,
        prior_recipe(of_type, parts, str(configuration)),
        sample_s=60.0 if recording_map is None else recording_map.sample_s,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        progress=lambda done, total: progress("training", done, total),
        machine=machine_named_by(kept_paths(paths, selection), recording_map),
    )


def mean_on_machine(of_type: MachineType, configuration: Path) -> FamilyTraining:
    """Return the mean of the fleet as a model of a machine without recordings; raises DatasetError."""
    names = tuple(f"T{sensor_id}" for sensor_id in sorted(sensors_of(configuration)))
    parts = dict(zip(names, parts_of(names, configuration, configuration), strict=True))
    read = matching(of_type.parts, list(parts.values()), str(configuration)).sum(axis=0)
    kept = {name: part for at, (name, part) in enumerate(parts.items()) if read[at] > 0.0}
    created = datetime.now(UTC).isoformat(timespec="seconds")
    model, trust = mean_of_type(of_type, kept, str(configuration), created)
    return FamilyTraining(
        model=model,
        trust=trust,
        hyper_parameters=model.hyper_parameters,
        left_out={},
        folds="machine",
        fold_names=(),
        counts={},
        drift_um_per_min=model.drift_um_per_min,
        warnings=(),
        advice=("record a warm-up and a cooling of this machine, and train again with them",),
    )
