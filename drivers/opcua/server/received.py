"""The bytes of a request while they are decoded: decoding ends when they do, whatever lengths they name.

The library takes a negative length for a step back, and makes as many empty elements as an array of the null type
names, before anybody has logged in: one message of 40 byte would stop the daemon and fill its memory.
"""

from typing import Self

from asyncua.common.utils import Buffer

ARRAY_OF_NULL = 0x80
"""First byte of a variant that is an array of the null type."""
MATRIX = 0xC0
"""Bits of the first byte of a variant with dimensions, which the library multiplies without end."""


class Received(Buffer):
    """A buffer of the library that is read forwards only."""

    @classmethod
    def of(cls, buffer: Buffer) -> Self:
        """Return what is left of a buffer."""
        return cls(buffer.read(len(buffer)))

    def read(self, size: int) -> bytes:
        """Return the next bytes; raises ValueError for a negative number, an array that takes no bytes, a matrix.

        Nothing that is decoded here has a single byte of such a value otherwise.
        """
        if size < 0:
            raise ValueError(f"a length of {size}")
        found = super().read(size)
        if size == 1 and (found[0] == ARRAY_OF_NULL or found[0] & MATRIX == MATRIX):
            raise ValueError("an array of the null type, or a matrix")
        return found

    def skip(self, size: int) -> None:
        """Pass over bytes; raises ValueError for a negative number."""
        if size < 0:
            raise ValueError(f"a length of {size}")
        super().skip(size)

    def copy(self, size: int = -1) -> Self:
        """Return a buffer of the next bytes, which stay."""
        return type(self)(self._data, self._cur_pos, self._size if size < 0 else min(size, self._size))
