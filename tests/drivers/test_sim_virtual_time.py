"""Virtual time: it passes when nothing else is to be done, and stands still while threads and sockets work."""

import asyncio
import time
from collections.abc import Coroutine
from typing import Any

from daemon.simulation.faults.virtual_world import VirtualClock, VirtualLoop


class EmptyWorld:
    """Nothing happens in it but the passing of time."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.held = 0

    def pass_time(self, timeout_s: float | None) -> None:
        assert timeout_s is not None, "the loop would wait for ever"
        self.clock.monotonic_s += timeout_s

    def hold(self) -> bool:
        self.held -= self.held > 0
        return self.held > 0


def run(work: Coroutine[Any, Any, Any], clock: VirtualClock, world: EmptyWorld | None = None) -> Any:
    loop = VirtualLoop(clock)
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        loop.inhabit(world or EmptyWorld(clock))
        try:
            return runner.run(work)
        finally:
            loop.inhabit(None)


def test_a_month_of_waiting_takes_no_time() -> None:
    clock = VirtualClock(epoch_utc_s=1000.0)

    async def work() -> list[float]:
        times = []
        for _ in range(3):
            await asyncio.sleep(10 * 86400.0)
            times.append(clock.now().monotonic_s)
        return times

    assert run(work(), clock) == [864000.0, 1728000.0, 2592000.0]
    assert clock.now().utc_s == 1000.0 + 2592000.0


def test_no_time_passes_while_a_thread_works() -> None:
    clock = VirtualClock(epoch_utc_s=0.0)

    async def work() -> tuple[str, float]:
        timer = asyncio.create_task(asyncio.sleep(1000.0))
        answer = await asyncio.to_thread(lambda: time.sleep(0.1) or "done")
        passed_s = clock.monotonic_s
        await timer
        return answer, passed_s

    assert run(work(), clock) == ("done", 0.0)
    assert clock.monotonic_s >= 1000.0


def test_the_calendar_can_be_set_without_touching_the_monotonic_clock() -> None:
    clock = VirtualClock(epoch_utc_s=100.0, monotonic_s=7.0)
    clock.utc_step_s = -50.0
    assert (clock.now().utc_s, clock.now().monotonic_s, clock.now().real_s) == (57.0, 7.0, 7.0)
