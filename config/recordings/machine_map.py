"""Which recording is of which machine, and where each machine's configuration says that its sensors sit."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import escape
from hashlib import file_digest
from os.path import normpath
from pathlib import Path

from pydantic import Field

from config.loader import load_configuration, load_yaml_model
from config.schema.base import ConfigurationError, Problem, Section
from config.schema.sources import SourceSensorConfig
from config.schema.temperatures import SensorConfig, TemperaturesConfig


class MachineEntry(Section):
    """One machine of a fleet."""

    recordings: list[str] = Field(
        min_length=1, description="its recordings: files or patterns such as mill-1/*.csv, from the map's own folder"
    )
    configuration: str | None = Field(
        None, description="its configuration, which says where each sensor sits; none: that of all machines"
    )
    map: str | None = Field(None, description="what the columns of its recordings mean; none: that of all machines")


class MachineMap(Section):
    """The machines of a fleet."""

    configuration: str | None = Field(
        None, description="configuration of machines that name none of their own; from the map's own folder"
    )
    map: str | None = Field(None, description="what columns mean (YAML), for machines that name no map of their own")
    machines: dict[str, MachineEntry] = Field(min_length=1, description="machines by name")


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineFiles:
    """The files of one machine."""

    name: str
    recordings: tuple[Path, ...]
    """In the order in which they were given."""
    configuration: Path
    map: Path | None


def load_machine_map(path: Path, recordings: Sequence[Path]) -> tuple[MachineFiles, ...]:
    """Return the machines of a map with their recordings; raises ConfigurationError with file and key."""
    one = load_yaml_model(path, MachineMap)
    whole = {str(recording.resolve()): recording for recording in recordings}
    folder, folders = path.resolve().parent, {path.resolve().parent, path.absolute().parent}
    problems: list[Problem] = []

    def refuse(name: str, key: str, sentence: str) -> None:
        """Keep what is wrong with a machine."""
        problems.append(Problem(file=str(path), line=0, column=0, key=f"machines.{name}.{key}", sentence=sentence))

    owners: dict[str, str] = {}
    copies = _copies(whole)
    found: list[MachineFiles] = []
    for name, entry in one.machines.items():
        own: list[str] = []
        for pattern in entry.recordings:
            files = {normpath(each / pattern) for each in folders}
            patterns = [normpath(Path(escape(str(each))) / pattern) for each in folders]
            matches = [
                file
                for file, recording in whole.items()
                for called in ({file, normpath(recording.absolute())},)  # with and without symbolic links
                if called & files or any(fnmatchcase(each, one) for each in called for one in patterns)
            ]
            if not matches:
                missing = f"{pattern!r} is none of the recordings that were given"
                refuse(name, "recordings", f"{missing}: give it on the command line, or take it out of the map")
            own += [file for file in matches if file not in own]
        for file in own:
            if (other := owners.setdefault(file, name)) != name:
                refuse(name, "recordings", f"{whole[file].name} is a recording of {other} already")
            if file in copies:
                again = f"{whole[file]} holds the same as {copies[file]}"
                refuse(name, "recordings", f"{again}: what is left out must not be known from elsewhere; give it once")
        configuration, columns = entry.configuration or one.configuration, entry.map or one.map
        if configuration is None:
            refuse(name, "configuration", "names none, so where its sensors sit is not known; name its toolpoint.yaml")
            continue
        found.append(
            MachineFiles(
                name=name,
                recordings=tuple(whole[file] for file in whole if file in own),
                configuration=folder / configuration,
                map=None if columns is None else folder / columns,
            )
        )
    if nobody := [recording.name for file, recording in whole.items() if file not in owners]:
        sentence = f"no machine has the recording {nobody[0]}; put it beside its machine, or do not give it"
        problems.append(Problem(file=str(path), line=0, column=0, key="machines", sentence=sentence))
    if problems:
        raise ConfigurationError(problems)
    return tuple(found)


def _copies(recordings: Mapping[str, Path]) -> dict[str, Path]:
    """Return the recordings that hold what an earlier one holds too, and that one. Only files of one size are read."""
    sizes = {file: path.stat().st_size for file, path in recordings.items() if path.is_file()}
    often = Counter(sizes.values())
    first: dict[bytes, Path] = {}
    found = {}
    for file, size in sizes.items():
        path = recordings[file]
        if often[size] > 1:
            with suppress(OSError), path.open("rb") as content:  # reading it says what is wrong
                earlier = first.setdefault(file_digest(content, "sha256").digest(), path)
                if earlier is not path:
                    found[file] = earlier
    return found


def sensors_of(configuration: Path) -> dict[int, SensorConfig | SourceSensorConfig]:
    """Return the sensors of a configuration by ID; raises ConfigurationError."""
    temperatures: TemperaturesConfig = load_configuration(configuration).temperatures
    return {sensor.id: sensor for sensor in temperatures.every_sensor}
