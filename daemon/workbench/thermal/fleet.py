"""Trains a model of a machine type from the recordings of many machines, on processes or on a Dask cluster."""

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

from config.recordings.machine_map import MachineFiles, sensors_of
from config.recordings.recording_map import ColumnError, RecordingMap, load_recording_map, resolve_columns, usual_map
from daemon.workbench.thermal.reading import read_alike
from drivers.files.recording_lines import read_beginning
from models.errors import RefusedInputError
from models.recordings.dataset import DatasetError, Recording
from models.recordings.slopes import SLOPE_SUFFIX
from models.thermal.training.fleet.fleet import (
    LeftOut,
    Summary,
    evenly,
    left_out_machines,
    machine_sample,
    machine_summary,
    machine_type,
)
from models.thermal.training.fleet.machine_type import MachineType
from models.thermal.training.fleet.odd_machines import exchanged_sensors, odd_machines, sentences
from models.thermal.training.fleet.places import Part, places_of_type
from models.thermal.training.fleet.products import Sample, Space, space_of
from models.thermal.training.inputs import temperatures_alone
from models.thermal.training.making import sensor_ids_from_names

MOST_SAMPLED = 8
"""So many machines, evenly spread, tell the directions of their type; only these are read twice."""
RETRIES = 3
"""A task whose worker is lost is done again, so often."""

Progress = Callable[[str, int, int], None]
Task = TypeVar("Task")
Result = TypeVar("Result")


class FleetError(RefusedInputError):
    """The work on a fleet cannot be shared out; the text says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Described:
    """A machine's columns."""

    files: MachineFiles
    parts: tuple[Part, ...]
    """Where each of its temperatures sits, in the order of its first recording."""
    channels: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FleetTraining:
    """A type, and what training says about it."""

    machine_type: MachineType
    summaries: tuple[Summary, ...]
    left_out: tuple[LeftOut, ...]
    odd: dict[str, list[str]]
    """What is said of machines that are otherwise than all others."""


@contextmanager
def fleet_executor(workers: int, dask: str | None) -> Iterator[Executor | None]:
    """Yield processes of this computer, or workers of a Dask cluster; None: this one. Raises FleetError."""
    if dask is not None:
        with _dask_executor(dask) as executor:
            yield executor
    elif workers == 1:
        yield None
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as executor:
            yield executor


@contextmanager
def _dask_executor(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise FleetError("--dask: Dask is not installed here; install toolpoint[dask], or use --workers") from error
    try:
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FleetError(
            f"--dask {address}: there is no Dask scheduler ({error}); start `dask scheduler` "
            "and name its address, such as tcp://192.0.2.10:8786, or use --workers"
        ) from error
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise FleetError(f"--dask {address}: the cluster has no worker; start one: `dask worker {address}`")
        yield client.get_executor(pure=False, retries=RETRIES)


def mapped(
    executor: Executor | None, work: Callable[[Task], Result], tasks: Sequence[Task], done: Callable[[int], None]
) -> list[Result]:
    """Return the result of each task, in order; raises what a task raises, and FleetError where workers are lost."""
    found: list[Result] = []
    lost: tuple[type[Exception], ...] = (BrokenExecutor, CancelledError, *_of_dask())
    try:
        for result in map(work, tasks) if executor is None else executor.map(work, tasks):
            found.append(result)
            done(len(found))
    except lost as error:
        machine = f"while machine {len(found) + 1} of {len(tasks)} was read"
        match error:
            case BrokenExecutor():
                why = f"a worker ended {machine} (killed, or out of memory); use fewer --workers"
            case CancelledError():
                why = f"the connection to the Dask scheduler was lost {machine}; see that it runs, and start again"
            case _:
                why = (
                    f"{RETRIES + 1} Dask workers ended, one after the other, {machine} (killed, or out of memory); "
                    "give each worker more memory, or fewer threads"
                )
        raise FleetError(why) from error
    return found


def _of_dask() -> tuple[type[Exception], ...]:
    """Return what a Dask cluster raises that gives a task up; it is loaded where there is one."""
    distributed = sys.modules.get("distributed")
    return () if distributed is None else (distributed.KilledWorker,)


def train_fleet(
    machines: Sequence[MachineFiles],
    type_id: str,
    channels: Sequence[str] | None,
    executor: Executor | None,
    progress: Progress = lambda what, done, total: None,
) -> FleetTraining:
    """Train a type from its machines, for these channels or those of all; raises DatasetError, FleetError."""
    if len(machines) < 2:
        raise DatasetError(
            f"machine {machines[0].name}: a type is learned from two machines at least; train a model of one machine "
            "with `toolpoint thermal train`"
        )
    described = mapped(executor, describe, machines, lambda done: progress("reading headers", done, len(machines)))
    of_type = places_of_type([one.parts for one in described])
    common = common_channels(described, channels)
    some = [described[at] for at in evenly(len(described), MOST_SAMPLED)]
    samples = mapped(
        executor,
        partial(_sample, of_type=of_type, channels=common),
        some,
        lambda done: progress("looking for directions", done, len(some)),
    )
    judged = set(evenly(len(described)))
    summaries = mapped(
        executor,
        partial(_summary, of_type=of_type, channels=common, space=space_of(samples)),
        [(one, at in judged) for at, one in enumerate(described)],
        lambda done: progress("machines", done, len(described)),
    )
    odd = odd_machines(summaries)
    right = [one for one in summaries if one.machine not in odd]
    left_out = left_out_machines(right)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    made = machine_type(type_id, created, of_type, common, space_of(samples), right, left_out)
    return FleetTraining(
        machine_type=made,
        summaries=tuple(summaries),
        left_out=tuple(left_out),
        odd=sentences(odd, exchanged_sensors(summaries), common),
    )


def describe(files: MachineFiles) -> Described:
    """Return where the temperatures of a machine sit, and what its channels are called, from its first header."""
    path, one = files.recordings[0], recording_map_of(files)
    header, _ = read_beginning(path, 0, "utf-8" if one is None else one.encoding)
    try:
        one = usual_map(header) if one is None else one
        columns = resolve_columns(one, header)
    except ColumnError as error:
        raise DatasetError(f"{path}: {error}") from error
    names = tuple(header[column] for column in columns.temperatures)
    slopes = tuple(name + SLOPE_SUFFIX for name in columns.slopes)
    return Described(
        files=files, parts=parts_of(names, files.configuration, path), channels=(*columns.channels, *slopes)
    )


def parts_of(names: Sequence[str], configuration: Path, recording: Path) -> tuple[Part, ...]:
    """Return where each temperature of a recording sits; raises DatasetError for one that the configuration lacks."""
    sensors = sensors_of(configuration)
    ids = sensor_ids_from_names(names)
    for name, sensor_id in zip(names, ids, strict=True):
        if sensor_id not in sensors:
            raise DatasetError(
                f"{recording}: column {name}: {configuration} has no sensor {sensor_id}, so nobody knows on which "
                "component and part it sits; name it there, or take the column out of the map of the columns"
            )
    found = [sensors[sensor_id] for sensor_id in ids]
    return tuple(Part(component=one.component, part=one.part, label=one.label or "") for one in found)


def common_channels(described: Sequence[Described], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Return the channels that are learned; raises DatasetError where a machine lacks one, or none is common."""
    if wanted is not None:
        for one in described:
            if lacking := [name for name in wanted if name not in one.channels]:
                raise DatasetError(
                    f"machine {one.files.name}: there is no displacement channel {lacking[0]}; there are "
                    f"{', '.join(one.channels)}"
                )
        return tuple(wanted)
    common = tuple(name for name in described[0].channels if all(name in one.channels for one in described))
    if not common:
        raise DatasetError(
            f"the machines {described[0].files.name} and {described[-1].files.name} have no displacement channel in "
            "common; call the same channel the same with `displacement_names` in the map of the columns"
        )
    return common


def recording_map_of(files: MachineFiles) -> RecordingMap | None:
    """Return what the columns of a machine's recordings mean; None: they carry the usual names."""
    return None if files.map is None else load_recording_map(files.map)


def read_machine(files: MachineFiles) -> tuple[list[Recording], float]:
    """Return a machine's recordings, without axis positions, and the time between averaged rows [s]."""
    one = recording_map_of(files)
    read = temperatures_alone(read_alike(files.recordings, one, lambda what, done, total: None))
    return read, 60.0 if one is None else one.sample_s


def _sample(one: Described, of_type: tuple[Part, ...], channels: tuple[str, ...]) -> Sample:
    with naming(one.files):
        read, sample_s = read_machine(one.files)
        return machine_sample(one.files.name, read, one.parts, of_type, channels, sample_s)


def _summary(
    task: tuple[Described, bool], of_type: tuple[Part, ...], channels: tuple[str, ...], space: Space
) -> Summary:
    one, tested = task
    with naming(one.files):
        read, _ = read_machine(one.files)
        return machine_summary(one.files.name, read, one.parts, of_type, channels, space, tested=tested)


@contextmanager
def naming(files: MachineFiles) -> Iterator[None]:
    """Name the machine of a recording that is refused: those of many machines are mostly called the same."""
    try:
        yield
    except RefusedInputError as error:
        machine = f"machine {files.name}: "
        raise FleetError(f"{machine}{str(error).removeprefix(machine)}") from error
