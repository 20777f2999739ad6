"""The housekeeping jobs that a configuration asks for: back-ups, and proposals trained on the daemon's own history."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from config.schema import Configuration
from config.schema.compensation import RetrainingConfig
from config.schema.service import BackupConfig
from daemon.backup.names import existing_backups
from daemon.housekeeping.side_job import Report, ScheduledProcess
from daemon.model_release.repository import proposals_folder

FIRST_BACKUP_S = 60
FIRST_PROPOSAL_S = 300


class BackupJob(ScheduledProcess):
    """Makes a back-up when the newest one in the folder is too old."""

    def __init__(self, configuration: Configuration, config_path: Path, backup: BackupConfig, report: Report) -> None:
        super().__init__("backup", "the back-up failed", report, first_look_s=FIRST_BACKUP_S)
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


class RetrainingJob(ScheduledProcess):
    """Trains on the history when the newest proposal, or the last attempt, is too old."""

    def __init__(
        self, configuration: Configuration, config_path: Path, retraining: RetrainingConfig, report: Report
    ) -> None:
        super().__init__("proposal", "no proposal was trained", report, first_look_s=FIRST_PROPOSAL_S)
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


def scheduled_jobs(
    configuration: Configuration, config_path: Path | None, report: Report
) -> tuple[ScheduledProcess, ...]:
    """Return the jobs, not started; none without a configuration file, which their processes read themselves."""
    jobs: list[ScheduledProcess] = []
    if config_path is None:
        return ()
    if (backup := configuration.history.backup) is not None:
        jobs.append(BackupJob(configuration, config_path, backup, report))
    if (retraining := configuration.compensation.retraining) is not None:
        jobs.append(RetrainingJob(configuration, config_path, retraining, report))
    return tuple(jobs)
