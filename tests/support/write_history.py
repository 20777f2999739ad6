"""Writes a history until it is killed or its disk is full; says on standard output what happened.

python write_history.py cycles STORE      cycles, samples and writes, a line of output per acknowledged cycle
python write_history.py pack STORE        packs what is old, a line of output before each hour
python write_history.py limit STORE       writes beyond a limit of the file size that is lifted later
python write_history.py ballast STORE     writes on a full disk, until a ballast file beside the store is removed
python write_history.py recall STORE      where no file may grow, says what an earlier process left
"""

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import history_records as make
import numpy as np
from history_records import EPOCH_S, SMALL, StillClock

from daemon.history import engine
from daemon.history.columns.packing import pack_hours
from daemon.history.database import connect_reader, connect_writer
from daemon.history.retention import store_hour
from daemon.history.store_lock import WriterLock
from daemon.history.writer import HistoryWriter

FOREVER_S = 60.0
STUCK_S = 0.5
"""Closing the store may free its journal once or twice; then it is full for good."""


def say(**what: object) -> None:
    """One line, at once, in one piece."""
    os.write(1, json.dumps(what).encode() + b"\n")


def degc_of(number: int) -> np.ndarray:
    return 20.0 + np.array([number % 100, number % 7, number % 13]) / 16.0


def put_cycle(writer: HistoryWriter, number: int) -> None:
    writer.temperatures(None, make.cycle("spindle", number, EPOCH_S + number, degc_of(number)))
    for k in range(4):
        writer.cnc_sample(make.cnc_sample(EPOCH_S + number + k / 4))


def start_writer(store: Path) -> HistoryWriter:
    writer = HistoryWriter(
        store,
        clock=StillClock(),
        machine=SMALL,
        on_acknowledged=lambda line, number: say(line=line, number=number),
        on_problem=lambda problem: say(problem=problem),
    )
    writer.start()
    return writer


def write_cycles(store: Path) -> None:
    """Each write's outcome follows one cycle later, so that one intent is always open."""
    writer = start_writer(store)
    before = None
    for number in range(1, 1_000_000):
        put_cycle(writer, number)
        written = make.macros(number, np.array([0.0, number / 3, 1.0]))
        write_id = writer.write_intent(None, written, "cycle")
        write_id.commit.result(FOREVER_S)
        say(intent=int(write_id), settled=None if before is None else int(before[0]))
        if before is not None:
            writer.write_outcome(before[0], make.receipt(EPOCH_S + number, before[1])).result(FOREVER_S)
        before = (write_id, written)


def recall(store: Path) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    say(left=[record.write_id for record in writer.unsettled_writes()], last=writer.last_write_id())


def pack(store: Path) -> None:
    with WriterLock(store), closing(connect_writer(store)) as connection, closing(connect_reader(store)) as reading:
        for hour in pack_hours(reading, 2**50):
            say(hour=hour.hour_ms, kind=hour.kind)
            store_hour(connection, hour)
    say(done=True)


def write_until_full(store: Path, make_room: Callable[[], object]) -> None:
    engine.RETRY_FIRST_S = engine.RETRY_LONGEST_S = 0.1
    writer = start_writer(store)
    number, works_s = 0, time.monotonic()
    while time.monotonic() - works_s < STUCK_S:
        if not writer.problem:
            works_s = time.monotonic()
        number += 1
        put_cycle(writer, number)
        time.sleep(0.002)
    say(full_at=number)
    for _ in range(20):
        number += 1
        put_cycle(writer, number)
        writer.event("note", f"while full {number}")
    say(waiting=writer.waiting, last=number)
    make_room()
    writer.submit(lambda _: None).result(FOREVER_S)
    writer.close()
    say(closed=True, dropped=dict(writer.dropped), problem_left=writer.problem)


def main() -> None:
    mode, store = sys.argv[1], Path(sys.argv[2])
    if mode == "cycles":
        write_cycles(store)
    elif mode == "pack":
        pack(store)
    elif mode == "recall":
        recall(store)
    elif mode == "limit":
        hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
        write_until_full(store, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard)))
    else:
        ballast = store.parent / "ballast"
        ballast.write_bytes(bytes(1_000_000))
        write_until_full(store, ballast.unlink)


if __name__ == "__main__":
    main()
