"""Housekeeping now and then."""

import asyncio

from config.schema.service import HistoryConfig
from daemon.housekeeping import jobs
from daemon.housekeeping.jobs import keep_house


class Store:
    """Counts what is asked of it; its first run takes too long."""

    def __init__(self):
        self.asked, self.problems = [], []
        self.twice, self.housekeeping = asyncio.Event(), self

    async def request_housekeeping(self, config):
        self.asked.append(config)
        if len(self.asked) == 1:
            await asyncio.sleep(60.0)
        self.twice.set()

    def put_off(self, why):
        self.problems.append(why)


async def test_the_store_is_tidied_now_and_then_with_its_configuration(monkeypatch):
    assert jobs.HOUSEKEEPING_PERIOD_S == 600
    monkeypatch.setattr(jobs, "HOUSEKEEPING_PERIOD_S", 0.01)
    monkeypatch.setattr(jobs, "HOUSEKEEPING_WITHIN_S", 0.05)
    store, config = Store(), HistoryConfig()
    running = asyncio.create_task(keep_house(store, config))
    async with asyncio.timeout(30):
        await store.twice.wait()
    running.cancel()
    assert store.asked[:2] == [config, config]
    assert "took longer" in store.problems[0]
