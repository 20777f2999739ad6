"""Reads what a recording says of itself: the machine, and the date of its first row."""

import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from config.recordings.recording_map import RecordingMap, resolve_columns, usual_map
from drivers.files.recording_lines import LONGEST_LINE, METADATA_MARK, read_beginning
from drivers.files.recording_time import time_reader

DAY_S = 86400.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """What a recording is of, as far as its file says."""

    machine: str
    """'' where no line `# machine:` names it."""
    begun_utc_s: float | None
    """Time of its first row [s]; None where its times are no dates."""


def read_origin(path: Path, recording_map: RecordingMap | None = None) -> Origin:
    """Return the machine and the date of a recording that can be read; raises `RecordingFileError`."""
    encoding = "utf-8" if recording_map is None else recording_map.encoding
    header, rows = read_beginning(path, 2, encoding)
    meaning = recording_map or usual_map(header)
    dated = meaning.time_unit == "iso" or meaning.time_format is not None
    first = rows[1 if meaning.unit_row else 0] if dated else []
    begun_utc_s = None
    if first:
        columns = resolve_columns(meaning, header)
        texts = [first[place] for place in (columns.date, columns.time) if place is not None]
        with suppress(ValueError, OverflowError):
            begun_utc_s = time_reader(meaning)(" ".join(texts))
    known = begun_utc_s is not None and math.isfinite(begun_utc_s) and begun_utc_s > DAY_S  # less is a time of day
    return Origin(machine=machine_of(path, encoding), begun_utc_s=begun_utc_s if known else None)


def machine_of(path: Path, encoding: str = "utf-8") -> str:
    """Return the machine that a recording names, '' where it names none; raises OSError."""
    with path.open(encoding="utf-8-sig" if encoding == "utf-8" else encoding) as file:
        while line := file.readline(LONGEST_LINE):
            key, _, value = line.removeprefix(METADATA_MARK).partition(":")
            if not line.startswith(METADATA_MARK):
                return ""
            if key.strip() == "machine":
                return value.strip()
    return ""
