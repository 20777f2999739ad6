"""Loads a released model after checks of its own: released, unchanged, fit, and not writable by this account."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from config.files import read_whole, sha256_of
from config.records.release_record import ReleaseRecord
from config.schema import Configuration
from config.signing import SigningError
from daemon.model_release.active import release_signer, released
from daemon.model_release.file_access import Account, how_it_could_change
from daemon.model_release.gate import inputs_inhibit, machine_inhibit, training_inhibit, unfit
from daemon.snapshots import ModelSnapshot
from models.model_file import ModelError
from models.thermal.family import ThermalModel, model_from_json


class Named(Protocol):
    """A model, of whatever kind."""

    @property
    def model_id(self) -> str:
        """Its name in audit and records."""


AnyModel = TypeVar("AnyModel", bound=Named)
Read = Callable[[bytes, str], tuple[AnyModel | None, str, str]]
"""A file's bytes and name -> the model, why it does not serve, and what its own training holds against it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedModel(Generic[AnyModel]):
    """The model, or why there is none, and who released it."""

    model: AnyModel | None
    inhibit: str
    record: ReleaseRecord | None = None
    sha256: str = ""
    signed_by: str = ""
    """Whose key has signed the release, '' where no key counts."""
    warning: str = ""
    """What `compensation.allow_writable_model_directory` lets pass."""

    def in_words(self) -> str:
        """Return one sentence for audit and log."""
        if self.model is None:
            return f"refused: {self.inhibit}"
        words = f"{self.model.model_id}, sha256 {self.sha256}, "
        if self.record is None:
            words += "released by nobody"
        else:
            words += f"release {self.record.number} by {self.record.person} on {self.record.released}"
            words += f", signed by {self.signed_by}" if self.signed_by else ", its signature not asked for"
        return f"{words}; WARNING: {self.warning}" if self.warning else words

    def snapshot(self) -> ModelSnapshot:
        record = self.record
        return ModelSnapshot(
            model_id=self.model.model_id if self.model is not None else None,
            sha256=self.sha256 or None,
            release=record.number if record is not None else None,
            released_by=record.person if record is not None else None,
            released=record.released if record is not None else None,
            problem=self.inhibit,
            warning=self.warning,
        )


def load_released(configuration: Configuration, account: Account) -> LoadedModel[ThermalModel]:
    """Return the configured thermal model as this account may use it; deny by default."""
    path = configuration.compensation.model_file
    if path is None:
        return LoadedModel(model=None, inhibit="no thermal model is configured (compensation.model_file)")
    wanted = [axis.estimate for axis in configuration.compensation.axes.values() if axis.estimate]

    def read(content: bytes, source: str) -> tuple[ThermalModel | None, str, str]:
        """Return the thermal model, and what stands against it."""
        model, inhibit = model_from_text(
            content, source, configuration.temperatures.sensor_ids, wanted, configuration.cnc.axis_positions
        )
        if model is not None and (inhibit := unfit(model, configuration)):
            return None, f"{source}: {inhibit}", ""
        return model, inhibit, "" if model is None else training_inhibit(model)

    found = load_checked(WantedModel(kind="thermal model", option=""), path, configuration, account, read)
    said = "" if found.record is None else found.record.trained_on
    if found.model is not None and (inhibit := machine_inhibit(found.model, configuration, said)):
        return replace(found, model=None, inhibit=f"{path}: {inhibit}")
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class WantedModel:
    """How sentences name the kind of model."""

    kind: str
    option: str
    """Of `toolpoint model release`."""


def load_checked(
    wanted: WantedModel, path: Path, configuration: Configuration, account: Account, read: Read[AnyModel]
) -> LoadedModel[AnyModel]:
    """Return a released, unchanged and readable model whose file this account cannot change."""
    try:
        found = _loaded(wanted, path, configuration, account, read)
        inhibit = "" if found.model is None else inputs_inhibit(found.record, configuration)
        return replace(found, model=None, inhibit=f"{os.path.realpath(path)}: {inhibit}") if inhibit else found
    except OSError as error:
        return LoadedModel(model=None, inhibit=f"{path}: the {wanted.kind} cannot be read ({error.strerror})")


def _loaded(
    wanted: WantedModel, path: Path, configuration: Configuration, account: Account, read: Read[AnyModel]
) -> LoadedModel[AnyModel]:
    lenient = configuration.compensation.allow_writable_model_directory
    real = Path(os.path.realpath(path))
    if not real.exists():
        return LoadedModel(
            model=None,
            inhibit=f"{path}: there is no {wanted.kind}; release one: `toolpoint model release {wanted.option}FILE`",
        )
    record, mismatch = released(path)
    unreleased = _not_released(wanted, path, account, record)
    if mismatch or (unreleased and not lenient):
        return LoadedModel(model=None, inhibit=mismatch or unreleased, record=record)
    content = read_whole(real)
    signed_by = ""
    if record is not None:
        try:
            signed_by = release_signer(path, record, configuration.signatures.public_keys)
        except SigningError as error:
            return LoadedModel(model=None, inhibit=str(error), record=record)
        if sha256_of(content) != record.sha256:
            return LoadedModel(model=None, inhibit=f"{real}: the model changed while it was read", record=record)
    model, inhibit, refused = read(content, str(real))
    if model is None:
        return LoadedModel(model=None, inhibit=inhibit, record=record)
    if refused:
        unreleased = f"{unreleased}; {refused}" if unreleased else f"{path}: {refused}"
        if not lenient:
            return LoadedModel(model=None, inhibit=unreleased, record=record)
    warning = unreleased and (
        f"{wanted.kind} for a simulation only, on a real machine take allow_writable_model_directory out: {unreleased}"
    )
    return LoadedModel(
        model=model, inhibit="", record=record, sha256=sha256_of(content), signed_by=signed_by, warning=warning
    )


def _not_released(wanted: WantedModel, path: Path, account: Account, record: ReleaseRecord | None) -> str:
    """Return why a model may not be used whose release is not in order, '' when nothing does."""
    if how := how_it_could_change(path, account):
        return (
            f"{path}: the daemon could change this model: {how}; let root or the account of the releases own file and "
            "folder (docs/how-to/release-a-model.md)"
        )
    if record is None:
        return f"{path}: nobody has released this model; release it: `toolpoint model release {wanted.option}FILE`"
    return ""


def read_model(
    path: Path, sensor_ids: Iterable[int], channels: Iterable[str], positions: Iterable[str] = ()
) -> tuple[ThermalModel | None, str]:
    """Return the model, or why it cannot serve a machine with these sensors that needs these channels."""
    try:
        content = read_whole(path)
    except OSError as error:
        return None, f"{path}: the thermal model cannot be read ({error.strerror})"
    return model_from_text(content, str(path), sensor_ids, channels, positions)


def model_from_text(
    content: bytes, source: str, sensor_ids: Iterable[int], channels: Iterable[str], positions: Iterable[str] = ()
) -> tuple[ThermalModel | None, str]:
    """Return the model that a file's bytes hold, or why it cannot serve a machine with these axis `positions`."""
    try:
        model = model_from_json(content, source)
    except ModelError as error:
        return None, str(error)
    if unread := [name for name in model.axis_positions if name not in set(positions)]:
        return None, (
            f"{source}: the model needs axis positions ({', '.join(unread[:8])}), which are not read while the machine "
            "runs: name them under cnc.axis_positions, or take axis_positions out of the map and train it again"
        )
    of_temperatures = model.sensor_ids[: len(model.sensor_ids) - len(model.axis_positions)]
    if set(model.sensor_ids[len(of_temperatures) :]) & set(sensor_ids := tuple(sensor_ids)):
        return None, f"{source}: gives an axis position the ID of a sensor, as versions before did: train it again"
    if foreign := sorted(set(of_temperatures) - set(sensor_ids)):
        return None, f"{source}: the model needs sensors that this machine does not have: {foreign[:10]}"
    if lacking := sorted(set(channels) - set(model.channels)):
        return None, (
            f"{source}: the model has no channel {', '.join(map(repr, lacking))}; it has "
            f"{', '.join(map(repr, model.channels))}: let compensation.axes.AXIS.estimate name one of these"
        )
    return model, ""
