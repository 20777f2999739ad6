"""`toolpoint thermal report`: ISO 230-3 figures of a recording, with and without a model."""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from daemon.cli import main
from drivers.files.recording_csv import write_recording
from models.thermal.features import lag_table

STOPS_MIN = (300, 420, 960)
"""Standstill in a hall that warms by 2 K; 120 min of rotation; standstill."""


def make_recording(path: Path, cycles: int = 1) -> Path:
    rng = np.random.default_rng(cycles)
    rpm = np.tile(np.r_[np.zeros(STOPS_MIN[0]), np.full(120, 3000.0), np.zeros(540)], cycles)
    time_min = np.arange(float(len(rpm)))
    quick, slow = lag_table(time_min, (rpm / 3000.0)[:, None], (8.0, 40.0))[:, :, 0]
    air = 20.0 + 2.0 * np.minimum(time_min % 960, 300.0) / 300.0 * (time_min < 960)
    columns = {
        "t": (60.0 * time_min, 0),
        "rpm": (rpm, 0),
        "Z1": (-30.0 * slow - 2.0 * (air - 20.0), 4),
        "Y1": (10.0 * quick, 4),
        "T1": (air, 4),
        "T2": (air + 12.0 * quick + rng.normal(0.0, 0.01, len(rpm)), 4),
        "T3": (air + 9.0 * slow + rng.normal(0.0, 0.01, len(rpm)), 4),
    }
    write_recording(path, {"machine": "of the test"}, columns)
    return path


def run(command: str, *arguments: object) -> Result:
    return CliRunner().invoke(main, ["thermal", command, *map(str, arguments)])


def report(*arguments: object) -> dict[str, Any]:
    result = run("report", *arguments, "--json", "-")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("report") / "day.csv")


def test_the_figures_are_those_of_the_known_responses(recording: Path) -> None:
    found = report(recording, "--ambient", "T1", "--ahead-min", 15, "--tolerance-um", 1)
    assert found["rotations"] == [{"from_h": 4.9833, "minutes": 120.0, "lowest_rpm": 3000.0, "highest_rpm": 3000.0}]
    z1 = found["channels"]["Z1"]
    # The environment: 2 um per kelvin over nearly 2 K; after the rotation the cooling is over only after 4 h.
    assert z1["worst_without"]["environmental_temperature_variation_error_um"] == pytest.approx(4.0, abs=0.1)
    assert found["environment"]["stretches"][0]["temperature_range_k"] == pytest.approx(2.0, abs=0.02)
    assert len(found["environment"]["stretches"]) == 2
    spindle = z1["distortion_by_rotating_spindle"][0]
    assert spindle["without"]["first_60_min_um"] == pytest.approx(30.0 * -np.expm1(-60.0 / 40.0), rel=0.03)
    assert spindle["without"]["whole_period_um"] == pytest.approx(30.0 * -np.expm1(-120.0 / 40.0), rel=0.03)
    exact = 40.0 * np.log(30.0 * -np.expm1(-15.0 / 40.0))
    assert spindle["without"]["time_to_stability_min"] == pytest.approx(exact, abs=3.0)
    assert spindle["warm_up"]["wait_min"] == pytest.approx(exact, abs=8.0)
    assert found["axes"]["Z"]["without"]["whole_period_um"] == z1["worst_without"]["whole_period_um"]
    assert z1["worst_with"]["whole_period_um"] is None, "there is no model"


def test_an_empty_field_where_the_spindle_starts_costs_neither_the_advice_nor_the_curve(
    recording: Path, tmp_path: Path
) -> None:
    lines = recording.read_text("utf-8").splitlines()
    for line in (2, 1 + STOPS_MIN[0]):
        fields = lines[line].split(",")
        lines[line] = ",".join([*fields[:2], "", *fields[3:]])
    (path := tmp_path / "day.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = report(path, "--html", page := tmp_path / "day.html")
    turn = found["channels"]["Z1"]["distortion_by_rotating_spindle"][0]
    (warning,) = found["warnings"]
    assert "2 values are missing" in warning and warning in page.read_text("utf-8"), (
        "the page warns as the terminal does"
    )
    assert turn["warm_up"]["why_not"] is None, "it said that 0 rows of rotation were measured"
    drawn = page.read_text("utf-8").split('"name":"Z1, measured"', 1)[1].split('"y":[', 1)[1].split("]", 1)[0]
    assert drawn.startswith("null,0.0,") and drawn.count("null") == 2


@pytest.mark.parametrize(
    ("channel", "axis"), [("Weg Z [µm]", "Z"), ("dX", "X"), ("A1", "A"), ("Channel 1", None), ("Bending", None)]
)
def test_a_channel_is_of_the_axis_whose_letter_stands_in_its_name(
    recording: Path, tmp_path: Path, channel: str, axis: str | None
) -> None:
    text = recording.read_text("utf-8").replace(",Z1,Y1,", f",{channel},e [um],")
    (path := tmp_path / "day.csv").write_text(text, encoding="utf-8")
    (columns := tmp_path / "map.yaml").write_text(
        f"time: t\nspeed: rpm\ntemperatures: [T1]\ndisplacements: ['{channel}']\n", encoding="utf-8"
    )
    found = report(path, "--map", columns)
    assert list(found["axes"]) == ([] if axis is None else [axis]), "`Channel 1` was a rotary axis C"


def test_a_model_takes_most_of_it_away(recording: Path, tmp_path: Path) -> None:
    training = make_recording(tmp_path / "training.csv", cycles=4)
    model = tmp_path / "model.json"
    trained = run("train", training, "--model", "ridge", "-o", model)
    assert trained.exit_code == 0, trained.output
    page = tmp_path / "page.html"
    found = report(recording, "--model", model, "--html", page)
    assert not found["seen_in_training"]
    for name, share in (("Z1", 0.35), ("Y1", 0.35)):
        channel = found["channels"][name]
        assert channel["worst_with"]["whole_period_um"] < share * channel["worst_without"]["whole_period_um"]
    text = page.read_text("utf-8")
    assert "with compensation" in text and "on the same scale" in text.lower()
    for words in (
        "of the test",
        "Z1, measured",
        "Z1, estimated",
        "T2",
        "report made",
        f"<td>{version('toolpoint')}</td>",
    ):
        assert words in text, words
    assert "<script src=" not in text
    assert report(training, "--model", model)["seen_in_training"]


def test_a_short_gap_is_bridged_and_a_long_one_is_named(recording: Path, tmp_path: Path) -> None:
    model_path = tmp_path / "model.json"
    assert run("train", recording, "--ridge", 1.0, "-o", model_path).exit_code == 0
    lines = recording.read_text("utf-8").splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("t,")) + 1

    def without_t2(rows: range) -> Path:
        """Return a copy in which T2 reads as a broken wire does in some rows."""
        broken = list(lines)
        for row in rows:
            fields = broken[first + row].split(",")
            broken[first + row] = ",".join([*fields[:-2], "850", fields[-1]])
        path = tmp_path / f"gap{len(rows)}.csv"
        path.write_text("\n".join(broken) + "\n", encoding="utf-8")
        return path

    short = report(without_t2(range(100, 105)), "--model", model_path)
    assert any("column T2, row 101: 850 degC cannot be (5 such values" in warning for warning in short["warnings"])
    refused = run("report", without_t2(range(100, 150)), "--model", model_path)
    assert refused.exit_code == 2 and "column T2, row 101 of its averages: the model needs a value" in refused.output


def test_energy_with_the_chiller_on_reduced_and_off(recording: Path) -> None:
    energy = report(recording, "--cut-kwh", 0.3, "--motor-kwh", 0.9, "--process-min", 30)["energy"]
    assert energy["chiller_kwh"]["idle_reduction"] == pytest.approx(1.2 * 2.0)
    assert energy["chiller_kwh"]["always_on"] == pytest.approx(1.2 * 959.0 / 60.0, abs=1e-3)
    process = energy["process"]
    assert process["productivity_per_h"] == 2.0
    assert process["energy_efficiency"]["always_on"] == pytest.approx(0.3 / 1.5)
    assert process["energy_efficiency"]["off"] == pytest.approx(0.3 / 0.9, abs=1e-5)
    idle = 0.3 / (0.9 + 1.2 * 0.5 * 120.0 / 959.0)
    assert process["energy_efficiency"]["idle_reduction"] == pytest.approx(idle, abs=1e-5)


def test_bad_input_is_one_sentence(recording: Path, tmp_path: Path) -> None:
    model = Path(__file__).parents[2] / "config" / "simulated_machine_model.json"
    for arguments, sentence in (
        ((tmp_path / "none.csv",), "cannot be opened"),
        ((recording, "--model", recording), "JSON"),
        ((recording, "--model", model), "the model needs temperatures that it lacks"),
        ((recording, "--ambient", "U*"), "no temperature matches U*"),
        ((recording, "--cut-kwh", 1), "together"),
        ((recording, "--cut-kwh", 2, "--motor-kwh", 1, "--process-min", 5), "the motors bring the cutting energy"),
    ):
        result = run("report", *arguments)
        assert (result.exit_code, sentence in result.output) == (2, True), result.output
