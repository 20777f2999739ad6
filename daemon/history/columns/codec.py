"""Lossless compression of single columns: delta, zigzag, byte split, zlib; int64 wraps, so that any column survives."""

import zlib

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
UnsignedArray = npt.NDArray[np.uint64]

MAX_DECIMALS = 9
_EXACT = 2.0**53
_BITS = 15
"""Float form: the 64 bits as they are, because no number of decimals was exact."""
_MASKED = 0x80
"""Flag of the float form: a bit per row follows that says where NaN stands."""
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


def inflate(data: bytes | memoryview) -> bytes:
    """Return what `deflate` was given."""
    return zlib.decompress(data, -15) if len(data) else b""


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


class ByteReader:
    """Reads the elements above one after another."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = memoryview(data)
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1]

    def varint(self) -> int:
        value = shift = 0
        while True:
            part = self.byte()
            value |= (part & 0x7F) << shift
            if part < 0x80:
                return value
            shift += 7

    def signed_varint(self) -> int:
        value = self.varint()
        return value >> 1 if value & 1 == 0 else -((value + 1) >> 1)

    def block(self) -> memoryview:
        length = self.varint()
        self._at += length
        if self._at > len(self._data):
            raise ValueError(f"packed data ends {self._at - len(self._data)} bytes early")
        return self._data[self._at - length : self._at]

    def rest(self) -> memoryview:
        return self._data[self._at :]


def encode_planes(values: UnsignedArray) -> bytes:
    """Return values split into byte planes, each deflated; as many planes as the largest needs."""
    count = (int(values.max(initial=0)).bit_length() + 7) // 8
    planes = (((values >> np.uint64(8 * k)) & np.uint64(255)).astype(np.uint8).tobytes() for k in range(count))
    return bytes([count]) + b"".join(block(deflate(plane)) for plane in planes)


def decode_planes(reader: ByteReader, size: int) -> UnsignedArray:
    """Return what `encode_planes` was given."""
    values = np.zeros(size, dtype=np.uint64)
    for k in range(reader.byte()):
        plane = np.frombuffer(inflate(reader.block()), dtype=np.uint8)
        values |= plane.astype(np.uint64) << np.uint64(8 * k)
    return values


def zigzag(values: IntArray) -> UnsignedArray:
    """Return 0, -1, 1, -2 .. as 0, 1, 2, 3 .."""
    return ((values << 1) ^ (values >> 63)).view(np.uint64)


def unzigzag(values: UnsignedArray) -> IntArray:
    """Return what `zigzag` was given."""
    return ((values >> np.uint64(1)) ^ (np.uint64(0) - (values & np.uint64(1)))).view(np.int64)


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


def decode_integers(data: bytes | memoryview, rows: int) -> IntArray:
    """Return what `encode_integers` was given."""
    if rows == 0:
        return np.zeros(0, dtype=np.int64)
    reader = ByteReader(data)
    if reader.byte() == 0:
        return _decode_centred(reader, rows)
    first = reader.signed_varint()
    values = np.empty(rows, dtype=np.int64)
    values[0] = first
    values[1:] = _decode_centred(reader, rows - 1)
    return np.cumsum(values, dtype=np.int64)


def _centred(values: IntArray) -> bytes:
    centre = int(np.sort(values)[values.size // 2]) if values.size else 0
    rest = values - np.int64(centre)
    step = common_step(rest)
    return signed_varint(centre) + varint(step) + encode_planes(zigzag(rest // step if step > 1 else rest))


def _decode_centred(reader: ByteReader, rows: int) -> IntArray:
    centre, step = reader.signed_varint(), reader.varint()
    return unzigzag(decode_planes(reader, rows)) * np.int64(step) + np.int64(centre)


def encode_floats(values: FloatArray) -> bytes:
    """Return float64 values exactly (NaN as one NaN): as decimals where that is exact, else as bits."""
    empty = np.isnan(values)
    form, integers = _as_integers(_fill(values, empty))
    mask = block(deflate(np.packbits(empty).tobytes())) if empty.any() else b""
    return bytes([form | (_MASKED if mask else 0)]) + mask + encode_integers(integers)


def decode_floats(data: bytes | memoryview, rows: int) -> FloatArray:
    """Return what `encode_floats` was given."""
    if rows == 0:
        return np.zeros(0)
    reader = ByteReader(data)
    form = reader.byte()
    mask = inflate(reader.block()) if form & _MASKED else b""
    integers = decode_integers(reader.rest(), rows)
    decimals = form & ~_MASKED
    values = integers.view(np.float64).copy() if decimals == _BITS else integers / 10.0**decimals
    if mask:
        values[np.unpackbits(np.frombuffer(mask, dtype=np.uint8), count=rows).astype(bool)] = np.nan
    return values


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
    return _BITS, bits
