"""Bad usage of the commands that start a simulated machine: refused in a sentence before anything starts."""

import math

import pytest
from click.testing import CliRunner

from config.records.commissioning import CommissioningError, load_commissioning
from daemon.cli import main
from daemon.cli.simulate.demo import simulation_folder
from daemon.model_release.loading import read_model
from daemon.simulation import SimulationError


def refused(*arguments):
    """Run a command that must refuse; return what it says."""
    finished = CliRunner().invoke(main, [*map(str, arguments)])
    assert finished.exit_code == 2 and isinstance(finished.exception, SystemExit), finished.output
    assert finished.stdout == ""
    return finished.stderr


@pytest.mark.parametrize("number", ["inf", "-inf", "nan"])
@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--headless", "--minutes"),
        ("demo", "--headless", "--speed"),
        ("replay", "--speed"),
        ("replay", "--from-hours"),
        ("replay", "--to-hours"),
        ("simulate", "--until-s"),
        ("simulate", "--report-s"),
        ("thermal", "train", "--interval-min"),
    ],
)
def test_numbers_that_are_not_finite_are_bad_usage(arguments, number):
    finished = CliRunner().invoke(main, [*arguments, number])
    assert finished.exit_code == 2
    assert arguments[-1] in finished.stderr
    assert "finite" in finished.stderr or "range" in finished.stderr


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("- {kind: noise\n", "not YAML"),
        ("- {kind: earthquake, at_s: 1}\n", "earthquake"),
        ("- {kind: noise, at_s: 1, target: nowhere}\n", "no line is called 'nowhere'"),
    ],
)
def test_a_fault_script_is_read_before_anything_starts(tmp_path, script, words):
    path = tmp_path / "faults.yaml"
    path.write_text(script, encoding="utf-8")
    assert words in refused("demo", "--headless", "--faults", path, "--directory", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_that_breaks_off_shows_the_end_of_logs_that_are_removed(capsys):
    with pytest.raises(SystemExit) as ended, simulation_folder(None) as folder:
        (folder / "daemon.log").write_text("".join(f"line {number}\n" for number in range(9)), encoding="utf-8")
        (folder / "simulator.log").write_text("port taken\n", encoding="utf-8")
        raise SimulationError("the daemon ended with status 3")
    said = capsys.readouterr().err
    assert ended.value.code == 1 and not folder.exists()
    assert "status 3" in said and "line 4" in said and "line 8" in said and "port taken" in said
    assert "line 3" not in said and str(folder) not in said


def recording_and_model(folder, names=("T1", "T2"), channels=("Y1", "Z1")):
    """Write a recording; train a model on it; return both paths."""
    path = folder / "warm_up.csv"
    rows = [",".join(("time", *names, *channels))]
    for minute in range(120):
        first, second = 20.0 + 5.0 * (1 - math.exp(-minute / 30)), 20.0 + 3.0 * (1 - math.exp(-minute / 50))
        values = (first, second, *(factor * (first - 20.0) + second - 20.0 for factor in range(2, 2 + len(channels))))
        rows.append(",".join([str(60 * minute), *(f"{value:.5f}" for value in values)]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    model = folder / "model.json"
    trained = CliRunner().invoke(main, ["thermal", "train", str(path), "--model", "ridge", "-o", str(model)])
    assert trained.exit_code == 0, trained.stderr
    return path, model


def test_a_replay_refuses_a_model_that_is_none(tmp_path):
    recording, model = recording_and_model(tmp_path)
    for content, words in ((b"\xff\xfe", "UTF-8"), (model.read_bytes()[:-40], "not JSON")):
        (tmp_path / "broken.json").write_bytes(content)
        said = refused("replay", recording, "--model", tmp_path / "broken.json", "--directory", tmp_path / "run")
        assert "broken.json" in said and words in said
    assert not (tmp_path / "run").exists()


def test_a_replay_refuses_a_model_of_other_columns(tmp_path):
    recording, model = recording_and_model(tmp_path)
    text = recording.read_text(encoding="utf-8")
    for columns, words in (
        ("T1,T02,Y1,Z1", "the model needs the temperature 'T2', and the r"),
        ("T1,T2,X1,X2", "the model estimates Y1, Z1, and the recording has X1, X2"),
    ):
        (tmp_path / "other.csv").write_text(text.replace("T1,T2,Y1,Z1", columns, 1), encoding="utf-8")
        assert words in refused("replay", tmp_path / "other.csv", "--model", model, "--directory", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_binary_files_are_named_as_such(tmp_path):
    path = tmp_path / "binary.json"
    path.write_bytes(b"\x80\x81")
    assert "not UTF-8" in read_model(path, (), ())[1]
    with pytest.raises(CommissioningError, match="not UTF-8"):
        load_commissioning(path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("demo", "--minutes", "5 min"), "'5 min' is not a valid number"),
        (("history", "--limit", "2.5"), "valid whole number"),
    ],
)
def test_what_is_no_number_is_called_so_and_no_float(arguments: tuple[str, ...], words: str) -> None:
    refused = CliRunner().invoke(main, arguments)
    assert refused.exit_code == 2 and words in refused.output


def test_an_unknown_command_gets_a_suggestion() -> None:
    refused = CliRunner().invoke(main, ["statsu"])
    assert refused.exit_code == 2 and "No such command 'statsu'; did you mean 'status'?" in refused.output
    assert "`toolpoint --help` lists all" in CliRunner().invoke(main, ["xyzzy"]).output
