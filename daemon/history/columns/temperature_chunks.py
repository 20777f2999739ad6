"""Chunks of temperatures: one hour of one line, in groups of sensors that are unpacked singly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import ByteReader, IntArray, decode_planes, unzigzag
from daemon.history.columns.frames import Frame, decode_frame
from daemon.history.columns.kinds import CYCLES

FORMAT = 1
GROUP = 16
"""Sensors per group: fewer make each sensor's share of a group's overhead larger, more make reading one slower."""
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


def _decode_codes(data: memoryview, shape: tuple[int, int], members: list[int]) -> CodeArray:
    if data[0] == 0:
        return np.zeros((shape[1], len(members)), dtype=np.uint8)
    codes = decode_planes(ByteReader(data), shape[0] * shape[1]).reshape(shape)[members].T
    return codes.astype(np.uint8)


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
