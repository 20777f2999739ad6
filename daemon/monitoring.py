"""Puts the monitor together: what it shows of the models beside what the snapshots and the store hold."""

import asyncio
import json
import os
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.model_release.active import proposals_folder
from daemon.model_release.repository import ReleaseRepository
from daemon.monitor.commands import CommandDesk
from daemon.monitor.web.application import MonitorParts
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.live import Live
from daemon.monitor.web.metrics import PresentMetrics
from daemon.monitor.web.problems import ProblemError
from daemon.monitor.web.serving import serve_monitor
from daemon.snapshots import SnapshotBoard
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock


def monitor_service(
    configuration: Configuration,
    clock: Clock,
    board: SnapshotBoard,
    desk: CommandDesk,
    telemetry: Telemetry,
    history: HistoryWriter,
) -> Callable[[Callable[[], None]], Awaitable[None]]:
    documents = Documents(configuration, clock, board, telemetry)
    telemetry.registry.register(PresentMetrics(configuration, board, documents))
    parts = MonitorParts(
        configuration=configuration,
        clock=clock,
        board=board,
        desk=desk,
        registry=telemetry.registry,
        documents=documents,
        live=Live(documents, board),
        report=history.event,
        models=ModelsOnDisk(configuration, board).document,
    )
    return partial(serve_monitor, parts)


NOTE = (
    "a person releases a candidate with `toolpoint model release`, which checks it again, and goes back with "
    "`toolpoint model rollback`; `toolpoint model list` shows the same as this page"
)
DESCRIBER = (sys.executable, "-P", "-m", "daemon.model_release.describing")
"""Starts the process that reads the models: reading a large one would keep this process from everything else."""
PATIENCE_S = 60.0
Stamp = tuple[tuple[str, int, int], ...]


class ModelsOnDisk:
    """What the files of releases and candidates say; they are read again when one of them has changed."""

    def __init__(self, configuration: Configuration, board: SnapshotBoard) -> None:
        self._configuration, self._board = configuration, board
        self._one_at_a_time = asyncio.Lock()
        self._known: tuple[Stamp, dict[str, Any]] | None = None

    async def document(self) -> dict[str, Any]:
        """Return models in force, releases and candidates; raises ProblemError when they cannot be read."""
        async with self._one_at_a_time:
            stamp = await asyncio.to_thread(self._stamp)
            if self._known is None or self._known[0] != stamp:
                self._known = stamp, await self._described()
        found, thermal, bearings = self._known[1], self._board.model, self._board.bearing_model
        own = thermal is not None and thermal.sha256 == found["in_force"]["sha256"]
        scores, hidden = found["in_force"]["scores"] if own else None, found["hidden"]
        return {
            "thermal": None if thermal is None else asdict(thermal),
            "scores": scores,
            "bearings": None if bearings is None else asdict(bearings),
            "releases": found["releases"],
            "candidates": found["candidates"],
            "note": f"{hidden}; {NOTE}" if hidden else NOTE,
        }

    def _stamp(self) -> Stamp:
        """Return names, times and sizes of all that is described."""
        path = self._configuration.compensation.model_file
        folders = [proposals_folder(self._configuration)]
        folders += [] if path is None else [ReleaseRepository(path).releases]
        found = [] if path is None else [path]
        for folder in folders:
            with suppress(OSError):  # not there yet, or not for this account to read: the process says so
                found += sorted(folder.iterdir())
        return tuple((str(each), status.st_mtime_ns, status.st_size) for each in found if (status := _status(each)))

    async def _described(self) -> dict[str, Any]:
        process = await asyncio.create_subprocess_exec(
            *DESCRIBER, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
        )
        try:
            async with asyncio.timeout(PATIENCE_S):
                output, words = await process.communicate(self._configuration.model_dump_json().encode())
        except TimeoutError:
            raise ProblemError(503, f"the models were not read within {PATIENCE_S:g} s; try again") from None
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        if process.returncode != 0:
            said = words.decode("utf-8", "replace").strip().splitlines()
            raise ProblemError(503, f"the models cannot be read: {said[-1] if said else process.returncode}")
        found = json.loads(output)
        assert isinstance(found, dict)
        return found


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:
        return None
