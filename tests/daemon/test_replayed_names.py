"""A replay takes a recording's names as they are: blanks, brackets, letters of any language."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model

from daemon.simulation.processes import write_simulation_configuration
from daemon.simulation.replaying import map_of, modelled, replay_machine
from models.recordings.dataset import Recording

CHANNELS = ("Weg Z [µm]", "Weg Z (µm)", '1st, "front"', "Z1")


def recording() -> Recording:
    time_s = np.arange(0.0, 1200.0, 60.0)
    return Recording(
        name="tag.csv",
        time_s=time_s,
        speed_rpm=None,
        temperature_names=("Temp [°C]", "Öl: Rücklauf"),
        temperatures_degc=np.tile([20.0, 21.0], (20, 1)),
        displacement_names=CHANNELS,
        displacements_um=np.outer(time_s / 60.0, [1.0, 2.0, 3.0, 4.0]),
    )


def test_the_configuration_of_a_replay_is_valid_whatever_its_columns_are_called(tmp_path: Path) -> None:
    machine = replay_machine(recording(), tmp_path / "model.json", tmp_path / "commissioning.json")
    path, _ = write_simulation_configuration(machine, tmp_path, speed=100.0)
    assert path.is_file()
    channels = [channel["name"] for channel in machine["displacements"]["channels"]]
    assert tuple(channels) == CHANNELS
    assert {axis["estimate"] for axis in machine["compensation"]["axes"].values()} == set(CHANNELS)


def test_more_sensors_than_one_line_carries_are_played_on_several(tmp_path: Path) -> None:
    degc = np.full((20, 302), 20.0)
    names = tuple(f"T{i}" for i in range(1, 303))
    many = replace(recording(), temperature_names=names, temperatures_degc=degc)
    machine = replay_machine(many, tmp_path / "model.json", tmp_path / "commissioning.json")
    write_simulation_configuration(machine, tmp_path, speed=100.0)
    assert [line["chain"] for line in machine["temperatures"]["lines"]] == [["1-151"], ["152-302"]]


def test_a_recording_without_usual_names_is_refused_with_its_file_and_what_to_do(tmp_path: Path) -> None:
    (path := tmp_path / "tag.csv").write_text("Zeit;Temp\n0;1\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"tag\.csv: time: no column carries a usual name .*--map-out map\.yaml"):
        map_of(path, None)


def test_sensors_have_the_numbers_that_their_columns_say(tmp_path: Path) -> None:
    """As `toolpoint export --what recording` writes them: a model keeps the IDs of the machine."""
    names = tuple(f"T{number}" for number in SENSOR_IDS)
    degc = np.full((20, len(names)), 20.0)
    numbered = replace(
        recording(), temperature_names=names, temperatures_degc=degc, displacement_names=("x", "Z1", "y", "Y1")
    )
    path = tmp_path / "model.json"
    path.write_text(model(sensor_names=names).to_json(), encoding="utf-8")
    played = modelled(path, numbered)
    assert played.displacement_names == ("Z1", "Y1"), "what the model does not estimate is not played"
    machine = replay_machine(played, path, tmp_path / "commissioning.json")
    write_simulation_configuration(machine, tmp_path, speed=100.0)
    assert [sensor["id"] for sensor in machine["temperatures"]["sensors"]] == list(SENSOR_IDS)
    with pytest.raises(ValueError, match="the model estimates Y1, Z1, and the recording has x"):
        modelled(path, numbered.with_channels(("x",)))
    with pytest.raises(ValueError, match=f"sensor {SENSOR_IDS[0]} of the model is"):
        path.write_text(model(sensor_names=(*names[1:], names[0])).to_json(), encoding="utf-8")
        modelled(path, numbered)
