"""A model of another machine of the same type has the same sensors: a person must say that it serves this one."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from control_rig import SENSOR_IDS
from model_folder import configured, proposal
from other_user import OTHER
from rewired import EXCHANGED, rewired
from small_model import model

from config.schema import Configuration
from config.schema.cnc import AxisPositionConfig
from config.schema.cnc_drivers import OpcUaNodesConfig
from daemon.cli import main
from daemon.model_release.file_access import Account
from daemon.model_release.gate import inputs_inhibit, inputs_now
from daemon.model_release.loading import load_released
from daemon.model_release.releasing import proposals, release, release_by_policy, rollback
from daemon.model_release.repository import ReleaseError
from models.thermal.family import model_from_json
from models.thermal.model import MACHINE

STRANGER = Account(user_id=OTHER)
OF_MILL_7 = {MACHINE: "mill 7"}


def test_the_model_of_another_machine_needs_a_person_s_word(folder: Path) -> None:
    configuration = configured(folder)
    own = model("own", hyper_parameters={MACHINE: configuration.machine})
    release(configuration, proposal(folder, own, "1.json"), person="anna")
    waiting = proposal(folder, model("other", band_um=1.0, hyper_parameters=OF_MILL_7), "2.json")
    words = f"it was trained on machine 'mill 7', and this one is {configuration.machine!r}"
    assert words in next(each.inhibit for each in proposals(configuration) if each.path == waiting)
    automatic = configured(folder, release=configuration.compensation.release.model_copy(update={"automatic": True}))
    assert release_by_policy(automatic, person="policy") is None
    for said in ("", "mill 8"):
        with pytest.raises(ReleaseError, match=r"it was trained on machine 'mill 7', .* with --trained-on 'mill 7'"):
            release(configuration, waiting, person="anna", trained_on=said)
    assert release(configuration, waiting, person="anna", trained_on="mill 7").trained_on == "mill 7"
    found = load_released(configuration, STRANGER)
    assert found.model is not None and found.model.model_id == "other"
    rollback(configuration, person="anna")
    assert rollback(configuration, person="anna", to=2).trained_on == "mill 7"
    assert load_released(configuration, STRANGER).model is not None


def test_releases_that_were_copied_from_another_machine_are_refused(folder: Path) -> None:
    there = configured(folder).model_copy(update={"machine": "mill 7"})
    record = release(there, proposal(folder, model(hyper_parameters=OF_MILL_7)), person="anna")
    assert record.trained_on == "" and "trained_on" not in (folder / "models/releases/0001/release.json").read_text()
    assert load_released(there, STRANGER).model is not None
    here = configured(folder)
    found = load_released(here, STRANGER)
    assert found.model is None and "trained on machine 'mill 7'" in found.inhibit
    again = release(here, folder / "state/proposals/p.json", person="anna", trained_on="mill 7")
    assert again.number == 2 and load_released(here, STRANGER).model is not None
    with pytest.raises(ReleaseError, match="active already"):
        release(here, folder / "state/proposals/p.json", person="anna", trained_on="mill 7")


def test_a_model_whose_sensors_read_something_else_since_its_release_is_released_again_or_refused(folder: Path) -> None:
    before = configured(folder)
    first = proposal(folder, model(), "1.json")
    release(before, first, person="anna")
    assert load_released(before, STRANGER).model is not None
    after = rewired(before, EXCHANGED)
    found = load_released(after, STRANGER)
    assert found.model is None and "sensor 1, sensor 2 read something else than when it was released" in found.inhibit
    release(after, Path(found.inhibit.partition(":")[0]), person="anna")
    assert load_released(after, STRANGER).model is not None and load_released(before, STRANGER).model is None
    with pytest.raises(ReleaseError, match="active already"):
        release(after, first, person="anna")
    release(after, proposal(folder, model("other", band_um=1.0), "2.json"), person="anna")
    with pytest.raises(ReleaseError, match="release 1: sensor 1, sensor 2 read something else"):
        rollback(after, person="anna", to=1)
    assert rollback(after, person="anna", to=2).reads and load_released(after, STRANGER).model is not None


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("axis position Z_mm", {"axis": "Y"}),
        ("axis position Z_mm", {"number": 4}),
        ("axis position Z_mm", {"unit": "inch"}),
        ("axis position Z_mm", {"axis_position": "s=Actual.{axis}"}),
        ("spindle speed", {"spindle_speed": "s=Speed.2"}),
        ("", {"travel_mm": (0.0, 400.0), "rapid_mm_per_min": 9000.0}),
        ("", {"clock": "s=Time"}),
    ],
)
def test_what_a_model_takes_from_the_control_is_held_to_the_same_rule(
    folder: Path, what: str, changes: dict[str, Any]
) -> None:
    """The axis of another column, its other number, inches, or the load in place of the speed, is another input."""
    before, axis = configured(folder), AxisPositionConfig(axis="Z", travel_mm=(0.0, 500.0), rapid_mm_per_min=600.0)

    def edited(nodes: dict[str, Any], of_axis: dict[str, Any]) -> Configuration:
        assert before.cnc.opcua is not None
        opcua = before.cnc.opcua.model_copy(update={"nodes": OpcUaNodesConfig(**nodes)})
        axes = {"Z_mm": axis.model_copy(update=of_axis)}
        return before.model_copy(update={"cnc": before.cnc.model_copy(update={"opcua": opcua, "axis_positions": axes})})

    of_axis = {key: value for key, value in changes.items() if key in AxisPositionConfig.model_fields}
    then, now = edited({}, {}), edited({k: v for k, v in changes.items() if k not in of_axis}, of_axis)
    made = model(axis_positions=("Z_mm",))
    record = release(then, proposal(folder, made), person="anna")
    assert list(record.reads) == [*(f"sensor {i}" for i in SENSOR_IDS), "axis position Z_mm"]
    assert load_released(then, STRANGER).model is not None
    assert (load_released(now, STRANGER).model is None) == what.startswith("axis")
    of_speed = record.model_copy(update={"reads": record.reads | {"spindle speed": inputs_now(then)["spindle speed"]}})
    assert inputs_inhibit(of_speed, now).partition(" read something else")[0] == what


def test_a_release_of_a_version_that_did_not_say_what_its_sensors_read_counts(folder: Path) -> None:
    before = configured(folder)
    release(before, proposal(folder, model()), person="anna")
    path = folder / "models/releases/0001/release.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "reads"}))
    assert load_released(rewired(before, EXCHANGED), STRANGER).model is not None
    release(before, proposal(folder, model("other", band_um=1.0), "2.json"), person="anna")
    rollback(before, person="anna", to=1)
    assert "reads" not in json.loads((folder / "models/releases/0003/release.json").read_text()), "it can go back to it"


@pytest.mark.parametrize(
    ("names", "machine"), [(("mill 7", "mill 7"), "mill 7"), (("mill 7", "mill 8"), None), (("", ""), None)]
)
def test_a_model_names_the_machine_of_its_recordings_where_they_name_one(
    tmp_path: Path, names: tuple[str, ...], machine: str | None
) -> None:
    paths = []
    for run, name in enumerate(names):
        minutes = np.arange(240.0)
        degc = 20.0 + (6.0 + run) * (1.0 - np.exp(-minutes / 40.0))
        rows = "".join(f"{60 * i:.0f},{t:.3f},{2 * (t - 20) + math.sin(i):.3f}\n" for i, t in enumerate(degc.tolist()))
        paths.append(tmp_path / f"{run}.csv")
        paths[-1].write_text((f"# machine: {name}\n" if name else "") + "t,t1,c1\n" + rows, encoding="utf-8")
    out = tmp_path / "model.json"
    done = CliRunner().invoke(main, ["thermal", "train", *map(str, paths), "--model", "ridge", "-o", str(out)])
    assert done.exit_code == 0, done.output
    made = model_from_json(out.read_bytes(), "model.json")
    assert made.hyper_parameters.get(MACHINE) == machine
