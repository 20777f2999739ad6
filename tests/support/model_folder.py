"""A machine whose models and proposals lie in a folder of a test."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from control_rig import machine

from config.schema import Configuration
from models.thermal.family import ThermalModel


@contextmanager
def open_folder() -> Iterator[Path]:
    """Yield a folder that every user may look into, below the sticky folder for temporary files."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def configured(folder: Path, **changes: object) -> Configuration:
    """A machine whose models lie in `folder`/models and whose store in `folder`/state."""
    for name in ("models", "state", "state/proposals"):
        (folder / name).mkdir(exist_ok=True)
    configuration = machine(folder / "state")
    own = {"allow_writable_model_directory": os.geteuid() != 0}  # everything here belongs to whoever tests
    section = {"model_file": folder / "models/model.json"} | own | changes
    compensation = configuration.compensation.model_copy(update=section)
    return configuration.model_copy(update={"compensation": compensation})


def proposal(folder: Path, the_model: ThermalModel, name: str = "p.json") -> Path:
    path = folder / "state/proposals" / name
    path.write_text(the_model.to_json(), encoding="utf-8")
    return path
