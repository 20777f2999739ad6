"""Trains a proposal on the daemon's own history now and then."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from config.schema import Configuration
from config.schema.compensation import RetrainingConfig
from daemon.housekeeping.side_job import Report, ScheduledProcess
from daemon.model_release.repository import proposals_folder

FIRST_LOOK_S = 300


class RetrainingJob(ScheduledProcess):
    """Trains on the history when the newest proposal, or the last attempt, is too old."""

    def __init__(
        self, configuration: Configuration, config_path: Path, retraining: RetrainingConfig, report: Report
    ) -> None:
        super().__init__("proposal", "no proposal was trained", report, first_look_s=FIRST_LOOK_S)
        self._folder = proposals_folder(configuration)
        self._config_path = config_path
        self._retraining = retraining

    def due(self, now_utc_s: float) -> bool:
        """Say whether there was neither a proposal nor an attempt lately; a time from the future is not lately."""
        times_s = [self.attempted_utc_s]
        if self._folder.is_dir():
            times_s += [path.stat().st_mtime for path in self._folder.glob("*.json")]
        return not any(0.0 <= now_utc_s - each_s < 3600.0 * self._retraining.every_hours for each_s in times_s)

    def arguments(self) -> Sequence[str]:
        """Return the words of `toolpoint model propose`."""
        return ("model", "propose", "--config", str(self._config_path))

    def in_words(self, made: Mapping[str, Any]) -> str:
        """Return file, length of the history, and whether its training refuses it."""
        refused = f"; its training refuses it: {made['refused']}" if made["refused"] else ""
        return f"{made['path']}, {made['hours']:g} h of history{refused}"
