"""Puts the monitor together: what it shows of the models beside what the snapshots and the store hold."""

from collections.abc import Awaitable, Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.monitor.commands import CommandDesk
from daemon.monitor.web.application import MonitorParts
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.live import Live
from daemon.monitor.web.metrics import PresentMetrics
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
    """Return what serves the monitor."""
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
        models=partial(_models, board),
    )
    return partial(serve_monitor, parts)


async def _models(board: SnapshotBoard) -> dict[str, Any]:
    """Return models in force and candidates."""
    thermal, bearings = board.model, board.bearing_model
    return {
        "thermal": None if thermal is None else asdict(thermal),
        "bearings": None if bearings is None else asdict(bearings),
        "releases": [],
        "candidates": [],
        "note": "`toolpoint model release` releases a candidate",
    }
