"""A file without separators, or with a quote that never ends, is named and refused, whatever reads it."""

import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from daemon.workbench.stability.csv_rows import csv_rows
from drivers.files.accelerometer_recording import read_acceleration
from drivers.files.frf_measurement import read_measurements
from drivers.files.impact_index import INDEX_FILE, first_time, read_index
from drivers.files.recording_lines import read_header
from drivers.files.recording_origin import machine_of
from models.errors import RefusedInputError

LONG = "x" * 200_000


def rows(path: Path) -> object:
    with csv_rows(path, "profile") as found:
        return list(found)


def timed(path: Path) -> object:
    return first_time(path, "Time")


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


@pytest.mark.parametrize("read", [read_header, rows, read_measurements, read_acceleration, machine_of, timed])
def test_a_file_without_an_end_is_refused_and_fills_no_memory(tmp_path: Path, read: Callable[[Path], object]) -> None:
    """A file of 2 GB that holds no line, as a copy that broke off leaves it, was read whole before it was refused."""
    path = tmp_path / "sparse.csv"
    with path.open("wb") as file:
        file.truncate(2 * 2**30)
    tracemalloc.start()
    try:
        with suppress(RefusedInputError):
            assert read(path) == ""
        assert tracemalloc.get_traced_memory()[1] < 300 * 2**20
    finally:
        tracemalloc.stop()
