"""Housekeeping by the calendar: packing and retention of the history. Nothing here moves the machine."""

from collections.abc import Callable
from typing import Protocol

from apscheduler.schedulers.asyncio import AsyncIOScheduler

from config.schema.service import HistoryConfig
from daemon.history.writer import HistoryWriter

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
