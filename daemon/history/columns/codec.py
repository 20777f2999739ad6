"""Single columns from packed bytes (`encoding.py` packs them): int64 wraps, so that any column survives."""

import zlib

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
UnsignedArray = npt.NDArray[np.uint64]

BITS = 15
"""Float form: the 64 bits as they are, because no number of decimals was exact."""
MASKED = 0x80
"""Flag of the float form: a bit per row follows that says where NaN stands."""


def inflate(data: bytes | memoryview) -> bytes:
    """Return what `deflate` was given."""
    return zlib.decompress(data, -15) if len(data) else b""


class ByteReader:
    """Reads the elements of packed bytes one after another."""

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


def decode_planes(reader: ByteReader, size: int) -> UnsignedArray:
    """Return what `encode_planes` was given."""
    values = np.zeros(size, dtype=np.uint64)
    for k in range(reader.byte()):
        plane = np.frombuffer(inflate(reader.block()), dtype=np.uint8)
        values |= plane.astype(np.uint64) << np.uint64(8 * k)
    return values


def unzigzag(values: UnsignedArray) -> IntArray:
    """Return what `zigzag` was given."""
    return ((values >> np.uint64(1)) ^ (np.uint64(0) - (values & np.uint64(1)))).view(np.int64)


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


def _decode_centred(reader: ByteReader, rows: int) -> IntArray:
    centre, step = reader.signed_varint(), reader.varint()
    return unzigzag(decode_planes(reader, rows)) * np.int64(step) + np.int64(centre)


def decode_floats(data: bytes | memoryview, rows: int) -> FloatArray:
    """Return what `encode_floats` was given."""
    if rows == 0:
        return np.zeros(0)
    reader = ByteReader(data)
    form = reader.byte()
    mask = inflate(reader.block()) if form & MASKED else b""
    integers = decode_integers(reader.rest(), rows)
    decimals = form & ~MASKED
    values = integers.view(np.float64).copy() if decimals == BITS else integers / 10.0**decimals
    if mask:
        values[np.unpackbits(np.frombuffer(mask, dtype=np.uint8), count=rows).astype(bool)] = np.nan
    return values
