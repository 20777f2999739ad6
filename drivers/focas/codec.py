"""The bytes of FOCAS2 over Ethernet: frames, blocks and values, for both sides and without I/O.

Not published by the vendor; the layout is what independent open implementations agree on. Big-endian throughout:

    frame    A0A0A0A0 | version u16 | kind u8 | direction u8 | body length u16 | body
    request  number of blocks u16, then: length u16 | class u16 | path u16 | function u16 | 4 x i32 | i32 n | n bytes
    answer   number of blocks u16, then: length u16 | class u16 | path u16 | function u16 | error i16 | 4 bytes
             | n u16 | n bytes
    value    mantissa i32 | base u16 (2 or 10) | exponent i16: mantissa / base^exponent; exponent FFFF: vacant

A block's length counts itself. An answer names the function that was asked for, not its arguments.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

SYNC = b"\xa0\xa0\xa0\xa0"
_HEADER = struct.Struct(">4sHBBH")
_COUNT = struct.Struct(">H")
_REQUEST = struct.Struct(">HHHHiiiii")
_ANSWER = struct.Struct(">HHHHh4xH")
_VALUE = struct.Struct(">iHh")
CNC_CLASS = 1
"""Blocks for the CNC; 2 would be the PMC."""
VACANT_EXPONENT = -1
LARGEST_MANTISSA = 2**31 - 1
MOST_DECIMALS = 9
NINE_DIGITS = 999_999_999
"""No control needs to take more of a value that is written; a whole number may have one more."""
LARGEST_EXPONENT = {2: 62, 10: 18}
"""By base: above it a double cannot hold what the value means."""
LEAST_EXPONENT = -290
"""The same of a value that is larger than a mantissa holds."""


class FocasFormatError(ValueError):
    """Bytes that are no frame, or a frame that is no answer to what was asked."""


class Kind(IntEnum):
    OPEN = 0x01
    CLOSE = 0x02
    DATA = 0x21


class Direction(IntEnum):
    REQUEST = 1
    ANSWER = 2
    REFUSED = 3


class Function(IntEnum):
    """What a block asks for."""

    AXIS_POSITION = 0x26
    DIAGNOSIS = 0x30
    DIAGNOSIS_31I = 0x93
    PROGRAM_NUMBER = 0x1C
    READ_MACRO = 0x15
    SEQUENCE_NUMBER = 0x1D
    SPINDLE_SPEED = 0x25
    STATUS = 0x19
    SYSTEM = 0x18
    WRITE_MACRO = 0x16
    WRITE_MACROS = 0xA8
    """A range of macro variables as doubles."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of either side."""

    kind: int
    direction: int
    body: bytes = b""


@dataclass(frozen=True, slots=True)
class Ask:
    """One block of a request."""

    function: int
    arguments: tuple[int, ...] = ()
    extra: bytes = b""


@dataclass(frozen=True, slots=True)
class Answer:
    """One block of an answer; `error` 0: done."""

    error: int
    data: bytes = b""


class FrameBuffer:
    """Cuts a stream of bytes into frames; holds at most one unfinished frame (64 kB)."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    @property
    def unfinished(self) -> bool:
        return bool(self._bytes)

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Yield every frame that these bytes complete; raises FocasFormatError at the first byte that cannot be one."""
        self._bytes += data
        while self._bytes:
            if not SYNC.startswith(begin := bytes(self._bytes[:4])):
                raise FocasFormatError(f"a frame begins with A0A0A0A0, not {begin.hex().upper()}")
            if len(self._bytes) < _HEADER.size:
                return
            _, _, kind, direction, length = _HEADER.unpack_from(self._bytes)
            if len(self._bytes) < _HEADER.size + length:
                return
            body = bytes(self._bytes[_HEADER.size : _HEADER.size + length])
            del self._bytes[: _HEADER.size + length]
            yield Frame(kind, direction, body)


def encode_frame(frame: Frame, version: int = 1) -> bytes:
    return _HEADER.pack(SYNC, version, frame.kind, frame.direction, len(frame.body)) + frame.body


def encode_asks(asks: Sequence[Ask], path: int = 1) -> bytes:
    blocks = [_COUNT.pack(len(asks))]
    for ask in asks:
        first = (*ask.arguments, 0, 0, 0, 0)[:4]
        length = _REQUEST.size + len(ask.extra)
        blocks += [_REQUEST.pack(length, CNC_CLASS, path, ask.function, *first, len(ask.extra)), ask.extra]
    return b"".join(blocks)


def parse_asks(body: bytes) -> list[tuple[int, int, Ask]]:
    """Return class, path and block of everything that a request asks for; raises FocasFormatError."""
    asks = []
    for block in _blocks(body, _REQUEST.size):
        _, kind, path, function, *arguments, extra = _REQUEST.unpack_from(block)
        if extra != len(block) - _REQUEST.size:
            raise FocasFormatError(f"a block says {extra} more bytes and has {len(block) - _REQUEST.size}")
        asks.append((kind, path, Ask(function, tuple(arguments), bytes(block[_REQUEST.size :]))))
    return asks


def encode_answers(answers: Sequence[tuple[int, int, int, Answer]]) -> bytes:
    """Return the body of an answer made of (class, path, function, block)."""
    blocks = [_COUNT.pack(len(answers))]
    for kind, path, function, answer in answers:
        length = _ANSWER.size + len(answer.data)
        blocks += [_ANSWER.pack(length, kind, path, function, answer.error, len(answer.data)), answer.data]
    return b"".join(blocks)


def parse_answers(body: bytes, asks: Sequence[Ask], path: int = 1) -> list[Answer]:
    """Return one answer per block that was asked for, in that order; raises FocasFormatError where one does not fit."""
    blocks = list(_blocks(body, _ANSWER.size))
    if len(blocks) != len(asks):
        raise FocasFormatError(f"{len(asks)} blocks were asked for and {len(blocks)} answered")
    answers = []
    for ask, block in zip(asks, blocks, strict=True):
        _, kind, found_path, function, error, length = _ANSWER.unpack_from(block)
        if (kind, found_path, function) != (CNC_CLASS, path, ask.function):
            asked = f"{CNC_CLASS}/{path}/{ask.function:02X}"
            raise FocasFormatError(f"{asked} was asked for and {kind}/{found_path}/{function:02X} answered")
        if length != len(block) - _ANSWER.size:
            raise FocasFormatError(f"an answer says {length} bytes and has {len(block) - _ANSWER.size}")
        answers.append(Answer(error, bytes(block[_ANSWER.size :])))
    return answers


def _blocks(body: bytes, smallest: int) -> Iterator[bytes]:
    if len(body) < _COUNT.size:
        raise FocasFormatError("a frame without a number of blocks")
    (count,) = _COUNT.unpack_from(body)
    place = _COUNT.size
    for _ in range(count):
        (length,) = _COUNT.unpack_from(body, place) if place + _COUNT.size <= len(body) else (0,)
        if length < smallest or place + length > len(body):
            raise FocasFormatError(f"a block of {length} bytes where {len(body) - place} are left")
        yield body[place : place + length]
        place += length
    if place != len(body):
        raise FocasFormatError(f"{len(body) - place} bytes after the last block")


def encode_value(value: float | None) -> bytes:
    """Return a value in base 10 with as many decimals as the mantissa holds; None: vacant."""
    if value is None:
        return _VALUE.pack(0, 10, VACANT_EXPONENT)
    for decimals in range(MOST_DECIMALS, -1, -1):
        if abs(mantissa := round(value * 10**decimals)) <= (NINE_DIGITS if decimals else LARGEST_MANTISSA):
            return _VALUE.pack(mantissa, 10, decimals)
    raise OverflowError(f"{value} has more digits than the protocol carries")


def parse_values(data: bytes, count: int, first: int = 1) -> list[float | None]:
    """Return `count` values from number `first` on, None: vacant; raises FocasFormatError: length, base, exponent."""
    if len(data) != count * _VALUE.size:
        raise FocasFormatError(f"{count} values take {count * _VALUE.size} bytes, not {len(data)}")
    values: list[float | None] = []
    for mantissa, base, exponent in _VALUE.iter_unpack(data):
        if base not in LARGEST_EXPONENT:
            raise FocasFormatError(f"value #{first + len(values)} is of base {base}: it is 2 or 10")
        if exponent == VACANT_EXPONENT:
            values.append(None)
        elif 0 <= exponent <= LARGEST_EXPONENT[base]:
            values.append(mantissa / base**exponent)
        elif LEAST_EXPONENT <= exponent < 0:
            values.append(float(mantissa * base**-exponent))
        else:
            raise FocasFormatError(f"value #{first + len(values)} is of exponent {exponent}")
    return values


def parse_integers(data: bytes, layout: str) -> tuple[int, ...]:
    """Return the numbers of a fixed layout such as `ii`; raises FocasFormatError for another length."""
    if len(data) != struct.calcsize(f">{layout}"):
        raise FocasFormatError(f"an answer of {len(data)} bytes, not {struct.calcsize(f'>{layout}')}")
    return struct.unpack(f">{layout}", data)


def runs_of(numbers: Sequence[int], longest: int) -> Iterator[range]:
    """Yield the numbers, sorted and each once, as ranges of at most `longest`."""
    waiting = sorted(set(numbers))
    while waiting:
        first = waiting[0]
        length = next((n for n in range(1, longest) if waiting[n : n + 1] != [first + n]), longest)
        yield range(first, first + length)
        del waiting[:length]
