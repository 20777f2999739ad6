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


async def watch(sink: SinkConfig, store: Path, came_up: Callable[[], None], period_s: float = LOOK_PERIOD_S) -> None:
    """Look at what the sink's process says of itself; raises LinkError with the reason when it sends nothing."""
    while True:
        cursor = await asyncio.to_thread(Cursor.read, cursor_path(store, sink.name))
        if cursor is None or not 0.0 <= time.time() - cursor.alive_utc_s < SILENT_AFTER_S:
            raise LinkError(
                f"sink {sink.name}: its process does not run, so the history waits: start toolpoint-sink.service"
            )
        if cursor.problem:
            raise LinkError(cursor.problem)
        came_up()
        await asyncio.sleep(period_s)
