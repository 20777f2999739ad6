"""The reader: every kind of record comes back as it went in, raw or packed, while the daemon writes."""

import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from other_user import OTHER, as_root, as_user
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from daemon.history import database
from daemon.history.database import HistoryError, connect_reader
from daemon.history.reader import HistoryReader
from daemon.history.series import NOT_IN_CYCLE
from daemon.history.writer import HistoryWriter
from models.quality import Quality, Reason
from models.records import CncMode, CncRun, OutputState, WriteOutcome

NOW_S = EPOCH_S + 1800.0
Fill = Callable[[HistoryWriter], None]


@pytest.fixture(params=["raw", "packed"])
def stored(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[Fill], HistoryReader]]:
    """Store records, as rows or as a packed hour, and read them."""
    readers = []

    def store(fill: Fill) -> HistoryReader:
        path = tmp_path / "history.sqlite"
        writer = HistoryWriter(path, clock=StillClock(NOW_S), machine=SMALL)
        writer.start()
        fill(writer)
        writer.close()
        assert writer.dropped == {}
        if request.param == "packed":
            assert housekeeping(path, HistoryConfig(), EPOCH_S + 86_400).packed_hours > 0
        readers.append(HistoryReader(path))
        return readers[-1]

    yield store
    for reader in readers:
        reader.close()


def hour(reader_method: Callable[..., object]) -> object:
    return reader_method(EPOCH_S, EPOCH_S + 3600)


def test_temperatures_with_quality_and_reason(stored: Callable[[Fill], HistoryReader]) -> None:
    def fill(writer: HistoryWriter) -> None:
        first = make.cycle("spindle", 1, EPOCH_S, [23.0, 21.0, 22.0625])
        writer.temperatures(make.cleansed(SMALL, first, make.codes(3), make.codes(3)), first)
        bed = make.cycle("bed", 9, EPOCH_S + 4, [19.5, np.nan])
        quality, reason = np.array([0, 2], dtype=np.uint8), np.array([0, Reason.NOT_RECEIVED], dtype=np.uint8)
        writer.temperatures(make.cleansed(SMALL, bed, quality, reason), bed)
        second = make.cycle("spindle", 2, EPOCH_S + 10, [23.0, 35.0, 22.125])
        quality, reason = np.array([0, 1, 0], dtype=np.uint8), np.array([0, Reason.RATE, 0], dtype=np.uint8)
        writer.temperatures(make.cleansed(SMALL, second, quality, reason), second)

    found = stored(fill).temperatures([22, 11, 21], EPOCH_S, EPOCH_S + 60)
    assert found.sensor_ids == (22, 11, 21)
    assert found.line == ("spindle", "bed", "spindle")
    assert found.number.tolist() == [1, 9, 2]
    assert (found.time_s - EPOCH_S).tolist() == [0.0, 4.0, 10.0]
    nan, other = np.nan, NOT_IN_CYCLE
    np.testing.assert_array_equal(found.degc, [[nan, 21.0, nan], [nan, nan, 19.5], [nan, 35.0, nan]])
    np.testing.assert_array_equal(
        found.quality, [[other, 0, other], [Quality.MISSING, other, 0], [other, Quality.HELD, other]]
    )
    np.testing.assert_array_equal(
        found.reason, [[other, 0, other], [Reason.NOT_RECEIVED, other, 0], [other, Reason.RATE, other]]
    )
    np.testing.assert_array_equal(found.cleansed()[:, 1], [21.0, nan, 21.0])
    np.testing.assert_array_equal(found.cleansed()[:, 0], [nan, nan, nan])
    times_s, degc, quality = found.series(11)
    assert ((times_s - EPOCH_S).tolist(), degc.tolist(), quality.tolist()) == ([0, 10], [21, 35], [0, 1])


def test_cnc_samples(stored: Callable[[Fill], HistoryReader]) -> None:
    second = make.cnc_sample(
        EPOCH_S + 0.5,
        mode=CncMode.JOG,
        run=CncRun.HOLD,
        alarm=True,
        spindle_speed_rpm=np.nan,
        motor_temperature_degc=41.07,
        clock_s=77.5,
        sequence_number=110,
        macros={500: 3.0, 600: None, 601: 1 / 3},
    )

    def fill(writer: HistoryWriter) -> None:
        writer.cnc_sample(make.cnc_sample(EPOCH_S))
        writer.cnc_sample(second)

    found = hour(stored(fill).cnc)
    assert (found.mode, found.run) == (("memory", "jog"), ("start", "hold"))
    assert found.alarm.tolist() == [False, True]
    np.testing.assert_array_equal(found.spindle_speed_rpm, [6000.0, np.nan])
    assert found.motor_temperature_degc.tolist() == [41.0, 41.07]
    assert found.clock_s.tolist() == [77.0, 77.5]
    assert found.sequence_number.tolist() == [100, 110]
    assert (found.program[0], found.work_offset[0], found.tool_number[0], found.power_on_count[0]) == (1234, 54, 7, 3)
    assert set(found.macros) == {600, 601}, "what we write stands in the audit"
    np.testing.assert_array_equal(found.macros[600], [0.012, np.nan])
    np.testing.assert_array_equal(found.macros[601], [np.nan, 1 / 3])


def test_writes_with_every_outcome(stored: Callable[[Fill], HistoryReader]) -> None:
    um = np.array([0.0, 1 / 3, -2.0])
    written = make.macros(8, um)
    differing = (None, 7.0, *[value for _, value in written][2:])
    outcomes = {
        WriteOutcome.VERIFIED: {},
        WriteOutcome.DIFFERS: {"read_back": differing, "detail": "macro #501 holds 7"},
        WriteOutcome.FAILED: {"read_back": (), "applied_um": np.array([]), "detail": "time-out"},
    }

    def fill(writer: HistoryWriter) -> None:
        for outcome, changes in outcomes.items():
            write_id = writer.write_intent(
                make.command(um, state=OutputState.RETREAT), written, "heartbeat", "somebody"
            )
            writer.write_outcome(write_id, make.receipt(EPOCH_S, written, outcome=outcome, **changes))
        write_id = writer.write_intent(None, ((500, 1.0), (500, 2.0)), "commission")
        writer.write_outcome(write_id, make.receipt(EPOCH_S, ((500, 1.0), (500, 2.0)), outcome=WriteOutcome.REFUSED))

    verified, differs, failed, twice = hour(stored(fill).writes)
    assert [r.outcome for r in (verified, differs, failed, twice)] == [*outcomes, WriteOutcome.REFUSED]
    assert verified.macros == written, "exactly as sent"
    assert verified.read_back == tuple(value for _, value in written)
    assert (verified.cause, verified.person, verified.state) == ("heartbeat", "somebody", "RETREAT")
    assert verified.cycle_time_s == EPOCH_S
    assert verified.outcome_time_s == pytest.approx(EPOCH_S + 1.502, abs=0.001), "when it was read back"
    assert verified.compensation_um == {"X": 0.0, "Y": 0.333, "Z": -2.0}
    assert (differs.read_back, differs.detail) == (differing, "macro #501 holds 7")
    assert (failed.read_back, failed.applied_um, failed.detail) == ((), {}, "time-out")
    assert twice.macros == ((500, 1.0), (500, 2.0))
    assert (twice.state, twice.requested_um, twice.enable) == (None, {}, ())


def test_events_and_references(tmp_path: Path) -> None:
    clock = StillClock()
    writer = HistoryWriter(tmp_path / "h.sqlite", clock=clock, machine=SMALL)
    writer.start()
    writer.event("state", "OFF -> ARMED", "somebody")
    clock.utc_s += 60
    writer.event("alarm", "line bed is silent")
    reference = make.reference(EPOCH_S + 5, 5)
    writer.reference(reference)
    writer.close()
    with HistoryReader(tmp_path / "h.sqlite") as reader:
        events = reader.events(EPOCH_S, EPOCH_S + 61)
        (found,) = reader.references(EPOCH_S, EPOCH_S + 61)
        assert reader.events(EPOCH_S + 60, EPOCH_S + 61) == events[1:]
    assert [(e.kind, e.text, e.person) for e in events] == [
        ("state", "OFF -> ARMED", "somebody"),
        ("alarm", "line bed is silent", None),
    ]
    np.testing.assert_array_equal(found.degc, reference.degc)
    assert replace(found, degc=reference.degc) == reference


def test_a_time_that_no_record_can_have_is_before_or_after_all_of_them_and_no_damage(tmp_path: Path) -> None:
    writer = HistoryWriter(tmp_path / "h.sqlite", clock=StillClock(), machine=SMALL)
    writer.start()
    writer.event("note", "here")
    writer.close()
    with HistoryReader(tmp_path / "h.sqlite") as reader:
        assert len(reader.events(-1e30, float("inf"))) == 1 and reader.events(1e30, 1e31) == []


def test_clock_that_was_set_back_loses_nothing(stored: Callable[[Fill], HistoryReader]) -> None:
    def fill(writer: HistoryWriter) -> None:
        for number, offset_s in enumerate((0, 10, 20, 5, 15, 25)):
            writer.temperatures(None, make.cycle("bed", number, EPOCH_S + offset_s, [20.0 + number, 20.0]))

    found = stored(fill).temperatures([21], EPOCH_S, EPOCH_S + 60)
    assert found.number.tolist() == [0, 3, 1, 4, 2, 5], "in order of time"


def test_reading_beside_a_writer_and_it_is_read_only(tmp_path: Path) -> None:
    path = tmp_path / "h.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    writer.event("note", "one")
    writer.submit(lambda _: None).result(30)
    with HistoryReader(path) as reader, closing(connect_reader(path)) as connection:
        assert len(reader.events(0, EPOCH_S + 1)) == 1
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            connection.execute("DELETE FROM events")
        writer.event("note", "two")
        writer.submit(lambda _: None).result(30)
        assert len(reader.events(0, EPOCH_S + 1)) == 2
    writer.close()


@as_root
def test_store_at_rest_is_read_by_a_user_who_may_not_write() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "h.sqlite"
        writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
        writer.start()
        writer.event("note", "one")
        writer.close()
        Path(folder).chmod(0o755)
        assert as_user(OTHER, lambda: HistoryReader(path).events(0, EPOCH_S + 1)[0].text) == "one"


@pytest.mark.parametrize("table", ["writes", "temperature_cycles"])
def test_a_damaged_page_is_a_sentence_with_what_to_do(tmp_path: Path, table: str) -> None:
    path = tmp_path / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(NOW_S), machine=SMALL)
    writer.start()
    for _ in range(40):
        writer.write_intent(None, ((500, 1.0),), "tick")
    for k in range(40):
        writer.temperatures(None, make.cycle("bed", k, EPOCH_S + 10 * k, [20.0 + k, 20.0]))
    writer.close()
    with closing(sqlite3.connect(path)) as connection:
        (page,) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    with path.open("r+b") as file:
        file.seek((page - 1) * size)
        file.write(b"\xff" * size)
    with pytest.raises(HistoryError, match=r"the store is damaged .*restore a back-up"), HistoryReader(path) as reader:
        reader.writes(0.0, 1e11)
        reader.temperatures(None, 0.0, 1e11)


@pytest.mark.parametrize("connect", [database.connect_reader, database.connect_writer])
def test_a_damaged_schema_is_a_sentence_with_what_to_do(tmp_path: Path, connect: Callable[[Path], object]) -> None:
    """The byte is no UTF-8, and SQLite's own sentence holds it."""
    path = tmp_path / "history.sqlite"
    database.connect_writer(path).close()
    path.write_bytes(path.read_bytes().replace(b"CREATE TABLE", b"CREATE T\xc1BLE", 1))
    with pytest.raises(HistoryError, match=r"the store is damaged \(its schema cannot be read\); restore a back-up"):
        connect(path)


def test_a_store_that_another_program_holds_for_itself_is_said_to_be_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A start on a full disk does so; it was said to be a matter of rights."""
    monkeypatch.setattr(database, "BUSY_TIMEOUT_S", 0.05)
    path = tmp_path / "history.sqlite"
    database.connect_writer(path).close()
    with closing(database._open_with_index_in_memory(path)):
        for also_on_full_disk in (False, True):
            with pytest.raises(HistoryError, match=r"locked\): another program holds it, try again"):
                database.connect_reader(path, also_on_full_disk=also_on_full_disk)
    database.connect_reader(path).close()
