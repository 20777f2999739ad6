"""What a new user is told whose recordings support less of a model than there could be, and what to record next."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from searched_once import searched_once
from thermal_runs import WEIGHTS, run

from daemon.cli import main
from drivers.files.recording_csv import read_recording
from models.thermal.family import model_from_json
from models.thermal.linear import LinearModel
from models.thermal.training.choice import ChosenProblem
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import Recipe


@pytest.fixture(autouse=True, scope="module")
def searches_once() -> Iterator[None]:
    """Several are trained on the same runs, with other words on the command line."""
    with searched_once():
        yield


def trained(folder: Path, *arguments: object, model: str = "ridge") -> dict[str, Any]:
    """Train as a user does; a model is always written, and loads."""
    output = folder / "model.json"
    result = CliRunner().invoke(
        main, ["thermal", "train", *map(str, arguments), "--model", model, "-o", str(output), "--json", "-"]
    )
    assert result.exit_code == 0, result.output
    assert model_from_json(output.read_bytes(), str(output)).model_id
    found: dict[str, Any] = json.loads(result.stdout)
    assert all(sentence in result.stderr for sentence in found["advice"])
    return found | {"said": result.stderr}


def advice(found: dict[str, Any]) -> str:
    return "\n".join(found["advice"])


def test_enough_good_runs_get_no_advice(tmp_path: Path) -> None:
    found = trained(tmp_path, *[run(tmp_path, number) for number in range(1, 7)])
    assert (found["advice"], found["refused"]) == ([], None)


def test_a_reversed_channel_is_named_and_left_out_on_request(tmp_path: Path) -> None:
    paths = [run(tmp_path, number, turned=number == 4) for number in range(1, 8)]
    found = trained(tmp_path, *paths)
    assert "recording run04.csv contradicts the others: its channel c1 moves against" in advice(found)
    assert "--without run04.csv" in advice(found)
    without = trained(tmp_path, *paths, "--without", "run04.csv")
    assert without["advice"] == [] and without["recordings_left_out"] == ["run04.csv"]
    assert "left out on request: run04.csv" in without["said"]
    assert without["held_out"]["relative_rmse"] < 0.5 * found["held_out"]["relative_rmse"]


@pytest.mark.parametrize(("model", "runs"), [("ridge", 12), ("lags", 5)])
def test_a_reversed_run_is_named_once_by_an_evaluation_with_every_family(tmp_path: Path, model: str, runs: int) -> None:
    """The channel as a whole is better off with the model, so its pooled figures do not tell."""
    paths = [run(tmp_path, number, turned=number == 4) for number in range(1, runs + 1)]
    found = evaluated(*paths, "--leave-out-runs", model=model)
    assert model != "ridge" or found["channels"]["c1"]["reduction_rmse"] > 0.0
    named = [sentence for sentence in found["advice"] if "the wrong way round" in sentence]
    assert len(named) == 1 and named[0].startswith("run04.csv: c1 reads the wrong way round")


def test_of_two_runs_that_contradict_each_other_nobody_knows_which_is_reversed(tmp_path: Path) -> None:
    found = evaluated(*[run(tmp_path, number, turned=number == 2) for number in (1, 2)], "--leave-out-runs")
    assert not any("the wrong way round" in sentence for sentence in found["advice"])


def test_an_evaluation_counts_what_was_recorded_and_not_what_each_training_is_left_with(tmp_path: Path) -> None:
    four = [run(tmp_path, number) for number in range(1, 5)]
    found = evaluated(*four, "--leave-out-runs")
    assert [sentence[:70] for sentence in found["advice"]] == [advice(trained(tmp_path, *four))[:70]]
    assert "4 whole runs or cycles can be left out" in advice(found) and "record 1 more run of" in advice(found)
    assert evaluated(*four, run(tmp_path, 5), "--leave-out-runs")["advice"] == []


def evaluated(*arguments: object, model: str = "ridge") -> dict[str, Any]:
    result = CliRunner().invoke(main, ["thermal", "evaluate", *map(str, arguments), "--model", model, "--json", "-"])
    assert result.exit_code == 0, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    assert all(sentence in result.stderr for sentence in found["advice"])
    return found


def test_a_machine_that_was_changed_is_seen_and_the_recent_runs_are_trained_on_request(tmp_path: Path) -> None:
    other = WEIGHTS * np.array([[0.3], [1.0], [6.0]])
    paths = [run(tmp_path, number, weights=other if number > 5 else WEIGHTS) for number in range(1, 10)]
    found = trained(tmp_path, *paths)
    assert "from recording run06.csv on the machine behaves otherwise" in advice(found)
    assert "--recent 4" in advice(found)
    recent = trained(tmp_path, *paths, "--recent", "4")
    assert [data["name"] for data in recent["training"]] == [f"run{n:02}.csv" for n in range(6, 10)]
    assert recent["held_out"]["relative_rmse"] < 0.5 * found["held_out"]["relative_rmse"]
    assert recent["recordings_left_out"] == [f"run{n:02}.csv" for n in range(1, 6)]


def test_of_runs_that_leave_hardly_anything_nobody_is_told_that_the_machine_changed(tmp_path: Path) -> None:
    other = WEIGHTS * np.array([[1.0], [1.0], [2.5]])
    paths = [run(tmp_path, number, weights=other if number > 5 else WEIGHTS) for number in range(1, 10)]
    found = trained(tmp_path, *paths)
    assert found["held_out"]["relative_rmse"] < 0.05 and "behaves otherwise" not in advice(found)


@pytest.mark.parametrize("model", ["ridge", "default"])
def test_too_few_runs_are_told_how_many_more_how_long_and_how(tmp_path: Path, model: str) -> None:
    found = trained(tmp_path, *[run(tmp_path, number) for number in (1, 2, 3)], model=model)
    assert "3 whole runs or cycles can be left out" in advice(found)
    assert "record 2 more runs of about 3 h, each from a machine at rest" in advice(found)


def test_one_run_alone_is_told_what_to_record_and_not_to_be_used_unproved(tmp_path: Path) -> None:
    found = trained(tmp_path, run(tmp_path, 1, minutes=100), model="default")
    assert "the longest run lasts 99 min" in advice(found) and "more runs of about" in advice(found)


def test_a_family_that_two_runs_cannot_support_is_not_taken_and_that_is_said(tmp_path: Path) -> None:
    """Asked for by name, two warm-ups without a cycle: the model is of ridges, and must not be taken for the other."""
    paths = [warm_up(tmp_path, number) for number in (1, 2)]
    found = trained(tmp_path, *paths, model="gaussian")
    assert found["chosen"]["family"] == "lags" and "fewer than three whole runs" in found["chosen"]["why"]
    asked = "chosen: lags; gaussian was asked for by name, but the model holds no Gaussian process: fewer than three"
    assert asked in found["said"]
    assert "asked for by name" not in trained(tmp_path, *paths, model="lags")["said"]


def test_a_family_on_temperatures_that_is_asked_for_is_fitted_alone_on_two_runs(tmp_path: Path) -> None:
    """The default averages a ridge where two runs do not tell; who asks for increments gets least squares of them."""
    paths = [run(tmp_path, number) for number in (2, 3)]
    found = trained(tmp_path, *paths, model="increments")
    assert found["chosen"] is None and "half" not in found["said"]
    made = model_from_json((tmp_path / "model.json").read_bytes(), "model.json")
    assert isinstance(made, LinearModel)
    tables = [np.loadtxt(path, delimiter=",", skiprows=1) for path in paths]
    steps = np.vstack([np.diff(table, axis=0) for table in tables])
    same_speed = steps[:, 1] == 0.0
    expected = np.linalg.lstsq(steps[same_speed, 2:5], steps[same_speed, 5:], rcond=None)[0]
    np.testing.assert_allclose(made.solutions[0].weights, expected, rtol=1e-6)


def test_half_a_ridge_says_that_it_stands_for_a_family_that_no_mean_can_hold(tmp_path: Path) -> None:
    families = Recipe(name="two", kind="two", prepare=partial(ChosenProblem, ("pls", "lags")), lags=True)
    problem = prepare([read_recording(run(tmp_path, number)) for number in (2, 3)], 60.0, families).problem
    assert isinstance(problem, ChosenProblem) and problem.choice.family == "half ridge, half lags"
    assert problem.choice.why.endswith(
        "half a ridge on temperatures, as no mean can hold pls: --model pls is that alone"
    )


def warm_up(folder: Path, number: int) -> Path:
    """Write a run that is one warm-up: its first speed lasts half of it, then the spindle stands."""
    path = run(folder, number)
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    spread = [row.split(",") for row in rows]
    turning = [[time, "4000" if n < 90 else "0", *rest] for n, (time, _, *rest) in enumerate(spread)]
    path.write_text("\n".join([head, *map(",".join, turning)]) + "\n", encoding="utf-8")
    return path


def test_a_channel_that_never_moves_is_named(tmp_path: Path) -> None:
    still = WEIGHTS * np.array([1.0, 0.0])
    found = trained(tmp_path, *[run(tmp_path, number, weights=still) for number in range(1, 7)])
    assert "channel c2 moved by" in advice(found) and "record runs in which its axis warms" in advice(found)
    assert "c1" not in advice(found)


def test_blocks_of_one_run_are_no_runs_that_tell_families_apart(tmp_path: Path) -> None:
    """It said to record five more runs, and in the next line three more."""
    path = run(tmp_path, 1)
    text = path.read_text(encoding="utf-8").splitlines()
    path.write_text("".join(",".join(line.split(",")[:1] + line.split(",")[2:]) + "\n" for line in text), "utf-8")
    found = trained(tmp_path, path, model="default")
    assert "record 5 more runs of about 4 h" in advice(found)
    assert "To tell them apart record 8 more runs in all, each at speeds" in advice(found)


def test_families_that_cannot_be_told_apart_are_named_with_what_would_tell_them(tmp_path: Path) -> None:
    found = trained(tmp_path, *[run(tmp_path, number) for number in range(1, 6)], model="default")
    assert "these recordings cannot tell '" in advice(found) and "apart, which leave the same" in advice(found)
    assert "record 3 more runs, each at speeds and with pauses that no run has had yet" in advice(found)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--without", "run09.csv"), "there is no such recording; there are run01.csv, run02.csv"),
        (("--recent", "3"), "there are 2 recordings; name a smaller number"),
        (("--without", "run01.csv", "--without", "run02.csv"), "leave one of them in"),
    ],
)
def test_what_cannot_be_left_out_is_said(tmp_path: Path, arguments: tuple[str, ...], sentence: str) -> None:
    paths = [str(run(tmp_path, number)) for number in (1, 2)]
    command = ["thermal", "train", *paths, *arguments, "--model", "ridge", "-o", str(tmp_path / "m.json")]
    result = CliRunner().invoke(main, command)
    assert (result.exit_code, sentence in result.stderr) == (2, True), result.output


def test_a_recording_that_is_given_twice_is_refused_by_training_as_by_an_evaluation(tmp_path: Path) -> None:
    """Left out in turn it would be predicted by a model that had seen it, under whatever name."""
    paths = [run(tmp_path, number) for number in (1, 2)]
    (copy := tmp_path / "copy.csv").write_bytes(paths[0].read_bytes())
    command = ["thermal", "train", *map(str, (*paths, copy)), "--model", "ridge", "-o", str(tmp_path / "m.json")]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 2, result.output
    assert "copy.csv: recordings 1 and 3 hold the same temperatures; give each run once" in result.stderr


def test_who_names_no_family_gets_the_one_that_the_recordings_support_best(tmp_path: Path) -> None:
    paths = [str(run(tmp_path, number)) for number in range(1, 4)]
    arguments = ["thermal", "train", *paths, "-o", str(tmp_path / "model.json"), "--json", "-"]
    of_increments = "this is the model of increments; without its options the family is taken that"
    for options, increments in (((), False), (("--b0",), True), (("--model", "ridge"), False)):
        result = CliRunner().invoke(main, [*arguments, *options])
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)
        assert (of_increments in result.stderr) is ("increments" in found) is increments
        assert (found["chosen"] is not None) is (not options)


@pytest.mark.parametrize(("model", "two"), [("ridge", False), ("lags", True)])
def test_two_figures_of_what_is_left_are_told_for_what_each_is(tmp_path: Path, model: str, two: bool) -> None:
    """Shares of members that were chosen on what was left out leave less of it than shares chosen without it."""
    found = trained(tmp_path, *[run(tmp_path, number) for number in (1, 2, 3)], model=model)
    remains = found["held_out"]["relative_rmse"]
    assert f"{remains:.1%} of the error remains there" in found["said"]
    assert ("in which it had a say; had it none, " in found["said"]) is two
    if two:
        unseen = found["chosen"]["relative_rmse"]
        assert unseen > remains and f"had it none, {unseen:.1%} would" in found["said"]
