"""Housekeeping by the calendar: packing and retention of the history. Nothing here moves the machine."""

from apscheduler.schedulers.asyncio import AsyncIOScheduler

from config.schema.service import HistoryConfig
from daemon.history.writer import HistoryWriter

HOUSEKEEPING_PERIOD_S = 600
"""Time between housekeeping runs [s of the wall clock]."""


def housekeeping_scheduler(history: HistoryWriter, config: HistoryConfig) -> AsyncIOScheduler:
    """Return a scheduler, not started, that packs and prunes the store now and then."""
    scheduler = AsyncIOScheduler(
        timezone="UTC", job_defaults={"coalesce": True, "max_instances": 1, "misfire_grace_time": None}
    )
    scheduler.add_job(history.request_housekeeping, "interval", seconds=HOUSEKEEPING_PERIOD_S, args=[config])
    return scheduler
