"""`toolpoint dynamics` with files and numbers that are refused, and the sentences."""

import re
from pathlib import Path

import numpy as np
import pytest
from dynamics_command import DIRECT, STEEL, answer, call, nose, refusal, write_csv

BAD_FILES = {
    "zero length": (
        "length_mm: 15.1",
        "length_mm: 0",
        ":3:17: segments[0].length_mm: this must be at least 0.01, not 0",
    ),
    "negative": (
        "length_mm: 15.1",
        "length_mm: -15",
        ":3:17: segments[0].length_mm: this must be at least 0.01, not -15",
    ),
    "inner": ("inner_mm: 42.4", "inner_mm: 89", ":3:39: segments[0].inner_mm: inner 89 mm must be smaller"),
    "ring": ("ring: {outer_mm: 85.0", "ring: {outer_mm: 50", "segments[2].ring.outer_mm: a ring sits on the segment"),
    "outside": ("position_mm: 400.1", "position_mm: 500", ":10:18: bearings[2].position_mm: 500 mm lies outside"),
    "before": ("position_mm: 99.1", "position_mm: -1", "bearings[0].position_mm: this must be at least 0"),
    "group": ("'12'", "'1 3'", ":8:13: bearings[0].group: "),
    "negative stiffness": ("5.11e7", "-5.11e7", ":8:50: bearings[0].kt_n_per_m: this must be at least 0"),
    "stiffness": ("5.11e7", "5.11e77", "bearings[0].kt_n_per_m: this must be at most 1e+15"),
    "pascals": ("E_gpa: 200", "E_gpa: 200e9", ":3:62: segments[0].E_gpa: this must be at most 2000"),
    "unknown key": ("inner_mm: 42.4", "iner_mm: 42.4", "unknown key; did you mean `inner_mm`?"),
    "material": (
        STEEL,
        "material: stel",
        ":3:65: segments[0].material: the material 'stel' is not known; did you mean",
    ),
    "lacking": ("E_gpa: 200, ", "", "segments[0]: E_gpa missing"),
    "nan": ("nu: 0.3", "nu: .nan", "is not a number that can be used"),
    "text": ("length_mm: 15.1", "length_mm: long", "this must be a number, not the text 'long'"),
}


@pytest.mark.parametrize(
    ("case", "command"), [*((case, "modes") for case in BAD_FILES), ("material", "frf"), ("material", "sensitivity")]
)
def test_bad_files_are_refused_with_line_and_key(tmp_path: Path, case: str, command: str) -> None:
    old, new, words = BAD_FILES[case]
    path = tmp_path / "bad.yaml"
    path.write_text(DIRECT.replace(old, new, 1))
    said = refusal(command, path)
    assert str(path) in said
    assert words in said


def test_missing_parts_are_refused(spindle: Path, tmp_path: Path) -> None:
    assert "describes no holder" in refusal("frf", spindle, "--at", "holder")
    assert "describes no tool" in refusal("frf", spindle, "--at", "tool")
    assert "spindles that ship are" in refusal("modes", tmp_path / "nowhere.yaml")
    assert "describes no bearings" in refusal("identify", "steel", write_csv(tmp_path / "m.csv", *nose(spindle)))
    assert f"{spindle}: the file describes no tool" in refusal("compare", "tool_cold_y", spindle, "--at", "tool")
    assert "--after-segment must name" in refusal(
        "contact", spindle, tmp_path / "m.csv", "--joint", "shaft", "--after-segment", 9
    )
    assert "the first must lie above 0" in refusal("frf", spindle, "--from-hz", 500, "--to-hz", 400)


def test_unfit_measurements_are_refused_with_a_sentence(spindle: Path, tmp_path: Path) -> None:
    at, values = nose(spindle)
    path = tmp_path / "m.csv"
    cases = {
        "um/N": (at, values * 1e6, "is the unit um/N"),
        "accelerance": (at, values * (2 * np.pi * at) ** 2, "is this an accelerance?"),
        "narrow": (at[:40], values[:40], "from 300 to 330.469 Hz is too narrow"),
        "few": (at[:5], values[:5], "5 frequencies cannot determine 5 parameters"),
    }
    for frequency, response, words in cases.values():
        said = refusal("identify", spindle, write_csv(path, frequency, response))
        assert words in said
        assert str(path) in said
    lines = write_csv(path, at, values).read_text().splitlines()
    broken = {
        ":7: column receptance_re: 'nan'": [*lines[:6], "304,nan,0", *lines[7:]],
        ":7: column frequency_hz: 300 Hz does not lie above": [*lines[:6], "300,1e-7,0", *lines[7:]],
        ":7: has 2 fields": [*lines[:6], "304,1e-7", *lines[7:]],
        ":1: there is no column frequency_hz": ["f,re,im", *lines[1:]],
        ":1: has 0 responses": ["frequency_hz,re,im", *lines[1:]],
    }
    for words, content in broken.items():
        path.write_text("\n".join(content))
        assert f"{path}{words}" in refusal("identify", spindle, path)
    assert "no frequency is left" in refusal(
        "identify", spindle, write_csv(path, at, values), "--from-hz", 9000, "--to-hz", 9900
    )


WRONG_UNITS = {
    "mm/N": (1.0, 1e3, "numbers in mm/N"),
    "m/kN": (1.0, 1e-3, "numbers in m/kN"),
    "kHz": (1e-3, 1.0, "is the axis in kHz?"),
    "rad/s": (2 * np.pi, 1.0, "is the axis in rad/s"),
    "1/min": (60.0, 1.0, "is the axis in rad/s or 1/min?"),
}


@pytest.mark.parametrize("case", WRONG_UNITS)
def test_a_response_in_another_unit_is_refused_unless_it_is_trusted(spindle: Path, tmp_path: Path, case: str) -> None:
    scale, factor, words = WRONG_UNITS[case]
    at, values = nose(spindle, "--points", 400)
    path = write_csv(tmp_path / "m.csv", at * scale, values * factor)
    said = refusal("identify", spindle, path)
    assert words in said
    assert str(path) in said
    if case in ("mm/N", "kHz"):
        trusted = call("identify", spindle, path, "--trust-units", "--json", "-")
        assert words not in trusted.stderr
        assert "Traceback" not in trusted.output


def test_the_unit_of_a_response_at_the_holder_is_found_by_what_fits(tmp_path: Path) -> None:
    found = answer("frf", "holder_warm_y", "--at", "holder", "--points", 300)
    values = np.array(found["receptance_re"]) + 1j * np.array(found["receptance_im"])
    at = np.array(found["frequency_hz"])
    for scale, factor, words in ((1.0, 1e3, "numbers in mm/N"), (2 * np.pi, 1.0, "numbers over rad/s")):
        measured = write_csv(tmp_path / "h.csv", at * scale, values * factor)
        assert words in refusal("contact", "holder_cold_y", measured, "--joint", "spindle-holder")
    trusted = answer("contact", "holder_cold_y", measured, "--joint", "spindle-holder", "--trust-units")
    assert trusted["log_error"] > 1.0


@pytest.mark.parametrize(
    ("scale", "factor", "words"),
    [
        (1.0, 1e290, "m/N, which nothing has"),
        (1.0, 1e-295, "m/N, which nothing has"),
        (1e290, 1.0, "is no frequency at which a response is measured"),
        (1e-290, 1.0, "is no frequency at which a response is measured"),
        (0.0, 1.0, "above 0 Hz|does not lie above the row before"),
    ],
)
def test_numbers_that_nothing_measures_are_refused_though_trusted(
    spindle: Path, tmp_path: Path, scale: float, factor: float, words: str
) -> None:
    at, values = nose(spindle, "--points", 60)
    path = write_csv(tmp_path / "m.csv", at * scale, values * factor)
    assert re.search(words, refusal("identify", spindle, path, "--trust-units"))
