"""Joining what was read from rows and chunks, in order of time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from daemon.history.columns.codec import FloatArray, IntArray
from daemon.history.columns.frames import Frame, frame_from_rows, select_rows
from daemon.history.columns.kinds import CYCLES
from daemon.history.columns.temperature_chunks import CycleBlock
from daemon.history.rows import FLAG
from daemon.history.series import NOT_IN_CYCLE, TemperatureHistory
from models.units import degc_from_int16


def ms_from_s(utc_s: float) -> int:
    """Return seconds as whole milliseconds; a time that no record can have is far before or after all of them."""
    return round(min(max(utc_s, -(2.0**40)), 2.0**40) * 1e3)


def time_s_of(frame: Frame) -> FloatArray:
    """Return the times of a frame's rows [s]."""
    return frame.integers("utc_ms") / 1e3


def texts_of(frame: Frame, name: str) -> tuple[str, ...]:
    """Return a text column that has no NULL."""
    return tuple(text or "" for text in frame.texts(name))


def in_order(frame: Frame, from_ms: int, to_ms: int) -> Frame:
    """Return the rows from <= time < to, in order of time."""
    times_ms = frame.integers("utc_ms")
    order: IntArray = np.argsort(times_ms, kind="stable")
    inside = order[(times_ms[order] >= from_ms) & (times_ms[order] < to_ms)]
    if inside.size == frame.rows and np.array_equal(inside, np.arange(frame.rows)):
        return frame
    return select_rows(frame, inside)


def merge_cycles(
    sensor_ids: tuple[int, ...], parts: list[tuple[str, list[int], CycleBlock]], from_ms: int, to_ms: int
) -> TemperatureHistory:
    """Return the cycles of several lines with from <= time < to as rows of one table, in order of time.

    What is outside is left out first: a packed hour of a large machine would take 3 MiB for each minute that is asked.
    """
    times = [content.cycles.integers("utc_ms") for _, _, content in parts]
    inside = [np.flatnonzero((part_ms >= from_ms) & (part_ms < to_ms)) for part_ms in times]
    rows = sum(part.size for part in inside)
    times_ms, number = np.empty(rows, dtype=np.int64), np.empty(rows, dtype=np.int64)
    monotonic_ms = np.empty(rows, dtype=np.int64)
    degc = np.full((rows, len(sensor_ids)), np.nan)
    quality = np.full(degc.shape, NOT_IN_CYCLE, dtype=np.uint8)
    reason = np.full(degc.shape, NOT_IN_CYCLE, dtype=np.uint8)
    lines: list[str] = []
    at = 0
    for (line, columns, content), part_ms, kept in zip(parts, times, inside, strict=True):
        here = slice(at, at + kept.size)
        times_ms[here], number[here] = part_ms[kept], content.cycles.integers("number")[kept]
        monotonic_ms[here] = content.cycles.integers("monotonic_ms")[kept]
        degc[here, columns] = degc_from_int16(content.counts[kept])
        quality[here, columns], reason[here, columns] = content.quality[kept], content.reason[kept]
        lines += [line] * kept.size
        at = here.stop
    order = np.argsort(times_ms, kind="stable")
    return TemperatureHistory(
        sensor_ids=sensor_ids,
        time_s=times_ms[order] / 1e3,
        monotonic_s=monotonic_ms[order] / 1e3,
        line=tuple(lines[i] for i in order.tolist()),
        number=number[order],
        degc=degc[order],
        quality=quality[order],
        reason=reason[order],
    )


def cycle_block(names: Sequence[str], rows: list[tuple[Any, ...]]) -> CycleBlock:
    """Return rows of temperature cycles (the named columns, counts, flags) of one layout. At least one is needed."""
    counts = np.frombuffer(b"".join(row[-2] for row in rows), dtype="<i2").reshape(len(rows), -1)
    quality = np.zeros(counts.shape, dtype=np.uint8)
    reason = np.zeros(counts.shape, dtype=np.uint8)
    for index, row in enumerate(rows):
        if row[-1] is not None:
            flags = np.frombuffer(row[-1], dtype=FLAG)
            quality[index, flags["position"]] = flags["quality"]
            reason[index, flags["position"]] = flags["reason"]
    cycles = frame_from_rows(CYCLES, names, [row[:-2] for row in rows])
    return CycleBlock(cycles=cycles, counts=counts.astype(np.int16), quality=quality, reason=reason)
