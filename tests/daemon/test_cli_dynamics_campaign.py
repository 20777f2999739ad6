"""`toolpoint dynamics campaign` on a simulated campaign: model, report, result; bad input."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from dynamics_command import call

from config.machine.spindle import load_spindle
from config.machines import shipped_file
from daemon.workbench.dynamics.campaign import read_temperatures
from drivers.files.impact_index import read_index
from models.thermomechanics.artifact import model_from_json


def refusal(*arguments: object) -> str:
    result = call("campaign", *arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    return str(result.stderr)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("campaign") / "hits"
    result = call("simulate-campaign", folder, "--df", 12.5)
    assert result.exit_code == 0, result.stderr
    return folder


@pytest.fixture
def few(simulated: Path, tmp_path: Path) -> Path:
    """The first responses along x alone, as somebody's folder that can be spoilt."""
    folder = tmp_path / "few"
    folder.mkdir()
    rows = (simulated / "impacts.csv").read_text().splitlines()
    kept = [rows[0], *[row for row in rows[1:] if ",x," in row][:25]]
    for row in kept[1:]:
        shutil.copy(simulated / row.partition(",")[0], folder)
    for name in ("temperatures.csv", "spindle.yaml"):
        shutil.copy(simulated / name, folder)
    (folder / "impacts.csv").write_text("\n".join(kept) + "\n")
    return folder


def test_model_report_and_result(simulated: Path, tmp_path: Path) -> None:
    model, report, summary = (tmp_path / name for name in ("model.json", "report.html", "result.json"))
    result = call(
        "campaign", simulated, "--temperatures", simulated / "temperatures.csv", "--config",
        shipped_file("cfrpmt.yaml"), "--to-hz", 1500, "--only-five", "--model", model, "--report", report,
        "--json", summary,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    found = json.loads(summary.read_text())
    fitted = model_from_json(model.read_text(), str(model))
    assert found["model_id"] == fitted.model_id
    assert set(fitted.axes) == {"x", "y"}
    assert fitted.shaft_sha256 == load_spindle(simulated / "spindle.yaml").shaft_sha256()
    assert found["signals"]["used"] == list(fitted.signals)
    assert found["signals"]["groups"]
    properties = found["axes"]["y"]["properties"]
    assert set(properties) == {"ct_12", "kr_12", "kt_34", "kt_5", "ct_5"}
    assert all(0.9 < each["adjusted_r2"] <= 1.0 for each in properties.values())
    series = found["axes"]["y"]["series"]["5"][0]
    assert len(series["time_min"]) == found["axes"]["y"]["responses"] == len(series["values"]["kt_34"])
    stiffness = np.array(series["values"]["kt_34"])
    assert stiffness.max() > 1.2 * stiffness[0], "the spindle stiffens as it warms"
    page = report.read_text()
    assert page.count("plotly-graph-div") == 9
    assert "Fig. 5-10" in page
    assert "<script src=" not in page and "<link" not in page.partition("<body>")[2]


def spoil(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "complaint"),
    [
        ("impacts.csv", "file,axis,time", "name,axis,time", "impacts.csv:1: the header must be file,axis,time"),
        ("impacts.csv", ",x,", ",z,", "impacts.csv:2: column axis: 'z' is neither x nor y"),
        ("impacts.csv", "x_001.csv,x,720.0", "x_001.csv,x,noon", "column time: 'noon' is neither a number nor date"),
        ("impacts.csv", "x_001.csv,x,720.0", "x_000.csv,x,720.0", "column file: there is no file"),
        ("impacts.csv", "x_001.csv,x,720.0", "x_001.csv,x,9e6", "times must be those of the recording"),
        ("x_001.csv", "frequency_hz", "Hz", "there is no column frequency_hz"),
        ("temperatures.csv", "t,T1,", "clock,T1,", "temperatures.csv: no column of the recording is a time"),
        ("spindle.yaml", "length_mm: 15", "length_mm: -15", "spindle.yaml:9:17: segments[0].length_mm"),
    ],
)
def test_bad_files_are_refused_with_file_and_line(few: Path, file: str, old: str, new: str, complaint: str) -> None:
    spoil(few / file, old, new)
    assert complaint in refusal(few, "--temperatures", few / "temperatures.csv", "--only-five")


def test_a_response_in_another_unit_is_refused_by_name(few: Path) -> None:
    path = few / "x_001.csv"
    plain = path.read_text()
    head, *rows = plain.splitlines()
    numbers = [[float(each) for each in row.split(",")] for row in rows]
    for scale, factor, words in ((1.0, 1e3, "numbers in mm/N"), (1e-3, 1.0, "is the axis in kHz?")):
        scaled = [f"{f * scale!r},{re * factor!r},{im * factor!r}" for f, re, im in numbers]
        path.write_text("\n".join([head, *scaled]) + "\n")
        said = refusal(few, "--temperatures", few / "temperatures.csv", "--only-five")
        assert words in said
        assert str(path) in said


# Track


@pytest.fixture(scope="module")
def fitted(simulated: Path) -> Path:
    model = simulated.parent / "model.json"
    result = call(
        "campaign", simulated, "--temperatures", simulated / "temperatures.csv", "--config",
        shipped_file("cfrpmt.yaml"), "--to-hz", 1500, "--only-five", "--model", model,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    return model


def test_an_index_with_semicolons_may_have_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "x.csv").touch()
    (tmp_path / "impacts.csv").write_text("file;axis;time\nx.csv;x;7,5\n", encoding="utf-8")
    assert [each.time for each in read_index(tmp_path)] == [7.5]


@pytest.mark.parametrize(
    ("before", "after"), [("# machine: mill-3\n# begun: today\n", ""), ("sep=;\n", ""), ("", "\n"), ("", "")]
)
def test_a_recording_begins_where_its_rows_do(tmp_path: Path, before: str, after: str) -> None:
    """Lines such as `# machine:`, which this product itself writes, were taken for the header."""
    path = tmp_path / "temperatures.csv"
    path.write_text(f"{before}time_min;T1;T2\n{after}7,5;20,0;21,0\n8,5;20,1;21,1\n", encoding="utf-8")
    found = read_temperatures(path, None)
    assert (found.start, found.seconds_per_unit) == (7.5, 60.0)
    assert found.time_min.tolist() == [0.0, 1.0]
