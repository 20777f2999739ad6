"""Puts the monitor together: what it shows of the models beside what the snapshots and the store hold."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.model_release.repository import ReleaseRepository, proposals_folder
from daemon.monitor.commands import CommandDesk
from daemon.monitor.web.application import MonitorParts
from daemon.monitor.web.documents import Documents
from daemon.monitor.web.live import Live
from daemon.monitor.web.metrics import PresentMetrics
from daemon.monitor.web.serving import serve_monitor
from daemon.snapshots import SnapshotBoard
from daemon.telemetry.metrics import Telemetry
from drivers.clock import Clock
from models.json_values import plain
from models.model_file import ModelError, parse


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
        models=partial(_models, configuration, board),
    )
    return partial(serve_monitor, parts)


NOTE = (
    "a person releases a candidate with `toolpoint model release`, which checks it again, and goes back with "
    "`toolpoint model rollback`; `toolpoint model proposals` says what stands against each"
)
MOST_READ = 4 << 20
"""A larger file is no candidate that is read for the page [byte]."""


async def _models(configuration: Configuration, board: SnapshotBoard) -> dict[str, Any]:
    """Return models in force, releases and candidates."""
    releases, candidates = await asyncio.to_thread(_on_disk, configuration)
    thermal, bearings = board.model, board.bearing_model
    return {
        "thermal": None if thermal is None else asdict(thermal),
        "bearings": None if bearings is None else asdict(bearings),
        "releases": releases,
        "candidates": candidates,
        "note": NOTE,
    }


def _on_disk(configuration: Configuration) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the releases, the newest first, and the candidates, as their files describe them."""
    path = configuration.compensation.model_file
    records = [] if path is None else ReleaseRepository(path).records()
    releases = [
        {
            "release": record.number,
            "model_id": record.model_id,
            "action": record.action,
            "released_by": record.person,
            "released": record.released,
            "note": record.note,
            "checks": list(record.checks),
            "sha256": record.sha256,
        }
        for record in reversed(records)
    ]
    try:
        paths = sorted(each for each in proposals_folder(configuration).glob("*.json") if each.is_file())
        candidates = [_candidate(each) for each in paths if each.stat().st_size <= MOST_READ]
    except OSError:
        candidates = []
    return releases, plain(candidates)


def _candidate(path: Path) -> dict[str, Any]:
    """Return what a candidate's file says of it; the release checks all of it again."""
    try:
        content = parse(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ModelError) as error:
        return {"file": path.name, "problem": f"cannot be read ({error})"}
    band = content.get("band_um")
    return {
        "file": path.name,
        "model_id": content.get("model_id"),
        "kind": content.get("kind"),
        "channels": content.get("channels"),
        "band_um": band,
        "created": content.get("created"),
        "recordings": [each.get("name") for each in content.get("training", []) if isinstance(each, dict)],
        "do_no_harm": content.get("refused") or "its training holds nothing against it",
    }
