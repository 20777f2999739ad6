"""The lines of a Haas control's machine data collection, for both sides and without I/O.

    query    ?Q100 serial number · ?Q101 software · ?Q102 model · ?Q104 mode · ?Q500 program and state
             ?Q600 n the macro or system variable n                                          each ends with CR LF
    write    ?En value; an older text has a blank before the number
    answer   STX, fields with commas between, ETB, CR LF and the prompt >
             or the prompt, the fields, CR LF; `MACRO, n, value`, or without the number on newer controls

A written value is acknowledged with `!`, an unknown line with `UNKNOWN`; neither says what it belongs to. A program
may print lines of its own between them (DPRNT).
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum

LONGEST_LINE = 512
"""No answer is longer; a program's own lines are not either."""
DECIMALS = 6
"""A control says values with so many."""
LARGEST_VALUE = 1e12
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")
_FRAME = "> \t\r"
_UNKNOWN = "UNKNOWN"


class HaasFormatError(ValueError):
    """Bytes that are no line of this protocol, or an answer that says something impossible."""


class Query(IntEnum):
    SERIAL_NUMBER = 100
    SOFTWARE = 101
    MODEL = 102
    MODE = 104
    PROGRAM = 500
    MACRO = 600


LABELS: Mapping[Query, tuple[str, ...]] = {
    Query.SERIAL_NUMBER: ("SERIAL NUMBER",),
    Query.SOFTWARE: ("SOFTWARE", "SOFTWARE VERSION"),
    Query.MODEL: ("MODEL",),
    Query.MODE: ("MODE",),
    Query.PROGRAM: ("PROGRAM", "STATUS"),
    Query.MACRO: ("MACRO",),
}
"""First field of the answer to each query, as older and as newer controls say it."""
_QUERY_OF = {label: query for query, labels in LABELS.items() for label in labels}


@dataclass(frozen=True, slots=True)
class Answer:
    """What a control has answered to a query."""

    query: Query
    fields: tuple[str, ...]
    """All fields, the label first."""
    number: int | None = None
    """The macro variable that the answer names; None: it names none."""
    value: float | None = None
    """Of a macro variable; None: vacant."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """The control did not understand a line, or does not do what it says."""


class LineBuffer:
    """Cuts a stream of bytes into lines without their frame and what is around it; holds one unfinished line."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[str]:
        """Yield every line that these bytes complete, empty ones left out; raises HaasFormatError."""
        self._bytes += data
        while (end := self._bytes.find(b"\n")) >= 0:
            line = self._bytes[:end].decode("ascii", "replace")
            line = line.rpartition("\x02")[2].partition("\x17")[0].strip(_FRAME)
            if end > LONGEST_LINE:
                raise HaasFormatError(f"a line of {end} characters")
            del self._bytes[: end + 1]
            if line:
                yield line
        if len(self._bytes) > LONGEST_LINE:
            raise HaasFormatError(f"more than {LONGEST_LINE} characters without an end of the line")


def encode_query(query: Query, number: int | None = None) -> bytes:
    """Return the line that asks; `number` is of the macro variable."""
    return f"?Q{query:d}{'' if number is None else f' {number}'}\r\n".encode("ascii")


def encode_write(number: int, value: float, *, spaced: bool = False) -> bytes:
    """Return the line that writes a macro variable; raises OverflowError for a value that the protocol cannot say."""
    return f"?E{' ' if spaced else ''}{number} {value_text(value)}\r\n".encode("ascii")


def value_text(value: float) -> str:
    """Return a value with its decimals and no exponent; raises OverflowError."""
    if not abs(value) < LARGEST_VALUE:
        raise OverflowError(f"{value} has more digits than the protocol carries")
    return f"{value:.{DECIMALS}f}".rstrip("0")


def parse_answer(line: str) -> Answer | Unknown | None:
    """Return what a line answers, None for one that answers no query; raises HaasFormatError for an impossible one."""
    fields = tuple(field.strip() for field in line.split(","))
    if fields[0] == _UNKNOWN or line.startswith("?"):  # a newer control says what it does not understand
        return Unknown()
    query = _QUERY_OF.get(fields[0])
    if query is None:
        return None
    if len(fields) < 2:
        raise HaasFormatError(f"{line!r} has a name and no value")
    if query is not Query.MACRO:
        return Answer(query, fields)
    if len(fields) == 2:
        return Answer(query, fields, None, _value(fields[1], line))
    if len(fields) != 3 or not fields[1].isdecimal():
        raise HaasFormatError(f"{line!r} is no macro variable with its value")
    return Answer(query, fields, int(fields[1]), _value(fields[2], line))


def _value(text: str, line: str) -> float | None:
    if not text:
        return None
    if not _NUMBER.fullmatch(text):
        raise HaasFormatError(f"{line!r}: {text!r} is no number")
    value = float(text)
    if not (math.isfinite(value) and abs(value) < LARGEST_VALUE):
        raise HaasFormatError(f"{line!r}: {text!r} is no value")
    return value


@dataclass(frozen=True, slots=True)
class Write:
    """A line of a client that writes."""

    number: int
    value: float


_ASKED = re.compile(r"\?Q(\d{3})(?: (\d{1,5}))?")
_WRITTEN = re.compile(r"\?E ?(\d{1,5}) ([+-]?(?:\d+\.?\d*|\.\d+))")


def parse_request(line: str) -> tuple[int, int | None] | Write | None:
    """Return (query, variable) or what is to be written, None where a control does not understand the line."""
    if asked := _ASKED.fullmatch(line):
        return int(asked[1]), None if asked[2] is None else int(asked[2])
    if written := _WRITTEN.fullmatch(line):
        value = float(written[2])
        return Write(int(written[1]), value) if abs(value) < LARGEST_VALUE else None
    return None


def encode_fields(*fields: str) -> bytes:
    """Return an answer's line in its frame."""
    return f"\x02{', '.join(fields)}\x17\r\n>".encode("ascii")
