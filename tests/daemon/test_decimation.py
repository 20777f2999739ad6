"""Series as charts need them: few points, nothing left out, from rows, packed hours and their extremes."""

import sqlite3
from contextlib import closing

import history_records as make
import numpy as np
import pytest
from history_records import EPOCH_S, SMALL, StillClock
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tidied_store import housekeeping

from config.schema.service import HistoryConfig
from daemon.history.columns.packing import decode_extremes, temperature_extremes
from daemon.history.columns.temperature_chunks import CycleBlock
from daemon.history.decimation import COARSE_S, Buckets, SeriesError, SeriesReader, decimated
from daemon.history.writer import HistoryWriter
from models.quality import Quality

DAYS = 3
STEP_S = 300.0
END_S = EPOCH_S + DAYS * 86400.0


def degc_at(time_s: float) -> np.ndarray:
    return 20.0 + np.array([5.0, 3.0, 1.0]) * np.sin(2.0 * np.pi * (time_s - EPOCH_S) / 86400.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Three days on two lines, packed but for what is too young."""
    path = tmp_path_factory.mktemp("store") / "history.sqlite"
    writer = HistoryWriter(path, clock=StillClock(), machine=SMALL)
    writer.start()
    for number, time_s in enumerate(np.arange(EPOCH_S, END_S, STEP_S).tolist(), 1):
        for line, ids in SMALL.lines.items():
            writer.temperatures(None, make.cycle(line, number, time_s, degc_at(time_s)[: len(ids)]))
        writer.cnc_sample(make.cnc_sample(time_s))
    writer.close()
    return path


@pytest.fixture(scope="module")
def packed(store, tmp_path_factory):
    path = tmp_path_factory.mktemp("packed") / "history.sqlite"
    path.write_bytes(store.read_bytes())
    housekeeping(path, HistoryConfig(), END_S)
    return path


def ask(path, names, from_s, to_s, points):
    with SeriesReader(path) as reader:
        return decimated(reader, names, from_s, to_s, points)


def same(one, other):
    assert one.keys() == other.keys()
    for name in one:
        for part in ("least", "greatest", "mean", "t"):
            np.testing.assert_allclose(getattr(one[name], part), getattr(other[name], part), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("points", [40, 100, 4000])
def test_packed_hours_give_the_same_as_rows(store, packed, points):
    names = ["temperature.12", "temperature.11", "spindle_speed"]
    found = ask(store, names, EPOCH_S + 500.0, EPOCH_S + 20_000.0, points)
    same(found, ask(packed, names, EPOCH_S + 500.0, EPOCH_S + 20_000.0, points))
    assert all(0 < found[name].t.size <= points for name in names)


def test_days_come_from_the_extremes_and_leave_no_peak_out(store, packed):
    points = 20
    assert (END_S - EPOCH_S) / points >= COARSE_S
    names = ["temperature.12", "temperature.21", "temperature.11", "motor_temperature"]
    coarse = ask(packed, names, EPOCH_S, END_S, points)
    exact = ask(store, names, EPOCH_S, END_S, 4000)
    with closing(sqlite3.connect(packed)) as connection:
        assert connection.execute("SELECT count(*) FROM extremes").fetchone()[0] > DAYS * 24
    for name in names:
        assert coarse[name].least.min() == pytest.approx(exact[name].least.min(), abs=1e-4)
        assert coarse[name].greatest.max() == pytest.approx(exact[name].greatest.max(), abs=1e-4)
        assert coarse[name].t.size <= points
        assert np.all(np.diff(coarse[name].t) > 0)
        assert np.all(coarse[name].least <= coarse[name].mean + 1e-4)
        assert np.all(coarse[name].mean <= coarse[name].greatest + 1e-4)


@pytest.mark.parametrize(
    "name", ["", "temperature", "temperature.x", "temperature.٣", "estimated", "nothing.Z1", "a" * 99]
)
def test_a_series_that_cannot_be_is_named(packed, name):
    with pytest.raises(SeriesError, match="there is no series"):
        ask(packed, [name], EPOCH_S, END_S, 10)


def test_a_query_can_be_broken_off(packed):
    class Enough(Exception):
        pass

    def enough():
        raise Enough

    with SeriesReader(packed) as reader, pytest.raises(Enough):
        decimated(reader, ["temperature.12"], EPOCH_S, END_S, 4000, enough)


@given(
    times=arrays(np.float64, st.integers(0, 60), elements=st.floats(-10.0, 110.0)),
    values=st.data(),
    points=st.integers(2, 30),
)
def test_buckets_hold_every_value_once_and_no_other(times, values, points):
    numbers = values.draw(
        arrays(np.float64, times.size, elements=st.floats(-1e6, 1e6) | st.just(float("nan"))), label="values"
    )
    buckets = Buckets(from_s=0.0, width_s=100.0 / points, count=points)
    half = times.size // 2
    buckets.add(times[:half], numbers[:half])
    buckets.add(times[half:], numbers[half:])
    found = buckets.series()
    counted = numbers[np.isfinite(numbers) & (times >= 0.0) & (np.floor(times / (100.0 / points)) < points)]
    assert found.t.size <= points
    if counted.size:
        assert found.least.min() == counted.min() and found.greatest.max() == counted.max()
        assert np.all(found.least <= found.mean + 1e-6) and np.all(found.mean <= found.greatest + 1e-6)
    else:
        assert found.t.size == 0


@given(
    counts=arrays(np.int16, st.tuples(st.integers(1, 20), st.integers(1, 9)), elements=st.integers(-9000, 16000)),
    bad=st.data(),
)
def test_extremes_of_temperatures_come_back(counts, bad):
    quality = bad.draw(arrays(np.uint8, counts.shape, elements=st.sampled_from([0, 0, 1, 2])))
    found = decode_extremes(
        temperature_extremes(CycleBlock(cycles=None, counts=counts, quality=quality, reason=quality))
    )
    assert found.table.shape == (4, counts.shape[1])
    for column in range(counts.shape[1]):
        good = counts[quality[:, column] == Quality.GOOD, column] / 160.0
        assert found.table[3, column] == good.size
        if good.size:
            expected = [good.min(), good.max(), good.mean()]
            np.testing.assert_allclose(found.table[:3, column], expected, rtol=1e-6, atol=1e-5)
