"""The daemon's look at its sinks: each is shown as a link, up while its own process says that all is well."""

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from drivers.contract import LinkError

LOOK_PERIOD_S = 10.0
SILENT_AFTER_S = 120.0
"""A process that has said nothing for so long does not run."""


def lock_path(store: Path) -> Path:
    """Return the file that the process of the sinks holds, and touches while it runs."""
    return cursor_path(store, "").with_name("lock")


def lately(utc_s: float, now_utc_s: float) -> bool:
    """Return whether a process that said something then counts as one that runs."""
    return 0.0 <= now_utc_s - utc_s < SILENT_AFTER_S


def runs(store: Path, now_utc_s: float) -> bool:
    """Return whether the process of the sinks runs, whatever each of them waits for."""
    try:
        return lately(lock_path(store).stat().st_mtime, now_utc_s)
    except OSError:
        return False


def silence(sink: str, store: Path, now_utc_s: float) -> str:
    """Return why a sink has said nothing for so long."""
    if runs(store, now_utc_s):
        return (
            f"sink {sink}: its process runs and has been at one piece for more than {SILENT_AFTER_S:g} s: look at the "
            "server, the network and the room on this computer's disk"
        )
    return f"sink {sink}: its process does not run, so the history waits: start toolpoint-sink.service"


async def watch(sink: SinkConfig, store: Path, came_up: Callable[[], None], period_s: float = LOOK_PERIOD_S) -> None:
    """Look at what the sink's process says of itself; raises LinkError with the reason when it sends nothing."""
    while True:
        cursor = await asyncio.to_thread(Cursor.read, cursor_path(store, sink.name))
        if cursor is None or not lately(cursor.alive_utc_s, time.time()):
            raise LinkError(await asyncio.to_thread(silence, sink.name, store, time.time()))
        if cursor.problem:
            raise LinkError(cursor.problem)
        came_up()
        await asyncio.sleep(period_s)
