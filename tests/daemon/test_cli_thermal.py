"""`toolpoint thermal train` from recordings on disk to a model file."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from daemon.cli import main
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel

WEIGHTS = np.array([[1.5, 0.0], [-2.0, 1.0], [0.0, 3.0]])


def day(folder: Path, seed: int, rows: int = 240) -> Path:
    rng = np.random.default_rng(seed)
    temperatures = 20.0 + np.cumsum(rng.normal(0.0, 0.05, (rows, 3)), axis=0)
    displacements = (temperatures - temperatures[0]) @ WEIGHTS
    table = np.column_stack([60.0 * np.arange(rows), np.zeros(rows), temperatures, displacements])
    path = folder / f"day{seed}.csv"
    np.savetxt(path, table, delimiter=",", header="t,rpm,T4,T2,T9,c1,c2", comments="", fmt="%.9g")
    return path


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["thermal", "train", *map(str, arguments)])


def test_a_model_is_written_and_the_outcome_is_json_alone(tmp_path: Path) -> None:
    output = tmp_path / "m.json"
    result = invoke(day(tmp_path, 1), day(tmp_path, 2), "--interval-min", 1, "-o", output, "--json", "-")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["held_out"]["folds"] == ["day1.csv", "day2.csv"]
    assert set(found["held_out"]["channels"]["c1"]) == {"without", "with"}
    assert found["held_out"]["channels"]["c1"]["with"]["rmse_um"] < 1e-3
    assert "left out in turn: day1.csv, day2.csv" in result.stderr
    model = model_from_json(output.read_text(), str(output))
    assert model.model_id == found["model"]["model_id"]
    assert (model.sensor_ids, model.sensor_names) == ((4, 2, 9), ("T4", "T2", "T9"))
    assert isinstance(model, LinearModel)
    np.testing.assert_allclose(model.coefficients(), WEIGHTS, atol=1e-4)
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_every_option_reaches_the_model(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(
        "{time: t, temperatures: ['T[24]'], displacements: ['c*'], sample_s: 120}\n", encoding="utf-8"
    )
    output = tmp_path / "m.json"
    result = invoke(
        day(tmp_path, 1), "--map", tmp_path / "map.yaml", "--hours", "1-3", "--interval-min", 4, "--ridge", 0.5,
        "--b0", "--channels", "c2", "-o", output,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    model = model_from_json(output.read_text(), str(output))
    assert isinstance(model, LinearModel) and model.kind == "ridge"
    score = model.hyper_parameters["held_out_relative_rmse"]
    assert model.hyper_parameters == {
        "interval_min": 4.0, "intercept": True, "ridge_k2": 0.5, "held_out_relative_rmse": score,
        "held_out_relative_rmse_by_channel": [score],
    }  # fmt: skip
    assert 0.0 < score < 1.0
    assert (model.channels, model.sensor_names) == (("c2",), ("T4", "T2"))
    assert (model.training[0].from_hours, model.training[0].rows) == (1.0, 120)
    assert model.drift_um_per_min[0] != 0.0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--ridge", "much"), "'much' is neither a number nor auto"),
        (("--ridge", "-1"), "a penalty is positive"),
        (("--hours", "32"), "are not two hours such as 0-32"),
        (("--hours", "5-2"), "the first hour must lie before the last"),
        (("--hours", "50-60"), "there is no row in hours 50 to 60"),
        (("--interval-min", "0"), "interval-min"),
        (("--interval-min", "1.5"), "no multiple of the 60 s"),
        (("--channels", "c7"), "there is no displacement channel c7; there are c1, c2"),
        (("--map", "/nonexistent/map.yaml"), "map.yaml"),
    ],
)
def test_bad_usage_ends_with_a_sentence_and_status_2(tmp_path: Path, options: tuple[str, ...], sentence: str) -> None:
    output = tmp_path / "m.json"
    result = invoke(day(tmp_path, 1), *options, "-o", output)
    assert result.exit_code == 2
    assert sentence in result.stderr
    assert result.stdout == ""
    assert not output.exists()


def test_training_never_loads_a_fitting_library() -> None:
    code = "import sys, daemon.workbench.thermal.training; print(sorted({'sklearn', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
