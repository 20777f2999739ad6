"""Retry: every link is opened anew, for ever, with bounded and jittered waits."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import structlog

from drivers.contract import DriverError, FatalDriverError, LinkError

log = structlog.get_logger(__name__)

STEADY_S = 10.0
"""A link that lived this long [s of the wall clock] starts its waits from the beginning."""


@dataclass(slots=True)
class LinkHealth:
    """How one link fares; written by its supervisor, read by status and telemetry."""

    name: str
    up: bool = False
    attempts: int = 0
    failures: int = 0
    problem: str = ""


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


async def run_with_reconnect(health: LinkHealth, attempt: Callable[[], Awaitable[None]], backoff: Backoff) -> None:
    """Run `attempt` again and again; it returns or raises when its link is gone.

    LinkError and FatalDriverError are expected (the second waits longest); any other exception
    is a defect: it is logged with its traceback and retried all the same.
    """
    loop = asyncio.get_running_loop()
    while True:
        health.attempts += 1
        started_s = loop.time()
        try:
            await attempt()
            health.problem = "ended"
        except LinkError as error:
            _note(health, str(error))
        except FatalDriverError as error:
            _note(health, str(error))
            await asyncio.sleep(backoff.draw())
        except DriverError as error:
            _note(health, str(error))
        except Exception as error:
            health.problem = f"unexpected {type(error).__name__}: {error}"
            log.exception("link.defect", link=health.name)
        health.up = False
        health.failures += 1
        if loop.time() - started_s > STEADY_S:
            backoff.reset()
        await asyncio.sleep(backoff.draw())


def _note(health: LinkHealth, problem: str) -> None:
    if health.up or problem != health.problem:
        log.warning("link.lost" if health.up else "link.down", link=health.name, problem=problem)
    health.problem = problem
