"""The daemon's own back-ups: in a process of their own, so that they take no time from the control loop."""

import asyncio
import json
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import structlog
from apscheduler.schedulers.asyncio import AsyncIOScheduler

from config.schema import Configuration
from config.schema.service import BackupConfig
from daemon.backup.making import existing_backups

log = structlog.get_logger(__name__)

LOOK_PERIOD_S = 600
"""The age of the newest back-up is looked at this often [s of the wall clock]: it outlives restarts of the daemon."""
FIRST_LOOK_S = 60
NICENESS = "15"

Report = Callable[[str, str], object]
"""Takes what an event is called, and its text."""


class BackupJob:
    """Makes a back-up when the newest one in the folder is too old."""

    def __init__(self, configuration: Configuration, config_path: Path, backup: BackupConfig, report: Report) -> None:
        self._machine = configuration.machine
        self._config_path = config_path
        self._backup = backup
        self._report = report
        self._problem = ""
        self._scheduler = AsyncIOScheduler(
            timezone="UTC", job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None}
        )
        first = datetime.now(UTC) + timedelta(seconds=FIRST_LOOK_S)
        self._scheduler.add_job(self.run_if_due, "interval", seconds=LOOK_PERIOD_S, next_run_time=first)

    def start(self) -> None:
        """Look now and then from now on."""
        self._scheduler.start()

    def stop(self) -> None:
        """Look no more."""
        if self._scheduler.running:
            self._scheduler.shutdown(wait=False)

    def due(self, now_utc_s: float) -> bool:
        """Say whether there is no young back-up; one from the future, after a step of the clock, is none."""
        ages_s = [now_utc_s - path.stat().st_mtime for path in existing_backups(self._backup.directory, self._machine)]
        return not any(0.0 <= age_s < self._backup.every_hours * 3600.0 for age_s in ages_s)

    async def run_if_due(self) -> None:
        """Make a back-up when one is due; say so in the audit, and say what went wrong once."""
        try:
            if not self.due(time.time()):
                return
            text = await self._run()
        except OSError as error:
            self._complain(f"the back-up failed: {error}")
            return
        self._problem = ""
        self._report("backup", text)

    async def _run(self) -> str:
        """Return what was made; raises OSError with the words of the process that failed."""
        process = await asyncio.create_subprocess_exec(
            *("nice", "-n", NICENESS, sys.executable, "-P", "-m", "daemon.cli", "backup", str(self._backup.directory)),
            *("--keep", str(self._backup.keep), "--config", str(self._config_path), "--json", "-"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            output, words = await process.communicate()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode != 0:
            said = words.decode("utf-8", "replace").strip().splitlines()
            raise OSError(said[-1] if said else f"status {process.returncode}")
        made = json.loads(output)
        return f"{made['path']}, {made['size_mib']:.1f} MiB, {len(made['manifest']['files'])} files"

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            log.error("backup.failed", problem=problem)
            self._report("backup", problem)
