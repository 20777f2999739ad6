"""Trains a model of a machine type from the recordings of many machines, on processes or on a Dask cluster."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
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
from models.recordings.findings import require_usable
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
Machine = TypeVar("Machine", MachineFiles, "Described")


class FleetError(RefusedInputError):
    """The work on a fleet cannot be shared out; the text says what to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """A machine, or one of its recordings, of which nothing is learned because it cannot be read."""

    machine: str
    recording: Path | None
    """None: the whole machine."""
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Described:
    """A machine's columns."""

    files: MachineFiles
    parts: Mapping[str, Part]
    """Where each of its temperatures sits, by the name of its column."""
    channels: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.files.name

    def parts_of(self, recording: Recording) -> tuple[Part, ...]:
        """Return where the temperatures of a recording sit; raises DatasetError for one that the machine lacks."""
        if unknown := [name for name in recording.temperature_names if name not in self.parts]:
            raise DatasetError(f"{recording.name}: {unknown[0]} is no column of the machine's first recording")
        return tuple(self.parts[name] for name in recording.temperature_names)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FleetTraining:
    """A type, and what training says about it."""

    machine_type: MachineType
    summaries: tuple[Summary, ...]
    left_out: tuple[LeftOut, ...]
    odd: dict[str, list[str]]
    """What is said of machines that are otherwise than all others."""
    refused: tuple[Refused, ...]


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
    described, refused = tried(
        executor, describe, machines, lambda done: progress("reading headers", done, len(machines))
    )
    if channels is not None:
        refused += [lacks for one in described if (lacks := _lacking(one, channels)) is not None]
    described = _left(described, refused)
    of_type = places_of_type([tuple(one.parts.values()) for one in described])
    common = common_channels(described) if channels is None else tuple(channels)
    some = [described[at] for at in evenly(len(described), MOST_SAMPLED)]
    samples, unread = tried(
        executor,
        partial(_sample, of_type=of_type, channels=common),
        some,
        lambda done: progress("looking for directions", done, len(some)),
    )
    refused += unread
    described = _left(described, refused)
    judged = {described[at].name for at in evenly(len(described))}
    space = space_of(samples)
    found, unread = tried(
        executor,
        partial(_summary, of_type=of_type, channels=common, space=space, judged=judged),
        described,
        lambda done: progress("machines", done, len(described)),
    )
    refused += unread
    _left(described, refused)
    summaries = [one for one, _ in found]
    refused += [each for _, of_machine in found for each in of_machine]
    odd = odd_machines(summaries)
    right = [one for one in summaries if one.machine not in odd]
    left_out = left_out_machines(right)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    made = machine_type(type_id, created, of_type, common, space, right, left_out)
    return FleetTraining(
        machine_type=made,
        summaries=tuple(summaries),
        left_out=tuple(left_out),
        odd=sentences(odd, exchanged_sensors(summaries), common),
        refused=tuple(refused),
    )


def tried(
    executor: Executor | None,
    work: Callable[[Machine], Result],
    machines: Sequence[Machine],
    done: Callable[[int], None],
) -> tuple[list[Result], list[Refused]]:
    """Return what was made of each machine that can be used, and what is said of the others."""
    found = mapped(executor, partial(_attempt, work), machines, done)
    refused = [each for each in found if isinstance(each, Refused)]
    return [each for each in found if not isinstance(each, Refused)], refused


def _attempt(work: Callable[[Machine], Result], machine: Machine) -> Result | Refused:
    try:
        return work(machine)
    except RefusedInputError as error:
        why = str(error).removeprefix(f"machine {machine.name}: ")
        return Refused(machine=machine.name, recording=None, why=why)


def _left(described: Sequence[Described], refused: Sequence[Refused]) -> list[Described]:
    """Return the machines that were not refused; raises FleetError where they are too few."""
    gone = {each.machine for each in refused}
    left = [one for one in described if one.name not in gone]
    if len(left) < 2:
        reasons = "\n".join(f"  machine {each.machine}: {each.why}" for each in refused)
        raise FleetError(f"a type is learned from two machines at least, and too few of these can be used:\n{reasons}")
    return left


def describe(files: MachineFiles) -> Described:
    """Return where the temperatures of a machine sit, and its channels, from the first header that can be read."""
    for path in files.recordings[:-1]:
        with suppress(RefusedInputError):
            return _described(files, path)
    return _described(files, files.recordings[-1])


def _described(files: MachineFiles, path: Path) -> Described:
    one = recording_map_of(files)
    header, _ = read_beginning(path, 0, "utf-8" if one is None else one.encoding)
    try:
        one = usual_map(header) if one is None else one
        columns = resolve_columns(one, header)
    except ColumnError as error:
        raise DatasetError(f"{path}: {error}") from error
    names = tuple(header[column] for column in columns.temperatures)
    slopes = tuple(name + SLOPE_SUFFIX for name in columns.slopes)
    parts = dict(zip(names, parts_of(names, files.configuration, path), strict=True))
    return Described(files=files, parts=parts, channels=(*columns.channels, *slopes))


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


def _lacking(one: Described, wanted: Sequence[str]) -> Refused | None:
    """Return what is said of a machine that lacks a channel, None where it has all of them."""
    if not (lacking := [name for name in wanted if name not in one.channels]):
        return None
    why = f"there is no displacement channel {lacking[0]}; there are {', '.join(one.channels)}"
    return Refused(machine=one.name, recording=None, why=why)


def common_channels(described: Sequence[Described]) -> tuple[str, ...]:
    """Return the channels that all machines have; raises DatasetError where there is none."""
    common = tuple(name for name in described[0].channels if all(name in one.channels for one in described))
    if not common:
        raise DatasetError(
            f"the machines {described[0].name} and {described[-1].name} have no displacement channel in "
            "common; call the same channel the same with `displacement_names` in the map of the columns"
        )
    return common


def recording_map_of(files: MachineFiles) -> RecordingMap | None:
    """Return what the columns of a machine's recordings mean; None: they carry the usual names."""
    return None if files.map is None else load_recording_map(files.map)


def read_machine(files: MachineFiles) -> tuple[list[Recording], float, tuple[Refused, ...]]:
    """Return a machine's recordings, without axis positions, and the time between averaged rows [s].

    A recording that cannot be read or used is left out and named; raises RefusedInputError where none can, or what is
    left does not fit together.
    """
    one, paths, refused = recording_map_of(files), files.recordings, []
    try:
        read = _read(paths, one)
    except RefusedInputError:
        for path in files.recordings:
            try:
                _read([path], one)
            except RefusedInputError as error:
                refused.append(Refused(machine=files.name, recording=path, why=str(error)))
        paths = tuple(path for path in paths if path not in {each.recording for each in refused})
        if not paths or not refused:
            raise
        read = _read(paths, one)
    return read, 60.0 if one is None else one.sample_s, tuple(refused)


def _read(paths: Sequence[Path], one: RecordingMap | None) -> list[Recording]:
    read = temperatures_alone(read_alike(paths, one, lambda what, done, total: None))
    for recording in read:
        require_usable(recording, len(recording.temperature_names) + 1)  # however few rows it has
    return read


def _sample(one: Described, of_type: tuple[Part, ...], channels: tuple[str, ...]) -> Sample:
    read, sample_s, _ = read_machine(one.files)
    return machine_sample(one.name, read, one.parts_of(read[0]), of_type, channels, sample_s)


def _summary(
    one: Described, of_type: tuple[Part, ...], channels: tuple[str, ...], space: Space, judged: set[str]
) -> tuple[Summary, tuple[Refused, ...]]:
    """Return what is learned of a machine, and its recordings of which nothing is."""
    read, _, refused = read_machine(one.files)
    parts, tested = one.parts_of(read[0]), one.name in judged
    return machine_summary(one.name, read, parts, of_type, channels, space, tested=tested), refused
