"""Many reports: the first at once, the rest summed up, none without a trace."""

import asyncio

from daemon.rate_limit import RateLimit

FOREVER_S = 30.0


async def test_the_first_pass_at_once_and_the_rest_is_counted() -> None:
    said: list[tuple[int, int]] = []
    limit = RateLimit[int](lambda item, left_out: said.append((item, left_out)), burst=3, period_s=3600.0)
    for number in range(10):
        limit(number)
    assert said == [(0, 0), (1, 0), (2, 0)]
    limit.flush()
    assert said[3:] == [(9, 6)]
    limit(10)
    assert said[4:] == [(10, 0)], "a flush begins anew"
    assert sum(1 + left_out for _, left_out in said) == 11


async def test_what_is_held_comes_when_the_period_is_over_though_nothing_more_comes() -> None:
    said: list[tuple[str, int]] = []
    over = asyncio.Event()

    def say(item: str, left_out: int) -> None:
        said.append((item, left_out))
        if item == "last":
            over.set()

    limit = RateLimit[str](say, burst=1, period_s=0.001)
    for item in ("first", "second", "last"):
        limit(item)
    async with asyncio.timeout(FOREVER_S):
        await over.wait()
    assert said == [("first", 0), ("last", 1)]
    limit.flush()
    assert len(said) == 2, "nothing is said twice"
