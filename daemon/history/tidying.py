"""Housekeeping of a running store: packs in a process, deletes in slices what is too old by a believed clock."""

import asyncio
import sqlite3
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import aclosing, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from config.schema.service import HistoryConfig
from daemon.history.columns.packer import packed_hours
from daemon.history.database import HOUR_MS, connect_reader
from daemon.history.engine import cause_in_words
from daemon.history.intake import Commit
from daemon.history.retention import HousekeepingReport, store_hour, tidy

if TYPE_CHECKING:
    from daemon.history.cursors import Position

    Held = Mapping[str, Position] | None

GAP_H = 6
"""So many hours without a record may be a step of the clock [h]."""
LONGEST_UNPROVEN_H = 30 * 24
"""After so many hours with records any gap before them counts as time that has passed [h]."""
LOST_SAID_S, LOST_SHOWN_S = 86_400.0, 93_600.0
"""What a sink has missed is said once a day, and is a problem until nothing more has been missed for as long [s]."""
SAID_H, PROBLEM_H = 4 * 24, 30 * 24
"""Such a gap is said from here on, and is a problem from there on [h]."""
RECORDED = """
SELECT hour FROM (SELECT DISTINCT utc_ms / :hour_ms AS hour FROM temperature_cycles
    UNION SELECT utc_ms / :hour_ms FROM cnc_samples UNION SELECT utc_ms / :hour_ms FROM events
    UNION SELECT start_ms / :hour_ms FROM chunks WHERE kind IN ('temperatures', 'cnc'))
WHERE hour <= :now ORDER BY hour DESC LIMIT :limit
"""


class Store(Protocol):
    """What housekeeping needs of the writer."""

    path: Path

    def submit(self, job: Callable[[sqlite3.Connection], object]) -> Commit: ...

    def event(self, kind: str, text: str, person: str | None = None) -> Commit: ...


def unproven_h(connection: sqlite3.Connection, now_utc_s: float) -> int:
    """Return by how many hours the clock may be ahead: it went on by them while nothing was recorded.

    A gap counts as time that has passed once as many hours have records after it, or `LONGEST_UNPROVEN_H`: the history
    of a machine that was off for three weeks stays for that much longer; a clock that is wrong by years would delete
    all of it.
    """
    limits = {"hour_ms": HOUR_MS, "now": int(now_utc_s * 1e3) // HOUR_MS, "limit": LONGEST_UNPROVEN_H}
    unproven, later = 0, limits["now"]
    for recorded, (hour,) in enumerate(connection.execute(RECORDED, limits)):
        gap = later - hour - 1
        if gap >= GAP_H and recorded < gap:
            unproven += gap
        later = hour
    return unproven


class Housekeeping:
    """Packs and prunes one store, one run at a time."""

    def __init__(self, history: Store, sinks: Sequence[str], report: Callable[[str], None]) -> None:
        self._history = history
        self._sinks = sinks
        self._report = report
        self._running = asyncio.Lock()
        self._said_h = 0
        self._untaken = Counter[str]()
        self._lost = ""
        self._lost_utc_s = float("-inf")
        self.problem = ""
        """Why the latest run did not come to its end, or deletes less than it should; '' when it did."""

    async def run(self, config: HistoryConfig, now_utc_s: float) -> HousekeepingReport | None:
        """Pack and prune in small slices, what is left next time; None while another run goes on."""
        if self._running.locked():
            return None
        async with self._running:
            report = HousekeepingReport()
            try:
                self.problem = await self._pack_and_prune(config, now_utc_s, report)
            except Exception as error:
                self.put_off(cause_in_words(error))
            return report

    def put_off(self, why: str) -> None:
        """Say why the latest run did not come to its end, once."""
        problem = f"{self._history.path}: housekeeping is put off: {why}"
        if problem != self.problem:
            self._history.event("housekeeping", problem, "daemon")
        self.problem = problem
        self._report(problem)

    async def _pack_and_prune(self, config: HistoryConfig, now_utc_s: float, report: HousekeepingReport) -> str:
        """Pack what is old enough, remove what is too old, say what a sink has missed; return the problem left."""
        history = self._history
        async with aclosing(packed_hours(history.path, config, now_utc_s)) as hours:
            async for hour in hours:
                report.packed_hours += await history.submit(partial(store_hour, hour=hour))
        held: Held = None
        if self._sinks:
            from daemon.history.cursors import held_positions  # noqa: PLC0415 (loaded only where there are sinks)

            held = await history.submit(partial(held_positions, history.path, self._sinks))
        ahead_h = await asyncio.to_thread(_unproven_h, history.path, now_utc_s)
        problem = self._say_unproven(ahead_h)
        believed_s = now_utc_s - ahead_h * 3600.0
        while await history.submit(partial(tidy, config=config, now_utc_s=believed_s, report=report, held=held)):
            pass
        self._untaken += report.untaken
        if self._untaken and not 0.0 <= now_utc_s - self._lost_utc_s < LOST_SAID_S:
            self._lost, self._lost_utc_s = _untaken_in_words(self._untaken), now_utc_s
            history.event("sinks", self._lost, "daemon")
            self._untaken.clear()
        if 0.0 <= now_utc_s - self._lost_utc_s < LOST_SHOWN_S:
            problem = problem or self._lost
        return problem

    def _say_unproven(self, ahead_h: int) -> str:
        """Say when the clock is not believed, and when it is again; return why not when it is a problem."""
        said_h, self._said_h = self._said_h, ahead_h if ahead_h >= SAID_H else 0
        text = (
            f"the clock went on by {ahead_h / 24.0:.1f} d in which nothing was recorded: nothing is deleted on their "
            f"account until the machine has recorded for as long, or for {LONGEST_UNPROVEN_H / 24:.0f} d; if the clock "
            "is wrong, set it right before then"
        )
        if self._said_h > said_h:
            self._history.event("housekeeping", text, "daemon")
        elif said_h and not self._said_h:
            self._history.event("housekeeping", "the clock is believed: what is too old is deleted again", "daemon")
        return text if ahead_h >= PROBLEM_H else ""


def _unproven_h(path: Path, now_utc_s: float) -> int:
    with closing(connect_reader(path)) as connection:
        return unproven_h(connection, now_utc_s)


def _untaken_in_words(untaken: Mapping[str, int]) -> str:
    rows = ", ".join(f"{count} {stream}" for stream, count in untaken.items())
    return (
        f"rows that a sink has not taken were deleted ({rows}), the oldest first: they had waited for it "
        "longer than history.keep_for_sinks_days; `toolpoint sink status` says what keeps the sink from taking more"
    )
