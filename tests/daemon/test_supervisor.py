"""Retry: bounded waits, whatever an attempt raises."""

import asyncio
import contextlib

import pytest
import structlog

from daemon import supervisor
from daemon.supervisor import Backoff, LinkHealth, run_with_reconnect
from drivers.contract import DriverError, FatalDriverError, LinkError


def test_waits_double_up_to_the_bound_and_are_jittered():
    backoff = Backoff(0.5, 30.0)
    waits = [backoff.draw() for _ in range(12)]
    for index, wait_s in enumerate(waits):
        whole_s = min(0.5 * 2**index, 30.0)
        assert whole_s / 2 <= wait_s <= whole_s
    backoff.reset()
    assert backoff.draw() <= 0.5
    assert len({Backoff(1.0, 2.0).draw() for _ in range(20)}) > 1


async def run_attempts(outcomes):
    """Keep a link alive whose attempts end with these outcomes, and then for ever."""
    health, left, reached = LinkHealth("made up"), list(outcomes), asyncio.Event()

    async def attempt():
        if not left:
            health.came_up()
            reached.set()
            await asyncio.Event().wait()
        outcome = left.pop(0)
        if outcome is not None:
            raise outcome

    task = asyncio.create_task(run_with_reconnect(health, attempt, Backoff(0.0001, 0.001)))
    try:
        async with asyncio.timeout(30):
            await reached.wait()
        assert not task.done()
        assert health.up
        return health
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def test_whatever_is_raised_is_tried_again():
    defects = [ZeroDivisionError("d"), asyncio.CancelledError("of a library, which nobody has asked for")]
    outcomes = [LinkError("a"), FatalDriverError("b"), DriverError("c"), *defects, None, LinkError("e")]
    with structlog.testing.capture_logs() as logs:
        health = await run_attempts(outcomes)
    assert health.attempts == len(outcomes) + 1
    assert health.failures == len(outcomes)
    logged = [entry for entry in logs if entry["event"] == "link.defect"]
    assert len(logged) == len(defects) and logged[0]["link"] == "made up"


async def test_the_same_problem_is_logged_once_and_shown_as_it_is():
    with structlog.testing.capture_logs() as logs:
        health = await run_attempts([LinkError("no such port")] * 20)
    assert (health.problem, health.last_problem) == ("", "no such port")
    assert len([entry for entry in logs if entry["event"] == "link.down"]) == 1


async def test_a_link_that_is_back_tells_by_what_and_when_it_was_lost():
    health = LinkHealth("made up")
    for problem, utc_s in (("no such port", 1.0), ("no permission", 2.0)):
        health.went_down(problem, utc_s)
    assert (health.last_problem, health.last_problem_utc_s) == ("no permission", 2.0)
    health.came_up()
    for problem, utc_s in (("the node does not answer", 10.0), ("no such port", 20.0)):
        health.went_down(problem, utc_s)
    health.came_up()
    assert (health.last_problem, health.last_problem_utc_s) == ("the node does not answer", 10.0)


async def flap(times, problem, **kwargs):
    """Let a link come up and be lost with the same words again and again, and stay up in the end."""
    health, left, reached = LinkHealth("made up"), times, asyncio.Event()

    async def attempt():
        nonlocal left
        health.came_up()
        if not left:
            reached.set()
            await asyncio.Event().wait()
        left -= 1
        raise LinkError(problem)

    keeping = run_with_reconnect(health, attempt, Backoff(0.0001, 0.001), utc_s=lambda: 1_760_000_000.0)
    with structlog.testing.capture_logs() as logs:
        task = asyncio.create_task(keeping)
        async with asyncio.timeout(30):
            await reached.wait()
        shown = (health.up, health.problem, health.last_problem, health.last_problem_utc_s, health.losses)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    return shown, logs


async def test_every_loss_and_every_return_is_logged_though_the_words_are_the_same():
    _, logs = await flap(3, "the node does not answer")
    said = [entry["event"] for entry in logs]
    assert said == ["link.up", "link.lost"] * 3 + ["link.up"]


async def test_a_link_that_a_person_must_repair_is_down_while_it_waits():
    health, lost = LinkHealth("made up"), asyncio.Event()

    async def attempt():
        health.came_up()
        lost.set()
        raise FatalDriverError("wrong password")

    task = asyncio.create_task(run_with_reconnect(health, attempt, Backoff(3600.0, 3600.0)))
    async with asyncio.timeout(30):
        await lost.wait()
    await asyncio.sleep(0)
    assert (health.up, health.problem) == (False, "wrong password")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_what_a_person_must_repair_is_tried_ever_more_rarely(monkeypatch):
    """The longer wait is none that the link has lived through: a wrong password is no reason to begin anew."""
    monkeypatch.setattr(supervisor, "STEADY_S", 0.3)
    backoff, attempts = Backoff(0.8, 0.8), asyncio.Semaphore(0)
    monkeypatch.setattr(backoff, "reset", lambda: pytest.fail("its waits begin anew"))

    async def attempt():
        attempts.release()
        raise FatalDriverError("wrong password")

    task = asyncio.create_task(run_with_reconnect(LinkHealth("made up"), attempt, backoff))
    for _ in range(2):
        await asyncio.wait([task, asyncio.create_task(attempts.acquire())], return_when=asyncio.FIRST_COMPLETED)
    assert not task.done(), task.exception()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_cancelling_ends_it():
    task = asyncio.create_task(run_with_reconnect(LinkHealth("x"), lambda: asyncio.sleep(3600), Backoff(0.1, 1.0)))
    await asyncio.sleep(0.01)
    task.cancel()
    assert isinstance((await asyncio.gather(task, return_exceptions=True))[0], asyncio.CancelledError)
