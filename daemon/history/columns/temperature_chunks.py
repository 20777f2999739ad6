"""Chunks of temperatures: one hour of one line, in groups of sensors that are unpacked singly.

Each sensor's series is coded as steps of its own resolution, as differences to the previous value or to the mean of a
short block, whichever is smaller: noise of one step costs less around a mean, slow drift as differences.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import (
    ByteReader,
    IntArray,
    block,
    common_step,
    decode_planes,
    encode_planes,
    signed_varint,
    unzigzag,
    varint,
    zigzag,
)
from daemon.history.columns.frames import Frame, decode_frame, encode_frame
from daemon.history.columns.kinds import CYCLES

FORMAT = 1
GROUP = 16
"""Sensors per group: fewer make each sensor's share of a group's overhead larger, more make reading one slower."""
BLOCKS = (0, 12)
"""Lengths of the blocks that are tried; 0 codes differences to the previous value."""
MISSING = -32768
CountArray = npt.NDArray[np.int16]
CodeArray = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class CycleBlock:
    """Consecutive cycles of one line."""

    cycles: Frame
    counts: CountArray
    """Measured, one row per cycle, one column per sensor [1/160 degC]; -32768 where none."""
    quality: CodeArray
    reason: CodeArray


def encode_temperatures(content: CycleBlock) -> bytes:
    """Return cycles of one line as a chunk."""
    sensors = content.counts.shape[1]
    groups = [
        block(encode_group(content.counts[:, at : at + GROUP]))
        + block(_encode_codes(content.quality[:, at : at + GROUP]))
        + block(_encode_codes(content.reason[:, at : at + GROUP]))
        for at in range(0, sensors, GROUP)
    ]
    head = bytes([FORMAT]) + block(encode_frame(CYCLES, content.cycles)) + varint(sensors)
    return head + b"".join(block(group) for group in groups)


def decode_temperatures(
    data: bytes | memoryview, positions: Sequence[int], names: Sequence[str] | None = None
) -> CycleBlock:
    """Return the sensors at the given positions of the line, and the columns of the cycles that are asked for."""
    reader = ByteReader(data)
    if (form := reader.byte()) != FORMAT:
        raise ValueError(f"packed temperatures have format {form}; this version of toolpoint knows {FORMAT}")
    cycles = decode_frame(CYCLES, reader.block(), names)
    sensors = reader.varint()
    counts = np.empty((cycles.rows, len(positions)), dtype=np.int16)
    quality = np.empty(counts.shape, dtype=np.uint8)
    reason = np.empty(counts.shape, dtype=np.uint8)
    for at in range(0, sensors, GROUP):
        group = ByteReader(reader.block())
        columns = [column for column, position in enumerate(positions) if at <= position < at + GROUP]
        if not columns:
            continue
        members = [positions[column] - at for column in columns]
        shape = (min(GROUP, sensors - at), cycles.rows)
        counts[:, columns] = decode_group(group.block(), shape, members)
        quality[:, columns] = _decode_codes(group.block(), shape, members)
        reason[:, columns] = _decode_codes(group.block(), shape, members)
    return CycleBlock(cycles=cycles, counts=counts, quality=quality, reason=reason)


def _encode_codes(codes: CodeArray) -> bytes:
    return encode_planes(codes.T.astype(np.uint64).ravel())


def _decode_codes(data: memoryview, shape: tuple[int, int], members: list[int]) -> CodeArray:
    if data[0] == 0:
        return np.zeros((shape[1], len(members)), dtype=np.uint8)
    codes = decode_planes(ByteReader(data), shape[0] * shape[1]).reshape(shape)[members].T
    return codes.astype(np.uint8)


def encode_group(counts: CountArray) -> bytes:
    """Return the series of some sensors, one per column."""
    series = counts.T.astype(np.int64)
    missing = series == MISSING
    filled = _fill(series, missing)
    first = filled[:, 0]
    rest = filled - first[:, None]
    steps = [common_step(row) for row in rest]
    rest //= np.array(steps, dtype=np.int64)[:, None]
    head = encode_planes(missing.astype(np.uint64).ravel())
    head += b"".join(signed_varint(int(value)) + varint(step) for value, step in zip(first, steps, strict=True))
    return head + min((_encode_series(rest, length) for length in BLOCKS), key=len)


def decode_group(data: memoryview, shape: tuple[int, int], members: list[int]) -> CountArray:
    """Return the series of some members of a group, one per column."""
    reader = ByteReader(data)
    missing = _decode_missing(reader, shape)
    heads = [(reader.signed_varint(), reader.varint()) for _ in range(shape[0])]
    first = np.array([heads[m][0] for m in members], dtype=np.int64)
    steps = np.array([heads[m][1] for m in members], dtype=np.int64)
    series = _decode_series(reader, shape, members) * steps[:, None] + first[:, None]
    if missing is not None:
        series[missing[members]] = MISSING
    return series.T.astype(np.int16)


def _decode_missing(reader: ByteReader, shape: tuple[int, int]) -> npt.NDArray[np.bool_] | None:
    missing = decode_planes(reader, shape[0] * shape[1])
    return missing.reshape(shape).astype(bool) if missing.any() else None


def _fill(series: IntArray, missing: npt.NDArray[np.bool_]) -> IntArray:
    """Return the series with each missing value replaced by its predecessor (0 where there is none)."""
    if not missing.any():
        return series
    latest = np.maximum.accumulate(np.where(missing, 0, np.arange(series.shape[1])), axis=1)
    filled = np.take_along_axis(series, latest, axis=1)
    filled[filled == MISSING] = 0
    return filled


def _encode_series(rest: IntArray, length: int) -> bytes:
    if length == 0:
        differences = np.diff(rest, axis=1)
        return varint(0) + encode_planes(zigzag(differences).ravel())
    levels = _block_means(rest, length)
    around = rest - np.repeat(levels, length, axis=1)[:, : rest.shape[1]]
    level_differences = np.diff(levels, axis=1, prepend=0)
    return varint(length) + encode_planes(zigzag(level_differences).ravel()) + encode_planes(zigzag(around).ravel())


def _decode_series(reader: ByteReader, shape: tuple[int, int], members: list[int]) -> IntArray:
    sensors, rows = shape
    length = reader.varint()
    if length == 0:
        differences = decode_planes(reader, sensors * (rows - 1)).reshape(sensors, rows - 1)[members]
        series = np.zeros((len(members), rows), dtype=np.int64)
        np.cumsum(unzigzag(differences), axis=1, out=series[:, 1:])
        return series
    blocks = -(-rows // length)
    level_differences = decode_planes(reader, sensors * blocks).reshape(sensors, blocks)[members]
    around = decode_planes(reader, sensors * rows).reshape(sensors, rows)[members]
    levels = np.cumsum(unzigzag(level_differences), axis=1)
    return unzigzag(around) + np.repeat(levels, length, axis=1)[:, :rows]


def _block_means(rest: IntArray, length: int) -> IntArray:
    starts = np.arange(0, rest.shape[1], length)
    sums = np.add.reduceat(rest, starts, axis=1)
    sizes = np.diff(np.append(starts, rest.shape[1]))
    return np.rint(sums / sizes).astype(np.int64)
