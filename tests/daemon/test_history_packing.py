"""Packed storage: nothing is changed by it, and nothing is lost or doubled on the way."""

import asyncio
import json
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

import history_records as make
from history_records import EPOCH_S, SMALL, StillClock

from config.schema.service import HistoryConfig
from daemon.history import HistoryReader, HistoryWriter, backup, housekeeping
from daemon.history.codec import (
    ByteReader,
    block,
    decode_floats,
    decode_integers,
    encode_floats,
    encode_integers,
    signed_varint,
    varint,
)
from daemon.history.database import HistoryError, connect_reader, connect_writer
from daemon.history.frames import (
    ColumnType,
    Kind,
    concatenate,
    decode_frame,
    encode_frame,
    frame_from_rows,
    select_rows,
)
from daemon.history.kinds import CNC, CYCLES, KINDS, WRITES
from daemon.history.packing import PackedHour, pack_hours
from daemon.history.retention import SPARE_PAGES, store_hour
from daemon.history.temperature_chunks import CycleBlock, decode_temperatures, encode_temperatures
from models.records import WriteOutcome

SOME = settings(max_examples=60, deadline=None)
FOREVER_S = 30.0
INT64 = st.integers(-(2**63), 2**63 - 1)


@SOME
@given(hnp.arrays(np.int64, st.integers(0, 40), elements=INT64 | st.integers(-20, 20)))
def test_any_integers_survive(values: np.ndarray) -> None:
    np.testing.assert_array_equal(decode_integers(encode_integers(values), values.size), values)


@SOME
@given(
    hnp.arrays(
        np.float64,
        st.integers(0, 40),
        elements=st.floats(allow_nan=True, allow_infinity=True) | st.integers(-5000, 5000).map(lambda i: i / 1000),
    )
)
def test_any_floats_survive_bit_by_bit(values: np.ndarray) -> None:
    found = decode_floats(encode_floats(values), values.size)
    number = ~np.isnan(values)
    np.testing.assert_array_equal(np.isnan(found), ~number)
    np.testing.assert_array_equal(found[number].view(np.int64), values[number].view(np.int64))


@SOME
@given(st.integers(0, 2**70), INT64, st.binary(max_size=300))
def test_elements_of_the_format_survive(natural: int, whole: int, data: bytes) -> None:
    reader = ByteReader(varint(natural) + signed_varint(whole) + block(data) + b"rest")
    assert (reader.varint(), reader.signed_varint(), bytes(reader.block())) == (natural, whole, data)
    assert bytes(reader.rest()) == b"rest"


def test_truncated_data_is_refused() -> None:
    with pytest.raises(ValueError, match="ends 2 bytes early"):
        ByteReader(block(b"12345")[:-2]).block()


NUMBER = st.none() | st.floats(allow_nan=False, allow_infinity=False) | st.integers(-99, 99).map(lambda i: i / 10)
MAPPING = st.none() | st.dictionaries(st.sampled_from(["500", "501", "Y", "Z"]), NUMBER).map(json.dumps)
VALUES = {
    ColumnType.INTEGER: st.integers(-(2**40), 2**40),
    ColumnType.NUMBER: NUMBER,
    ColumnType.TEXT: st.none() | st.sampled_from(["", "memory", "\u00b5m \u2013 \u2713"]) | st.text(max_size=5),
    ColumnType.MAPPING: MAPPING,
}


def rows_of(kind: Kind) -> st.SearchStrategy[list[tuple[object, ...]]]:
    return st.lists(st.tuples(*(VALUES[column.type] for column in kind.columns)), max_size=12)


def plain(kind: Kind, rows: list[tuple[object, ...]]) -> list[tuple[object, ...]]:
    """Rows as a frame gives them back: mappings as dictionaries."""
    parsed = [json.loads if c.type is ColumnType.MAPPING else (lambda value: value) for c in kind.columns]
    return [tuple(v if v is None else f(v) for f, v in zip(parsed, row, strict=True)) for row in rows]


def rows_back(kind: Kind, data: bytes) -> list[tuple[object, ...]]:
    frame = decode_frame(kind, data)
    back = []
    for index in range(frame.rows):
        row: list[object] = []
        for column in kind.columns:
            if column.type is ColumnType.MAPPING:
                row.append(frame.mapping(column.name).row(index))
            elif column.type is ColumnType.TEXT:
                row.append(frame.texts(column.name)[index])
            elif column.type is ColumnType.INTEGER:
                row.append(int(frame.integers(column.name)[index]))
            else:
                value = float(frame.numbers(column.name)[index])
                row.append(None if np.isnan(value) else value)
        back.append(tuple(row))
    return back


@pytest.mark.parametrize("kind", [CYCLES, *KINDS.values()], ids=lambda kind: kind.table)
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_any_rows_survive(kind: Kind, data: st.DataObject) -> None:
    rows = data.draw(rows_of(kind))
    packed = encode_frame(kind, frame_from_rows(kind, kind.names, rows))
    assert rows_back(kind, packed) == plain(kind, rows)


@settings(max_examples=15, deadline=None)
@given(first=rows_of(CNC), second=rows_of(CNC))
def test_joining_frames_joins_their_rows(first: list[tuple[object, ...]], second: list[tuple[object, ...]]) -> None:
    frames = [decode_frame(CNC, encode_frame(CNC, frame_from_rows(CNC, CNC.names, rows))) for rows in (first, second)]
    joined = concatenate(frames)
    reversed_ = select_rows(joined, np.arange(joined.rows)[::-1])
    assert rows_back(CNC, encode_frame(CNC, joined)) == plain(CNC, first + second)
    assert rows_back(CNC, encode_frame(CNC, reversed_)) == plain(CNC, (first + second)[::-1])


def test_one_column_is_read_with_what_it_is_relative_to() -> None:
    rows = [(1000 + k, 500 + k, "memory", "start", 0, 1, 2, 3.0, 4.0, 5.0, 6, 54, 7, '{"600":1}') for k in range(3)]
    packed = encode_frame(CNC, frame_from_rows(CNC, CNC.names, rows))
    frame = decode_frame(CNC, packed, ["monotonic_ms"])
    assert set(frame.columns) == {"utc_ms", "monotonic_ms"}
    assert frame.integers("monotonic_ms").tolist() == [500, 501, 502]
    with pytest.raises(ValueError, match=r"cnc have no columns \['speed'\]"):
        decode_frame(CNC, packed, ["speed"])


@st.composite
def blocks(draw: st.DrawFn) -> CycleBlock:
    shape = (draw(st.integers(1, 40)), draw(st.integers(1, 37)))
    near = st.integers(3990, 4010)
    counts = draw(hnp.arrays(np.int16, shape, elements=near | st.integers(-32768, 32767), fill=near))
    code = st.integers(0, 255)
    quality = draw(hnp.arrays(np.uint8, shape, elements=code, fill=st.just(0)))
    reason = draw(hnp.arrays(np.uint8, shape, elements=code, fill=st.just(0)))
    rows = [(10_000 * k, 10_000 * k - 7, k, 1500, 1, None) for k in range(shape[0])]
    return CycleBlock(cycles=frame_from_rows(CYCLES, CYCLES.names, rows), counts=counts, quality=quality, reason=reason)


@SOME
@given(content=blocks(), data=st.data())
def test_any_temperatures_survive_and_any_choice_of_sensors(content: CycleBlock, data: st.DataObject) -> None:
    sensors = content.counts.shape[1]
    positions = data.draw(
        st.permutations(range(sensors)).flatmap(lambda p: st.integers(1, sensors).map(lambda n: p[:n]))
    )
    found = decode_temperatures(encode_temperatures(content), positions)
    np.testing.assert_array_equal(found.counts, content.counts[:, positions])
    np.testing.assert_array_equal(found.quality, content.quality[:, positions])
    np.testing.assert_array_equal(found.reason, content.reason[:, positions])
    assert found.cycles.integers("number").tolist() == list(range(content.counts.shape[0]))


@pytest.mark.parametrize("noise", ["none", "one step", "drift"])
def test_each_way_of_coding_a_series_survives(noise: str) -> None:
    random = np.random.default_rng(3)
    base = {"none": np.zeros((360, 20)), "one step": random.integers(-1, 2, (360, 20))}.get(noise)
    counts = np.cumsum(random.integers(0, 3, (360, 20)), axis=0) if base is None else base
    rows = [(k, k, k, 0, 1, None) for k in range(360)]
    content = CycleBlock(
        cycles=frame_from_rows(CYCLES, CYCLES.names, rows),
        counts=(4000 + 10 * counts).astype(np.int16),
        quality=np.zeros((360, 20), dtype=np.uint8),
        reason=np.zeros((360, 20), dtype=np.uint8),
    )
    packed = encode_temperatures(content)
    np.testing.assert_array_equal(decode_temperatures(packed, range(20)).counts, content.counts)
    bits = 8 * len(packed) / counts.size
    assert bits < {"none": 0.2, "one step": 2.3, "drift": 2.3}[noise], "packing must pay"


def test_unknown_format_is_refused() -> None:
    packed = encode_frame(CNC, frame_from_rows(CNC, CNC.names, []))
    with pytest.raises(ValueError, match="packed cnc have format 99"):
        decode_frame(CNC, b"\x63" + packed[1:])
    with pytest.raises(ValueError, match="packed temperatures have format 99"):
        decode_temperatures(b"\x63", [0])


# --- hours in a store --------------------------------------------------------------------------

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


def test_packing_twice_does_nothing_more(store: Path) -> None:
    housekeeping(store, CONFIG, END_S)
    before = chunks(store)
    assert housekeeping(store, CONFIG, END_S).packed_hours == 0
    assert chunks(store) == before


def test_hour_that_is_not_old_enough_stays_as_it_is(store: Path) -> None:
    assert housekeeping(store, CONFIG, EPOCH_S + 2 * 3600 - 0.001).packed_hours == 0
    assert housekeeping(store, CONFIG, EPOCH_S + 2 * 3600).packed_hours == 6


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


def test_macros_last_written_are_found_in_packed_hours(store: Path) -> None:
    with HistoryReader(store) as reader:
        before = reader.last_written_macros()
    housekeeping(store, CONFIG, END_S + 86_400)
    assert raw_rows(store)["writes"] == 0
    with HistoryReader(store) as reader:
        assert reader.last_written_macros() == before
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    assert writer.write_intent(None, ((500, 1.0),), "cycle") == HOURS * 12 + 1, "no number is given twice"
    writer.close()


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


async def test_failing_packing_process_is_reported(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[str] = []
    writer = HistoryWriter(store, clock=StillClock(END_S), machine=SMALL, on_problem=problems.append)
    writer.start()
    await writer.submit(
        lambda connection: connection.execute("INSERT INTO estimates SELECT NULL,1,1,'',1,1,'{','','','',1,1,'','',''")
    )
    report = await writer.request_housekeeping(CONFIG)
    writer.close()
    assert report is not None
    assert any("housekeeping is put off" in problem and "packing process failed" in problem for problem in problems)


async def test_packing_process_ends_with_whoever_waits_for_it(store: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(END_S), machine=SMALL)
    writer.start()
    task = asyncio.create_task(writer.request_housekeeping(CONFIG))
    while not (children := psutil.Process().children()):
        await asyncio.sleep(0.01)
    assert await writer.request_housekeeping(CONFIG) is None, "one at a time"
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    writer.close()
    psutil.wait_procs(children, timeout=FOREVER_S)
    assert not any(child.is_running() for child in children)


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


def test_file_gives_back_what_retention_freed(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()

    def fill_pages(connection: sqlite3.Connection) -> None:
        connection.execute("BEGIN")
        blob = bytes(40_000)
        for k in range(600):
            connection.execute("INSERT INTO chunks VALUES (NULL, 'cnc', 0, ?, ?, 1, ?)", (k, k, blob))
        connection.execute("COMMIT")

    writer.submit(fill_pages).result(FOREVER_S)
    writer.close()
    full = path.stat().st_size
    report = housekeeping(path, CONFIG, END_S + 1e9)
    assert report.removed_chunks == 600
    assert path.stat().st_size <= (SPARE_PAGES + 100) * 4096 < full


def test_offline_housekeeping_is_refused_beside_a_writer(store: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    with pytest.raises(HistoryError, match="writes this store"):
        housekeeping(store, CONFIG, END_S)
    writer.close()


def test_backup_of_a_store_in_use_is_whole(store: Path, tmp_path: Path) -> None:
    writer = HistoryWriter(store, clock=StillClock(), machine=SMALL)
    writer.start()
    destination = tmp_path / "backup.sqlite"
    backup(store, destination)
    writer.close()
    assert everything(destination) == everything(store)
    assert sorted(p.name for p in tmp_path.iterdir() if "partial" in p.name) == []


def test_failing_backup_leaves_the_older_one(store: Path, tmp_path: Path) -> None:
    destination = tmp_path / "backup.sqlite"
    backup(store, destination)
    before = destination.read_bytes()
    with pytest.raises(HistoryError, match="there is no history store"):
        backup(tmp_path / "absent.sqlite", destination)
    assert destination.read_bytes() == before


def test_kind_of_the_audit_is_packed_with_its_number() -> None:
    assert WRITES.names[0] == "write_id"
