"""A replay takes a recording's names as they are: blanks, brackets, letters of any language."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from control_rig import SENSOR_IDS
from small_model import model
from whole_loop import lagged_model

from config.recordings.recording_map import RecordingMap
from config.schema.guard import GuardConfig
from daemon.simulation.processes import write_simulation_configuration
from daemon.simulation.replaying import findings_said, guard_of, map_of, modelled, replay_machine
from daemon.simulation.simulation import recorded_simulation
from drivers.clock import ScaledClock
from drivers.files.recording_csv import read_recording, write_recording
from drivers.sim.machine.recorded import RecordedMachine
from models.recordings.dataset import Recording
from models.units import TMP102_DEGC_PER_LSB

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


def test_rows_of_five_minutes_are_averaged_as_the_machine_averages_and_not_over_their_distance(tmp_path: Path) -> None:
    """A mean of 5 min is 2.5 min late: 1.5 um were left of a recording of which the machine leaves 0.4."""
    slow, path = replace(recording(), time_s=5.0 * recording().time_s), tmp_path / "model.json"
    for made, mean_s in (
        (model(period_min=5.0), 60.0),
        (replace(lagged_model("lags", lags_min=(1.0, 20.0)), period_min=2.0), 120.0),
    ):
        path.write_text(made.to_json(), encoding="utf-8")
        machine = replay_machine(slow, path, tmp_path / "record.json")
        assert machine["compensation"]["reference"]["mean_s"] == mean_s


def test_a_displacement_that_cannot_be_is_told_and_is_no_error_of_the_machine(tmp_path: Path) -> None:
    """Three codes for no value made 1000 um of the largest error, without a word."""
    um = recording().displacements_um[:, 3:].copy()
    um[[5, 9, 14]] = -999.0
    one = replace(recording(), displacement_names=("Z1",), displacements_um=um)
    assert any("-999 um cannot be (3 such values" in sentence for sentence in findings_said(one))
    machine = replay_machine(one, tmp_path / "model.json", tmp_path / "commissioning.json")
    _, configuration = write_simulation_configuration(machine, tmp_path, speed=100.0)
    columns = {name: (v, 1) for name, v in zip(one.temperature_names, one.temperatures_degc.T, strict=True)}
    write_recording(tmp_path / "day.csv", {}, {"t": (one.time_s, 0), **columns, "Z1": (um[:, 0], 1)})
    columns_of = RecordingMap(time="t", temperatures=list(columns), displacements=["Z1"])
    clock = ScaledClock(speed=100.0, epoch_real_s=0.0, epoch_utc_s=0.0)
    played = recorded_simulation(
        configuration, clock, tmp_path / "day.csv", recording_map=columns_of, hours=None
    ).machine
    assert isinstance(played, RecordedMachine)
    for second in range(0, int(played.duration_s), 10):
        played.advance(float(second))
    assert played.channels()["Z1"]["without"]["max_um"] < 100.0


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
    with pytest.raises(ValueError, match="needs the temperature 'T77', and the recording has T1, "):
        path.write_text(model(sensor_names=("T77", *names[1:])).to_json(), encoding="utf-8")
        modelled(path, numbered)


def test_columns_go_to_the_sensors_of_the_model_by_their_names(tmp_path: Path) -> None:
    """In another order, with more of them, or with a map that names some which this recording lacks."""
    names = ("Öl [°C]", "Bett (1)", "Spindel, vorn", "Raum", "Säule")
    (path := tmp_path / "model.json").write_text(model(sensor_names=names).to_json(), encoding="utf-8")
    given = {name: 20.0 + place for place, name in enumerate(names)}
    columns = {"t": (60.0 * np.arange(20.0), 0), "tot": (np.full(20, 19.0), 1)}
    columns |= {name: (np.full(20, given[name]), 1) for name in reversed(names)}
    columns |= {name: (np.arange(20.0), 1) for name in ("Z1", "Y1")}
    write_recording(csv := tmp_path / "tag.csv", {}, columns)
    keys = {"time": "t", "temperatures": ["tot", *names, "Türen"], "displacements": ["Z1", "Y1", "X1"]}
    (map_path := tmp_path / "map.yaml").write_text(yaml.safe_dump(keys, allow_unicode=True), encoding="utf-8")
    played = modelled(path, read_recording(csv, map_of(csv, map_path)))
    assert played.temperature_names == names
    assert played.temperatures_degc[0].tolist() == list(given.values())
    machine = replay_machine(played, path, tmp_path / "commissioning.json")
    said = {sensor["id"]: sensor["part"] for sensor in machine["temperatures"]["sensors"]}
    assert said == dict(zip(SENSOR_IDS, names, strict=True))
    _, configuration = write_simulation_configuration(machine, tmp_path, speed=100.0)
    clock = ScaledClock(speed=100.0, epoch_real_s=0.0, epoch_utc_s=0.0)
    simulated = recorded_simulation(configuration, clock, csv, recording_map=map_of(csv, map_path), hours=None)
    assert isinstance(simulated.machine, RecordedMachine)
    codes = simulated.machine.register_codes(SENSOR_IDS)
    assert [code * TMP102_DEGC_PER_LSB for code in codes] == list(given.values())


def test_every_channel_of_a_recording_has_an_axis_of_the_played_control() -> None:
    """A real control's A, B and C turn; here they are linear, which their settings say."""
    for count in (1, 5, 6, 9):
        guard = GuardConfig.model_validate(guard_of(tuple(f"c{number}" for number in range(count))))
        assert len({axis.letter for axis in guard.axes.values()}) == count
