"""Puts values into the bytes of OPC UA (OPC 10000-6, 5.2), once for all who read them."""

import math
import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NewType

from drivers.opcua.services import EPOCH_100NS

Encoded = NewType("Encoded", bytes)
"""A variant: its type and its value."""
NodeKey = tuple[int, int | str]
"""Number of the namespace, and the identifier in it."""


class Kind(IntEnum):
    """Built-in types; as a node of namespace 0 the same number is their data type (OPC 10000-6, 5.1.2)."""

    BOOLEAN = 1
    INT32 = 6
    UINT32 = 7
    DOUBLE = 11
    STRING = 12
    TIME = 13
    EXTENSION = 22


_INT = struct.Struct("<i")
_DOUBLE = struct.Struct("<Bd")
_FORMATS = {Kind.BOOLEAN: "<B?", Kind.INT32: "<Bi", Kind.UINT32: "<BI", Kind.TIME: "<Bq"}
ARRAY = 0x80
NULL = Encoded(b"\x00")
LONGEST_TEXT = 4000
"""A longer text is cut [character]."""


def string(text: str | None) -> bytes:
    """Return a text with its length; None is the null string."""
    if text is None:
        return b"\xff\xff\xff\xff"
    content = text[:LONGEST_TEXT].encode("utf-8", "replace")
    return _INT.pack(len(content)) + content


def node_id(key: NodeKey) -> bytes:
    namespace, identifier = key
    if isinstance(identifier, str):
        return struct.pack("<BH", 3, namespace) + string(identifier)
    if namespace == 0 and identifier < 256:
        return struct.pack("<BB", 0, identifier)
    return struct.pack("<BBH", 1, namespace, identifier)


def qualified_name(namespace: int, name: str) -> bytes:
    return struct.pack("<H", namespace) + string(name)


def localized_text(text: str) -> bytes:
    """Return a text without a language."""
    return b"\x02" + string(text) if text else b"\x00"


def variant(kind: Kind, value: object) -> Encoded:
    """Return one value; None is the null value, and so is a number that is none."""
    if value is None or (kind is Kind.DOUBLE and not math.isfinite(value)):  # type: ignore[arg-type]
        return NULL
    if kind is Kind.DOUBLE:
        return Encoded(_DOUBLE.pack(kind, value))
    if kind is Kind.STRING:
        return Encoded(bytes((kind,)) + string(str(value)))
    return Encoded(struct.pack(_FORMATS[kind], kind, value))


def strings(values: Sequence[str]) -> Encoded:
    return Encoded(bytes((Kind.STRING | ARRAY,)) + _INT.pack(len(values)) + b"".join(string(value) for value in values))


def extension(type_number: int, body: bytes) -> Encoded:
    """Return a structure of namespace 0 whose encoding has this number."""
    return Encoded(bytes((Kind.EXTENSION,)) + node_id((0, type_number)) + b"\x01" + _INT.pack(len(body)) + body)


def time_100ns(utc_s: float) -> int:
    """Return a time as OPC UA counts it."""
    return EPOCH_100NS + round(utc_s * 1e7)


def data_value(value: bytes, status: int, source_100ns: int, server_100ns: int, stamps: int) -> bytes:
    """Return a value with status and the wanted time stamps (0 source, 1 server, 2 both, 3 neither)."""
    source, server = stamps in (0, 2) and source_100ns > 0, stamps in (1, 2)
    mask = (value != NULL) | (bool(status) << 1) | (source << 2) | (server << 3)
    parts = [bytes((mask,))]
    if value != NULL:
        parts.append(value)
    if status:
        parts.append(struct.pack("<I", status))
    if source:
        parts.append(struct.pack("<q", source_100ns))
    if server:
        parts.append(struct.pack("<q", server_100ns))
    return b"".join(parts)
