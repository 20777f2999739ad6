"""Live events: one task makes the status once for all viewers, and only while somebody looks."""

import asyncio
import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from starlette.types import Message, Receive, Scope, Send

from daemon.monitor.web.documents import Documents
from daemon.monitor.web.problems import ProblemError
from daemon.snapshots import SnapshotBoard

LOOK_S = 0.2
"""Whether something changed is looked at this often [s]."""
LONGEST_S = 0.8
"""The status is sent at least this often [s]."""
MOST_VIEWERS = 100
"""So many event streams are served at a time."""
RETRY_MS = 2000
"""A page that lost its stream connects again after this [ms]."""


def event(name: str, document: Any) -> bytes:
    return f"event: {name}\ndata: {json.dumps(document, allow_nan=False, separators=(',', ':'))}\n\n".encode()


class Live:
    """Makes each event once; every viewer gets the newest and skips what it was too slow for."""

    def __init__(self, documents: Documents, board: SnapshotBoard) -> None:
        self._documents, self._board = documents, board
        self._viewers = 0
        self._task: asyncio.Task[None] | None = None
        self.fresh = asyncio.Event()
        """Set when there is something newer; another one takes its place then."""
        self.status = self.cycle = b""
        self._cycles_wanted = 0

    @property
    def viewers(self) -> int:
        """How many event streams are open."""
        return self._viewers

    def check_room(self) -> None:
        """Raise ProblemError when no further viewer is served."""
        if self._viewers >= MOST_VIEWERS:
            raise ProblemError(
                503, f"{MOST_VIEWERS} pages are watching already; close one", {"retry-after": str(RETRY_MS // 1000)}
            )

    def joins(self, *, cycles: bool) -> None:
        """Count a viewer in; the first one starts the work."""
        self._viewers += 1
        self._cycles_wanted += cycles
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())

    def leaves(self, *, cycles: bool) -> None:
        """Count a viewer out; the last one ends the work."""
        self._viewers -= 1
        self._cycles_wanted -= cycles
        if self._viewers == 0 and self._task is not None:
            self._task.cancel()
            self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        seen: object = None
        cycle: object = None
        sent_s = float("-inf")
        while True:
            now, newest = self._what_counts(), self._board.thermal.temperatures
            news = now != seen or loop.time() - sent_s >= LONGEST_S
            if news:
                seen, sent_s = now, loop.time()
                self.status = event("status", self._documents.status())
            if self._cycles_wanted and newest is not cycle:
                cycle, news = newest, True
                self.cycle = event("cycle", self._documents.cycle())
            if news:
                fresh, self.fresh = self.fresh, asyncio.Event()
                fresh.set()
            await asyncio.sleep(LOOK_S)

    def _what_counts(self) -> object:
        """Return what must be shown at once when it changes."""
        control, speed = self._board.control, self._board.spindle_speed
        links = tuple((link.up, link.problem) for link in self._board.links)
        reference = control.reference.reference_id if control.reference is not None else None
        speeds = None if speed is None else (speed.state, speed.alarm, speed.commanded_rpm)
        return (control.state, control.reason, control.alarm, control.wanted, reference, links, speeds)


class EventStream:
    """The answer of one viewer; ends with the connection, and when the viewer may no longer look."""

    def __init__(self, live: Live, *, cycles: bool, allowed: Callable[[], bool]) -> None:
        self._live, self._cycles, self._allowed = live, cycles, allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = [(b"content-type", b"text/event-stream; charset=utf-8"), (b"x-accel-buffering", b"no")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        gone = asyncio.create_task(when_gone(receive))
        self._live.joins(cycles=self._cycles)
        try:
            await self._send(send, f"retry: {RETRY_MS}\n\n".encode())
            await self._follow(send, gone)
        finally:
            self._live.leaves(cycles=self._cycles)
            gone.cancel()
            with suppress(asyncio.CancelledError):
                await gone
        await send({"type": "http.response.body", "body": b""})

    async def _follow(self, send: Send, gone: asyncio.Task[None]) -> None:
        status = cycle = b""
        while not gone.done() and self._allowed():
            fresh = self._live.fresh
            if self._live.status is not status:
                status = self._live.status
                await self._send(send, status)
            if self._cycles and self._live.cycle is not cycle:
                cycle = self._live.cycle
                await self._send(send, cycle)
            changed = asyncio.create_task(fresh.wait())
            await asyncio.wait([gone, changed], return_when=asyncio.FIRST_COMPLETED)
            changed.cancel()

    @staticmethod
    async def _send(send: Send, data: bytes) -> None:
        message: Message = {"type": "http.response.body", "body": data, "more_body": True}
        await send(message)


async def when_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
