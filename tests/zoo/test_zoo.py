"""The zoo of machines: what it holds, that it is what its files say, and every family on a few small machines."""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
import zoo
from click.testing import CliRunner
from zoo_machines import ROSTER, Machine, recordings, reversed_run, write

from daemon.cli import main
from drivers.files.recording_csv import read_recording
from models.recordings.dataset import Recording
from models.thermal.family import model_from_json
from models.thermal.training.inputs import build_inputs
from models.thermal.training.online import compensated_um, follow
from models.thermal.training.train_family import train_family
from models.thermal.training.trial import since_first_known

SMALL = next(machine for machine in ROSTER if machine.sensors == 6 and machine.half == "tuning" and machine.runs == 4)


def traits(half: str) -> set[str]:
    return {trait.partition("=")[0] for machine in ROSTER if machine.half == half for trait in machine.traits}


def test_both_halves_hold_every_kind_of_machine() -> None:
    assert len(ROSTER) >= 40 and len({machine.name for machine in ROSTER}) == len(ROSTER)
    for half in ("tuning", "judging"):
        machines = [machine for machine in ROSTER if machine.half == half]
        assert len(machines) >= 20
        assert {machine.layout for machine in machines} == {machine.layout for machine in ROSTER}
        assert {machine.programme for machine in machines} == {machine.programme for machine in ROSTER}
    assert traits("judging") - traits("tuning") == {"analogue", "from"}
    assert not traits("tuning") - traits("judging")
    runs, sensors, sampling = ({getattr(m, key) for m in ROSTER} for key in ("runs", "sensors", "sample_s"))
    assert (min(runs), max(runs), min(sensors), max(sensors)) == (3, 40, 6, 302)
    assert (min(sampling), max(sampling)) == (1.0, 300.0)
    assert min(m.hours[0] for m in ROSTER) <= 0.7 and max(m.hours[1] for m in ROSTER) >= 12.0


def test_the_plants_share_nothing_with_what_is_tried_on_them() -> None:
    imported = set()
    for file in ("zoo_plant.py", "zoo_machines.py"):
        for node in ast.walk(ast.parse((Path(__file__).parent / file).read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom):
                imported.add(node.module)
            elif isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
    product = {name for name in imported if str(name).split(".")[0] in {"models", "drivers", "config", "daemon"}}
    assert product == {"drivers.files.recording_csv", "models.recordings.dataset"}


@pytest.fixture(scope="module")
def small() -> list[Recording]:
    return recordings(SMALL)


def test_a_seed_makes_the_same_machine_again_and_another_seed_another(small: list[Recording]) -> None:
    again, other = recordings(SMALL), recordings(SMALL, seed=2)
    assert all(np.array_equal(a.displacements_um, b.displacements_um) for a, b in zip(small, again, strict=True))
    assert small[0].displacements_um.shape != other[0].displacements_um.shape or not np.array_equal(
        small[0].displacements_um, other[0].displacements_um
    )


def test_a_machine_is_what_its_files_say(small: list[Recording], tmp_path: Path) -> None:
    for path, recording in zip(write(SMALL, tmp_path), small, strict=True):
        read = read_recording(path)
        assert read.temperature_names == recording.temperature_names
        assert np.allclose(read.time_s, recording.time_s)
        assert np.allclose(read.temperatures_degc, recording.temperatures_degc, atol=6e-4)
        assert np.allclose(read.displacements_um, recording.displacements_um, atol=6e-3)


def test_a_reversed_channel_is_reversed_in_one_recording() -> None:
    (machine, *_) = [machine for machine in ROSTER if reversed_run(machine) is not None]
    straight = Machine(**{key: getattr(machine, key) for key in Machine.__dataclass_fields__} | {"traits": frozenset()})
    pairs = list(zip(recordings(machine), recordings(straight), strict=True))
    differing = [i for i, (a, b) in enumerate(pairs) if not np.array_equal(a.displacements_um, b.displacements_um)]
    assert differing == [reversed_run(machine)]


def test_a_machine_is_evaluated_as_a_user_would(tmp_path: Path) -> None:
    files = [str(path) for path in write(SMALL, tmp_path)]
    command = ["thermal", "evaluate", *files, "--map", str(Path(files[0]).parent / "map.yaml")]
    result = CliRunner().invoke(main, [*command, "--leave-out-runs", "--model", "ridge", "--json", "-"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["mean"]["reduction_rmse"] > 0.4


def test_every_family_on_a_small_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No family may fail, and the default must be of use; how near it is to the best, the whole table tells."""
    result = tmp_path / "zoo.json"
    assert zoo.main(["--only", str(SMALL.number), "--processes", "1", "--json", str(result)]) == 0
    found = json.loads(result.read_text("utf-8"))
    assert len(found["machines"]) == 1 and found["halves"][0]["half"] == "tuning"
    for machine in found["machines"]:
        assert all(value is not None for value in machine["reductions"].values()), machine
        assert machine["reductions"][zoo.DEFAULT] > 0.6, machine
        assert machine["points"] > -20.0, machine
    table = capsys.readouterr().out
    assert f"tuning: machines {SMALL.number}" in table and "points below it on" in table


@pytest.mark.parametrize(
    ("number", "first", "family"),
    [
        (25, 0, "ridge"),
        (29, 0, "half ridge, half lags"),
    ],
)
def test_of_two_runs_the_whole_runs_tell_whether_lags_are_better(number: int, first: int, family: str) -> None:
    """By cycles or blocks of the same two runs lags looked better on all of these; the model is one that loads."""
    machine = next(one for one in ROSTER if one.number == number)
    two = [recording.downsampled(60.0) for recording in recordings(machine)[first : first + 2]]
    trained = train_family(two, "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert trained.choice is not None and (trained.choice.family, trained.model.kind) == (family, "default")
    assert "of the two runs, each left out whole" in trained.choice.why
    assert trained.choice.family in [one.family for one in trained.choice.candidates]
    content = trained.model.to_json()
    assert model_from_json(content, "model.json").model_id == trained.model.model_id


@pytest.mark.parametrize("number", [24, 26])
def test_after_a_change_of_the_machine_what_it_gets_is_never_worse_than_nothing(number: int) -> None:
    """Trained before another coolant or preload: all that comes after it, as the daemon would have it."""
    machine = next(one for one in ROSTER if one.number == number)
    changed = next(int(trait.partition("=")[2].partition(":")[0]) for trait in machine.traits if "regime" in trait)
    made = [recording.downsampled(60.0) for recording in recordings(machine)]
    model = train_family(made[:changed], "default", sample_s=60.0, created="2026-01-01T00:00:00Z").model
    inputs = build_inputs(made[changed:], sample_s=60.0, lags_min=(), speed_lags_min=())
    for recording in range(len(made) - changed):
        rows = np.flatnonzero(inputs.recording == recording)
        measured_um = since_first_known(inputs.measured_um[rows])
        held_um = compensated_um(follow(model, inputs, rows), inputs.time_min[rows], measured_um)
        left, without = (np.sqrt(np.nanmean(np.square(um), axis=0)) for um in (measured_um - held_um, measured_um))
        assert (left <= without).all(), (recording, left / without)
