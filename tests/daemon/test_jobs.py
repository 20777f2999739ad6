"""Housekeeping by the calendar."""

import asyncio
import time
from datetime import UTC, datetime, timedelta

import pytest
from apscheduler.schedulers import base
from apscheduler.triggers.interval import IntervalTrigger

from config.schema.service import HistoryConfig
from daemon.housekeeping import jobs
from daemon.housekeeping.jobs import HOUSEKEEPING_PERIOD_S, housekeeping_scheduler


class Store:
    """Counts what is asked of it."""

    def __init__(self):
        self.asked = []
        self.once, self.housekeeping = asyncio.Event(), self

    async def request_housekeeping(self, config):
        self.asked.append(config)
        self.once.set()


class Job:
    """Counts how often it looks whether it is time."""

    first_look_s = 60

    def __init__(self):
        self.looks = 0

    async def run_if_due(self):
        self.looks += 1


async def test_the_store_is_tidied_now_and_then_with_its_configuration():
    store, config = Store(), HistoryConfig()
    scheduler = housekeeping_scheduler(store, config, ())
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


@pytest.mark.parametrize("by", [timedelta(days=-365), timedelta(hours=-2), timedelta(days=56 * 365)])
async def test_a_clock_that_was_set_puts_nothing_off_and_is_not_caught_up_with_run_by_run(monkeypatch, by):
    """The timer of the loop goes on whatever the clock says; set on by years, 3 s went by in counting missed runs."""

    class Set(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime.now(tz) + by

    store, looking = Store(), Job()
    scheduler = housekeeping_scheduler(store, HistoryConfig(), [looking])
    scheduler.start()
    try:
        await asyncio.sleep(0.05)
        assert store.asked == [] and looking.looks == 0
        monkeypatch.setattr(base, "datetime", Set)
        monkeypatch.setattr(jobs, "datetime", Set)
        begun_s = time.process_time()
        scheduler.wakeup()
        await asyncio.sleep(0.05)
        assert len(store.asked) == looking.looks == 1
        assert time.process_time() - begun_s < 1.0
        for job in scheduler.get_jobs():
            assert 0.0 < (job.next_run_time - Set.now(UTC)).total_seconds() <= HOUSEKEEPING_PERIOD_S
        scheduler.wakeup()
        await asyncio.sleep(0.05)
        assert len(store.asked) == looking.looks == 1, "once, not at every look at the clock"
    finally:
        scheduler.shutdown(wait=False)
