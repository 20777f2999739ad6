"""A link that is cancelled ends, even where a client's library swallows the cancellation."""

import asyncio

from daemon.supervisor import Backoff, LinkHealth, run_with_reconnect
from drivers.contract import LinkError


async def test_a_cancellation_that_an_attempt_swallows_ends_the_link_all_the_same():
    begun, attempts = asyncio.Event(), 0

    async def attempt() -> None:
        nonlocal attempts
        attempts += 1
        if attempts > 1:
            return
        begun.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise LinkError("lost while connecting") from None

    task = asyncio.create_task(run_with_reconnect(LinkHealth("cnc"), attempt, Backoff(0.001, 0.002)))
    await begun.wait()
    task.cancel()
    done, _ = await asyncio.wait([task], timeout=10.0)
    task.cancel()
    assert done and task.cancelled() and attempts == 1
