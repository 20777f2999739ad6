"""Work that is done now and then in a process of its own, apart from the control loop: back-ups and proposals."""

import asyncio
import json
import math
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Protocol

import structlog
from apscheduler.schedulers.asyncio import AsyncIOScheduler

from config.schema import Configuration
from config.schema.compensation import RetrainingConfig
from config.schema.service import BackupConfig, HistoryConfig
from daemon.backup.names import backup_name, existing_backups
from daemon.history.writer import HistoryWriter
from daemon.model_release.active import proposals_folder
from daemon.snapshots import JobSnapshot
from daemon.telemetry.metrics import give_memory_back

log = structlog.get_logger(__name__)
LOOK_WITHIN_S = 30.0
"""A look at the folder is waited for so long: a network share may not answer for hours [s of the wall clock]."""
RUN_WITHIN_S = 6 * 3600.0
"""A run that takes longer is ended [s of the wall clock]."""
END_WITHIN_S = 10.0
"""A process that is killed ends within this time, unless it waits for a disk or a share [s of the wall clock]."""
NICENESS = "15"
Report = Callable[[str, str], object]
"""Takes what an event is called, and its text."""


class ScheduledProcess(ABC):
    """Runs a command of this program when it is due; says what came of it, and what went wrong once."""

    def __init__(self, event: str, failure: str, report: Report, *, first_look_s: float) -> None:
        self._event = event
        self._failure = failure
        self._report = report
        self._problem = self._unanswered = self._outcome = ""
        self._look: Future[bool] | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._not_before_s = float("-inf")
        """A run that failed is not tried again before as much time has passed as it took [s of the monotonic clock]."""
        self.attempted_utc_s = float("-inf")
        """When the command was last started; -inf: not since the daemon began."""
        self.first_look_s = first_look_s

    @abstractmethod
    def due(self, now_utc_s: float) -> bool:
        """Say whether it is time."""

    @abstractmethod
    def arguments(self) -> Sequence[str]:
        """Return the command's words; it prints JSON on its standard output."""

    @abstractmethod
    def in_words(self, made: Mapping[str, Any]) -> str:
        """Return what was made, for the audit."""

    async def run_if_due(self) -> None:
        """Run the command when it is due; whatever goes wrong is said, and tried again at the next look."""
        try:
            due = await self._looked()
        except Exception as error:
            self._unanswered = self._said(self._unanswered, f"{self._failure}: {_in_words(error)}")
            return
        self._unanswered = ""
        if not due or (begun_s := time.monotonic()) < self._not_before_s:
            return
        self.attempted_utc_s = time.time()
        try:
            text = await self._run()
        except Exception as error:
            self._not_before_s = 2 * time.monotonic() - begun_s
            self._problem = self._said(self._problem, f"{self._failure}: {_in_words(error)}")
            return
        self._problem, self._outcome = "", text
        self._report(self._event, text)

    async def _looked(self) -> bool:
        """Ask `due` in a thread of its own, which keeps up neither the loop nor the end of the daemon."""
        if self._look is None or self._look.done():
            self._look = Future()
            threading.Thread(target=_answer, args=(self._look, self.due), name=self._event, daemon=True).start()
        try:
            async with asyncio.timeout(LOOK_WITHIN_S):
                return await asyncio.shield(asyncio.wrap_future(self._look))
        except TimeoutError as error:
            raise OSError(f"its folder has not answered for {LOOK_WITHIN_S:g} s") from error

    def snapshot(self) -> JobSnapshot:
        attempted = math.isfinite(self.attempted_utc_s)
        return JobSnapshot(
            name=self._event,
            attempted_utc_s=self.attempted_utc_s if attempted else None,
            outcome=self._outcome,
            problem=self._unanswered or self._problem,
        )

    async def _run(self) -> str:
        """Return what was made; raises OSError with the words of the process that failed."""
        last = self._process
        if last is not None and last.returncode is None:
            raise OSError(f"process {last.pid} of an earlier run cannot be ended: it waits for a disk or a share")
        process = self._process = await asyncio.create_subprocess_exec(
            *("nice", "-n", NICENESS, sys.executable, "-P", "-m", "daemon.cli", *self.arguments(), "--json", "-"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(RUN_WITHIN_S):
                output, words = await process.communicate()
        except TimeoutError as error:
            raise OSError(f"it was ended because it took longer than {RUN_WITHIN_S / 3600.0:g} h") from error
        finally:
            for end in (process.terminate, process.kill):  # told to end, it removes what it has half done
                if process.returncode is None:
                    end()
                    await asyncio.wait([asyncio.ensure_future(process.wait())], timeout=END_WITHIN_S)
        if process.returncode != 0:
            said = words.decode("utf-8", "replace").strip().splitlines()
            raise OSError(said[-1] if said else f"status {process.returncode}")
        return self.in_words(json.loads(output))

    def _said(self, before: str, problem: str) -> str:
        """Report a problem that is not what was said before; return it."""
        if problem != before:
            log.error(f"{self._event}.failed", problem=problem)
            self._report(self._event, problem)
        return problem


def _answer(look: "Future[bool]", due: Callable[[float], bool]) -> None:
    try:
        look.set_result(due(time.time()))
    except Exception as error:
        look.set_exception(error)


def _in_words(error: Exception) -> str:
    return str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"


HOUSEKEEPING_PERIOD_S = 600
"""Time between housekeeping runs, and between looks whether it is time for another job [s of the wall clock]."""
HOUSEKEEPING_WITHIN_S = 3600.0
"""A run that takes longer is ended, and what is left is done by the next [s of the wall clock]."""


class Scheduler(Protocol):
    """Starts the housekeeping and the jobs now and then."""

    @property
    def running(self) -> bool: ...

    def start(self) -> None: ...

    def shutdown(self, *, wait: bool) -> None: ...


Housekeeping = Callable[[HistoryWriter, HistoryConfig, Sequence[ScheduledProcess]], Scheduler]
"""Returns a scheduler, not started, for a store and the jobs beside it."""


class _ByTheClock(AsyncIOScheduler):  # type: ignore[misc]
    def wakeup(self) -> None:
        """Start what is due, and what is further off than its period: the clock was set back, or on by years."""
        now = datetime.now(UTC)
        for job in self.get_jobs():
            if abs(job.next_run_time - now) > job.trigger.interval:
                job.modify(next_run_time=now)
        super().wakeup()


def housekeeping_scheduler(
    history: HistoryWriter, config: HistoryConfig, jobs: Sequence[ScheduledProcess]
) -> Scheduler:
    """Return a scheduler, not started, that packs and prunes the store and looks after the jobs now and then."""
    scheduler = _ByTheClock(
        timezone="UTC", job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None}
    )
    every = {"trigger": "interval", "seconds": HOUSEKEEPING_PERIOD_S}
    scheduler.add_job(_tidy, args=[history, config], **every)
    for job in jobs:
        first = datetime.now(UTC) + timedelta(seconds=job.first_look_s)
        scheduler.add_job(job.run_if_due, next_run_time=first, **every)
    made: Scheduler = scheduler
    return made


async def _tidy(history: HistoryWriter, config: HistoryConfig) -> None:
    try:
        async with asyncio.timeout(HOUSEKEEPING_WITHIN_S):
            await history.request_housekeeping(config)
        await asyncio.to_thread(give_memory_back)  # what was free between what is kept, else 1 MiB after a day
    except TimeoutError:
        history.housekeeping.put_off(f"it was ended because it took longer than {HOUSEKEEPING_WITHIN_S / 60.0:g} min")


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
        """Say whether no back-up is young by its name, as a share may have another clock; one of the future is none."""
        now = datetime.fromtimestamp(now_utc_s, UTC)
        old, new = (backup_name(self._machine, now - timedelta(hours=h)) for h in (self._backup.every_hours, 0.0))
        return not any(old < path.name <= new for path in existing_backups(self._backup.directory, self._machine))

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


def job_snapshots(history: HistoryWriter, jobs: Sequence[ScheduledProcess]) -> tuple[JobSnapshot, ...]:
    """Return what status shows of the housekeeping of the store and of these jobs."""
    tidying = JobSnapshot(name="housekeeping", problem=history.housekeeping.problem)
    return (tidying, *(job.snapshot() for job in jobs))
