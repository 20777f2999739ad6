"""Retention by the calendar: a clock far ahead deletes nothing, a machine that was switched off loses nothing."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from tidied_store import packed_here

from config.schema.service import HistoryConfig
from daemon.history import tidying
from daemon.history.database import connect_reader
from daemon.history.reader import HistoryReader
from daemon.history.tidying import LONGEST_UNPROVEN_H, unproven_h
from daemon.history.writer import HistoryWriter
from models.records import ProbeSample

HOUR_S, DAY_S = 3600.0, 86_400.0
CONFIG = HistoryConfig(
    keep_temperatures_days=10.0,
    keep_cnc_days=10.0,
    keep_estimates_days=10.0,
    keep_displacements_days=10.0,
    keep_writes_days=3650.0,
)


@pytest.fixture(autouse=True)
def no_packing_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has tests of its own (`test_history_packing`), and takes half a second of each housekeeping."""
    monkeypatch.setattr(tidying, "packed_hours", packed_here)


@contextmanager
def writing(path: Path, utc_s: float = EPOCH_S) -> Iterator[HistoryWriter]:
    """A writer of its own, as after a start of the daemon."""
    writer = HistoryWriter(path, clock=StillClock(utc_s), machine=SMALL)
    writer.start()
    try:
        yield writer
    finally:
        writer.close()


def record(writer: HistoryWriter, from_s: float, hours: int) -> None:
    """One cycle in every hour, and the clock at its end."""
    for k in range(hours):
        writer.temperatures(None, make.cycle("bed", k + 1, from_s + k * HOUR_S, np.full(2, 20.0)))
    writer._clock.utc_s = from_s + hours * HOUR_S


def cycles_before(path: Path, utc_s: float) -> int:
    with HistoryReader(path) as reader:
        return len(reader.temperatures(reader.sensor_ids(), 0.0, utc_s).time_s)


async def test_a_clock_that_is_years_ahead_deletes_nothing_over_restarts_too(tmp_path: Path) -> None:
    store, ahead_s = tmp_path / "h.sqlite", EPOCH_S + 20 * 365 * DAY_S
    with writing(store) as writer:
        record(writer, EPOCH_S, 48)
        await writer.flushed()
        writer._clock.utc_s = ahead_s
        await writer.request_housekeeping(CONFIG)
        assert cycles_before(store, EPOCH_S + 3 * DAY_S) == 48
        assert "if the clock is wrong" in writer.housekeeping.problem
    with writing(store) as writer:
        record(writer, ahead_s, 24)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG)
        assert cycles_before(store, EPOCH_S + 3 * DAY_S) == 48, "a day of the wrong clock and a restart prove nothing"
        assert "if the clock is wrong" in writer.housekeeping.problem
        writer._clock.utc_s = EPOCH_S + 49 * HOUR_S
        await writer.request_housekeeping(CONFIG)
        assert writer.housekeeping.problem == "" and cycles_before(store, EPOCH_S + 3 * DAY_S) == 48
    with HistoryReader(store) as reader:
        said = [event.text for event in reader.events(0.0, 1e11) if event.kind == "housekeeping"]
    assert (
        len(said) == 3
        and sum("by 7298.0 d" in text for text in said) == 2
        and sum("believed" in text for text in said) == 1
    )


async def test_a_machine_that_was_off_for_three_weeks_keeps_its_history_for_so_much_longer(tmp_path: Path) -> None:
    store, on_again_s = tmp_path / "h.sqlite", EPOCH_S + 22 * DAY_S
    with writing(store) as writer:
        record(writer, EPOCH_S, 24)
    with writing(store) as writer:
        record(writer, on_again_s, 12)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG)
        assert cycles_before(store, on_again_s) == 24 and writer.housekeeping.problem == ""
        record(writer, on_again_s + 12 * HOUR_S, 21 * 24)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG)
        assert cycles_before(store, on_again_s) == 0, "as long on as it was off: the clock is believed"
    with HistoryReader(store) as reader:
        said = [event.text for event in reader.events(0.0, 1e11) if event.kind == "housekeeping"]
    assert len(said) == 2 and "by 21.0 d" in said[0] and "believed" in said[1]


@pytest.mark.parametrize(
    ("shifts", "most_h"), [(range(0, 60 * 24, 24), 16), ([24 * day for day in range(60) if day % 7 < 5], 64 + 16)]
)
async def test_nights_and_weekends_hold_nothing_up(tmp_path: Path, shifts: range | list[int], most_h: int) -> None:
    """A shift of eight hours a day: what is doubted stays a few days."""
    store = tmp_path / "h.sqlite"
    with writing(store) as writer:
        for hour in shifts:
            record(writer, EPOCH_S + hour * HOUR_S, 8)
        await writer.flushed()
        now_s = writer._clock.utc_s
    with closing(connect_reader(store)) as connection:
        assert unproven_h(connection, now_s - 1.0) <= 2 * most_h
        assert unproven_h(connection, now_s - 1.0 + 40 * 24 * HOUR_S) >= 40 * 24 - 1
    assert most_h < LONGEST_UNPROVEN_H


async def test_probes_stay_as_long_as_the_audit_and_no_longer(tmp_path: Path) -> None:
    with writing(tmp_path / "h.sqlite") as writer:
        for day in (0.0, 15.0):
            numbers = {"deviation_um": 1.0, "applied_um": 0.0, "thermal_error_um": 1.0}
            told = {"axis": "Z", "reference_id": None, "accepted": True, "reason": ""}
            writer.probe(ProbeSample(time=make.instant(EPOCH_S + day * DAY_S), **numbers, **told))
        record(writer, EPOCH_S, 20 * 24)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG.model_copy(update={"keep_writes_days": 10.0}))
        with HistoryReader(tmp_path / "h.sqlite") as reader:
            assert [probe.time.utc_s for probe in reader.probes(0.0, 1e11)] == [EPOCH_S + 15.0 * DAY_S]


async def test_what_was_written_while_the_clock_was_decades_behind_stays_as_long_as_what_was_written_before_it(
    tmp_path: Path,
) -> None:
    """A clock without its battery begins in 1970, and is set right a minute later."""
    store, behind_s, right_s = tmp_path / "h.sqlite", 5 * DAY_S, EPOCH_S + 40 * DAY_S
    with writing(store) as writer:
        record(writer, EPOCH_S, 40 * 24)
        writer.event("state", "before", "anna")
        await writer.flushed()
        writer._clock.utc_s = behind_s
        record(writer, behind_s, 3)
        writer.event("state", "acknowledged", "anna")
        writer._clock.utc_s = right_s
        record(writer, right_s, 3)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG)
        assert cycles_before(store, EPOCH_S) == 3 and cycles_before(store, right_s) == 3 + 10 * 24 - 3
        with HistoryReader(store) as reader:
            assert "acknowledged" in [event.text for event in reader.events(0.0, EPOCH_S)]
        record(writer, right_s + 3 * HOUR_S, 11 * 24)
        await writer.flushed()
        await writer.request_housekeeping(CONFIG.model_copy(update={"keep_writes_days": 10.0}))
        assert cycles_before(store, EPOCH_S) == 0, "what was written before them is too old, and so are they"
