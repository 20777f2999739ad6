"""Where a restoration may write: where the installed configuration says, or a person; never where an archive says."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from config.loader import ConfigurationError, load_configuration
from config.schema import Configuration
from config.signing import signature_beside
from daemon.backup.manifest import (
    COMMISSIONING_NAME,
    CONFIGURATION_NAME,
    MODEL_NAME,
    RELEASES_NAME,
    STORE_NAME,
    BackupError,
    Manifest,
    signature_name,
)

OPTIONS = {
    "store": ("--store", "history.path", STORE_NAME),
    "commissioning_file": ("--commissioning-file", "compensation.commissioning_file", COMMISSIONING_NAME),
    "model_file": ("--model-file", "compensation.model_file", MODEL_NAME),
}
"""Place: the option that names it, its key in the configuration, and what in the back-up needs it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Where store, commissioning record and model go; None: nowhere that anybody has named."""

    store: Path | None = None
    commissioning_file: Path | None = None
    model_file: Path | None = None

    @classmethod
    def of(cls, configuration: Configuration) -> "Places":
        compensation = configuration.compensation
        return cls(
            store=configuration.history.path,
            commissioning_file=compensation.commissioning_file,
            model_file=compensation.model_file,
        )


def installed_places(config_path: Path, given: Places) -> Places:
    """Return the places that a person has given, and else those of the installed configuration."""
    installed = Places()
    if config_path.exists():
        try:
            installed = Places.of(load_configuration(config_path))
        except ConfigurationError as error:
            if None in (given.store, given.commissioning_file, given.model_file):
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
    return place == "model_file" and bool(manifest.release_files)


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
