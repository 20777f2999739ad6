"""A history store with some rows of every stream, for tests of the sinks."""

from dataclasses import replace
from pathlib import Path

import history_records as make
import numpy as np
from history_records import EPOCH_S, SMALL, StillClock

from daemon.history.cursors import Cursor, Position
from daemon.history.writer import HistoryWriter
from daemon.sinks.outbox import STREAMS, Outbox


def fill(path: Path, *, start_s: float = EPOCH_S, hours: float = 3.0) -> None:
    """Some rows of every stream, every five minutes."""
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    add(writer, start_s, hours)
    writer.close()


def add(writer: HistoryWriter, start_s: float, hours: float) -> None:
    for k in range(int(hours * 12)):
        first_s = start_s + 300.0 * k
        writer._clock.utc_s = first_s
        degc = 20.0 + np.array([k % 7, np.nan, 3.0]) / 16.0
        writer.temperatures(None, make.cycle("spindle", k + 1, first_s, degc, faults=("ID 2 did not arrive",)))
        writer.temperatures(None, make.cycle("bed", k + 1, first_s + 2, degc[:2]))
        writer.cnc_sample(make.cnc_sample(first_s + 1))
        writer.estimate(make.estimate(first_s + 2, np.array([1.0, np.nan, k])))
        written = make.macros(k + 1, np.array([0.0, k, 1.0]))
        writer.write_outcome(
            writer.write_intent(make.command(np.array([0.0, k, 1.0])), written, "cycle"),
            make.receipt(first_s + 2, written),
        )
        writer.displacement(make.displacement(first_s, np.array([1.0, 2.0, k])))
        writer.event("note", f"number {k}\nsecond line \u00b5", "Ada")
        if k % 10 == 0:
            writer.reference(replace(make.reference(first_s, len(SMALL.sensor_ids)), reference_id=f"r{k}"))


def rows_waiting(path: Path, cursor: Cursor) -> int:
    """Return how many rows a sink has not taken yet, but for writes, of which the last wait for their echo."""
    with Outbox(path) as outbox:
        return sum(
            outbox.waiting(stream, cursor.positions.get(name, Position()))[0]
            for name, stream in STREAMS.items()
            if name != "writes"
        )
