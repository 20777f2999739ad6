"""Where a restoration may write: where the installed configuration says, or a person; never where an archive says."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import config
from config.loader import ConfigurationError, load_configuration
from config.schema import Configuration
from config.signing import signature_beside
from daemon.backup.manifest import (
    BEARING_RELEASES_NAME,
    BEARINGS_NAME,
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    MODEL_NAME,
    PLANNED_WITH,
    RELEASES_NAME,
    STORE_NAME,
    BackupError,
    Manifest,
    signature_name,
)
from daemon.model_release.repository import bearing_releases

SHIPPED = Path(config.__file__).parent
OPTIONS = {
    "store": ("--store", "history.path", STORE_NAME),
    "commissioning_file": ("--commissioning-file", "compensation.commissioning_file", COMMISSIONING_NAME),
    "model_file": ("--model-file", "compensation.model_file", MODEL_NAME),
    "bearings_file": ("--bearings-file", "spindle_speed.thermomechanical_model", BEARINGS_NAME),
}
"""Place: the option that names it, its key in the configuration, and what in the back-up needs it."""
RELEASED = {"model_file": RELEASES_NAME, "bearings_file": BEARING_RELEASES_NAME}
"""Place -> the releases that lie beside it, which need it too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Where store, commissioning record and models go; None: nowhere that anybody has named."""

    store: Path | None = None
    commissioning_file: Path | None = None
    model_file: Path | None = None
    bearings_file: Path | None = None

    @classmethod
    def of(cls, configuration: Configuration) -> "Places":
        compensation, tuning = configuration.compensation, configuration.spindle_speed
        return cls(
            store=configuration.history.path,
            commissioning_file=compensation.commissioning_file,
            model_file=compensation.model_file,
            bearings_file=None if tuning is None else tuning.thermomechanical_model,
        )


def installed_places(config_path: Path, given: Places) -> Places:
    """Return the places that a person has given, and else those of the installed configuration."""
    installed = Places()
    if config_path.exists():
        try:
            installed = Places.of(load_configuration(config_path))
        except ConfigurationError as error:
            if None in (given.store, given.commissioning_file, given.model_file):  # not every machine tunes its speed
                raise BackupError(
                    f"the installed configuration cannot be read, so it names no places to restore to; name them with "
                    f"{', '.join(option for option, _, _ in OPTIONS.values())}, or put it right first:\n{error}"
                ) from error
    return Places(**{name: getattr(given, name) or getattr(installed, name) for name in OPTIONS})


def agreed_places(manifest: Manifest, archived: Places, wanted: Places, *, keep_configuration: bool) -> Places:
    """Return where everything goes; raises BackupError where only the archive names a place, or names another."""
    names = {file.name for file in manifest.files}
    needed = {place for place, (_, _, name) in OPTIONS.items() if name in names or _is_released(manifest, place)}
    if keep_configuration:
        differing = [place for place in needed if getattr(wanted, place) is None]
    else:
        differing = [place for place in needed if not _same(getattr(wanted, place), getattr(archived, place))]
    if differing:
        told = "; ".join(_difference(place, archived, wanted) for place in sorted(differing))
        named = {OPTIONS[place][0]: getattr(archived, place) for place in sorted(differing)}
        options = " ".join(f"{option} {path}" for option, path in named.items() if path is not None)
        raise BackupError(
            f"nothing is written to a place that an archive alone names: {told}. If these places are right, name them: "
            f"{options or '(the back-up names none)'}; or leave the installed configuration in force and put the rest "
            "back where that one says: --keep-configuration"
        )
    return Places(**{place: getattr(wanted, place) for place in needed})


def _is_released(manifest: Manifest, place: str) -> bool:
    return place in RELEASED and bool(manifest.files_in(RELEASED[place]))


def _same(one: Path | None, other: Path | None) -> bool:
    return one is not None and other is not None and os.path.abspath(one) == os.path.abspath(other)  # noqa: PTH100


def _difference(place: str, archived: Places, wanted: Places) -> str:
    there, here = (getattr(places, place) or "none" for places in (archived, wanted))
    return f"{OPTIONS[place][1]} is {there} in the back-up and {here} here"


def targets(places: Places, config_path: Path | None) -> Iterator[tuple[str, Path]]:
    """Yield the name in the back-up and the new place of what is restored as one piece."""
    if config_path is not None:
        yield CONFIGURATION_NAME, config_path.absolute()
    if places.store is not None:
        yield STORE_NAME, places.store
    if places.commissioning_file is not None:
        yield COMMISSIONING_NAME, places.commissioning_file
        yield signature_name(COMMISSIONING_NAME), signature_beside(places.commissioning_file)
    if places.model_file is not None:
        yield RELEASES_NAME, places.model_file.parent / "releases"
        yield MODEL_NAME, places.model_file
    if places.bearings_file is not None:
        yield BEARING_RELEASES_NAME, places.bearings_file.parent / bearing_releases(places.bearings_file)
        yield BEARINGS_NAME, places.bearings_file


def planned_with(configuration: Configuration) -> dict[str, Path]:
    """Return spindle and case files by their names in a back-up; those that ship come with the program."""
    tuning, found = configuration.spindle_speed, dict[str, Path]()
    for index, operation in enumerate(() if tuning is None else tuning.operations):
        files = {"case": operation.case} | {f"spindle-{axis}": path for axis, path in operation.spindles.items()}
        for name, path in files.items():
            if not path.is_relative_to(SHIPPED) and path not in found.values():
                found[f"{PLANNED_WITH}/{index}/{name}.yaml"] = path
    return found


def places_of_plans(
    archived: Configuration, config_path: Path, taken: Mapping[Path, str], *, keep_configuration: bool
) -> dict[str, Path]:
    """Return where spindle and case files go: where the installed configuration has one, or beside the configuration.

    `taken`: places of other pieces. Those without a place stay in the back-up, as an archive names none.
    """
    try:
        here = planned_with(load_configuration(config_path))
    except ConfigurationError:
        here = {}
    beside = config_path.absolute().parent.resolve()
    known = {os.path.abspath(path) for path in here.values()}  # noqa: PTH100
    return {
        name: path
        for name, path in planned_with(archived).items()
        if path not in taken
        and (os.path.abspath(path) in known or (not keep_configuration and path.parent.resolve() == beside))  # noqa: PTH100
    }
