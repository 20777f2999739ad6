"""Retries: opens every link anew, for ever, with bounded and jittered waits."""

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from typing import Any

import structlog

from daemon.rate_limit import RateLimit
from daemon.snapshots import LinkSnapshot
from drivers.contract import DriverError, FatalDriverError

log = structlog.get_logger(__name__)

STEADY_S = 10.0
"""A link that lived this long [s of the wall clock] starts its waits from the beginning."""


class LinkHealth:
    """The state of one link: written by its supervisor and by what uses the link, shown by status and telemetry."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.up = False
        self.attempts = 0
        self.failures = 0
        """Attempts that ended."""
        self.losses = 0
        """Of them, those that had been up."""
        self.problem = ""
        """Why the link is down, '' while it is up."""
        self.last_problem = ""
        self.last_problem_utc_s: float | None = None
        self.on_change: Callable[[], None] = _nothing
        """Called when an attempt begins, and when the link has come up or could not."""
        self._log = RateLimit[tuple[str, dict[str, Any]]](self._say)

    def came_up(self, **facts: object) -> None:
        """Note that the link works; said once until it is lost."""
        if not self.up:
            self.up, self.problem = True, ""
            self._log(("link.up", facts))
            self.on_change()

    def went_down(self, problem: str, utc_s: float) -> None:
        """Note that the link does not work; every loss is said, a failed attempt when its problem is a new one."""
        was_up, is_new = self.up, problem != self.problem
        self.up, self.problem = False, problem
        if was_up or not self.losses:  # when it is back, what it was lost by counts, and no attempt since
            self.last_problem, self.last_problem_utc_s = problem, utc_s
        self.losses += was_up
        if was_up or is_new:
            self._log(("link.lost" if was_up else "link.down", {"problem": problem}))
        self.on_change()

    def flush(self) -> None:
        """Say what the limit of the log still holds."""
        self._log.flush()

    def snapshot(self) -> LinkSnapshot:
        return LinkSnapshot(
            name=self.name,
            up=self.up,
            problem=self.problem,
            attempts=self.attempts,
            failures=self.failures,
            losses=self.losses,
            last_problem=self.last_problem,
            last_problem_utc_s=self.last_problem_utc_s,
        )

    def _say(self, entry: tuple[str, dict[str, Any]], left_out: int) -> None:
        event, facts = entry
        say = log.info if event == "link.up" else log.warning
        say(event, link=self.name, **facts, **({"left_out": left_out} if left_out else {}))


def _nothing() -> None:
    """Nobody is told."""


def told_to_end() -> bool:
    """Whether the task that runs is cancelled; else a CancelledError is that of a library, which ends no task."""
    return bool((task := asyncio.current_task()) and task.cancelling())


def raise_when_told_to_end(error: BaseException) -> None:
    """Raise the cancellation of the task that runs; that of a library is an error like others, and comes back."""
    if isinstance(error, asyncio.CancelledError) and told_to_end():
        raise error


class Backoff:
    """Waits that double up to a bound, each drawn between half and the whole."""

    def __init__(self, least_s: float, most_s: float) -> None:
        self._least_s = least_s
        self._most_s = most_s
        self._next_s = least_s

    def reset(self) -> None:
        self._next_s = self._least_s

    def draw(self) -> float:
        wait_s = self._next_s * random.uniform(0.5, 1.0)
        self._next_s = min(self._next_s * 2.0, self._most_s)
        return wait_s


async def run_with_reconnect(
    health: LinkHealth,
    attempt: Callable[[], Awaitable[None]],
    backoff: Backoff,
    *,
    utc_s: Callable[[], float] = time.time,
) -> None:
    """Run `attempt` again and again; it returns or raises when its link is gone.

    LinkError and FatalDriverError are expected (the second waits longest); any other exception
    is a defect: it is logged with its traceback and retried all the same.
    """
    try:
        while True:
            await _once(health, attempt, backoff, utc_s)
    finally:
        health.flush()


async def _once(
    health: LinkHealth, attempt: Callable[[], Awaitable[None]], backoff: Backoff, utc_s: Callable[[], float]
) -> None:
    loop = asyncio.get_running_loop()
    health.attempts += 1
    health.on_change()
    started_s, problem, must_be_repaired = loop.time(), "ended", False
    try:
        await attempt()
    except DriverError as error:
        problem, must_be_repaired = str(error), isinstance(error, FatalDriverError)
    except (Exception, asyncio.CancelledError) as error:
        raise_when_told_to_end(error)
        problem = f"unexpected {type(error).__name__}: {error}"
        log.exception("link.defect", link=health.name)
    health.failures += 1
    health.went_down(problem, utc_s())
    if told_to_end():
        raise asyncio.CancelledError  # a client's library has taken the cancellation for a lost connection
    if loop.time() - started_s > STEADY_S:
        backoff.reset()
    if must_be_repaired:
        await asyncio.sleep(backoff.draw())
    await asyncio.sleep(backoff.draw())
