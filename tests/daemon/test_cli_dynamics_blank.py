"""`toolpoint dynamics blank`: one test, every tool; and what is refused, with file, line and key."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blank_in_holder import HZ, TOOL, blank_test, holder_on_spindle, noisy, tip
from click.testing import CliRunner, Result

from daemon.cli import main
from models.dynamics.beam import ComplexArray

MATERIALS = """
materials:
  my_steel: {E_gpa: 205, G_gpa: 79, nu: 0.3, density_g_cm3: 7.85}
"""
TEST = (
    """
blank: {outer_mm: 16, length_mm: 70, material: my_steel}
second_point_mm: 30
responses: {tip: [tip.csv], cross: [cross.csv], second: [second.csv]}
"""
    + MATERIALS
)
TOOLS = """
tools:
  em16: {diameter_mm: 16, flute_length_mm: 30, shank_mm: 16, stickout_mm: 90, material: carbide}
  drill: {diameter_mm: 16, flute_length_mm: 60, shank_mm: 16, stickout_mm: 60, material: steel, equivalent_ratio: 0.7}
"""


@pytest.fixture(scope="module")
def measured() -> ComplexArray:
    return noisy(blank_test(holder_on_spindle()), 0.003, 1)


@pytest.fixture
def folder(tmp_path: Path, measured: ComplexArray) -> Path:
    (tmp_path / "test.yaml").write_text(TEST, "utf-8")
    (tmp_path / "tools.yaml").write_text(TOOLS, "utf-8")
    for name, values in zip(("tip", "cross", "second"), measured, strict=True):
        write(tmp_path / f"{name}.csv", values)
    return tmp_path


def write(path: Path, values: ComplexArray, hz: Any = HZ) -> None:
    rows = [f"{f!r},{v.real!r},{v.imag!r}" for f, v in zip(hz.tolist(), values.tolist(), strict=True)]
    path.write_text("\n".join(["frequency_hz,receptance_re,receptance_im", *rows]) + "\n", "utf-8")


def gone(*paths: Path) -> None:
    for path in paths:
        path.unlink()


def call(folder: Path, *more: object) -> Result:
    words = ["dynamics", "blank", folder / "test.yaml", folder / "tools.yaml", *more]
    return CliRunner().invoke(main, [str(word) for word in words])


def test_one_test_serves_every_tool(folder: Path) -> None:
    done = call(folder, "--json", "-", "--output-dir", folder / "frf")
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    true = np.abs(tip(holder_on_spindle(), TOOL))
    em16 = found["tools"]["em16"]
    assert em16["peak_hz"] == pytest.approx(HZ[np.argmax(true)], rel=0.005)
    low, high = em16["peak_m_per_n_interval"]
    assert low < em16["peak_m_per_n"] < high < 1.05 * low and em16["peak_m_per_n"] == pytest.approx(
        true.max(), rel=0.02
    )
    assert found["noise"] == pytest.approx(0.003, rel=0.4) and found["peak_mismatch"] < 0.02 and not found["warnings"]
    assert set(found["tools"]) == {"em16", "drill"}
    assert "em16: peak" in done.stderr
    lobes = CliRunner().invoke(main, ["stability", "lobes", str(case(folder)), "--json", "-"])
    assert lobes.exit_code == 0, lobes.output
    above = " ".join(json.loads(call(folder, "--from-hz", 1000, "--json", "-").stdout)["warnings"])
    assert "em16: at 1000 Hz the tip moves against the force already" in above


def case(folder: Path) -> Path:
    path = folder / "case.yaml"
    path.write_text(
        "teeth: 4\ndiameter_mm: 16\nradial_depth_mm: 8\nmilling: down\nmaterial: al7075_t6\n"
        "x: {frf: frf/em16.csv}\ny: {frf: frf/em16.csv}\n",
        "utf-8",
    )
    return path


Change = Callable[[Path, ComplexArray], object]
REFUSED: dict[str, tuple[Change, str]] = {
    "another shank": (
        lambda at, _: (at / "tools.yaml").write_text(
            TOOLS.replace("shank_mm: 16, stickout_mm: 60", "shank_mm: 12, stickout_mm: 60"), "utf-8"
        ),
        r"tools\.yaml:4:.*tools\.drill\.shank_mm: the blank was 16 mm thick",
    ),
    "a needle": (
        lambda at, _: (at / "tools.yaml").write_text(
            TOOLS.replace("{diameter_mm: 16, flute_length_mm: 30", "{diameter_mm: 0.1, flute_length_mm: 30"), "utf-8"
        ),
        r"tools\.yaml:3:.*diameter_mm: bends like a cylinder of 0.08 mm, and a beam is computed from 0.1 mm on",
    ),
    "longer flutes": (
        lambda at, _: (at / "tools.yaml").write_text(
            TOOLS.replace("flute_length_mm: 30", "flute_length_mm: 300"), "utf-8"
        ),
        r"tools\.yaml:3:.*flute_length_mm: 300 mm are longer than the tool stands out",
    ),
    "an unknown material": (
        lambda at, _: (at / "tools.yaml").write_text(TOOLS.replace("carbide", "carbid"), "utf-8"),
        r"tools\.yaml:3:.*'carbid' is not known; did you mean carbide",
    ),
    "a point in the holder": (
        lambda at, _: (at / "test.yaml").write_text(
            TEST.replace("second_point_mm: 30", "second_point_mm: 80"), "utf-8"
        ),
        r"test\.yaml:3:.*second_point_mm: must lie between the tip and the holder, 70 mm",
    ),
    "a point at the tip": (
        lambda at, _: (at / "test.yaml").write_text(
            TEST.replace("second_point_mm: 30", "second_point_mm: 1e-320"), "utf-8"
        ),
        r"test\.yaml:3:.*second_point_mm: this must be at least 0\.01",
    ),
    "a sensor turned round": (
        lambda at, values: write(at / "cross.csv", -values[1]),
        "cross moves against the tip's: one sensor points the other way",
    ),
    "other lines": (
        lambda at, values: write(at / "second.csv", values[2], HZ + 1.0),
        "second was measured at other frequencies",
    ),
    "uneven lines": (
        lambda at, values: [
            write(at / f"{name}.csv", np.delete(row, 40), np.delete(HZ, 40))
            for name, row in zip(("tip", "cross", "second"), values, strict=True)
        ],
        "after 178 Hz the step changes",
    ),
    "um/N": (lambda at, values: write(at / "tip.csv", values[0] * 1e6), r"tip\.csv: half of the receptances"),
    "no file": (lambda at, _: (at / "cross.csv").unlink(), r"cross\.csv: cannot be opened"),
    "no files": (
        lambda at, _: gone(at / "tip.csv", at / "second.csv"),
        r"tip\.csv, \S+second\.csv: cannot be opened",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_with_its_place(folder: Path, measured: ComplexArray, name: str) -> None:
    change, sentence = REFUSED[name]
    change(folder, measured)
    done = call(folder)
    assert done.exit_code == 2, done.output

    assert re.search(sentence, done.stderr), done.stderr
    assert "Traceback" not in done.output


def test_responses_that_do_not_belong_together_are_told(folder: Path, measured: ComplexArray) -> None:
    write(folder / "second.csv", 2.0 * measured[2])
    found = json.loads(call(folder, "--json", "-").stdout)
    assert found["peak_mismatch"] == pytest.approx(0.5, abs=0.05)
    assert any("cross^2 is tip x second" in each for each in found["warnings"])
