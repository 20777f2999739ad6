"""Lossless compression of columns: delta, zigzag, byte split, zlib; int64 wraps, so that any column survives.

Each sensor's series is coded as steps of its own resolution, as differences to the previous value or to the mean of a
short block, whichever is smaller: noise of one step costs less around a mean, slow drift as differences.
"""

import json
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from daemon.history.columns.codec import BITS, MASKED, FloatArray, IntArray, UnsignedArray
from daemon.history.columns.frames import FORMAT as FRAME_FORMAT
from daemon.history.columns.frames import Column, ColumnData, ColumnType, Frame, Kind, MappingColumn, all_keys, has_key
from daemon.history.columns.kinds import CYCLES
from daemon.history.columns.temperature_chunks import FORMAT as TEMPERATURES_FORMAT
from daemon.history.columns.temperature_chunks import GROUP, MISSING, CodeArray, CountArray, CycleBlock

MAX_DECIMALS = 9
BLOCKS = (0, 12)
"""Lengths of the blocks that are tried; 0 codes differences to the previous value."""
_EXACT = 2.0**53
_STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_RLE)


def deflate(data: bytes) -> bytes:
    """Return raw deflate data, by whichever zlib strategy is smallest."""
    if not data:
        return b""
    packed = []
    for strategy in _STRATEGIES:
        compressor = zlib.compressobj(9, zlib.DEFLATED, -15, 9, strategy)
        packed.append(compressor.compress(data) + compressor.flush())
    return min(packed, key=len)


def varint(value: int) -> bytes:
    """Return a whole number >= 0 in 7-bit groups, least first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def signed_varint(value: int) -> bytes:
    """Return any whole number as a varint, its sign in the lowest bit."""
    return varint(value << 1 if value >= 0 else (-value << 1) - 1)


def block(data: bytes) -> bytes:
    """Return bytes preceded by their length."""
    return varint(len(data)) + data


def encode_planes(values: UnsignedArray) -> bytes:
    """Return values split into byte planes, each deflated; as many planes as the largest needs."""
    count = (int(values.max(initial=0)).bit_length() + 7) // 8
    planes = (((values >> np.uint64(8 * k)) & np.uint64(255)).astype(np.uint8).tobytes() for k in range(count))
    return bytes([count]) + b"".join(block(deflate(plane)) for plane in planes)


def zigzag(values: IntArray) -> UnsignedArray:
    """Return 0, -1, 1, -2 .. as 0, 1, 2, 3 .."""
    return ((values << 1) ^ (values >> 63)).view(np.uint64)


def common_step(values: IntArray) -> int:
    """Return the greatest common divisor of the values, at least 1."""
    if values.size == 0 or int(values.max()) > 2**61 or int(values.min()) < -(2**61):
        return 1
    return max(1, int(np.gcd.reduce(np.abs(values))))


def encode_integers(values: IntArray) -> bytes:
    """Return int64 values as offsets from their median, or as differences; whichever is smaller."""
    if values.size == 0:
        return b""
    differences = np.diff(values)
    first = int(values[0])
    return min(b"\x00" + _centred(values), b"\x01" + signed_varint(first) + _centred(differences), key=len)


def _centred(values: IntArray) -> bytes:
    centre = int(np.sort(values)[values.size // 2]) if values.size else 0
    rest = values - np.int64(centre)
    step = common_step(rest)
    return signed_varint(centre) + varint(step) + encode_planes(zigzag(rest // step if step > 1 else rest))


def encode_floats(values: FloatArray) -> bytes:
    """Return float64 values exactly (NaN as one NaN): as decimals where that is exact, else as bits."""
    empty = np.isnan(values)
    form, integers = _as_integers(_fill(values, empty))
    mask = block(deflate(np.packbits(empty).tobytes())) if empty.any() else b""
    return bytes([form | (MASKED if mask else 0)]) + mask + encode_integers(integers)


def _fill(values: FloatArray, empty: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the values with each empty one replaced by its predecessor, so that it costs nothing."""
    if not empty.any():
        return values
    latest = np.maximum.accumulate(np.where(empty, 0, np.arange(values.size)))
    filled = values[latest]
    filled[np.isnan(filled)] = 0.0
    return filled


def _as_integers(values: FloatArray) -> tuple[int, IntArray]:
    """Return the fewest decimals that hold every value exactly, and the integers; or the bits."""
    bits = values.view(np.int64)
    if np.isfinite(values).all():
        for decimals in range(MAX_DECIMALS + 1):
            scaled = np.rint(values * 10.0**decimals)
            if np.abs(scaled).max(initial=0.0) >= _EXACT:
                break
            integers = scaled.astype(np.int64)
            if np.array_equal((integers / 10.0**decimals).view(np.int64), bits):
                return decimals, integers
    return BITS, bits


def encode_frame(kind: Kind, frame: Frame) -> bytes:
    """Return a frame with all of its kind's columns as bytes."""
    parts = []
    for column in kind.columns:
        data = frame.columns[column.name]
        if column.relative_to is not None:
            data = frame.integers(column.name) - frame.integers(column.relative_to)
        parts.append(block(_encode_column(column, data)))
    return bytes([FRAME_FORMAT]) + varint(frame.rows) + b"".join(parts)


def _encode_column(column: Column, data: ColumnData) -> bytes:
    if isinstance(data, MappingColumn):
        return _encode_mapping(data)
    if isinstance(data, list):
        return _encode_texts(data)
    if column.type is ColumnType.INTEGER:
        return encode_integers(data.astype(np.int64, copy=False))
    return encode_floats(data.astype(np.float64, copy=False))


def _encode_dictionary(distinct: Sequence[object], codes: IntArray) -> bytes:
    listed = json.dumps(distinct, ensure_ascii=False, separators=(",", ":")).encode()
    return block(deflate(listed)) + block(encode_integers(codes))


def _encode_texts(texts: list[str | None]) -> bytes:
    codes = {text: code for code, text in enumerate(dict.fromkeys(texts))}
    return _encode_dictionary(list(codes), np.array([codes[text] for text in texts], dtype=np.int64))


def _encode_mapping(mapping: MappingColumn) -> bytes:
    parts = [_encode_dictionary(mapping.shapes, mapping.shape_of_row)]
    for key in all_keys(mapping.shapes):
        parts.append(block(encode_floats(mapping.values[key][has_key(mapping.shapes, mapping.shape_of_row, key)])))
    return b"".join(parts)


def encode_temperatures(content: CycleBlock) -> bytes:
    """Return cycles of one line as a chunk."""
    sensors = content.counts.shape[1]
    groups = [
        block(_encode_group(content.counts[:, at : at + GROUP]))
        + block(_encode_codes(content.quality[:, at : at + GROUP]))
        + block(_encode_codes(content.reason[:, at : at + GROUP]))
        for at in range(0, sensors, GROUP)
    ]
    head = bytes([TEMPERATURES_FORMAT]) + block(encode_frame(CYCLES, content.cycles)) + varint(sensors)
    return head + b"".join(block(group) for group in groups)


def _encode_codes(codes: CodeArray) -> bytes:
    return encode_planes(codes.T.astype(np.uint64).ravel())


def _encode_group(counts: CountArray) -> bytes:
    """Return the series of some sensors, one per column."""
    series = counts.T.astype(np.int64)
    missing = series == MISSING
    filled = _fill_series(series, missing)
    first = filled[:, 0]
    rest = filled - first[:, None]
    steps = [common_step(row) for row in rest]
    rest //= np.array(steps, dtype=np.int64)[:, None]
    head = encode_planes(missing.astype(np.uint64).ravel())
    head += b"".join(signed_varint(int(value)) + varint(step) for value, step in zip(first, steps, strict=True))
    return head + min((_encode_series(rest, length) for length in BLOCKS), key=len)


def _fill_series(series: IntArray, missing: npt.NDArray[np.bool_]) -> IntArray:
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


def _block_means(rest: IntArray, length: int) -> IntArray:
    starts = np.arange(0, rest.shape[1], length)
    sums = np.add.reduceat(rest, starts, axis=1)
    sizes = np.diff(np.append(starts, rest.shape[1]))
    return np.rint(sums / sizes).astype(np.int64)
