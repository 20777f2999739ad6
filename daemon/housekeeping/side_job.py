"""Work that is done now and then in a process of its own, so that it takes no time from the control loop."""

import asyncio
import json
import math
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Protocol

import structlog
from apscheduler.schedulers.asyncio import AsyncIOScheduler

from config.schema.service import HistoryConfig
from daemon.history.writer import HistoryWriter
from daemon.snapshots import JobSnapshot

log = structlog.get_logger(__name__)
LOOK_PERIOD_S = 600
"""Whether it is time is looked at this often [s of the wall clock]: what decides outlives restarts of the daemon."""
NICENESS = "15"
Report = Callable[[str, str], object]
"""Takes what an event is called, and its text."""


class ScheduledProcess(ABC):
    """Runs a command of this program when it is due; says what came of it, and what went wrong once."""

    def __init__(self, event: str, failure: str, report: Report, *, first_look_s: float) -> None:
        self._event = event
        self._failure = failure
        self._report = report
        self._problem = self._outcome = ""
        self.attempted_utc_s = float("-inf")
        """When the command was last started; -inf: not since the daemon began."""
        self._scheduler = AsyncIOScheduler(
            timezone="UTC", job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None}
        )
        first = datetime.now(UTC) + timedelta(seconds=first_look_s)
        self._scheduler.add_job(self.run_if_due, "interval", seconds=LOOK_PERIOD_S, next_run_time=first)

    @abstractmethod
    def due(self, now_utc_s: float) -> bool:
        """Say whether it is time."""

    @abstractmethod
    def arguments(self) -> Sequence[str]:
        """Return the command's words; it prints JSON on its standard output."""

    @abstractmethod
    def in_words(self, made: Mapping[str, Any]) -> str:
        """Return what was made, for the audit."""

    def start(self) -> None:
        """Look now and then from now on."""
        self._scheduler.start()

    def stop(self) -> None:
        """Look no more."""
        if self._scheduler.running:
            self._scheduler.shutdown(wait=False)

    async def run_if_due(self) -> None:
        """Run the command when it is due."""
        try:
            if not self.due(time.time()):
                return
            self.attempted_utc_s = time.time()
            text = await self._run()
        except OSError as error:
            self._complain(f"{self._failure}: {error}")
            return
        self._problem, self._outcome = "", text
        self._report(self._event, text)

    def snapshot(self) -> JobSnapshot:
        """Return what status shows."""
        attempted = math.isfinite(self.attempted_utc_s)
        return JobSnapshot(
            name=self._event,
            attempted_utc_s=self.attempted_utc_s if attempted else None,
            outcome=self._outcome,
            problem=self._problem,
        )

    async def _run(self) -> str:
        """Return what was made; raises OSError with the words of the process that failed."""
        process = await asyncio.create_subprocess_exec(
            *("nice", "-n", NICENESS, sys.executable, "-P", "-m", "daemon.cli", *self.arguments(), "--json", "-"),
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
        return self.in_words(json.loads(output))

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            log.error(f"{self._event}.failed", problem=problem)
            self._report(self._event, problem)


HOUSEKEEPING_PERIOD_S = 600
"""Time between housekeeping runs [s of the wall clock]."""


class Scheduler(Protocol):
    """Starts the housekeeping now and then."""

    @property
    def running(self) -> bool: ...

    def start(self) -> None: ...

    def shutdown(self, *, wait: bool) -> None: ...


Housekeeping = Callable[[HistoryWriter, HistoryConfig], Scheduler]
"""Returns a scheduler, not started, for a store."""


def housekeeping_scheduler(history: HistoryWriter, config: HistoryConfig) -> Scheduler:
    """Return a scheduler, not started, that packs and prunes the store now and then."""
    scheduler = AsyncIOScheduler(
        timezone="UTC", job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None}
    )
    scheduler.add_job(history.request_housekeeping, "interval", seconds=HOUSEKEEPING_PERIOD_S, args=[config])
    made: Scheduler = scheduler
    return made
