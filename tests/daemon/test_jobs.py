"""Housekeeping by the calendar."""

import asyncio
from datetime import UTC, datetime

from apscheduler.triggers.interval import IntervalTrigger

from config.schema.service import HistoryConfig
from daemon.housekeeping.jobs import HOUSEKEEPING_PERIOD_S, housekeeping_scheduler


class Store:
    """Counts what is asked of it."""

    def __init__(self):
        self.asked = []
        self.once, self.housekeeping = asyncio.Event(), self

    async def request_housekeeping(self, config):
        self.asked.append(config)
        self.once.set()


async def test_the_store_is_tidied_now_and_then_with_its_configuration():
    store, config = Store(), HistoryConfig()
    scheduler = housekeeping_scheduler(store, config)
    assert not scheduler.running
    (job,) = scheduler.get_jobs()
    assert isinstance(job.trigger, IntervalTrigger)
    assert job.trigger.interval.total_seconds() == HOUSEKEEPING_PERIOD_S
    scheduler.start()
    try:
        (job,) = scheduler.get_jobs()
        assert (job.coalesce, job.max_instances, job.misfire_grace_time) == (True, 1, None)
        job.modify(next_run_time=datetime.now(UTC))
        async with asyncio.timeout(30):
            await store.once.wait()
        assert store.asked == [config]
    finally:
        scheduler.shutdown(wait=False)
