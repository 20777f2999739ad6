"""`toolpoint thermal campaign`: recordings of the simulated machine that any recording's reader understands."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from daemon.cli import main

PROGRAMME = """
name: short
minutes: 24
series:
  - operations:
      - {dataset: 2, speeds_rpm: [12000.0], minutes_each: 14, idle_reduction: true, cooling: cold start, usage: train}
      - {speeds_rpm: [4000.0], minutes_each: 10}
      - {dataset: 1, speeds_rpm: [6000.0], minutes_each: 10, previous: "4000", usage: test}
"""


def run(folder: Path, programme: Path, *more: object) -> Result:
    arguments = ["thermal", "campaign", folder, "--programme", programme, *more]
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def programme(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("programme") / "short.yaml"
    path.write_text(PROGRAMME, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, programme: Path) -> Path:
    out = tmp_path_factory.mktemp("campaign") / "out"
    result = run(out, programme, "--seed", 3)
    assert result.exit_code == 0, result.output
    return out


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(folder: Path, programme: Path, tmp_path: Path) -> None:
    for seed, same in ((3, True), (4, False)):
        assert run(tmp_path / str(seed), programme, "--seed", seed).exit_code == 0
        again = (tmp_path / str(seed) / "dataset-02.csv").read_bytes().split(b"\n", 12)[-1]
        assert (again == (folder / "dataset-02.csv").read_bytes().split(b"\n", 12)[-1]) is same


def test_bad_input_is_one_sentence(programme: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = run(tmp_path, programme)
    assert (result.exit_code, "holds other files" in result.output) == (2, True)
    bad = tmp_path / "bad.yaml"
    bad.write_text(
        PROGRAMME.replace("dataset: 1", "dataset: 2").replace("minutes_each: 14", "minutes_each: 90"), "utf-8"
    )
    result = run(tmp_path / "out", bad)
    assert result.exit_code == 2
    assert "data set 2 stands here more than once" in result.output
    assert "takes 90 min where an operation has 24" in result.output
