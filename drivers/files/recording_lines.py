"""The lines of a recording (CSV) until its first row: encoding, field separator, and the names of its columns."""

import csv
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

from drivers.contract import FatalDriverError

DELIMITERS = (",", ";", "\t")
MAX_FIELDS = 4096
"""A recording has hundreds of columns; more means that the file is something else."""
LONGEST_LINE = 2**20
"""A line of a recording is shorter [characters]; what has no end of a line is something else."""
METADATA_MARK = "#"
SEPARATOR_LINE = "sep="
"""Spreadsheets begin a file with it; it says nothing that the header does not."""
WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""Files of spreadsheets (xlsx, xls) begin so."""
MOST_LINES_OF_NAMES = 20
"""Spreadsheets break long names in quotes into lines; a header of more lines is none."""
FEWEST_COLUMNS = 3
"""A recording has a time, a temperature and a displacement."""
MOST_BEFORE_HEADER = 100
"""In so many lines after a first one that is no header, one is looked for."""


class RecordingFileError(FatalDriverError):
    """A recording cannot be read; the text begins with file, line and column where there is one."""


class EncodingError(RecordingFileError):
    """A recording is not written in the encoding that was expected."""


class Place:
    """Where in the file the reader is."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.line = 0

    def refuse(self, sentence: str, column: str | None = None) -> RecordingFileError:
        place = f"{self.path}:{self.line}" if self.line else str(self.path)
        return RecordingFileError(f"{place}: column {column}: {sentence}" if column else f"{place}: {sentence}")


def read_header(path: Path) -> list[str]:
    """Return the names of a recording's columns; raises `RecordingFileError`."""
    place = Place(path)
    with opened(place) as lines:
        return header_of(place, lines)[0]


def read_beginning(path: Path, rows: int, encoding: str = "utf-8") -> tuple[list[str], list[list[str]]]:
    """Return the names of a recording's columns and the texts of its first rows; raises `RecordingFileError`."""
    place = Place(path)
    with opened(place, encoding) as lines:
        header, delimiter = header_of(place, lines)
        first = place.line + 1
        rest = require_names(place, header, lines)
        reader = csv.reader((line for line in rest if line.strip()), delimiter=delimiter)
        try:
            found = [[text.strip() for text in fields] for fields in islice(reader, rows)]
        except csv.Error as error:
            raise place.refuse(f"is not CSV ({error})") from error
        place.line = first
        if found and not any(map(is_number, found[0])) and (sentence := second_header(header, found[0])):
            raise place.refuse(sentence)
        return header, found


class opened:
    """The file's lines; read errors and wrong encodings become sentences."""

    def __init__(self, place: Place, encoding: str = "utf-8") -> None:
        self._place, self._encoding = place, "utf-8-sig" if encoding == "utf-8" else encoding

    def __enter__(self) -> Iterator[str]:
        try:
            self._file = self._place.path.open(encoding=self._encoding, newline="")
            if self._file.buffer.peek(4)[:4] in WORKBOOKS:  # type: ignore[attr-defined]
                self._file.close()
                raise self._place.refuse("is a workbook of a spreadsheet, no CSV: save the sheet as CSV (UTF-8) there")
        except OSError as error:
            raise self._place.refuse(f"cannot be opened ({error.strerror})") from error
        return self._lines()

    def _lines(self) -> Iterator[str]:
        try:
            while line := self._file.readline(LONGEST_LINE + 1):
                self._place.line += 1
                if len(line) > LONGEST_LINE:
                    raise self._place.refuse(f"is longer than {LONGEST_LINE} characters; this is not a recording")
                if "\0" in line:
                    raise self._place.refuse("holds a NUL byte; the file is damaged or not text")
                yield line
        except UnicodeError as error:
            self._place.line += 1
            byte = f" (byte {error.object[error.start]:#04x})" if isinstance(error, UnicodeDecodeError) else ""
            name = "UTF-8" if self._encoding == "utf-8-sig" else self._encoding
            sentence = (
                f"is not {name} at or after this line{byte}; save it as UTF-8, or name its encoding in the map, which "
                "`toolpoint thermal train RECORDING -o model.json --map-out map.yaml` proposes"
            )
            raise EncodingError(str(self._place.refuse(sentence))) from error
        except OSError as error:
            raise self._place.refuse(f"cannot be read ({error.strerror})") from error

    def __exit__(self, *_: object) -> None:
        self._file.close()


def header_of(place: Place, lines: Iterator[str]) -> tuple[list[str], str]:
    line = next(lines, "")
    while line.startswith(METADATA_MARK) or line.lower().startswith(SEPARATOR_LINE):
        line = next(lines, "")
    if not line.strip():
        raise place.refuse("has no header row with the names of its columns")
    first = place.line
    while line.count('"') % 2 and place.line < first + MOST_LINES_OF_NAMES and (more := next(lines, "")):
        line += more
    delimiter = max(DELIMITERS, key=line.count)
    try:
        names = [" ".join(name.split()) for name in next(csv.reader([line], delimiter=delimiter))]
    except csv.Error as error:
        raise place.refuse(f"is not CSV ({error})") from error
    if len(names) > MAX_FIELDS:
        raise place.refuse(f"has {len(names)} columns; this is not a recording")
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise place.refuse(
            f"{', '.join(map(repr, twice))} is the name of several columns; give each a name of its own. Where the "
            f"next row holds the names, take this one out, or begin it with {METADATA_MARK}"
        )
    if all(is_number(name) for name in names if name):
        raise place.refuse("begins with numbers; the first row must hold the names of the columns")
    return names, delimiter


def require_names(place: Place, header: list[str], lines: Iterator[str]) -> Iterator[str]:
    """Return the lines after the header; refuses one that cannot be it, naming the line that seems to be it."""
    if len([name for name in header if name]) >= FEWEST_COLUMNS:
        return lines
    first, text = place.line, next((name for name in header if name), "")
    ahead = list(islice(lines, MOST_BEFORE_HEADER))
    counts = [len([field for field in line.split(max(DELIMITERS, key=line.count)) if field.strip()]) for line in ahead]
    if max(counts, default=0) >= FEWEST_COLUMNS:
        found, place.line = first + 1 + counts.index(max(counts)), first
        raise place.refuse(
            f"{text[:40]!r} does not look like the names of the columns; where line {found} holds them, take out "
            f"the lines before it, or begin each with {METADATA_MARK}"
        )
    return chain(ahead, lines)


def second_header(header: Sequence[str], row: Sequence[str]) -> str | None:
    """Return what to say where a row of texts names columns that have no name in the header, else None."""
    named = [(i, text) for i, text in enumerate(row[: len(header)], 1) if text.strip() and not header[i - 1]]
    if not named:
        return None
    column, text = named[0]
    return (
        f"{text.strip()[:40]!r} stands here in column {column}, which has no name in the row before: where this row "
        f"holds the names, take out the row before it, or begin that with {METADATA_MARK}; else give the column a name"
    )


def encoding_hint(header: list[str]) -> str:
    """Return what to say where names look like UTF-8 that was read as another encoding, else ''."""
    try:
        meant = [name.encode("cp1252").decode("utf-8") for name in header]
    except UnicodeError:
        return ""
    if meant == header:
        return ""
    named = ", ".join(name for name, read in zip(meant, header, strict=True) if name != read)
    return f"; the file seems to be UTF-8 ({named}): say encoding: utf-8 in the map"


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
