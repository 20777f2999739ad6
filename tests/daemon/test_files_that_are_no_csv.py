"""A file without separators, or with a quote that never ends, is named and refused, whatever reads it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.workbench.stability.csv_rows import csv_rows
from drivers.files.frf_measurement import read_measurements
from drivers.files.impact_index import INDEX_FILE, read_index
from models.errors import RefusedInputError

LONG = "x" * 200_000


def rows(path: Path) -> object:
    with csv_rows(path, "profile") as found:
        return list(found)


@pytest.mark.parametrize(
    ("read", "header"),
    [
        (rows, ""),
        (rows, "x_mm,z_um\n"),
        (read_measurements, "frequency_hz,receptance_re,receptance_im\n"),
        (lambda path: read_index(path.parent), ""),
    ],
)
def test_what_is_no_csv_is_refused_and_named(tmp_path: Path, read: Callable[[Path], object], header: str) -> None:
    path = tmp_path / INDEX_FILE
    path.write_text(f"{header}{LONG}\n", encoding="utf-8")
    with pytest.raises(RefusedInputError, match=rf"{INDEX_FILE}: is not CSV \(field larger"):
        read(path)
