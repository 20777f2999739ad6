"""Reads a frequency response from CSV: `frequency_hz,receptance_re,receptance_im` [Hz, m/N, m/N].

The names may stand in any order and beside others; the frequencies must ascend. Comma, semicolon
or tab separates the fields. Everything refused is named with file, line and column.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.contract import FatalDriverError
from models.records import FloatArray

COLUMNS = ("frequency_hz", "receptance_re", "receptance_im")
DELIMITERS = (",", ";", "\t")
FEWEST_ROWS = 4
"""Fewer frequencies show no resonance."""
LARGEST_RECEPTANCE_M_PER_N = 1e-2
"""A tool point softer than 100 N/m is one whose unit is not m/N."""


class FrfFileError(FatalDriverError):
    """A frequency response cannot be read; the text begins with file and line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrequencyResponse:
    """One receptance over frequency."""

    frequency_hz: FloatArray
    """Ascending [Hz], shape (n,)."""
    receptance_m_per_n: npt.NDArray[np.complex128]
    """Displacement per force [m/N], shape (n,)."""


def read_frf_csv(path: Path) -> FrequencyResponse:
    """Read a frequency response; raises `FrfFileError`."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FrfFileError(f"{path}: cannot be opened ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise FrfFileError(f"{path}: is not UTF-8 text; export the FRF as CSV") from error
    lines = text.splitlines()
    header = lines[0] if lines else ""
    delimiter = max(DELIMITERS, key=header.count)
    names = [name.strip() for name in header.split(delimiter)]
    if missing := [name for name in COLUMNS if name not in names]:
        raise FrfFileError(
            f"{path}:1: there is no column {', '.join(missing)}; an FRF has the header {','.join(COLUMNS)} (Hz and m/N)"
        )
    places = [names.index(name) for name in COLUMNS]
    rows: list[list[float]] = []
    for number, fields in enumerate(csv.reader(lines[1:], delimiter=delimiter), start=2):
        if any(field.strip() for field in fields):
            rows.append(_row(path, number, fields, places, len(names)))
            if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
                raise FrfFileError(
                    f"{path}:{number}: column frequency_hz: {rows[-1][0]:g} Hz does not lie above the row before; "
                    "sort the rows and remove doubles"
                )
    if len(rows) < FEWEST_ROWS:
        raise FrfFileError(f"{path}: holds {len(rows)} frequencies; at least {FEWEST_ROWS} are needed")
    table = np.array(rows)
    receptance = table[:, 1] + 1j * table[:, 2]
    _check_size(path, receptance)
    return FrequencyResponse(frequency_hz=table[:, 0].copy(), receptance_m_per_n=receptance)


def _row(path: Path, number: int, fields: list[str], places: list[int], width: int) -> list[float]:
    if len(fields) != width:
        raise FrfFileError(f"{path}:{number}: has {len(fields)} fields where the header has {width}")
    values = []
    for name, place in zip(COLUMNS, places, strict=True):
        try:
            value = float(fields[place])
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (name == "frequency_hz" and value < 0.0):
            raise FrfFileError(
                f"{path}:{number}: column {name}: {fields[place].strip()!r} is no finite number in range; "
                "remove the row or measure again"
            )
        values.append(value)
    return values


def _check_size(path: Path, receptance: npt.NDArray[np.complex128]) -> None:
    largest = float(np.abs(receptance).max())
    if largest == 0.0:
        raise FrfFileError(f"{path}: every receptance is zero; say `rigid` if the direction is rigid")
    if largest > LARGEST_RECEPTANCE_M_PER_N:
        raise FrfFileError(
            f"{path}: a receptance of {largest:g} m/N is softer than any tool; is the unit um/N or is this "
            "an accelerance? Convert it to displacement per force in m/N"
        )


__all__ = ["FrequencyResponse", "FrfFileError", "read_frf_csv"]
