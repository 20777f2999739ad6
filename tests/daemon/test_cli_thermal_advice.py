"""What a new user is told whose recordings support less of a model than there could be, and what to record next."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from searched_once import searched_once
from thermal_runs import WEIGHTS, run

from daemon.cli import main
from models.thermal.family import model_from_json


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


def test_a_cycle_that_goes_against_the_others_is_no_sensor_that_was_mounted_the_wrong_way_round(tmp_path: Path) -> None:
    """Nobody turns a sensor round within a recording, and without the recording nothing would be left."""
    parts = [np.loadtxt(run(tmp_path, number, turned=number == 1), delimiter=",", skiprows=1) for number in range(1, 6)]
    table = np.vstack([np.pad(part[:150], ((0, 30), (0, 0)), mode="edge") for part in parts])
    path, table[:, 0] = tmp_path / "long.csv", 60.0 * np.arange(len(table))
    table[np.arange(len(table)) % 180 >= 150, 1] = 0.0
    np.savetxt(path, table, delimiter=",", header="t,rpm,T1,T2,T3,c1,c2", comments="", fmt="%.9g")
    found = evaluated(path, "--leave-out-cycles")
    assert found["tests"][0]["reduction_rmse"] < 0.0
    assert "the wrong way round" not in advice(found)


def test_of_a_channel_that_is_noise_an_evaluation_asks_for_one_thing(tmp_path: Path) -> None:
    """Neither its sign nor its wiring is wrong, and more runs of the kind bring nothing."""
    paths = [run(tmp_path, number, weights=WEIGHTS * [1.0, 0.0]) for number in range(4, 8)]
    found = evaluated(*paths, "--leave-out-runs")
    assert found["channels"]["c2"]["reduction_rmse"] < 0.0
    said = [sentence for sentence in found["advice"] if "channel c2" in sentence]
    assert len(said) == 1 and "no more than its noise" in said[0]


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


def test_too_few_runs_are_told_how_many_more_how_long_and_how(tmp_path: Path) -> None:
    found = trained(tmp_path, *[run(tmp_path, number) for number in (1, 2, 3)])
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
