"""`toolpoint thermal evaluate` and `train --model` from recordings on disk to figures and model files."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from searched_once import searched_once

from daemon.cli import main
from daemon.cli.thermal.evaluate import MODELS
from daemon.simulation.replaying import LEAST_SHARE
from daemon.workbench.thermal.choice_figures import choice_figures
from daemon.workbench.thermal.shortfalls import on_line_sentences
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.linear import LinearModel
from models.thermal.training.choice import Choice

MINUTES = 60
SPLIT = ("--train-hours", "0-4", "--test-hours", "4-6")
LONG, OF_LONG = 120, ("--train-hours", "0-8", "--test-hours", "8-12")
"""Where a sensor shall go its own way for hours."""


@pytest.fixture(autouse=True, scope="module")
def searches_once() -> Iterator[None]:
    """Most tests train on the same hours of the same day."""
    with searched_once():
        yield


def table(seed: int = 0, cycles: int = 6, minutes: int = MINUTES) -> dict[str, Any]:
    """On/off cycles at several speeds; three parts follow, four sensors and two channels see them."""
    rng = np.random.default_rng(seed)
    speeds = np.array([3000.0, 5000.0, 2000.0, 4000.0, 3500.0, 2500.0])[:cycles]
    rpm = np.concatenate([np.r_[np.full(minutes // 2, s), np.zeros(minutes // 2)] for s in speeds])
    time_min = np.arange(float(len(rpm)))
    quick, slow = lag_table(time_min, ((rpm / 5000.0) ** 2)[:, None], (8.0, 40.0))[:, :, 0]
    degc = 21.0 + np.column_stack([12.0 * quick, 8.0 * slow, 6.0 * quick + 5.0 * slow, 9.0 * slow + 2.0 * quick])
    degc += rng.normal(0.0, 0.02, degc.shape)
    um = np.column_stack([30.0 * slow, 15.0 * quick - 20.0 * slow]) + rng.normal(0.0, 0.05, (len(rpm), 2))
    names = {f"t{i + 1}": degc[:, i] for i in range(4)} | {"c1": um[:, 0], "c2": um[:, 1]}
    return {"t": 60.0 * time_min, "rpm": rpm, **names}


def write(path: Path, columns: dict[str, Any]) -> Path:
    rows = zip(*columns.values(), strict=True)
    text = [",".join("" if np.isnan(value) else f"{value:.6g}" for value in row) for row in rows]
    path.write_text("\n".join([",".join(columns), *text]) + "\n", encoding="utf-8")
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write(tmp_path / "day.csv", table())


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["thermal", "evaluate", *map(str, arguments)])


def figures(*arguments: object) -> dict[str, Any]:
    result = invoke(*arguments, "--json", "-")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return found


def test_a_fault_and_a_false_alarm_name_the_recording(tmp_path: Path) -> None:
    """Of several recordings whose hours are tested, one is meant."""
    columns = table(seed=1)
    columns["t2"][300:] += 40.0  # from hour 5 on, in the second recording alone
    days = [write(tmp_path / "day.csv", table()), write(tmp_path / "next.csv", columns)]
    done = invoke(*days, *SPLIT, "--model", "ridge", "--fault", "step:t1:5degC@4.5h")
    assert done.exit_code == 0, done.output
    assert "step t1 in day.csv: found after" in done.stderr and "step t1 in next.csv: found after" in done.stderr
    assert "t2 in next.csv after 1.0 h" in done.stderr and "in test" not in done.stderr


def test_the_json_holds_what_is_promised_and_nothing_else_is_on_standard_output(recording: Path) -> None:
    found = figures(recording, *SPLIT)
    promised = {"rmse_um", "max_um", "reduction_rmse", "reduction_max", "band_coverage", "band_width_um"}
    assert set(found["channels"]) == {"c1", "c2"}
    assert all(promised <= set(channel) for channel in found["channels"].values())
    assert set(found["mean"]) == promised | {"rmse_without_um", "online", "band"}
    for figures_of in (*found["channels"].values(), found["mean"]):
        assert set(figures_of["online"]) >= {"rmse_um", "reduction_rmse", "mean_confidence"}
        band = {"coverage": figures_of["band_coverage"], "width_um": figures_of["band_width_um"]}
        assert figures_of["band"] == pytest.approx(band)
    assert found["mean"]["max_um"] == max(channel["max_um"] for channel in found["channels"].values())
    for key in promised - {"max_um"}:
        assert found["mean"][key] == pytest.approx(np.mean([c[key] for c in found["channels"].values()]))
    assert (found["faults"], found["false_alarms"], found["refused"]) == ([], 0, None)
    assert found["mean"]["reduction_rmse"] > 0.8
    assert found["hyper_parameters"]["family"] == found["channels"]["c1"]["chosen"]["family"]
    for channel in found["channels"].values():
        assert channel["chosen"]["family"] in channel["candidates"] and channel["chosen"]["why"]
        assert set(channel["candidates"]) >= {"ridge", "increments", "lags"}
        assert all({"rmse_um", "reduction_rmse"} <= set(figures) for figures in channel["candidates"].values())


def test_what_is_gone_of_a_channel_that_is_noise_is_in_no_mean(tmp_path: Path) -> None:
    columns = table()
    columns["c3"] = np.random.default_rng(8).normal(0.0, 0.3, len(columns["t"]))
    found = figures(write(tmp_path / "day.csv", columns), *SPLIT, "--model", "ridge")
    channels, mean = found["channels"], found["mean"]
    assert channels["c3"]["reduction_rmse"] < 0.3 and mean["online"]["reduction_rmse"] > 0.8
    for key in ("reduction_rmse", "reduction_max"):
        assert mean[key] == pytest.approx(0.5 * (channels["c1"][key] + channels["c2"][key]))
        assert found["tests"][0][key] == pytest.approx(mean[key])
    assert mean["rmse_um"] == pytest.approx(np.mean([its["rmse_um"] for its in channels.values()]))


def test_what_the_machine_gets_is_told_beside_what_is_estimated(tmp_path: Path) -> None:
    columns = table(minutes=LONG)
    beyond = columns["t"] >= 8 * 3600.0
    for name in ("t1", "t2"):
        columns[name] = columns[name] + np.where(beyond, 0.03 * (columns["t"] - 8 * 3600.0), 0.0)
    path = write(tmp_path / "hot.csv", columns)
    usual = figures(write(tmp_path / "day.csv", table()), *SPLIT)["mean"]
    hot = figures(path, *OF_LONG)["mean"]
    assert usual["online"]["mean_confidence"] > 0.99
    late = usual["reduction_rmse"] - usual["online"]["reduction_rmse"]
    assert 0.005 < late < 0.02, "a part of 8 min is followed half a minute late, by means over a minute"
    assert hot["reduction_rmse"] < -0.1 and hot["online"]["mean_confidence"] < 0.7
    assert hot["online"]["reduction_rmse"] > -0.02, "what is far from training is not followed"


@pytest.mark.parametrize("model", MODELS)
def test_every_family_says_what_it_chose(recording: Path, model: str) -> None:
    found = figures(recording, *SPLIT, "--model", model)
    assert found["model"] == model and found["hyper_parameters"]
    assert found["mean"]["rmse_um"] > 0.0
    assert found["mean"]["online"]["mean_confidence"] > 0.7, "the daemon runs every family"
    assert all(test["online"]["following"] >= LEAST_SHARE for test in found["tests"]), "and follows it"


def test_runs_are_left_out_one_by_one_each_with_a_zero_of_its_own(tmp_path: Path) -> None:
    paths = []
    for number in range(3):
        columns = table(number)
        columns["c1"] = columns["c1"] + 1000.0 * number
        paths.append(write(tmp_path / f"run{number}.csv", columns))
    found = figures(*paths, "--leave-out-runs", "--model", "lags")
    assert [test["name"] for test in found["tests"]] == ["run0.csv", "run1.csv", "run2.csv"]
    assert found["mean"]["reduction_rmse"] > 0.9
    assert found["refused"] is None


def test_without_speed_hours_work_and_cycles_are_refused(tmp_path: Path) -> None:
    columns = table()
    del columns["rpm"]
    path = write(tmp_path / "silent.csv", columns)
    assert figures(path, *SPLIT)["hyper_parameters"]["speed_lags_min"] == []
    result = invoke(path, "--leave-out-cycles")
    assert (result.exit_code, "need a speed column" in result.stderr) == (2, True)


def test_probing_removes_what_no_temperature_tells(tmp_path: Path) -> None:
    columns = table()
    columns["c1"] = columns["c1"] + 6.0 * np.sin(columns["t"] / 60.0 / 90.0)
    recording = write(tmp_path / "wandering.csv", columns)
    lags = (recording, *SPLIT, "--model", "lags")
    without, probed = figures(*lags), figures(*lags, "--probe-minutes", 30)
    assert probed["channels"]["c1"]["rmse_um"] < 0.5 * without["channels"]["c1"]["rmse_um"]
    assert probed["mean"]["band_width_um"] < without["mean"]["band_width_um"]


@pytest.mark.parametrize("model", ["default", "lags"])
def test_faults_are_found_and_cost_little(recording: Path, model: str) -> None:
    found = figures(
        recording, *SPLIT, "--model", model, "--fault", "stuck:t1@4.5h", "--fault", "step:each:5degC@4.5h",
        "--fault", "open:t3@4.5h", "--fault", "drift:t2:4degC/h@4.5h",
    )  # fmt: skip
    kinds = [(fault["sensor"], fault["kind"]) for fault in found["faults"]]
    steps = [(f"t{number}", "step") for number in range(1, 5)]
    assert kinds == [("t1", "stuck"), *steps, ("t3", "open"), ("t2", "drift")]
    by_kind = {fault["kind"]: fault for fault in found["faults"]}
    assert by_kind["open"]["found_after_min"] == 0.0
    assert by_kind["stuck"]["found_after_min"] == pytest.approx(15.0, abs=10.0)
    assert by_kind["drift"]["found_after_min"] is not None
    worst = max(fault["max_ratio"] for fault in found["faults"])
    assert model == "default" or worst < 10.0
    assert worst * found["mean"]["max_um"] < 4.0, "of an error of 35 um; what is left without a fault is 0.2 um"
    assert found["false_alarms"] == 0


def test_a_machine_that_hardly_moves_is_refused_and_still_judged(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    columns = table()
    rows = len(columns["t"])
    for name in ("c1", "c2"):
        columns[name] = np.cumsum(rng.normal(0.0, 0.05, rows))
    found = figures(write(tmp_path / "steady.csv", columns), *SPLIT, "--model", "ridge")
    assert isinstance(found["refused"], str)
    assert found["mean"]["rmse_um"] is not None


def test_what_would_not_be_had_on_line_and_a_channel_that_is_made_worse_are_said_with_what_to_record(
    tmp_path: Path,
) -> None:
    columns = table()
    tested = columns["t"] >= 4 * 3600.0
    columns["c2"] = np.where(tested, -1.0, 1.0) * columns["c2"]
    columns["rpm"] = np.where(tested, 1.6, 1.0) * columns["rpm"]
    found = figures(write(tmp_path / "day.csv", columns), *SPLIT, "--model", "ridge")
    said = "\n".join(found["advice"])
    assert "channel c2: the model leaves" in said and "worse than no compensation" in said
    assert "record 2 more runs like that test" in said and "channel c1:" not in said
    assert "4 whole runs or cycles can be left out" in said, "a family that was asked for by name is advised too"
    online = found["tests"][0]["online"]
    assert set(online) - {"imputed_unsure"} == {"rmse_um", "reduction_rmse", "mean_confidence", "following"}
    faster = {"name": "test", "reduction_rmse": 0.9, "excluded": [], "online": online | {"reduction_rmse": 0.5}}
    (sentence,) = on_line_sentences([faster], {"test": ["spindle speed to 7000 1/min (training: 5000)"]})
    assert sentence.startswith("test: 90% of the error could be removed, on line it would be 50%")
    assert "it goes beyond training (spindle speed to 7000 1/min (training: 5000)): record 2 runs" in sentence
    assert on_line_sentences([faster | {"online": online | {"reduction_rmse": 0.85}}], {}) == []
    warm = faster | {"reduction_rmse": -0.31, "online": online | {"reduction_rmse": -0.0002, "following": 0.15}}
    (sentence,) = on_line_sentences([warm], {})
    assert sentence.startswith("test: the estimate makes the error 31% larger, on line it would be 0%, because")
    assert "follow for 15% of the time" in sentence and "begins without its past" in sentence
    gaps = faster | {"online": online | {"following": 0.6, "imputed_unsure": 0.3}}
    (sentence,) = on_line_sentences([gaps], {"test": ["t1 by 9 K (training: 8)"]})
    assert "for 30% of the time" in sentence and "fields are empty" in sentence and "beyond training" not in sentence
    unread = faster | {"online": online | {"following": 0.3, "speed_unread": 0.6}}
    (sentence,) = on_line_sentences([unread], {"test": ["t1 by 9 K (training: 8)"]})
    assert "for 60% of the time what the spindle did between rows that lie far apart" in sentence
    assert "record a row a minute" in sentence and "beyond training" not in sentence
    out = on_line_sentences([faster | {"excluded": [{"sensor": "t3"}]}] * 5, {})
    assert "sensors were excluded (t3)" in out[0] and out[-1] == "so it is in 2 more tests"


def test_a_logger_that_leaves_rows_out_is_why_less_would_be_had_on_line(tmp_path: Path) -> None:
    """A row when something changes: what the spindle did in seven minutes without one, no lag of its speed knows."""
    columns = table()
    minute = columns["t"] // 60.0
    columns["c1"] += 80.0 * lag_table(minute, np.square(columns["rpm"] / 5000.0)[:, None], (60.0,))[0, :, 0]
    kept = (columns["t"] < 4 * 3600.0) | (minute % 8 == 0)
    thin = {name: values[kept] for name, values in columns.items()}
    found = figures(write(tmp_path / "day.csv", thin), *SPLIT, "--model", "lags")
    assert found["tests"][0]["online"]["speed_unread"] > 0.3
    assert "what the spindle did between rows that lie far apart" in "\n".join(found["advice"])


def test_a_sensor_that_nothing_stands_in_for_is_why_less_would_be_had_on_line(tmp_path: Path) -> None:
    """Its range was left, too, but it does not count any more: recordings that go as far would not help."""
    columns = table(minutes=LONG)
    own_k = 3.0 * np.sin(columns["t"] / 3600.0)
    columns["t4"] = columns["t4"] + own_k + np.where(columns["t"] > 9.0 * 3600.0, 40.0, 0.0)
    columns["c1"] = columns["c1"] + 4.0 * own_k
    found = figures(write(tmp_path / "day.csv", columns), *OF_LONG, "--model", "ridge")
    online = found["tests"][0]["online"]
    assert online["following"] + online["imputed_unsure"] == pytest.approx(1.0) and online["imputed_unsure"] > 0.5
    (sentence,) = [one for one in found["advice"] if "on line it would be" in one]
    assert "what is imputed for excluded sensors (t4) may be off by more than 1 um" in sentence
    assert "beyond training" not in sentence and "record 2 more runs in which they do the same" in sentence


def test_families_that_differ_between_trainings_are_told_apart() -> None:
    """The name of one holds a comma."""
    families = {"a.csv": "lags", "b.csv": "half ridge, half gaussian", "c.csv": "lags", "d.csv": "gaussian"}
    made = {name: Choice(family=family, why="it leaves less", candidates=()) for name, family in families.items()}
    chosen = choice_figures(made, ["c1"])["c1"]["chosen"]
    said = "in 2 of 4 trainings, 'half ridge, half gaussian' in 1, 'gaussian' in 1; a.csv: it leaves less"
    assert chosen == {"family": "lags", "why": said}


def test_constant_and_lost_sensors_are_left_out_by_name(tmp_path: Path) -> None:
    columns = table()
    columns["t1"] = np.full_like(columns["t1"], 25.0)
    columns["t4"][50:200] = np.nan
    columns["t2"][300:] = np.nan
    found = figures(write(tmp_path / "dirty.csv", columns), *SPLIT, "--model", "lags")
    (test,) = found["tests"]
    assert set(test["temperatures_left_out"]) == {"t1", "t4"}
    assert any("t1: constant" in warning for warning in found["warnings"])
    assert found["mean"]["reduction_rmse"] > 0.3
    assert found["false_alarms"] == 0


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--train-hours", "0-4"), "say --train-hours and --test-hours"),
        (("--train-hours", "0-4", "--test-hours", "3-6"), "training and test hours overlap"),
        (("--train-hours", "0-4", "--test-hours", "50-60"), "there is no row in the test hours 50-60"),
        (("--train-hours", "0-0.05", "--test-hours", "4-6"), "of 3 training rows 3 are complete, for 4 temperatures"),
        (("--leave-out-runs",), "at least two recordings"),
        (("--leave-out-runs", "--leave-out-cycles"), "not both"),
        (("--leave-out-cycles", "--test-hours", "4-6"), "does not go with"),
        ((*SPLIT, "--model", "magic"), "'magic' is not one of"),
        ((*SPLIT, "--fault", "step:t1@9h"), "a step needs an amount such as 1degC"),
        ((*SPLIT, "--fault", "melted:t1@9h"), "is no fault"),
        ((*SPLIT, "--probe-minutes", "0"), "probe-minutes"),
        ((*SPLIT, "--map", "/nonexistent/map.yaml"), "map.yaml"),
    ],
)
def test_bad_usage_ends_with_a_sentence_and_status_2(
    recording: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    result = invoke(recording, *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert sentence in result.stderr


@pytest.mark.parametrize("model", ["default", "gaussian", "lasso"])
def test_a_family_is_trained_into_a_file(recording: Path, tmp_path: Path, model: str) -> None:
    output = tmp_path / "m.json"
    arguments = ["thermal", "train", str(recording), "--model", model, "-o", str(output), "--json", "-"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    made = model_from_json(output.read_text("utf-8"), str(output))
    assert isinstance(made, LinearModel)
    assert model == "default" or bool(made.layout.lags_min) == (model in ("lags", "gaussian"))
    assert made.refused == found["refused"]
    assert (found["model"]["model_id"], found["hyper_parameters"] != {}) == (made.model_id, True)
    assert made.sensor_ids == (1, 2, 3, 4)


@pytest.mark.parametrize("method", ["forward", "lasso", "clusters"])
def test_sensors_are_compared_on_what_is_left_out(recording: Path, method: str) -> None:
    arguments = ["thermal", "sensors", str(recording), "--method", method, "--most", "3", "--json", "-"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert [step["count"] for step in found["selected"]] == [1, 2, 3]
    assert {price["sensor"] for price in found["prices"]} == {"t1", "t2", "t3", "t4"}
    assert found["folds"] == "cycle" and found["warnings"] == []


def test_the_comparison_of_sensors_names_those_that_cannot_be_compared(recording: Path, tmp_path: Path) -> None:
    head, *rows = recording.read_text("utf-8").splitlines()
    at = head.split(",").index("t2")
    (path := tmp_path / "dead.csv").write_text(
        "\n".join([head, *(",".join("20" if i == at else f for i, f in enumerate(r.split(","))) for r in rows)]),
        "utf-8",
    )
    result = CliRunner().invoke(main, ["thermal", "sensors", str(path), "--most", "1"])
    assert "warning: dead.csv: column t2: constant at 20 over the whole recording" in result.stderr, "it said nothing"


def test_many_cycles_are_left_out_in_twelve_parts_as_in_training(tmp_path: Path) -> None:
    """Each of 72 tool changes was tested on the others, one training for each, of which its neighbours tell it."""
    columns = table()
    columns["rpm"] = np.where(np.arange(len(columns["t"])) % 5 < 3, columns["rpm"].max(), 0.0)
    found = figures(write(tmp_path / "day.csv", columns), "--leave-out-cycles", "--model", "ridge")
    names = [test["name"] for test in found["tests"]]
    assert (len(names), names[0], names[-1]) == (12, "cycles 1 to 6", "cycles 67 to 72")
    assert sum(test["rows"] for test in found["tests"]) == len(columns["t"])
