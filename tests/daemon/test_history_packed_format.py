"""The packed format: any integers, floats, rows and temperatures come back as they went in."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from daemon.history.columns.codec import ByteReader, decode_floats, decode_integers
from daemon.history.columns.encoding import block, encode_floats, encode_frame, encode_integers, encode_temperatures
from daemon.history.columns.frames import ColumnType, Kind, concatenate, decode_frame, frame_from_rows, select_rows
from daemon.history.columns.kinds import CNC, CYCLES, KINDS
from daemon.history.columns.temperature_chunks import CycleBlock, decode_temperatures

SOME = settings(max_examples=60, deadline=None)
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
