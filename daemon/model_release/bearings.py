"""Release and use of the bearing model that the spindle speed follows, by the rules of thermal models."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from config.files import read_whole
from config.machine.spindle_chain import found_file
from config.schema import Configuration
from config.schema.base import ConfigurationError
from config.schema.spindle_speed import SpindleSpeedConfig
from daemon.model_release.file_access import Account
from daemon.model_release.loading import LoadedModel, WantedModel, load_checked
from daemon.model_release.releasing import Kind
from daemon.model_release.repository import ReleaseError, ReleaseRepository, bearing_releases
from daemon.spindle_speed.planning import OperationPlanning, planned_with
from models.errors import RefusedInputError, StabilityError
from models.model_file import ModelError
from models.thermomechanics.artifact import model_from_json
from models.thermomechanics.regression import ThermomechanicalModel


def load_released_bearings(configuration: Configuration, account: Account) -> LoadedModel[ThermomechanicalModel]:
    """Return the bearing model of the spindle-speed tuning as this account may use it; deny by default."""
    tuning = configuration.spindle_speed
    if tuning is None:
        return LoadedModel(model=None, inhibit="no bearing model is configured (there is no section spindle_speed)")
    wanted = WantedModel(kind="bearing model", option="--bearings ")
    return load_checked(wanted, tuning.thermomechanical_model, configuration, account, _read_bearings)


def bearings_from_text(content: bytes, source: str) -> tuple[ThermomechanicalModel | None, str]:
    """Return the bearing model that a file's bytes hold, or why they hold none."""
    try:
        return model_from_json(content.decode("utf-8"), source), ""
    except UnicodeDecodeError as error:
        return None, f"{source}: this is no bearing model: byte {error.start} is not UTF-8 text"
    except ModelError as error:
        return None, str(error)


def _read_bearings(content: bytes, source: str) -> tuple[ThermomechanicalModel | None, str, str]:
    return (*bearings_from_text(content, source), "")


def bearing_repository(configuration: Configuration) -> ReleaseRepository:
    """Return the releases of the bearing model; raises RefusedInputError without a configured place."""
    tuning = configuration.spindle_speed
    if tuning is None:
        raise RefusedInputError("there is no section spindle_speed, so there is no place for a released bearing model")
    path = tuning.thermomechanical_model
    if path == configuration.compensation.model_file:
        raise RefusedInputError(
            f"{path}: compensation.model_file and spindle_speed.thermomechanical_model name the same file; two models "
            "need two names"
        )
    return ReleaseRepository(path, releases=bearing_releases(path))


def _checked(configuration: Configuration, content: bytes, source: str) -> tuple[ThermomechanicalModel, list[str]]:
    """Return the model and what was found good; raises ReleaseError."""
    model, inhibit = bearings_from_text(content, source)
    if model is None:
        raise ReleaseError(inhibit)
    try:
        planning = planned_with(configuration, model)
    except (ConfigurationError, StabilityError) as error:
        raise ReleaseError(f"{source}: {error}") from error
    regressed = sorted({each.name for axis in model.axes.values() for each in axis.properties})
    return model, [
        "the checksum fits the content",
        f"its signals are labels of this machine: {', '.join(model.signals)}",
        f"spindles and cases of {len(planning)} operation(s) fit it, and each has a resonance to follow",
        f"axes {', '.join(model.axes)}, properties {', '.join(regressed)}",
    ]


def _labels(model: ThermomechanicalModel) -> Iterable[str]:
    return (f"label {signal}" for signal in model.signals)


BEARINGS = Kind(repository=bearing_repository, checked=_checked, inputs=_labels)
"""The bearing model of the spindle speed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedPlanning:
    """The planning of the configured operations, or why there is none, and which model it follows."""

    operations: dict[int, OperationPlanning]
    """By the place of the operation in the configuration."""
    inhibit: str
    model: LoadedModel[ThermomechanicalModel] | None
    """None without a section `spindle_speed`."""
    files: Mapping[Path, str] = field(default_factory=dict)
    """Cases and spindles that were read, with the sha256 of each."""

    def in_words(self) -> str:
        """Return one sentence for audit and log: model, cases and spindles."""
        found = "" if self.model is None else self.model.in_words()
        return "; ".join([found, *(f"{path}, sha256 {sha256}" for path, sha256 in self.files.items())])


def open_planning(configuration: Configuration, account: Account) -> OpenedPlanning:
    """Return the planning of each configured operation with the released model, as this account may use it."""
    if configuration.spindle_speed is None:
        return OpenedPlanning(operations={}, inhibit="", model=None)
    loaded = load_released_bearings(configuration, account)
    if loaded.model is None:
        return OpenedPlanning(operations={}, inhibit=loaded.inhibit, model=loaded)
    try:
        operations = planned_with(configuration, loaded.model)
        files = _files(configuration.spindle_speed)
        return OpenedPlanning(operations=operations, inhibit="", model=loaded, files=files)
    except (ConfigurationError, StabilityError) as error:
        return OpenedPlanning(operations={}, inhibit=str(error), model=loaded)


def _files(tuning: SpindleSpeedConfig) -> dict[Path, str]:
    """Return cases and spindles with the sha256 of each; raises ConfigurationError."""
    told = [path for each in tuning.operations for path in (each.case, *each.spindles.values())]
    return {path: sha256(read_whole(path)).hexdigest() for path in map(found_file, told)}
