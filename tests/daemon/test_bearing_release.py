"""The bearing model of the spindle speed is released as thermal models are: deny by default, record, way back."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from model_folder import open_folder
from other_user import OTHER, as_root, as_user
from speed_machine import bearing_model, speed_machine

from config.schema import Configuration
from config.schema.temperatures import TemperaturesConfig
from daemon.cli import main
from daemon.model_release.bearings import BEARINGS, open_planning
from daemon.model_release.file_access import Account, own_account
from daemon.model_release.releasing import release, rollback
from daemon.model_release.repository import ReleaseError
from models.thermomechanics.artifact import model_to_json

STRANGER = Account(user_id=OTHER)


@pytest.fixture
def folder() -> Iterator[Path]:
    with open_folder() as folder:
        (folder / "models").mkdir()
        (folder / "state").mkdir()
        yield folder


def configured(folder: Path, *, lenient: bool = False) -> Configuration:
    configuration = speed_machine(folder, thermomechanical_model=folder / "models/bearings.json")
    compensation = configuration.compensation.model_copy(update={"allow_writable_model_directory": lenient})
    return configuration.model_copy(update={"compensation": compensation})


def proposed(folder: Path, name: str = "a", stiffening_per_k: float = 0.02) -> Path:
    path = folder / f"{name}.json"
    model = replace(bearing_model(stiffening_per_k=stiffening_per_k), model_id=f"bearings-{name}")
    path.write_text(model_to_json(model), encoding="utf-8")
    return path


def test_one_that_nobody_released_is_refused(folder: Path) -> None:
    configuration = configured(folder)
    assert "there is no bearing model; release one: `toolpoint model release --bearings" in (
        open_planning(configuration, STRANGER).inhibit
    )
    proposed(folder).rename(folder / "models/bearings.json")
    (folder / "models/bearings.json").chmod(0o644)
    opened = open_planning(configuration, STRANGER)
    assert "nobody has released this model" in opened.inhibit
    assert opened.operations == {}


@as_root
def test_one_that_the_daemon_could_change_is_refused_unless_the_bench_says_so(folder: Path) -> None:
    release(configured(folder, lenient=True), proposed(folder), person="anna", kind=BEARINGS)
    strict = configured(folder)
    assert as_user(OTHER, lambda: open_planning(strict, own_account()).inhibit) == ""
    os.chown(folder / "models", OTHER, OTHER)
    inhibit = as_user(OTHER, lambda: open_planning(strict, own_account()).inhibit)
    assert "the daemon could change this model" in inhibit
    assert "runs as root" in open_planning(strict, own_account()).inhibit
    opened = open_planning(configured(folder, lenient=True), own_account())
    assert opened.inhibit == ""
    assert opened.model is not None
    assert "WARNING: bearing model for a simulation only, on a real machine take allow" in opened.model.in_words()


def test_a_release_is_recorded_audited_and_can_be_taken_back(folder: Path) -> None:
    configuration = configured(folder, lenient=True)
    first = release(configuration, proposed(folder), person="anna", kind=BEARINGS)
    second = release(configuration, proposed(folder, "b", 0.03), person="bert", kind=BEARINGS)
    assert (first.number, second.number) == (1, 2)
    assert second.previous is not None
    assert second.previous.sha256 == first.sha256
    opened = open_planning(configured(folder), STRANGER)
    assert opened.model is not None
    assert f"sha256 {second.sha256}, release 2 by bert" in opened.model.in_words()
    assert rollback(configuration, person="anna", kind=BEARINGS).sha256 == first.sha256
    again = open_planning(configured(folder), STRANGER).model
    assert again is not None
    assert again.sha256 == first.sha256
    assert sorted(each.name for each in (folder / "models").iterdir()) == ["bearings-releases", "bearings.json"]


def test_a_model_whose_label_has_other_sensors_since_its_release_plans_no_speed(folder: Path) -> None:
    configuration = configured(folder)
    release(configuration, proposed(folder), person="anna", kind=BEARINGS)
    assert open_planning(configuration, STRANGER).inhibit == ""
    of = configuration.temperatures
    turned = TemperaturesConfig(lines=of.lines, sensors=[*reversed(of.sensors)], cleansing=of.cleansing)
    assert max(map(len, of.labels.values())) > 1
    assert open_planning(configuration.model_copy(update={"temperatures": turned}), STRANGER).inhibit == ""
    first, *others = of.sensors
    sensors = [first.model_copy(update={"label": "B"}), *others]
    temperatures = TemperaturesConfig(lines=of.lines, sensors=sensors, cleansing=of.cleansing)
    opened = open_planning(configuration.model_copy(update={"temperatures": temperatures}), STRANGER)
    assert "label A read something else" in opened.inhibit


def test_what_does_not_fit_the_machine_is_not_released(folder: Path) -> None:
    configuration = configured(folder, lenient=True)
    path = folder / "no.json"
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(ReleaseError, match=r"no\.json"):
        release(configuration, path, person="anna", kind=BEARINGS)
    only_x = replace(bearing_model(), axes={"x": bearing_model().axes["x"]})
    path.write_text(model_to_json(only_x), encoding="utf-8")
    with pytest.raises(ReleaseError, match="no regression for axis y"):
        release(configuration, path, person="anna", kind=BEARINGS)


@pytest.fixture
def file(folder: Path) -> Path:
    """A configuration as YAML whose spindles are one beside it and one that ships."""
    configuration = configured(folder, lenient=True)
    document = configuration.model_dump(mode="json")
    shipped = Path(__file__).resolve().parents[2] / "config/machine/data/spindles/simulated_machine.yaml"
    (folder / "own.yaml").write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
    document["spindle_speed"]["operations"][0]["spindles"] = {"x": "own.yaml", "y": "simulated_machine"}
    document["spindle_speed"]["operations"][0]["case"] = "case.yaml"
    (folder / "machine.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    return folder / "machine.yaml"


def test_the_command_releases_lists_and_goes_back(file: Path, folder: Path) -> None:
    def run(*words: str) -> str:
        result = CliRunner().invoke(main, ["model", *words, "--config", str(file)])
        assert result.exit_code == 0, result.output
        return result.output

    assert "release 1: bearings-a" in run("release", "--bearings", str(proposed(folder)))
    assert "at its next start" in run("release", "--bearings", str(proposed(folder, "b", 0.03)))
    assert "release 3: bearings-a" in run("rollback", "--bearings")
    listed = run("list", "--bearings").splitlines()
    assert [line[0] for line in listed] == [" ", " ", "*"]
    for words in (("--by-policy", "--bearings"), ("nowhere.json",), ("--bearings", "nowhere.json")):
        result = CliRunner().invoke(main, ["model", "release", *words, "--config", str(file)])
        assert result.exit_code == 2, result.output
    assert "nowhere.json: there is no such file; `toolpoint model list` shows what waits" in result.output


def test_the_resonance_to_follow_is_configured(folder: Path) -> None:
    configuration = configured(folder, lenient=True)
    release(configuration, proposed(folder), person="anna", kind=BEARINGS)
    tuning = configuration.spindle_speed
    assert tuning is not None
    operation = tuning.operations[0]
    found = []
    for near_hz in (dict[str, float](), {"x": 1.0}, {"x": 1e5}):
        changed = tuning.model_copy(update={"operations": [operation.model_copy(update={"near_hz": near_hz})]})
        opened = open_planning(configuration.model_copy(update={"spindle_speed": changed}), own_account())
        known = opened.operations[0].estimator.renew(0.0, np.full(5, 25.0))
        assert known is not None
        found.append(known.resonance_hz["x"])
    assert found[1] < found[2]
    assert found[0] >= found[1]
