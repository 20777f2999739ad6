"""Measured responses from CSV and universal files: units, kinds, coherence, refusals."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyuff

from drivers.files.frf_measurement import MeasurementFileError, read_measurements

FREQUENCY_HZ = np.linspace(0.0, 2000.0, 41)
OMEGA = 2 * np.pi * FREQUENCY_HZ
RECEPTANCE = 1e-7 / (1 - (FREQUENCY_HZ / 1000) ** 2 + 0.05j)


def function(data: Any, **changes: Any) -> dict[str, Any]:
    told = {
        "type": 58, "func_type": 4, "rsp_node": 1, "rsp_dir": 2, "ref_node": 1, "ref_dir": 2, "x": FREQUENCY_HZ,
        "data": data, "id1": "", "id2": "", "id3": "", "id4": "", "id5": "", "abscissa_spec_data_type": 18,
        "ordinate_spec_data_type": 8, "orddenom_spec_data_type": 13, "ordinate_axis_units_lab": "m",
        "orddenom_axis_units_lab": "N", "binary": 0,
    }  # fmt: skip
    return {**told, **changes}


def universal(path: Path, *sets: dict[str, Any]) -> Path:
    path.unlink(missing_ok=True)
    pyuff.UFF(str(path)).write_sets(list(sets), mode="add")
    return path


@pytest.mark.parametrize(
    ("kind", "data", "label"),
    [
        (8, RECEPTANCE, "m"),
        (8, RECEPTANCE * 1e3, "mm"),
        (8, RECEPTANCE * 1e6, "um"),
        (11, RECEPTANCE * 1j * OMEGA, "m/s"),
        (12, RECEPTANCE * -(OMEGA**2), "m/s^2"),
        (12, RECEPTANCE * -(OMEGA**2) / 9.80665, "g"),
        (12, RECEPTANCE * -(OMEGA**2) * 1e3, "mm/s^2"),
    ],
)
def test_kinds_and_units_of_universal_files(tmp_path: Path, kind: int, data: Any, label: str) -> None:
    path = universal(tmp_path / "m.uff", function(data, ordinate_spec_data_type=kind, ordinate_axis_units_lab=label))
    (found,) = read_measurements(path)
    # The line at 0 Hz is left out: nothing can be integrated there.
    assert found.frequency_hz == pytest.approx(FREQUENCY_HZ[1:])
    assert found.receptance_m_per_n == pytest.approx(RECEPTANCE[1:], rel=1e-5)
    assert found.coherence is None


@pytest.mark.parametrize(
    ("label", "force", "units", "factor"),
    [
        ("in", "lbf", None, 0.0254 / 4.4482216),
        ("mm", "kN", None, 1e-6),
        ("g/lbf", "NONE", None, 9.80665 / 4.4482216),
        ("mm", "kN", (1000.0, 0.001), 1e-6),
        ("g", "lbf", (39.37008, 0.2248089), 9.80665 / 4.4482216),
        ("g", "N", (1000.0, 1.0), 9.80665),
    ],
)
def test_the_unit_of_the_force_counts(
    tmp_path: Path, label: str, force: str, units: tuple[float, float] | None, factor: float
) -> None:
    """Per lbf was read as per N: a machine 4.4 times softer, or, in g with units in a set of its own, per N too."""
    kind, order = (12, -(OMEGA**2)) if label.startswith("g") else (8, np.ones(41))
    told = function(
        RECEPTANCE * order / factor, ordinate_spec_data_type=kind, ordinate_axis_units_lab=label,
        orddenom_axis_units_lab=force,
    )  # fmt: skip
    sets = [] if units is None else [pyuff.prepare_164(units_code=1, units_description="", temp_mode=1,
            length=units[0], force=units[1], temp=1.0, temp_offset=0.0)]  # fmt: skip
    (found,) = read_measurements(universal(tmp_path / "m.uff", *sets, told))
    assert found.receptance_m_per_n == pytest.approx(RECEPTANCE[1:], rel=1e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"func_type": 6}, "holds no frequency response function"),
        ({"ordinate_spec_data_type": 2}, "its ordinate is of kind 2"),
        ({"orddenom_spec_data_type": 12}, "is per kind 12 of data, not per force"),
        ({"ordinate_axis_units_lab": "furlong"}, "the unit 'furlong' is not known"),
        ({"orddenom_axis_units_lab": "mV"}, "the unit 'mV' of the force is not known"),
    ],
)
def test_unfit_universal_files_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    data = np.abs(RECEPTANCE) if changes.get("func_type") == 6 else RECEPTANCE
    with pytest.raises(MeasurementFileError, match=words):
        read_measurements(universal(tmp_path / "m.uff", function(data, **changes)))


def test_csv_with_coherence_other_columns_and_semicolons(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    rows = ["note;coherence;mobility_im;frequency_hz;mobility_re"]
    for f, h in zip(FREQUENCY_HZ.tolist(), (RECEPTANCE * 1j * OMEGA).tolist(), strict=True):
        rows.append(f"x;0.75;{h.imag!r};{f!r};{h.real!r}")
    path.write_text("\n".join(rows))
    (found,) = read_measurements(path)
    assert found.receptance_m_per_n == pytest.approx(RECEPTANCE[1:])
    assert found.coherence == pytest.approx(np.full(40, 0.75))


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_csv_with_decimal_commas_and_a_header_in_capitals(tmp_path: Path, delimiter: str) -> None:
    path = tmp_path / "m.csv"
    rows = [delimiter.join(("Frequency_Hz", " Receptance_Re", "Receptance_Im"))]
    for f, h in zip(FREQUENCY_HZ.tolist(), RECEPTANCE.tolist(), strict=True):
        rows.append(delimiter.join(repr(value).replace(".", ",") for value in (f, h.real, h.imag)))
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(rows).encode())
    (found,) = read_measurements(path)
    assert found.frequency_hz == pytest.approx(FREQUENCY_HZ[FREQUENCY_HZ > 0.0])
    assert found.receptance_m_per_n == pytest.approx(RECEPTANCE[FREQUENCY_HZ > 0.0])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("frequency_hz;receptance_re;receptance_im\n1.000,5;1e-7;0\n", r":2: column frequency_hz: '1.000,5'"),
        ("frequency_hz,receptance_re,receptance_im\n", "holds no frequencies"),
        ("frequency_hz,receptance_re,receptance_im\n-1,0,0\n", r":2: column frequency_hz: '-1'"),
        ("frequency_hz,receptance_re,receptance_im\n1,1e-7,inf\n", r":2: column receptance_im: 'inf'"),
        ("frequency_hz,receptance_re,receptance_im,coherence\n1,1e-7,0,2\n", r":2: column coherence: '2'"),
        ("frequency_hz,receptance_re,receptance_im\n1,0,0\n", "at 1 Hz the response is zero"),
        ("frequency_hz,receptance_re,receptance_im,mobility_re,mobility_im\n", "has 2 responses"),
    ],
)
def test_unfit_csv_files_are_refused(tmp_path: Path, content: str, words: str) -> None:
    path = tmp_path / "m.csv"
    path.write_text(content)
    with pytest.raises(MeasurementFileError, match=words):
        read_measurements(path)
