"""The daemon's own back-ups."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from config.schema import Configuration
from config.schema.service import BackupConfig
from daemon.backup.names import existing_backups
from daemon.housekeeping.side_job import Report, ScheduledProcess

FIRST_LOOK_S = 60


class BackupJob(ScheduledProcess):
    """Makes a back-up when the newest one in the folder is too old."""

    def __init__(self, configuration: Configuration, config_path: Path, backup: BackupConfig, report: Report) -> None:
        super().__init__("backup", "the back-up failed", report, first_look_s=FIRST_LOOK_S)
        self._machine = configuration.machine
        self._config_path = config_path
        self._backup = backup

    def due(self, now_utc_s: float) -> bool:
        """Say whether there is no young back-up; one from the future, after a step of the clock, is none."""
        ages_s = [now_utc_s - path.stat().st_mtime for path in existing_backups(self._backup.directory, self._machine)]
        return not any(0.0 <= age_s < self._backup.every_hours * 3600.0 for age_s in ages_s)

    def arguments(self) -> Sequence[str]:
        """Return the words of `toolpoint backup`."""
        keep = str(self._backup.keep)
        return ("backup", str(self._backup.directory), "--keep", keep, "--config", str(self._config_path))

    def in_words(self, made: Mapping[str, Any]) -> str:
        """Return file, size and content."""
        return f"{made['path']}, {made['size_mib']:.1f} MiB, {len(made['manifest']['files'])} files"
