"""Which housekeeping jobs a configuration asks for."""

from pathlib import Path

from config.schema import Configuration
from daemon.housekeeping.backup_job import BackupJob
from daemon.housekeeping.retraining_job import RetrainingJob
from daemon.housekeeping.side_job import Report, ScheduledProcess


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
