"""Packed hours in a store: nothing is changed by packing, and nothing is lost or doubled on the way."""

import signal
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from daemon.backup import making
from daemon.backup.making import copy_store
from daemon.history.columns.kinds import CYCLES, KINDS
from daemon.history.columns.packed_hour import PackedHour
from daemon.history.columns.packing import missing_extremes, pack_hours
from daemon.history.cursors import Position
from daemon.history.database import HistoryError, connect_reader, connect_writer
from daemon.history.reader import HistoryReader
from daemon.history.retention import HousekeepingReport, store_hour, tidy
from daemon.history.writer import HistoryWriter
from daemon.sinks.outbox import STREAMS, Outbox
from models.records import WriteOutcome

HOURS = 3
CONFIG = HistoryConfig(pack_after_s=3600.0)
END_S = EPOCH_S + HOURS * 3600.0


def fill(writer: HistoryWriter, *, start_s: float = EPOCH_S, hours: int = HOURS) -> None:
    """Cycles with every quality, samples, estimates, writes, displacements: a few per hour."""
    random = np.random.default_rng(1)
    for k in range(hours * 12):
        first_s = start_s + 300.0 * k
        for line, size in (("spindle", 3), ("bed", 2)):
            degc = 25.0 + np.round(random.normal(0, 2, size) / 0.0625) * 0.0625
            quality, reason = np.zeros(size, dtype=np.uint8), np.zeros(size, dtype=np.uint8)
            if k % 5 == 1:
                quality[0], reason[0] = 1, 6
            if k % 7 == 2:
                degc[1], quality[1], reason[1] = np.nan, 2, 1
            record = make.cycle(line, k + 1, first_s, degc, faults=("ID 2 did not arrive",) if k % 7 == 2 else ())
            writer.temperatures(make.cleansed(SMALL, record, quality, reason), record)
        writer.cnc_sample(make.cnc_sample(first_s + 1, spindle_speed_rpm=float(k), macros={600: k / 7, 601: None}))
        writer.estimate(make.estimate(first_s + 2, random.normal(0, 10, 3)))
        written = make.macros(k + 1, random.normal(0, 10, 3))
        writer._clock.utc_s = first_s + 3
        write_id = writer.write_intent(make.command(random.normal(0, 10, 3)), written, "cycle")
        outcome = WriteOutcome.DIFFERS if k % 6 == 3 else WriteOutcome.VERIFIED
        read_back = (None, *[value for _, value in written][1:]) if k % 6 == 3 else tuple(v for _, v in written)
        writer.write_outcome(write_id, make.receipt(first_s + 2, written, outcome=outcome, read_back=read_back))
        writer.displacement(make.displacement(first_s, random.normal(0, 5, 3)))


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    fill(writer)
    writer.close()
    yield path


def everything(path: Path) -> dict[str, object]:
    """All that the reader can tell, in a form that compares."""
    with HistoryReader(path) as reader:
        span = (EPOCH_S - 1e6, END_S + 1e6)
        temperatures = reader.temperatures(None, *span)
        cnc, estimates, displacements = reader.cnc(*span), reader.estimates(*span), reader.displacements(*span)
        writes = reader.writes(*span)
    records = {"temperatures": temperatures, "cnc": cnc, "estimates": estimates, "displacements": displacements}
    found: dict[str, object] = {"writes": writes}
    for name, record in records.items():
        found |= {f"{name}.{field}": comparable(getattr(record, field)) for field in record.__slots__}
    return found


def comparable(value: object) -> object:
    """Arrays as their bytes, so that NaN equals NaN and every bit counts."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: comparable(item) for key, item in value.items()}
    return value


def chunks(path: Path) -> list[tuple[str, int]]:
    with closing(connect_reader(path)) as connection:
        return connection.execute("SELECT kind, row_count FROM chunks ORDER BY kind, start_ms").fetchall()


def raw_rows(path: Path) -> dict[str, int]:
    with closing(connect_reader(path)) as connection:
        tables = [CYCLES.table, *(kind.table for kind in KINDS.values())]
        return {t: connection.execute(f"SELECT count(*) FROM {t}").fetchone()[0] for t in tables}


def test_packing_changes_nothing_for_the_reader(store: Path) -> None:
    before = everything(store)
    report = housekeeping(store, CONFIG, END_S)
    assert everything(store) == before
    assert report.packed_hours == 2 * (2 + len(KINDS)), "two whole hours, two lines and four kinds"
    assert raw_rows(store) == {
        "temperature_cycles": 24,
        "cnc_samples": 12,
        "displacements": 12,
        "estimates": 12,
        "writes": 12,
    }


def test_records_that_come_late_for_a_packed_hour_join_it(store: Path) -> None:
    housekeeping(store, CONFIG, END_S)
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    writer.displacement(make.displacement(EPOCH_S + 30, [9.0, 9.0, 9.0]))
    writer.close()
    housekeeping(store, CONFIG, END_S)
    with HistoryReader(store) as reader:
        times_s = reader.displacements(EPOCH_S, EPOCH_S + 301).time_s - EPOCH_S
    assert times_s.tolist() == [0.0, 30.0, 300.0]


def test_intent_without_outcome_is_not_packed_away(store: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(EPOCH_S + 100), machine=SMALL)
    writer.start()
    write_id = writer.write_intent(None, ((500, 1.0),), "cycle")
    writer.close()
    housekeeping(store, CONFIG, END_S)
    with HistoryReader(store) as reader:
        assert [record.write_id for record in reader.unsettled_writes()] == [write_id]
        assert write_id in [record.write_id for record in reader.writes(EPOCH_S, END_S)]
    writer = HistoryWriter(store, clock=StillClock(END_S), machine=SMALL)
    writer.start()
    writer.write_outcome(write_id, make.receipt(EPOCH_S, ((500, 1.0),), outcome=WriteOutcome.FAILED))
    writer.close()
    housekeeping(store, CONFIG, END_S)
    with HistoryReader(store) as reader:
        assert reader.unsettled_writes() == []
        (settled,) = [record for record in reader.writes(EPOCH_S, END_S) if record.write_id == write_id]
        assert settled.outcome is WriteOutcome.FAILED
        assert reader.last_written_macros() is not None


def test_rows_that_changed_meanwhile_are_left_for_the_next_time(store: Path) -> None:
    before = everything(store)
    with closing(connect_writer(store)) as connection, closing(connect_reader(store)) as reading:
        hour = next(pack_hours(reading, 2**50))
        assert store_hour(connection, replace(hour, row_count=hour.row_count + 1)) is False
        assert store_hour(connection, hour) is True
        assert store_hour(connection, hour) is False, "the same hour twice must not double it"
    assert everything(store) == before


def test_hour_is_packed_whole_or_not_at_all(store: Path) -> None:
    before, raw = everything(store), raw_rows(store)
    with closing(connect_reader(store)) as reading:
        hours: list[PackedHour] = list(pack_hours(reading, 2**50))
    with closing(connect_writer(store)) as connection:
        for hour in hours:
            # Deleting fails half way: the chunk is in, the rows are not out.
            connection.set_authorizer(lambda action, *_: sqlite3.SQLITE_DENY if action == sqlite3.SQLITE_DELETE else 0)
            with pytest.raises(sqlite3.DatabaseError, match="not authorized"):
                store_hour(connection, hour)
            connection.set_authorizer(None)
            connection.rollback()
    assert (everything(store), raw_rows(store), chunks(store)) == (before, raw, [])


async def test_running_writer_packs_beside_its_work(store: Path) -> None:
    before = everything(store)
    clock = StillClock(END_S)
    problems: list[str] = []
    writer = HistoryWriter(store, clock=clock, machine=SMALL, on_problem=problems.append)
    writer.start()
    report = await writer.request_housekeeping(CONFIG)
    writer.close()
    assert problems == []
    assert report is not None and report.packed_hours == 12
    assert everything(store) == before


def test_what_is_asked_of_years_in_the_index_reads_not_what_they_hold(store: Path) -> None:
    housekeeping(store, CONFIG, END_S + 7200.0)
    times = "start_ms - 3600000 * (n + 1), end_ms - 3600000 * (n + 1)"
    with closing(connect_writer(store)) as connection:
        connection.execute(
            "WITH RECURSIVE numbers(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM numbers WHERE n < 1000) "
            "INSERT INTO chunks (kind, layout_id, start_ms, end_ms, row_count, data, last_row_id) "
            f"SELECT kind, layout_id, {times}, row_count, randomblob(3000), last_row_id FROM chunks, numbers "
            "WHERE chunk_id IN (SELECT max(chunk_id) FROM chunks GROUP BY kind)"
        )
        connection.execute(
            "INSERT INTO extremes SELECT kind, layout_id, start_ms / 3600000 * 3600000, chunk_id, randomblob(900) "
            "FROM chunks WHERE chunk_id NOT IN (SELECT chunk_id FROM extremes)"
        )
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert store.stat().st_size > 20e6
    with Outbox(store) as reader, closing(connect_reader(store)) as packing, closing(connect_writer(store)) as writing:
        cnc, taken = STREAMS["cnc"], Position(row=reader.last_row(STREAMS["cnc"]))
        before = bytes_read()
        assert reader.extent("cnc") == (EPOCH_S - 999 * 3600.0 + 1.0, END_S - 299.0)
        assert reader.last_displacement_utc_s() == END_S - 300.0
        assert list(missing_extremes(packing)) == []
        assert not tidy(writing, CONFIG, END_S, HousekeepingReport())
        assert reader.waiting(cnc, taken) == (0, None) and reader.days(cnc, taken)[0] == []
        assert bytes_read() - before < 1.5e6


def bytes_read() -> int:
    """Bytes that this process has read, from memory or disk."""
    return int(Path("/proc/self/io").read_text().split()[1])


def test_what_was_written_last_is_so_by_its_number_though_a_clock_was_ahead(store: Path) -> None:
    """Hours of a clock that was ahead by years are not packed, or lie after all others once they are."""
    writer = HistoryWriter(store, clock=StillClock(END_S + 4e8), machine=SMALL)
    writer.start()
    fill(writer, start_s=END_S + 4e8, hours=2)
    writer.close()
    for packed_at_s in (END_S, END_S + 4e8 + 7200.0):
        housekeeping(store, CONFIG, packed_at_s)
        writer = HistoryWriter(store, clock=StillClock(END_S), machine=SMALL)
        writer.start()
        written = ((500, 1.0), (501, packed_at_s))
        write_id = writer.write_intent(make.command([0.0, 0.0, 0.0]), written, "cycle")
        writer.write_outcome(write_id, make.receipt(END_S, written))
        writer.close()
        housekeeping(store, CONFIG, END_S + 7200.0)
        with HistoryReader(store) as reader:
            assert reader.last_written_macros() == {500: (1.0,), 501: (packed_at_s,)}


def test_retention_is_per_kind_and_reaches_packed_hours(store: Path) -> None:
    housekeeping(store, CONFIG, END_S)
    hour_days = 1.0 / 24.0
    config = HistoryConfig(pack_after_s=3600.0, keep_cnc_days=0.5 * hour_days, keep_temperatures_days=1.5 * hour_days)
    housekeeping(store, config, END_S)
    with HistoryReader(store) as reader:
        cnc, temperatures = reader.extent("cnc"), reader.extent("temperatures")
        counts = {kind: reader.row_count(kind) for kind in ("cnc", "temperatures", "estimates", "writes")}
    assert cnc is not None and cnc[0] >= END_S - 1800
    assert temperatures is not None and temperatures[0] >= END_S - 2 * 3600, "an hour goes when all of it is too old"
    assert counts == {"cnc": 6, "temperatures": 48, "estimates": 36, "writes": 36}


def test_backup_of_a_store_in_use_is_whole(store: Path, tmp_path: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    destination = tmp_path / "backup.sqlite"
    copy_store(store, destination)
    writer.close()
    assert everything(destination) == everything(store)
    assert sorted(p.name for p in tmp_path.iterdir() if "partial" in p.name) == []


def test_a_backup_ends_when_it_is_told_to_and_begins_anew_for_no_commit(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces: list[tuple[object, ...]] = []
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()

    def commit(*piece: object) -> None:
        pieces.append(piece)
        writer.event("note", "meanwhile").result(5.0)

    monkeypatch.setattr(making, "PAGES_AT_ONCE", 10)
    monkeypatch.setattr(making, "answer_signals", commit)
    copy_store(store, tmp_path / "backup.sqlite")
    left = [piece[1] for piece in pieces if piece]
    assert len(left) > 3 and left == sorted(left, reverse=True)
    monkeypatch.setattr(making, "answer_signals", lambda *_: signal.raise_signal(signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        with pytest.raises(SystemExit):
            copy_store(store, tmp_path / "other.sqlite")
    finally:
        signal.signal(signal.SIGTERM, before)
        writer.close()
    with HistoryReader(tmp_path / "backup.sqlite") as reader:
        assert reader.events(0.0, 1e11) == [], "as it was when the copy began"


def test_failing_backup_leaves_the_older_one(store: Path, tmp_path: Path) -> None:
    destination = tmp_path / "backup.sqlite"
    copy_store(store, destination)
    before = destination.read_bytes()
    with pytest.raises(HistoryError, match="there is no history store"):
        copy_store(tmp_path / "absent.sqlite", destination)
    assert destination.read_bytes() == before
