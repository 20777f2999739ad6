"""Put a model among the proposals in the state directory, where somebody else may release it."""

import os
from pathlib import Path

from config.schema import Configuration
from daemon.estimation.contract import AnyThermalModel
from daemon.model_file import model_text
from daemon.release.releasing import proposals_folder
from daemon.release.shelf import READABLE_FILE, READABLE_FOLDER

MOST_PROPOSALS = 20
"""Older proposals are removed."""


def propose(configuration: Configuration, model: AnyThermalModel) -> Path:
    """Write a proposal in one step and return its file, readable by the account that releases; raises OSError."""
    folder = proposals_folder(configuration)
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(READABLE_FOLDER)
    path = folder / f"{_file_name(model.model_id)}.json"
    temporary = folder / f".{path.name}.{os.getpid()}.tmp"
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(model_text(model))
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(READABLE_FILE)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    for old in sorted(folder.glob("*.json"), key=lambda file: file.stat().st_mtime)[:-MOST_PROPOSALS]:
        old.unlink(missing_ok=True)
    return path


def _file_name(model_id: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in model_id).lstrip(".") or "model"
