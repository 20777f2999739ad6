"""What the monitor does in threads: in a few of its own, and what it reads of the store for a bounded time."""

import asyncio
import gzip
import json
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from config.schema import Configuration
from daemon.history.database import HistoryError
from daemon.history.decimation import Decimated, SeriesError, SeriesReader, decimated
from daemon.monitor.web.problems import ProblemError

Answer = TypeVar("Answer")
THREADS = 2
MOST_WAITING = 32
"""So many answers wait for a thread; more are refused."""
LONGEST_QUERY_S = 20.0
"""A query that takes longer is broken off [s]."""


class QueryBrokenOffError(Exception):
    """Nobody waits for the answer any more, or it takes too long."""


class _Threads:
    def __init__(self, number: int) -> None:
        self.pool = ThreadPoolExecutor(number, thread_name_prefix="monitor")
        self._waiting = 0

    async def run(self, work: Callable[[], Answer]) -> Answer:
        """Return what `work` returns; raises ProblemError when too much waits already."""
        if self._waiting >= MOST_WAITING:
            raise ProblemError(503, "too many queries are under way; try again", {"retry-after": "2"})
        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self.pool, work)
        finally:
            self._waiting -= 1


class Recorded:
    """Runs queries of the store, and in a thread of its own what does not wait for them, beside the loop."""

    def __init__(self, configuration: Configuration) -> None:
        self._path = configuration.history.path
        self._queries, others = _Threads(THREADS), _Threads(1)
        self._pools, self.beside = (self._queries.pool, others.pool), others.run

    def close(self) -> None:
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)

    async def query(self, ask: Callable[[SeriesReader, Callable[[], None]], Answer]) -> Answer:
        """Return what `ask(reader, go_on)` returns; it calls `go_on` now and then, which raises to break it off."""
        ended = threading.Event()
        try:
            return await self._queries.run(lambda: self._run(ask, ended))
        except (HistoryError, SeriesError) as error:
            raise ProblemError(404 if isinstance(error, SeriesError) else 503, str(error)) from error
        except QueryBrokenOffError as error:
            raise ProblemError(
                503, f"the query took longer than {LONGEST_QUERY_S:g} s; ask for less time or fewer names"
            ) from error
        finally:
            ended.set()

    def _run(self, ask: Callable[[SeriesReader, Callable[[], None]], Answer], ended: threading.Event) -> Answer:
        until_s = time.monotonic() + LONGEST_QUERY_S

        def go_on() -> None:
            if ended.is_set() or time.monotonic() > until_s:
                raise QueryBrokenOffError

        go_on()
        with SeriesReader(self._path) as reader:
            return ask(reader, go_on)

    async def series(self, names: Sequence[str], from_s: float, to_s: float, points: int, *, packed: bool) -> bytes:
        """Return the series document, encoded; compressed when `packed`."""

        def ask(reader: SeriesReader, go_on: Callable[[], None]) -> bytes:
            found = decimated(reader, names, from_s, to_s, points, go_on)
            return encoded({name: series_document(each) for name, each in found.items()}, packed=packed)

        return await self.query(ask)


def encoded(document: Any, *, packed: bool) -> bytes:
    """Return a document as JSON, compressed when `packed`."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    return gzip.compress(text, 4, mtime=0) if packed else text


def series_document(series: Decimated) -> dict[str, list[float | None]]:
    """Return one series as lists: time to a millisecond, values to a thousandth of their unit."""
    return {
        "t": np.round(series.t, 3).tolist(),
        "min": np.round(series.least, 3).tolist(),
        "max": np.round(series.greatest, 3).tolist(),
        "mean": np.round(series.mean, 3).tolist(),
    }
