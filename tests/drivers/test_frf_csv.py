"""Frequency responses from CSV, and what is refused."""

from pathlib import Path

import pytest

from drivers.frf_csv import FrfFileError, read_frf_csv

HEAD = "frequency_hz,receptance_re,receptance_im"
ROWS = ["300,1e-8,-1e-9", "301,2e-8,-2e-9", "302,3e-8,-3e-9", "303,4e-8,-4e-9", "304,5e-8,-5e-9"]


def file(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "x.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_columns_are_found_by_name(tmp_path: Path) -> None:
    plain = read_frf_csv(file(tmp_path, HEAD, *ROWS))
    assert plain.frequency_hz.tolist() == [300.0, 301.0, 302.0, 303.0, 304.0]
    assert plain.receptance_m_per_n[1] == 2e-8 - 2e-9j
    other = ["coherence;receptance_im;frequency_hz;receptance_re"]
    for row in ROWS:
        frequency, real, imaginary = row.split(",")
        other.append(f"1;{imaginary};{frequency};{real}")
    assert read_frf_csv(file(tmp_path, *other)).receptance_m_per_n.tolist() == plain.receptance_m_per_n.tolist()


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (["f,re,im", *ROWS], "x.csv:1: there is no column frequency_hz, receptance_re, receptance_im"),
        ([HEAD, *ROWS[:2], "301,1,1"], "x.csv:4: column frequency_hz: 301 Hz does not lie above"),
        ([HEAD, *ROWS[:2], "302,abc,1"], "x.csv:4: column receptance_re: 'abc' is no finite number"),
        ([HEAD, *ROWS[:2], "302,nan,1"], "x.csv:4: column receptance_re: 'nan'"),
        ([HEAD, *ROWS[:2], "302,1"], "x.csv:4: has 2 fields where the header has 3"),
        ([HEAD, *ROWS[:2]], "holds 2 frequencies"),
        ([HEAD, *(row.replace("e-8", "") for row in ROWS)], "softer than any tool"),
        ([HEAD, *(f"{300 + i},0,0" for i in range(5))], "every receptance is zero"),
        ([], "x.csv:1: there is no column"),
    ],
)
def test_refusals(tmp_path: Path, lines: list[str], sentence: str) -> None:
    with pytest.raises(FrfFileError) as refused:
        read_frf_csv(file(tmp_path, *lines))
    assert sentence in str(refused.value)
