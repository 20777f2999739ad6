"""Trains a model on the daemon's own history and puts it among the proposals; run in a process of its own."""

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from config.files import write_whole
from config.schema import Configuration
from config.schema.compensation import RetrainingConfig
from daemon.history.reader import HistoryReader
from daemon.model_release.active import proposals_folder
from daemon.model_release.gate import reads_in_short
from daemon.model_release.past_recordings import commissioned_um_per_unit, read_of_history, recordings_from_history
from daemon.model_release.releasing import age_order
from daemon.model_release.repository import READABLE_FILE, READABLE_FOLDER
from models.json_values import finite_or_none
from models.thermal.family import ThermalModel
from models.thermal.model import READS
from models.thermal.training.train_family import train_family

DAY_S = 86400.0


def propose_from_history(configuration: Configuration, retraining: RetrainingConfig) -> dict[str, Any]:
    """Train on the history, write a proposal for the release's gate, and return what came of it."""
    um_per_unit = commissioned_um_per_unit(configuration)
    now_s = time.time()
    with HistoryReader(configuration.history.path) as reader:
        read = read_of_history(reader)
        recordings = recordings_from_history(
            configuration, reader, um_per_unit, from_utc_s=now_s - DAY_S * retraining.days, to_utc_s=now_s
        )
    trained = train_family(
        recordings,
        retraining.model,
        sample_s=60.0,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=configuration.machine,
    )
    if read:
        trained.model.hyper_parameters[READS] = reads_in_short(trained.model, read)
    path = propose(configuration, trained.model)
    return {
        "path": str(path),
        "model_id": trained.model.model_id,
        "recordings": len(recordings),
        "hours": round(sum(float(recording.time_s[-1]) for recording in recordings) / 3600.0, 2),
        "channels": list(trained.model.channels),
        "held_out_relative_rmse": finite_or_none(trained.trust.held_out_relative_rmse, 4),
        "refused": trained.trust.refused,
    }


MOST_PROPOSALS = 20
"""Older proposals are removed."""


def propose(configuration: Configuration, model: ThermalModel) -> Path:
    """Write a proposal in one step and return its file, readable by the account that releases; raises OSError."""
    folder = proposals_folder(configuration)
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(READABLE_FOLDER)
    path = folder / f"{_file_name(model.model_id)}.json"
    write_whole(path, model.to_json(), READABLE_FILE)
    for old in sorted(folder.glob("*.json"), key=lambda file: age_order(file.stat().st_mtime))[:-MOST_PROPOSALS]:
        old.unlink(missing_ok=True)
    return path


def _file_name(model_id: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in model_id).lstrip(".") or "model"
