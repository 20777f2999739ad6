"""The bytes of a message while they are decoded: decoding ends when they do, whatever lengths they name.

The library takes a negative length for a step back, makes as many empty elements as an array of the null type names,
and as many lists as the dimensions of an array name: one message of 40 byte would stop the daemon and fill its memory.
"""

from typing import Any, Self

from asyncua import ua
from asyncua.common.utils import Buffer, NotEnoughData
from asyncua.ua import ua_binary

ARRAY, SHAPED, KIND = 0x80, 0x40, 0x3F
"""Bits of the first byte of a variant: it is an array, dimensions follow, number of the type."""
LIBRARY: Any = ua_binary
_variant_of_any = LIBRARY.variant_from_binary


class Received(Buffer):
    """A buffer of the library that is read forwards only."""

    @classmethod
    def of(cls, buffer: Buffer) -> Self:
        """Return what is left of a buffer."""
        return cls(buffer.read(len(buffer)))

    def read(self, size: int) -> bytes:
        """Return the next bytes; raises NotEnoughData where they are fewer, and for a negative number."""
        if size < 0:
            raise NotEnoughData(f"a length of {size}")
        return super().read(size)

    def skip(self, size: int) -> None:
        """Pass over bytes; raises NotEnoughData where they are fewer, and for a negative number."""
        if size < 0:
            raise NotEnoughData(f"a length of {size}")
        super().skip(size)

    def copy(self, size: int = -1) -> Self:
        """Return a buffer of the next bytes, which stay."""
        return type(self)(self._data, self._cur_pos, self._size if size < 0 else min(size, self._size))


def variant_of_received(data: Buffer) -> ua.Variant:
    """Return a variant as the library does, but for the shape of an array, which nothing here asks for.

    Raises NotEnoughData for an array of the null type, whose elements take no bytes.
    """
    if not isinstance(data, Received):
        whole: ua.Variant = _variant_of_any(data)
        return whole
    encoding = data.read(1)[0]
    kind: Any = ua.datatype_to_varianttype(encoding & KIND)
    array = bool(encoding & ARRAY)
    if array and kind is ua.VariantType.Null:
        raise NotEnoughData("an array of the null type")
    value = (LIBRARY.unpack_uatype_array if array else LIBRARY.unpack_uatype)(kind, data)
    if encoding & SHAPED:
        LIBRARY.unpack_uatype_array(ua.VariantType.Int32, data)
    return ua.Variant(value, kind, is_array=array)


def _decode_variants_so() -> None:
    """Let the library decode every variant of what was received by the function above."""
    LIBRARY.variant_from_binary = variant_of_received
    for what in ("uatype", "uatype_array", "list", "type", "dataclass"):
        getattr(LIBRARY, f"_create_{what}_deserializer").cache_clear()  # made before, it knows the library's function


_decode_variants_so()
