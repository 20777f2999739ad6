"""How far each sink has taken the store: one small file per sink, written by the sink's process alone.

A file that is lost means that nothing was taken: all is sent again, which the keys of the rows make harmless.
"""

import json
import os
import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Self

from config.files import read_whole


@dataclass(frozen=True, slots=True, kw_only=True)
class Position:
    """How far one stream was taken."""

    row: int = 0
    """Every row up to this number was taken."""
    chunk: int = 0
    """Of what was packed before rows had lasting numbers: every chunk up to this number."""
    needed_from_ms: int | None = None
    """Rows of this time and later are needed once more, whatever their number; None: none is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cursor:
    """What one sink has taken, and how it fares."""

    generation: str = ""
    """Of the store that the positions are of."""
    positions: Mapping[str, Position] = field(default_factory=lambda: MappingProxyType({}))
    """By stream."""
    newest_utc_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """By stream: time of the newest row that was taken."""
    sent_rows: int = 0
    stored_rows: int = 0
    """Rows that the sink did not have before; the rest of `sent_rows` were repeats."""
    acknowledged_utc_s: float | None = None
    alive_utc_s: float = 0.0
    """When the sink's process last said that it runs."""
    problem: str = ""
    """Why nothing can be sent, '' while it can."""

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Return what a file says; None when there is none that can be read."""
        try:
            content = json.loads(read_whole(path))
            positions = {str(name): Position(**each) for name, each in content.pop("positions").items()}
            return cls(**content, positions=positions)
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return None

    def write(self, path: Path) -> None:
        """Replace the file in one step; raises OSError.

        Nothing waits for the disk: after a power cut an older file may stand there, from which rows are sent again.
        """
        content = {name: getattr(self, name) for name in self.__slots__}
        content["positions"] = {name: asdict(each) for name, each in self.positions.items()}
        content["newest_utc_s"] = dict(self.newest_utc_s)
        path.parent.mkdir(exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            temporary.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def cursor_path(store: Path, sink: str) -> Path:
    return Path(f"{store}.sinks") / f"{sink}.json"


def generation(connection: sqlite3.Connection) -> str:
    """Return which store this is; a store that is begun anew or restored is another one."""
    (text,) = connection.execute("SELECT text FROM generation").fetchone()
    return str(text)


def held_positions(store: Path, sinks: Iterable[str], connection: sqlite3.Connection) -> Mapping[str, Position]:
    """Return per stream what every sink has taken; what lies beyond waits for one of them."""
    now = generation(connection)
    cursors = [Cursor.read(cursor_path(store, sink)) for sink in sinks]
    known = [cursor if cursor is not None and cursor.generation == now else Cursor() for cursor in cursors]
    streams = ("temperatures", "cnc", "displacements", "estimates", "writes", "events", "references", "probes")
    return {name: _least([cursor.positions.get(name, Position()) for cursor in known]) for name in streams}


def _least(positions: list[Position]) -> Position:
    needed = [each.needed_from_ms for each in positions if each.needed_from_ms is not None]
    return Position(
        row=min(each.row for each in positions),
        chunk=min(each.chunk for each in positions),
        needed_from_ms=min(needed, default=None),
    )
