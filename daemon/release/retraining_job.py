"""Trains a proposal now and then, in a process of its own, so that it takes no time from the control loop."""

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
from config.schema.compensation import RetrainingConfig
from daemon.release.releasing import proposals_folder

log = structlog.get_logger(__name__)

LOOK_PERIOD_S = 600
"""The age of the newest proposal is looked at this often [s of the wall clock]: it outlives restarts of the daemon."""
FIRST_LOOK_S = 300
NICENESS = "15"

Report = Callable[[str, str], object]
"""Takes what an event is called, and its text."""


class RetrainingJob:
    """Trains on the history when the newest proposal, or the last attempt, is too old."""

    def __init__(
        self, configuration: Configuration, config_path: Path, retraining: RetrainingConfig, report: Report
    ) -> None:
        self._folder = proposals_folder(configuration)
        self._config_path = config_path
        self._retraining = retraining
        self._report = report
        self._problem = ""
        self._attempted_utc_s = float("-inf")
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
        """Say whether there was neither a proposal nor an attempt lately; a time from the future is not lately."""
        times_s = [self._attempted_utc_s]
        if self._folder.is_dir():
            times_s += [path.stat().st_mtime for path in self._folder.glob("*.json")]
        return not any(0.0 <= now_utc_s - each_s < 3600.0 * self._retraining.every_hours for each_s in times_s)

    async def run_if_due(self) -> None:
        """Train when it is due; say so in the audit, and say what went wrong once."""
        try:
            if not self.due(time.time()):
                return
            self._attempted_utc_s = time.time()
            text = await self._run()
        except OSError as error:
            self._complain(f"no proposal was trained: {error}")
            return
        self._problem = ""
        self._report("proposal", text)

    async def _run(self) -> str:
        """Return what was proposed; raises OSError with the words of the process that failed."""
        process = await asyncio.create_subprocess_exec(
            *("nice", "-n", NICENESS, sys.executable, "-P", "-m", "daemon.cli", "model", "propose"),
            *("--config", str(self._config_path), "--json", "-"),
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
        refused = f"; its training refuses it: {made['refused']}" if made["refused"] else ""
        return f"{made['path']}, {made['hours']:g} h of history{refused}"

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            log.error("retraining.failed", problem=problem)
            self._report("proposal", problem)
