"""The daemon's look at its sinks: each is shown as a link, up while its own process says that all is well."""

import asyncio
import fcntl
import time
from collections.abc import Callable
from pathlib import Path

from config.schema.sinks import SinkConfig
from daemon.history.cursors import Cursor, cursor_path
from drivers.contract import LinkError

LOOK_PERIOD_S = 10.0
SILENT_AFTER_S = 120.0
"""A sink that has said nothing for so long is not well, though its process runs."""


def lock_path(store: Path) -> Path:
    """Return the file that the process of the sinks holds while it runs."""
    return cursor_path(store, "").with_name("lock")


def runs(store: Path) -> bool:
    """Return whether the process of the sinks runs: the system drops its lock when it ends, however it does."""
    try:
        with lock_path(store).open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    return False


def silence(sink: str, store: Path, alive_utc_s: float, now_utc_s: float) -> str:
    """Return why nothing is heard of a sink, '' when its process runs and has said something lately."""
    if not runs(store):
        return f"sink {sink}: its process does not run, so the history waits: start toolpoint-sink.service"
    if 0.0 <= now_utc_s - alive_utc_s < SILENT_AFTER_S:
        return ""
    return (
        f"sink {sink}: its process runs and has been at one piece for more than {SILENT_AFTER_S:g} s: look at the "
        "server, the network and the room on this computer's disk"
    )


async def watch(sink: SinkConfig, store: Path, came_up: Callable[[], None], period_s: float = LOOK_PERIOD_S) -> None:
    """Look at what the sink's process says of itself; raises LinkError with the reason when it sends nothing."""
    while True:
        cursor = await asyncio.to_thread(Cursor.read, cursor_path(store, sink.name)) or Cursor()
        silent = await asyncio.to_thread(silence, sink.name, store, cursor.alive_utc_s, time.time())
        if problem := silent or cursor.problem:
            raise LinkError(problem)
        came_up()
        await asyncio.sleep(period_s)
