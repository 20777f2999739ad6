"""`toolpoint fleet train` on a few simulated sisters with a few sensors, and what it refuses."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result
from sisters import few_sensors, write_configuration, write_sister

from config.loader import parse_yaml_model
from config.recordings.machine_map import MachineMap
from daemon.cli import main
from daemon.workbench.thermal.fleet_report import contradictions
from models.thermal.family import model_from_json
from models.thermal.training.fleet.fleet import LeftOut

MACHINES = (1, 2, 3, 4)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    sensors = few_sensors()
    write_configuration(folder / "toolpoint.yaml", sensors)
    for machine in MACHINES:
        write_sister(folder, machine, 4, sensors, hours=3.0)
    write_map(folder)
    return folder


def write_map(folder: Path, **changes: Any) -> Path:
    machines = {f"mill-{machine}": {"recordings": [f"m{machine}/*.csv"]} for machine in MACHINES}
    path = folder / "machines.yaml"
    path.write_text(yaml.safe_dump({"configuration": "toolpoint.yaml", "machines": machines} | changes))
    return path


def train(folder: Path, machines: tuple[int, ...] = MACHINES, *more: str) -> Result:
    files = [str(path) for machine in machines for path in sorted((folder / f"m{machine}").glob("*.csv"))]
    return CliRunner().invoke(main, ["fleet", "train", *files, "--machines", str(folder / "machines.yaml"), *more])


def test_a_type_is_learned_and_told_on_machines_that_were_left_out(fleet: Path) -> None:
    result = train(fleet, MACHINES, "-o", str(fleet / "type.json"), "--json", "-")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["type"]["sensors"] == 16 and found["type"]["channels"] == ["Y1", "Y2", "Z1", "Z2", "Z3"]
    assert [machine["machine"] for machine in found["machines"]] == [f"mill-{machine}" for machine in MACHINES]
    for machine in found["machines"]:
        none, one = machine["left_out"]
        assert (none["recordings"], one["recordings"], none["tested_on"]) == (0, 1, 2)
        assert none["rmse_um"]["alone"] is None and set(one["rmse_um"]["alone"]) == {"Y1", "Y2", "Z1", "Z2", "Z3"}
        assert one["taken_over"] == "a combination of the fleet's models" and machine["warnings"] == []
    none, one = found["left_out"]
    assert none["with_prior"]["worst"] > 0.5 and one["with_prior"]["mean"] > one["alone"]["mean"]
    assert (fleet / "type.json").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"machines": {"mill-1": {"recordings": ["m9/*.csv"]}}},
            "'m9/*.csv' is none of the recordings that were given",
        ),
        (
            {"machines": {"a": {"recordings": ["m*/*.csv"]}, "b": {"recordings": ["m1/*.csv"]}}},
            "machines.b.recordings: day01.csv is a recording of a already",
        ),
        ({"machines": {"a": {"recordings": ["m1/*.csv"]}}}, "no machine has the recording day01.csv"),
        ({"configuration": None}, "machines.mill-1.configuration: names none, so where its sensors sit is not known"),
        ({"machines": {"a": {"recordings": ["m*/*.csv"]}}}, "machine a: a type is learned from two machines at least"),
        ({"machines": {}}, "machines"),
    ],
)
def test_a_map_that_does_not_fit_is_refused_with_file_and_key(fleet: Path, changes: dict[str, Any], said: str) -> None:
    try:
        path = write_map(fleet, **changes)
        result = train(fleet)
    finally:
        write_map(fleet)
    assert result.exit_code == 2 and said in result.output, result.output
    assert str(path) in result.output or "machine a" in result.output


def test_a_copy_of_a_recording_is_refused(fleet: Path, tmp_path: Path) -> None:
    """A machine that is left out would be known from its copy."""
    shutil.copytree(fleet, tmp_path / "fleet")
    shutil.copy(fleet / "m1" / "day02.csv", tmp_path / "fleet" / "m4" / "day09.csv")
    result = train(tmp_path / "fleet")
    assert result.exit_code == 2 and "machines.mill-4.recordings" in result.output
    assert "m4/day09.csv holds the same as" in result.output and "m1/day02.csv" in result.output


def changed(fleet: Path, tmp_path: Path, change: Callable[[str, str, dict[str, str]], str]) -> Path:
    """The fleet, with other values in the recordings of its fourth machine."""
    shutil.copytree(fleet, tmp_path / "fleet")
    for path in (tmp_path / "fleet" / "m4").glob("*.csv"):
        comment, head, *rows = path.read_text().splitlines()
        names = head.split(",")
        cells = [dict(zip(names, row.split(","), strict=True)) for row in rows]
        lines = [",".join(change(name, row[name], row) for name in names) for row in cells]
        path.write_text("\n".join([comment, head, *lines]) + "\n")
    return tmp_path / "fleet"


def test_a_machine_that_the_others_contradict_is_named(fleet: Path, tmp_path: Path) -> None:
    folder = changed(fleet, tmp_path, lambda name, cells, _row: str(-float(cells)) if name == "Z1" else cells)
    result = train(folder, MACHINES, "--json", "-")
    assert result.exit_code == 0, result.output
    warnings = {machine["machine"]: machine["warnings"] for machine in json.loads(result.stdout)["machines"]}
    assert warnings["mill-4"][0].startswith("Z1 reads the wrong way round, by what all other machines say")
    assert "warning: mill-4: Z1 reads the wrong way round" in result.stderr
    assert not any(warnings[f"mill-{machine}"] for machine in MACHINES[:3])


def test_a_machine_on_which_a_channel_happens_to_move_little_is_not_accused() -> None:
    def machine(name: str, *without_um: float, left_um: float = 5.0) -> LeftOut:
        return LeftOut(
            machine=name,
            recordings=0,
            tested_on=2,
            without_um=np.array(without_um),
            alone_um=None,
            with_prior_um=np.array([left_um, 5.0, 5.0]),
            how="",
            residual_um=np.zeros((1, 3)),
        )

    sound, others = machine("m1", 4.0, 20.0, 20.0), [machine(f"m{at}", 20.0, 20.0, 20.0) for at in (2, 3, 4)]
    assert contradictions([sound, *others], ("X", "Y", "Z")) == {}
    found = contradictions([machine("m1", 4.0, 20.0, 20.0, left_um=30.0), *others], ("X", "Y", "Z"))
    assert list(found) == ["m1"] and "worse than nothing (X -650% of the error gone)" in found["m1"][0]


def test_a_machine_of_another_type_is_left_out_with_what_it_lacks(fleet: Path, tmp_path: Path) -> None:
    shutil.copytree(fleet, tmp_path / "fleet")
    moved = [sensor.model_copy(update={"component": f"Other {sensor.component}"}) for sensor in few_sensors()]
    write_configuration(tmp_path / "fleet" / "other.yaml", moved)
    machines = {f"mill-{machine}": {"recordings": [f"m{machine}/*.csv"]} for machine in MACHINES}
    machines["mill-4"] |= {"configuration": "other.yaml"}  # type: ignore[dict-item]
    write_map(tmp_path / "fleet", machines=machines)
    result = train(tmp_path / "fleet", MACHINES, "--json", "-")
    assert result.exit_code == 1 and "mill-4: it shares 0 of the 16 sensors of the type" in result.stderr
    assert [one["machine"] for one in json.loads(result.stdout)["refused"]] == ["mill-4"]


def test_a_bad_recording_is_named_and_the_type_learned_from_the_others(fleet: Path, tmp_path: Path) -> None:
    """The first of a machine is no recording, one of another breaks off in a row, and of a third none can be read."""
    folder, path = tmp_path / "fleet", tmp_path / "type.json"
    shutil.copytree(fleet, folder)
    first, broken, *_ = sorted((folder / "m1").glob("*.csv"))[:1] + sorted((folder / "m2").glob("*.csv"))[1:]
    first.write_bytes(b"\x00\x01\x02 no recording")
    text = broken.read_text()
    broken.write_text(text[: len(text) // 2] + "\nx,y\n")
    for number, each in enumerate(sorted((folder / "m3").glob("*.csv"))):
        each.write_text("time\n" + "\n" * number)
    result = train(folder, MACHINES, "--json", "-", "-o", str(path))
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)
    refused = {(one["machine"], Path(one["recording"] or "").name): one["why"] for one in found["refused"]}
    assert set(refused) == {("mill-1", first.name), ("mill-2", broken.name), ("mill-3", "")}
    assert broken.name in refused["mill-2", broken.name], "it says which file"
    assert {one["machine"]: one["recordings"] for one in found["machines"]} == {"mill-1": 3, "mill-2": 3, "mill-4": 4}
    assert path.is_file() and found["type"]["machines_kept"] == ["mill-1", "mill-2", "mill-4"]
    assert "left out, because they cannot be used:" in result.stderr
    for machine, why in (("mill-1", refused["mill-1", first.name]), ("mill-3", refused["mill-3", ""])):
        assert f"{machine}: {why}" in result.stderr


def test_a_recording_in_another_unit_costs_the_machine_nothing_but_that(fleet: Path, tmp_path: Path) -> None:
    """The map of a machine holds for all its recordings, so nobody could say the unit of one."""
    folder = tmp_path / "fleet"
    shutil.copytree(fleet, folder)
    wrong = sorted((folder / "m4").glob("*.csv"))[1]
    comment, head, *rows = wrong.read_text().splitlines()
    hot = [name.startswith("T") for name in head.split(",")]
    cells = [zip(row.split(","), hot, strict=True) for row in rows]
    warm = [",".join(str(1.8 * float(cell) + 32.0) if is_hot else cell for cell, is_hot in row) for row in cells]
    wrong.write_text("\n".join([comment, head, *warm]) + "\n")
    result = train(folder, MACHINES, "--json", "-")
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)
    assert [(one["machine"], Path(one["recording"]).name) for one in found["refused"]] == [("mill-4", wrong.name)]
    assert "it looks like degF" in found["refused"][0]["why"]
    assert {one["machine"]: one["recordings"] for one in found["machines"]}["mill-4"] == 3
    assert "the models of 4 of 4 machines" in result.stderr


def test_a_recording_that_is_not_there_is_named_and_so_are_channels_that_are_none(fleet: Path, tmp_path: Path) -> None:
    """As where a shell passes on a pattern that fits nothing."""
    shutil.copytree(fleet, tmp_path / "fleet")
    (tmp_path / "fleet" / "m1" / "day05.csv").symlink_to("nowhere")
    result = train(tmp_path / "fleet")
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit), result.output
    assert "m1/day05.csv: cannot be opened (No such file or directory); learned from its other" in result.stderr
    result = train(fleet, MACHINES, "--channels", " ,")
    assert result.exit_code == 2 and "--channels: there is no channel in it" in result.stderr


def test_machines_are_found_behind_symbolic_links(fleet: Path, tmp_path: Path) -> None:
    """Recordings of forty machines often lie where a link leads."""
    for machine in MACHINES:
        (tmp_path / f"m{machine}").symlink_to(fleet / f"m{machine}")
    shutil.copy(fleet / "toolpoint.yaml", tmp_path)
    write_map(tmp_path)
    assert train(tmp_path).exit_code == 0
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "machines.yaml").symlink_to(fleet / "machines.yaml")
    files = [str(path) for machine in MACHINES for path in sorted((fleet / f"m{machine}").glob("*.csv"))]
    given = ["fleet", "train", *files, "--machines", str(tmp_path / "elsewhere" / "machines.yaml")]
    assert CliRunner().invoke(main, given).exit_code == 0


def test_too_few_machines_that_can_be_used_are_refused_with_each_reason(fleet: Path, tmp_path: Path) -> None:
    shutil.copytree(fleet, tmp_path / "fleet")
    for number, each in enumerate(sorted((tmp_path / "fleet").glob("m[234]/*.csv"))):
        each.write_text("time\n" + "\n" * number)
    result = train(tmp_path / "fleet", MACHINES, "-o", str(tmp_path / "type.json"))
    assert result.exit_code == 2 and not (tmp_path / "type.json").exists()
    assert all(f"  machine mill-{number}: " in result.output for number in (2, 3, 4)), result.output


def test_the_map_in_the_guide_is_one() -> None:
    text = (Path(__file__).parents[2] / "docs/how-to/learn-from-a-fleet.md").read_text("utf-8")
    block = "".join(line[4:] for line in text.split("## 2.")[0].splitlines(True) if line.startswith("    "))
    assert set(parse_yaml_model(block, MachineMap, "guide").machines) == {"mill-1", "mill-2", "mill-3"}


def test_a_sister_with_more_sensors_than_rows_takes_over_the_type(tmp_path: Path) -> None:
    """One recording of five hours has 301 rows for the published machine's 302 sensors, and was refused."""
    sensors = few_sensors(190)
    config = write_configuration(tmp_path / "toolpoint.yaml", sensors)
    for machine in MACHINES[:3]:
        write_sister(tmp_path, machine, 2, sensors, hours=3.0)
    write_map(tmp_path, machines={f"mill-{n}": {"recordings": [f"m{n}/*.csv"]} for n in MACHINES[:3]})
    made = train(tmp_path, MACHINES[:3], "-o", str(tmp_path / "type.json"))
    assert made.exit_code == 0, made.output
    command = ["thermal", "train", str(tmp_path / "m1" / "day01.csv"), "-o", str(tmp_path / "model.json")]
    alone = CliRunner().invoke(main, command)
    assert alone.exit_code == 2 and "rows cannot determine 190 variables" in alone.output, alone.output
    told = CliRunner().invoke(
        main, [*command, "--prior", str(tmp_path / "type.json"), "-c", str(config), "--json", "-"]
    )
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)
    assert found["hyper_parameters"]["taken_over"] == "a combination of the fleet's models"
    assert found["model"]["sensors"] == 190


def test_a_sister_takes_over_the_type_with_one_recording(fleet: Path, tmp_path: Path) -> None:
    made = train(fleet, MACHINES, "-o", str(tmp_path / "type.json"))
    assert made.exit_code == 0, made.output
    day = str(fleet / "m4" / "day01.csv")
    command = ["thermal", "train", day, "--prior", str(tmp_path / "type.json"), "-o", str(tmp_path / "model.json")]
    result = CliRunner().invoke(main, [*command, "-c", str(fleet / "toolpoint.yaml"), "--json", "-"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["hyper_parameters"]["taken_over"] == "a combination of the fleet's models"
    assert found["model"]["kind"] == "fleet" and found["model"]["sensors"] == 16
    assert "where this one is refused, --prior without recordings makes the mean" in found["advice"][0]
    model = model_from_json((tmp_path / "model.json").read_bytes(), "model.json")
    assert model.channels == ("Y1", "Y2", "Z1", "Z2", "Z3")
    own = ["-c", str(fleet / "toolpoint.yaml"), "--json", "-"]
    alone = CliRunner().invoke(main, [*command[:2], *command[3:], *own])
    assert alone.exit_code == 0, alone.output
    found = json.loads(alone.stdout)
    assert found["training"] == [] and found["held_out"]["folds"] == "machine" and found["refused"] is None
    assert found["held_out"]["relative_rmse"] < 0.6 and "on machines that were left out" in alone.stderr
    no_prior = CliRunner().invoke(main, ["thermal", "train", "-o", str(tmp_path / "model.json")])
    assert no_prior.exit_code == 2 and "only --prior can do without" in no_prior.output
    of_none = CliRunner().invoke(main, [*command[:2], *command[3:], *own, "--recent", "2"])
    assert of_none.exit_code == 2 and "without recordings the type says everything" in of_none.output
    write_configuration(tmp_path / "other.yaml", few_sensors()[1:])
    other = CliRunner().invoke(main, [*command, "-c", str(tmp_path / "other.yaml")])
    assert other.exit_code == 2 and "day01.csv: column T1: " in other.output
    both = CliRunner().invoke(main, [*command, "--model", "ridge"])
    assert both.exit_code == 2 and "--prior says what is fitted" in both.output
    none = CliRunner().invoke(main, [*command[:4], day, *command[5:]])
    assert none.exit_code == 2 and f"{day}: family: this is no model file of format 3, not a type" in none.output
