"""Axis positions of a recording are inputs of models like temperatures, are watched like none, and must be read."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from searched_once import searched_once

from daemon.cli import main
from daemon.model_release.loading import read_model
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.training.making import FIRST_POSITION_ID

MAP = "time: t\nspeed: rpm\ntemperatures: ['t[0-9]*']\naxis_positions: ['*_mm']\ndisplacements: [c1]\n"


@pytest.fixture(autouse=True, scope="module")
def searches_once() -> Iterator[None]:
    """The family that is named and the one that is chosen are trained on the same day."""
    with searched_once():
        yield


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A displacement that follows the spindle's heat, and where the Z axis has dwelt, which no sensor sees."""
    rng = np.random.default_rng(4)
    time_min = np.arange(720.0)
    rpm = np.where(time_min % 120.0 < 60.0, np.repeat([3000.0, 5000.0, 2000.0, 4000.0, 3500.0, 2500.0], 120), 0.0)
    z_mm = np.repeat(rng.uniform(0.0, 500.0, 24), 30)
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
    arguments = ["thermal", "evaluate", str(recording), "--map", str(columns), "--train-hours", "0-8"]
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


@pytest.mark.parametrize("family", ["default", "ridge", "increments", None])
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
    played = CliRunner().invoke(main, ["replay", str(recording), "--map", str(columns), "--model", str(model_file)])
    assert played.exit_code == 2 and "axis positions" in played.output
    report = ["thermal", "report", str(recording), "--map", str(columns), "--model", str(model_file)]
    assert CliRunner().invoke(main, report).exit_code == 0


def test_a_position_is_compared_with_the_sensors_but_cannot_fail(files: tuple[Path, Path]) -> None:
    recording, columns = files
    compared = CliRunner().invoke(main, ["thermal", "sensors", str(recording), "--map", str(columns), "--json", "-"])
    assert "Z_mm" in json.loads(compared.stdout)["order"]
    arguments = ["thermal", "evaluate", str(recording), "--map", str(columns), "--train-hours", "0-8"]
    broken = CliRunner().invoke(main, [*arguments, "--test-hours", "8-12", "--fault", "open:Z_mm@9h"])
    assert broken.exit_code == 2 and "there is no temperature Z_mm; there are t1, t2" in broken.output


def test_a_column_is_a_position_or_something_else(files: tuple[Path, Path]) -> None:
    recording, columns = files
    columns.write_text(MAP.replace("'*_mm'", "'t1'"), encoding="utf-8")
    result = CliRunner().invoke(main, ["thermal", "report", str(recording), "--map", str(columns)])
    assert result.exit_code == 2 and "t1 would be temperature and axis position at once" in result.output
