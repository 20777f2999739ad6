"""Axis positions of a recording are inputs of models like temperatures, are watched like none, and must be read."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from expanding_axis import MAP as EXPANDING
from expanding_axis import ExpandingAxis
from searched_once import searched_once

from config.recordings.recording_map import load_recording_map
from daemon.cli import main
from daemon.model_release.loading import read_model
from drivers.files.recording_csv import read_recording
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.training.making import FIRST_POSITION_ID
from models.thermal.training.train_family import train_family

MAP = "time: t\nspeed: rpm\ntemperatures: ['t[0-9]*']\naxis_positions: ['*_mm']\ndisplacements: [c1]\n"


@pytest.fixture(autouse=True, scope="module")
def searches_once() -> Iterator[None]:
    """The family that is named and the one that is chosen are trained on the same day."""
    with searched_once():
        yield


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    return recorded(tmp_path)


def recorded(tmp_path: Path, stay_min: int = 30) -> tuple[Path, Path]:
    """A displacement that follows the spindle's heat, and where the Z axis has dwelt, which no sensor sees."""
    rng = np.random.default_rng(4)
    time_min = np.arange(720.0)
    rpm = np.where(time_min % 120.0 < 60.0, np.repeat([3000.0, 5000.0, 2000.0, 4000.0, 3500.0, 2500.0], 120), 0.0)
    z_mm = np.repeat(rng.uniform(0.0, 500.0, 720 // stay_min), stay_min)
    heat, dwelt_mm = lag_table(time_min, np.column_stack([(rpm / 5000.0) ** 2, z_mm]), (20.0,))[0].T
    degc = 21.0 + np.outer(heat, [9.0, 4.0]) + rng.normal(0.0, 0.02, (720, 2))
    um = 20.0 * heat + 0.05 * dwelt_mm + rng.normal(0.0, 0.05, 720)
    table = np.column_stack([60.0 * time_min, rpm, degc, z_mm, um])
    rows = [",".join(f"{value:.6g}" for value in row) for row in table]
    recording, columns = tmp_path / "day.csv", tmp_path / "map.yaml"
    recording.write_text("\n".join(["t,rpm,t1,t2,Z_mm,c1", *rows]) + "\n", encoding="utf-8")
    columns.write_text(MAP, encoding="utf-8")
    return recording, columns


def figures(recording: Path, columns: Path, *more: str) -> dict[str, Any]:
    arguments = [
        "thermal",
        "evaluate",
        str(recording),
        "--map",
        str(columns),
        "--train-hours",
        "0-8",
        "--model",
        "lags",
    ]
    result = CliRunner().invoke(main, [*arguments, "--test-hours", "8-12", *more, "--json", "-"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return found


def test_a_position_tells_what_no_temperature_does(files: tuple[Path, Path]) -> None:
    recording, columns = files
    with_position = figures(recording, columns, "--fault", "step:each:5degC@9h")
    assert [fault["sensor"] for fault in with_position["faults"]] == ["t1", "t2"]
    assert with_position["false_alarms"] == 0, "an axis that stands or travels is no broken sensor"
    columns.write_text(MAP.replace("axis_positions: ['*_mm']\n", ""), encoding="utf-8")
    without = figures(recording, columns)
    assert with_position["mean"]["rmse_um"] < 0.4 * without["mean"]["rmse_um"]


@pytest.mark.parametrize("family", ["ridge", "increments"])
def test_what_the_machine_would_get_of_a_model_with_positions_is_told_with_where_they_are_missing(
    tmp_path: Path, family: str
) -> None:
    recording, columns = recorded(tmp_path, stay_min=5)
    whole = figures(recording, columns, "--model", family)
    (test,) = whole["tests"]
    assert test["online"]["position_known"] == 1.0 and test["online"]["following"] > 0.9
    assert test["online"]["reduction_rmse"] == pytest.approx(test["reduction_rmse"], abs=0.05)
    assert whole["channels"]["c1"]["online"]["rmse_um"] == test["online"]["rmse_um"]
    head, *rows = recording.read_text(encoding="utf-8").splitlines()

    def without(first: int, last: int) -> dict[str, Any]:
        lost = [
            ",".join([*row.split(",")[:4], "", row.split(",")[5]]) if first <= i < last else row
            for i, row in enumerate(rows)
        ]
        gap = recording.with_name("gap.csv")
        gap.write_text("\n".join([head, *lost]) + "\n", encoding="utf-8")
        return figures(gap, columns, "--model", family, "--html", str(recording.with_name("gap.html")))

    short = without(500, 503)
    assert short["tests"][0]["online"]["position_known"] == pytest.approx(1.0 - 4.0 / 240.0)
    assert any("an axis position is not known for 2% of the time" in each for each in short["advice"])
    page = recording.with_name("gap.html").read_text(encoding="utf-8")
    assert "left on line, by confidence" in page and "an axis position is not known for 2% of the time" in page
    never = without(480, 481)
    online = never["tests"][0]["online"]
    assert (online["position_known"], online["following"], online["mean_confidence"]) == (0.0, 0.0, 0.0)
    assert online["reduction_rmse"] == pytest.approx(0.0), "nothing is followed, so nothing is worse"
    assert any("missing where the test begins" in each for each in never["advice"])


@pytest.mark.parametrize("family", ["increments", None])
def test_a_model_with_positions_is_trained_and_runs_where_they_are_read(
    files: tuple[Path, Path], family: str | None
) -> None:
    recording, columns = files
    model_file = recording.with_name("model.json")
    chosen = [] if family is None else ["--model", family]
    arguments = ["thermal", "train", str(recording), "--map", str(columns), *chosen, "-o", str(model_file)]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    model = model_from_json(model_file.read_text(encoding="utf-8"), "model.json")
    assert (model.sensor_names, model.axis_positions) == (("t1", "t2", "Z_mm"), ("Z_mm",))
    refused, why = read_model(model_file, range(1, 9), ("c1",))
    assert refused is None and "needs axis positions (Z_mm)" in why and "name them under cnc.axis_positions" in why
    assert read_model(model_file, range(1, 3), ("c1",), ("X_mm", "Z_mm"))[0] is not None
    assert model.sensor_ids == (1, 2, FIRST_POSITION_ID)
    refused, why = read_model(model_file, (1, 2, FIRST_POSITION_ID), ("c1",), ("Z_mm",))
    assert refused is None and "the ID of a sensor" in why
    plain = recording.with_name("plain.yaml")
    plain.write_text(MAP.replace("axis_positions: ['*_mm']\n", ""), encoding="utf-8")
    played = CliRunner().invoke(main, ["replay", str(recording), "--map", str(plain), "--model", str(model_file)])
    assert played.exit_code == 2 and "needs the axis position Z_mm, and the recording has none" in played.output
    report = ["thermal", "report", str(recording), "--map", str(columns), "--model", str(model_file)]
    assert CliRunner().invoke(main, report).exit_code == 0


def test_a_model_with_positions_watches_its_sensors_and_not_its_axes(files: tuple[Path, Path]) -> None:
    recording, columns = files
    day = read_recording(recording, load_recording_map(columns))
    model = train_family([day], "lags", sample_s=60.0, created="2026-01-01T00:00:00").model
    again = model_from_json(model.to_json(), "model.json")
    assert again.watch is not None and again.watch.layout.sensors == 2
    found = {}
    for fault_k in (0.0, 5.0):
        online = again.runtime(Machine(components=dict.fromkeys(again.sensor_ids, "head")))
        degc = day.temperatures_degc.copy()
        degc[600:, 0] += fault_k
        degc[500:520, 2] = np.nan
        for minute, (row, rpm) in enumerate(zip(degc, day.speed_rpm, strict=True)):
            if minute == 300:
                online.set_reference(OnlineReference(time_min=300.0, now_min=300.0, degc=row))
            online.on_sample(float(minute), row, float(rpm))
            if minute >= 300:
                estimation, _ = online.estimate(float(minute), row, np.zeros(3, dtype=np.bool_))
        assert estimation is not None
        found[fault_k] = (online.excluded, float(estimation.thermal_error_um[0]))
    assert found[0.0][0] == {} and found[5.0][0] == {1: "slew"}, "an axis that jumps or is lost is no broken sensor"
    assert found[5.0][1] == pytest.approx(found[0.0][1], abs=2.0)


def test_the_figures_of_a_slope_along_an_axis_are_in_um_per_m(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ExpandingAxis(11, 1.0).write(tmp_path / "day.csv")
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(EXPANDING.model_dump(exclude_unset=True)), encoding="utf-8")
    given = "thermal evaluate day.csv --map map.yaml --model ridge --train-hours 0-16 --test-hours 16-24 --json -"
    done = CliRunner().invoke(main, [*given.split(), "--html", "page.html"])
    assert done.exit_code == 0, done.output
    channels = json.loads(done.stdout)["channels"]
    assert channels["Z1_per_m"]["unit"] == "um/m" and "unit" not in channels["Z1"]
    assert "Z1_per_m [um/m]" in done.stderr
    page = (tmp_path / "page.html").read_text(encoding="utf-8").replace("\\u002f", "/")
    assert "Z1_per_m [um/m]" in page and page.count('"um/m"') == 2, "both drawings of the slope"
