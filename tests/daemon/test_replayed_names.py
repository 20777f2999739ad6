"""A replay takes a recording's names as they are: blanks, brackets, letters of any language."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from control_rig import SENSOR_IDS
from small_model import model

from config.loader import parse_yaml_model
from config.schema.compensation import AxisConfig
from daemon.model_release.gate import machine_inhibit
from daemon.simulation.processes import write_simulation_configuration
from daemon.simulation.replaying import axis_names, map_of, modelled, replay_machine
from drivers.sim.machine.recorded import LEAD_IN_S, RecordedMachine
from models.recordings.dataset import Recording
from models.thermal.family import model_from_json
from models.thermal.model import MACHINE

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


def test_every_channel_has_an_axis_of_its_own_that_may_be_written_so() -> None:
    axes = axis_names(CHANNELS)
    assert tuple(axes.values()) == CHANNELS
    assert list(axes)[1] == "Weg_Z_m_2" and "Z1" in axes
    assert all(name.isascii() and name.replace("_", "").isalnum() and name[0].isalpha() for name in axes)


def test_the_configuration_of_a_replay_is_valid_whatever_its_columns_are_called(tmp_path: Path) -> None:
    machine = replay_machine(recording(), tmp_path / "model.json", tmp_path / "commissioning.json")
    path, _ = write_simulation_configuration(machine, tmp_path, speed=100.0)
    assert path.is_file()
    channels = [channel["name"] for channel in machine["displacements"]["channels"]]
    assert tuple(channels) == CHANNELS
    assert {axis["estimate"] for axis in machine["compensation"]["axes"].values()} == set(CHANNELS)


@pytest.mark.parametrize("name", ["", " Z", "Z\n", "Z\t1", "Z" * 81])
def test_a_channel_s_name_is_text_on_one_line(name: str) -> None:
    text = f"estimate: {json.dumps(name)}\nabsolute_bound_um: 50.0\nslew_um_per_min: 2.0\nstep_um: 5.0\n"
    with pytest.raises(Exception, match="estimate"):
        parse_yaml_model(text, AxisConfig, "axis.yaml")


def test_what_was_played_is_a_series_per_axis(tmp_path: Path) -> None:
    from config.loader import load_configuration

    machine = replay_machine(recording(), tmp_path / "model.json", tmp_path / "commissioning.json")
    path, _ = write_simulation_configuration(machine, tmp_path, speed=100.0)
    configuration = load_configuration(path)
    played = RecordedMachine(
        recording(),
        configuration.temperatures.sensors,
        configuration.cnc.macros,
        configuration.compensation.axes,
        configuration.cnc.guard,
        block_s=60.0,
    )
    for at_s in np.arange(0.0, LEAD_IN_S + 600.0, 10.0):
        played.advance(float(at_s))
    series = played.series()
    assert series["block_s"] == 60.0
    assert list(series["channels"]) == list(axis_names(CHANNELS))
    without = series["channels"]["Z1"]["without"]
    assert without[:3] == [1.667, 5.667, 9.667], "means over a minute in which it goes from row to row"
    assert series["channels"]["Z1"]["with"] == without


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


def test_a_model_of_a_machine_with_a_name_is_played_as_on_that_machine(tmp_path: Path) -> None:
    """A recording that the daemon exported names its machine, the model too, and the daemon refuses it on any other."""
    names = tuple(f"T{number}" for number in SENSOR_IDS)
    (path := tmp_path / "model.json").write_text(
        model(sensor_names=names, hyper_parameters={MACHINE: "mill 7"}).to_json(), encoding="utf-8"
    )
    machine = replay_machine(recording(), path, tmp_path / "commissioning.json")
    _, configuration = write_simulation_configuration(machine, tmp_path, speed=100.0)
    assert machine_inhibit(model_from_json(path.read_bytes(), "model"), configuration) == ""


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
