"""Bytes of a LATSIS line -> frames. No I/O, no clock.

    frame = [SOF] ID SEP VAL [SEP STAT] ["*" CHK] EOL

The widths of ID and STAT are fixed by the grammar, the width of VAL by the sensor that is expected
under the ID. Hexadecimal digits are upper-case; lower-case is refused everywhere, because 'C' and 'c'
differ in a single bit and no node sends it. CHK covers the characters between SOF and the asterisk:

- `sum8`: their sum modulo 256;
- `lrc8`: the two's complement of that sum, so that sum and CHK add up to zero (as in Modbus ASCII);
- `crc8`: polynomial x^8 + x^2 + x + 1 (07h), start value 0, not reflected, no final XOR (the packet error
  code of SMBus; CRC of "123456789" is F4h). It is the only one that finds every burst of up to 8 bits.

With EOL = CRLF a frame ends at its LF, and a CR inside is taken for a line end whose LF was lost, so that
one lost end character costs no frame.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from config.schema.temperatures import GrammarConfig

MAX_LINE_BYTES = 256
"""Without a line end for so many bytes they are dropped; the longest frame of any grammar has 19."""
EXCERPT_BYTES = 24
"""How much of a rejected frame its error record quotes."""
VALUE_DIGITS = (3, 4)
"""Possible widths of VAL; both are accepted under an ID that is not expected."""


class FrameFault(StrEnum):
    """Why bytes were rejected."""

    OVERLONG = "no line end"
    NOISE = "characters before the start of a frame"
    NO_START = "no start character"
    LENGTH = "wrong length"
    FORM = "not the line's frame grammar"
    CHECKSUM = "wrong checksum"
    TOO_WIDE = "value has more digits than this ID's sensor sends"
    TOO_NARROW = "value has fewer digits than this ID's sensor sends"


class Frame(NamedTuple):
    """One frame that follows the grammar; a named tuple, because a line brings some thousand of them a minute."""

    wire_id: int
    code: int
    """The sensor's register."""
    status: int
    """The status byte; 0 where the grammar has none."""
    offset: int
    """Byte of the stream at which it starts, from 0."""
    end: int
    """Byte of the stream after its last."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameError:
    """Bytes that are no frame."""

    kind: FrameFault
    offset: int
    end: int
    excerpt: bytes
    wire_id: int | None = None
    """The ID, where the rest of the frame was sound (wrong width of the value)."""

    def __str__(self) -> str:
        return f"bytes {self.offset}-{self.end - 1} rejected: {self.kind} ({self.excerpt!r})"


def sum8(text: bytes) -> int:
    """Return the sum of the characters modulo 256."""
    return sum(text) & 0xFF


def lrc8(text: bytes) -> int:
    """Return the two's complement of the sum of the characters."""
    return -sum(text) & 0xFF


def _crc8_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = (register << 1) ^ 0x107 if register & 0x80 else register << 1
        table.append(register)
    return bytes(table)


_CRC8 = _crc8_table()


def crc8(text: bytes) -> int:
    """Return the CRC-8 of SMBus (polynomial 07h, start value 0)."""
    register = 0
    for byte in text:
        register = _CRC8[register ^ byte]
    return register


CHECKSUMS: dict[str, Callable[[bytes], int]] = {"sum8": sum8, "lrc8": lrc8, "crc8": crc8}
_END = {"CR": b"\r", "LF": b"\n", "CRLF": b"\n"}


def frame_bytes(grammar: GrammarConfig, value_digits: int) -> int:
    """Return the length of a frame on the wire, line end included."""
    separator = len(grammar.separator)
    length = len(grammar.start) + grammar.id_digits + separator + value_digits
    if grammar.status:
        length += separator + 2
    if grammar.checksum != "none":
        length += 3
    return length + len(grammar.end) // 2


class FrameParser:
    """Turns a stream of bytes into frames and error records, whatever the sizes of its pieces."""

    def __init__(self, grammar: GrammarConfig, value_digits_by_wire_id: Mapping[int, int]) -> None:
        self._end = _END[grammar.end]
        self._crlf = grammar.end == "CRLF"
        self._start = grammar.start.encode()
        self._digits = value_digits_by_wire_id
        self._checksum = CHECKSUMS.get(grammar.checksum)
        self._pattern = _pattern(grammar)
        self._whole_line = re.compile(self._pattern.pattern + (b"\r\n" if self._crlf else self._end))
        end_bytes = len(grammar.end) // 2
        self._lengths = {frame_bytes(grammar, digits) - end_bytes for digits in VALUE_DIGITS}
        self._buffer = bytearray()
        self._line_offset = 0
        self._cut = False

    @property
    def bytes_fed(self) -> int:
        """Length of the stream so far."""
        return self._line_offset + len(self._buffer)

    @property
    def bytes_judged(self) -> int:
        """Length of the part of the stream that has become frames or error records."""
        return self._line_offset

    def feed(self, data: bytes) -> list[Frame | FrameError]:
        """Take the next piece of the stream and return what it completes, in the order of the stream."""
        self._buffer += data
        records: list[Frame | FrameError] = []
        while True:
            self._sound_lines(records)
            at = self._buffer.find(self._end, 0, MAX_LINE_BYTES)
            if at < 0 and len(self._buffer) < MAX_LINE_BYTES:
                return records
            size = at + 1 if at >= 0 else MAX_LINE_BYTES
            line = bytes(self._buffer[:size])
            del self._buffer[:size]
            if at >= 0:
                records.extend(self._line(line[:-1], self._line_offset))
                self._cut = False
            else:
                records.append(self._error(FrameFault.OVERLONG, self._line_offset, line))
                self._cut = True
            self._line_offset += size

    def _sound_lines(self, records: list[Frame | FrameError]) -> None:
        """Take whole sound lines off the head of the buffer; whatever is wrong with the next one is judged apart."""
        if self._cut:
            return
        at = 0
        while (match := self._whole_line.match(self._buffer, at)) is not None:
            frame = self._judged(match, self._line_offset + at, self._line_offset + match.end())
            if frame is None:
                break
            records.append(frame)
            at = match.end()
        if at:
            del self._buffer[:at]
            self._line_offset += at

    def _judged(self, match: re.Match[bytes], offset: int, end: int) -> Frame | None:
        """Return the frame of a match, None when its checksum or the width of its value is wrong."""
        body, wire_id_text, value, status, check = match.groups()
        if self._checksum is not None and self._checksum(body) != int(check, 16):
            return None
        wire_id = int(wire_id_text, 16)
        if len(value) != self._digits.get(wire_id, len(value)):
            return None
        return Frame(wire_id, int(value, 16), int(status, 16) if status else 0, offset, end)

    def _line(self, line: bytes, offset: int) -> Iterator[Frame | FrameError]:
        """Yield the records of one line without its end character."""
        pieces = line.split(b"\r") if self._crlf else [line]
        for index, piece in enumerate(pieces):
            end = offset + len(piece) + (2 if self._crlf and index == len(pieces) - 2 and not pieces[-1] else 1)
            if piece:
                yield from self._piece(piece, offset, end)
            offset += len(piece) + 1
            self._cut = False

    def _piece(self, text: bytes, offset: int, end: int) -> Iterator[Frame | FrameError]:
        if self._start:
            at = text.rfind(self._start)
            if at < 0:
                yield self._error(FrameFault.NO_START, offset, text, end)
                return
            if at > 0:
                yield self._error(FrameFault.NOISE, offset, text[:at], offset + at)
                text, offset = text[at:], offset + at
        elif self._cut:
            yield self._error(FrameFault.OVERLONG, offset, text, end)
            return
        yield self._frame(text, offset, end)

    def _frame(self, text: bytes, offset: int, end: int) -> Frame | FrameError:
        if len(text) not in self._lengths:
            return self._error(FrameFault.LENGTH, offset, text, end)
        match = self._pattern.fullmatch(text)
        if match is None:
            return self._error(FrameFault.FORM, offset, text, end)
        if (frame := self._judged(match, offset, end)) is not None:
            return frame
        body, wire_id_text, value, _, check = match.groups()
        if self._checksum is not None and self._checksum(body) != int(check, 16):
            return self._error(FrameFault.CHECKSUM, offset, text, end)
        wire_id = int(wire_id_text, 16)
        kind = FrameFault.TOO_WIDE if len(value) > self._digits[wire_id] else FrameFault.TOO_NARROW
        return self._error(kind, offset, text, end, wire_id)

    @staticmethod
    def _error(
        kind: FrameFault, offset: int, text: bytes, end: int | None = None, wire_id: int | None = None
    ) -> FrameError:
        return FrameError(
            kind=kind,
            offset=offset,
            end=offset + len(text) if end is None else end,
            excerpt=text[:EXCERPT_BYTES],
            wire_id=wire_id,
        )


def _pattern(grammar: GrammarConfig) -> re.Pattern[bytes]:
    """Return the grammar as a pattern with the groups body, ID, value, status and checksum."""
    digit = "[0-9A-F]"
    separator = re.escape(grammar.separator)
    status = f"{separator}({digit}{{2}})" if grammar.status else "()"
    body = f"({digit}{{{grammar.id_digits}}}){separator}({digit}{{3,4}}){status}"
    check = f"\\*({digit}{{2}})" if grammar.checksum != "none" else "()"
    return re.compile(f"{re.escape(grammar.start)}({body}){check}".encode())
