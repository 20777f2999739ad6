"""The daemon's own look at its model: out of its reach, released, unchanged, and fit for this machine."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from config.release_record import ReleaseRecord
from config.schema import Configuration
from daemon.estimation.contract import AnyThermalModel
from daemon.model_file import read_model
from daemon.release.gate import training_obstacle
from daemon.release.reach import Account, how_it_could_change
from daemon.release.shelf import released, sha256_of


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedModel:
    """The model, or why there is none, and who released it."""

    model: AnyThermalModel | None
    obstacle: str
    record: ReleaseRecord | None = None
    sha256: str = ""
    warning: str = ""
    """What `compensation.allow_writable_model_directory` lets pass."""

    def in_words(self) -> str:
        """Return one sentence for audit and log."""
        if self.model is None:
            return f"refused: {self.obstacle}"
        words = f"{self.model.model_id}, sha256 {self.sha256}, "
        if self.record is None:
            words += "released by nobody"
        else:
            words += f"release {self.record.number} by {self.record.person} on {self.record.released}"
        return f"{words}; WARNING: {self.warning}" if self.warning else words

    def picture(self) -> dict[str, Any]:
        """Return the same for status, as JSON."""
        record = self.record
        return {
            "model_id": self.model.model_id if self.model is not None else None,
            "sha256": self.sha256 or None,
            "release": record.number if record is not None else None,
            "released_by": record.person if record is not None else None,
            "released": record.released if record is not None else None,
            "problem": self.obstacle,
            "warning": self.warning,
        }


def load_released(configuration: Configuration, account: Account) -> LoadedModel:
    """Return the configured model as this account may use it; deny by default."""
    path = configuration.compensation.model_file
    if path is None:
        return LoadedModel(model=None, obstacle="no thermal model is configured (compensation.model_file)")
    try:
        return _load(configuration, path, account)
    except OSError as error:
        return LoadedModel(model=None, obstacle=f"{path}: the thermal model cannot be read ({error.strerror})")


def _load(configuration: Configuration, path: Path, account: Account) -> LoadedModel:
    compensation = configuration.compensation
    real = Path(os.path.realpath(path))
    if not real.exists():
        return LoadedModel(
            model=None, obstacle=f"{path}: there is no thermal model; release one: `toolpoint model release FILE`"
        )
    record, mismatch = released(path)
    doubt = _doubt(path, account, record)
    if mismatch or (doubt and not compensation.allow_writable_model_directory):
        return LoadedModel(model=None, obstacle=mismatch or doubt, record=record)
    wanted = [axis.estimate for axis in compensation.axes.values() if axis.estimate]
    model, obstacle = read_model(real, configuration.temperatures.sensor_ids, wanted)
    if model is None:
        return LoadedModel(model=None, obstacle=obstacle, record=record)
    if refused := training_obstacle(model):
        doubt = f"{doubt}; {refused}" if doubt else f"{path}: {refused}"
        if not compensation.allow_writable_model_directory:
            return LoadedModel(model=None, obstacle=doubt, record=record)
    warning = f"allow_writable_model_directory lets it pass: {doubt}" if doubt else ""
    return LoadedModel(model=model, obstacle="", record=record, sha256=sha256_of(real.read_bytes()), warning=warning)


def _doubt(path: Path, account: Account, record: ReleaseRecord | None) -> str:
    """Return what stands against a model whose release is not in order, '' when nothing does."""
    if how := how_it_could_change(path, account):
        return (
            f"{path}: the daemon could change this model: {how}; let root or the account of the releases own file and "
            "folder (docs/how-to/release-a-model.md)"
        )
    if record is None:
        return f"{path}: nobody has released this model; release it: `toolpoint model release FILE`"
    return ""
