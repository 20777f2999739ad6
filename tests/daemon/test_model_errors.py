"""Probe values of the history, as what they say of the model in force, and the command that judges them."""

import json
import time
from pathlib import Path

import history_records as make
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from control_rig import machine

from config.loader import load_configuration
from config.sample import sample_configuration
from config.schema import Configuration
from config.schema.displacements import DisplacementChannelConfig, DisplacementFileConfig, DisplacementsConfig
from config.schema.temperatures import TemperaturesConfig
from daemon.cli import main
from daemon.history.layout import MachineLayout
from daemon.history.reader import HistoryReader
from daemon.history.writer import HistoryWriter
from daemon.model_release.model_errors import MeasuredError, measured_errors
from daemon.model_release.past_recordings import recordings_from_history
from daemon.sinks.alarms.observing import worn_models
from models.records import ProbeSample

DAY_S = 86_400.0
UM_PER_UNIT = {"z": 1000.0}
BASELINE_UM = 3.0


def fill(
    configuration: Configuration,
    start_s: float,
    days: int,
    share_left,
    *,
    model_id: str = "m1",
    on: bool = True,
    estimated_before_s: float = 5.0,
) -> None:
    """A reference and two probe values a day; the machine errs by 10 to 20 um, the model takes its part away."""
    layout = MachineLayout.from_configuration(configuration)
    clock = make.StillClock(start_s)
    writer = HistoryWriter(configuration.history.path, clock=clock, machine=layout)
    writer.start()
    echo = configuration.cnc.macros.echo_applied["z"]
    refused = make.instant(start_s + 7200.0)
    writer.probe(
        ProbeSample(
            time=refused,
            axis="z",
            deviation_um=900.0,
            applied_um=0.0,
            thermal_error_um=0.0,
            reference_id=f"{model_id} 0",
            accepted=False,
            reason="larger than believed",
        )
    )
    for day in range(days):
        set_s = start_s + DAY_S * day
        clock.utc_s = set_s
        writer.cnc_sample(make.cnc_sample(set_s - 1.0, macros={echo: BASELINE_UM / 1000.0}))
        reference = make.reference(set_s, len(layout.sensor_ids))
        writer.reference(reference.__class__(**{**_fields(reference), "reference_id": f"{model_id} {day}"}))
        for number in range(2):
            probe_s = set_s + 3600.0 * (number + 1)
            error_um = 10.0 + (7 * day + 3 * number) % 11
            estimated_um = (1.0 - share_left(day)) * error_um
            writer.estimate(make.estimate(probe_s - estimated_before_s, np.zeros(3), model_id=model_id))
            writer.probe(
                ProbeSample(
                    time=make.instant(probe_s),
                    axis="z",
                    deviation_um=error_um - on * estimated_um,
                    applied_um=on * (BASELINE_UM - estimated_um),
                    thermal_error_um=estimated_um,
                    reference_id=f"{model_id} {day}",
                    accepted=True,
                    reason="",
                )
            )
    writer.close()


def _fields(record: object) -> dict[str, object]:
    return {name: getattr(record, name) for name in record.__slots__}


def errors_of(configuration: Configuration, um_per_unit=UM_PER_UNIT) -> list[MeasuredError]:
    with HistoryReader(configuration.history.path) as reader:
        return measured_errors(configuration, reader, um_per_unit, from_utc_s=0.0, to_utc_s=4e9)


def test_each_accepted_probe_value_says_what_the_model_left(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    fill(configuration, make.EPOCH_S, 3, lambda day: 0.2)
    found = errors_of(configuration)
    assert len(found) == 6 and {each.model_id for each in found} == {"m1"}
    for day, each in enumerate(found[::2]):
        error_um = 10.0 + (7 * day) % 11
        assert each.without_um == pytest.approx(error_um) and each.left_um == pytest.approx(0.2 * error_um)
        assert each.with_um == pytest.approx(each.left_um) and each.source == "probe"
    assert errors_of(configuration, {"y": 1.0}) == [], "without the echo of z its baseline is not known"


def test_sensors_that_are_read_every_five_minutes_hide_no_probe_value(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    lines = [line.model_dump() | {"cycle_period_s": 300.0} for line in configuration.temperatures.lines]
    temperatures = TemperaturesConfig.model_validate(configuration.temperatures.model_dump() | {"lines": lines})
    configuration = configuration.model_copy(update={"temperatures": temperatures})
    fill(configuration, make.EPOCH_S, 3, lambda day: 0.2, estimated_before_s=299.0)
    assert len(errors_of(configuration)) == 6


ZERO_UM = 400.0
"""Where the logger has its zero."""


def measured_machine(folder: Path) -> Configuration:
    """The displacement that axis z follows is measured."""
    section = DisplacementsConfig(
        file=DisplacementFileConfig(path=folder / "d.csv", header="Time"),
        channels=[DisplacementChannelConfig(name="Z1", column="Z")],
    )
    return machine(folder).model_copy(update={"displacements": section})


def fill_displacements(
    configuration: Configuration,
    start_s: float,
    days,
    share_left,
    *,
    minutes: int = 131,
    every: int = 1,
    references: int = 1,
) -> None:
    """A warm-up on each day: Z1 grows to 20 um, the model takes its part away and the guard applies it."""
    clock = make.StillClock(start_s)
    layout = MachineLayout.from_configuration(configuration)
    writer = HistoryWriter(configuration.history.path, clock=clock, machine=layout)
    writer.start()
    echo = configuration.cnc.macros.echo_applied["z"]
    for day in days:
        for minute in range(0, minutes, every):
            now_s = start_s + DAY_S * day + 60.0 * minute
            clock.utc_s = now_s
            error_um = 5.0 + 20.0 * (1.0 - np.exp(-minute / 40.0))
            reference_id = f"{day}.{minute * references // minutes}"
            estimated_um = (1.0 - share_left(day)) * error_um - 3.0 * (minute * references // minutes)
            writer.estimate(
                make.estimate(
                    now_s,
                    [0.0, estimated_um],
                    channels=("Y1", "Z1"),
                    band_um=np.full(2, 2.5),
                    model_id="m1",
                    reference_id=reference_id,
                )
            )
            writer.cnc_sample(make.cnc_sample(now_s, macros={echo: -estimated_um / 1000.0}))
            um = np.array([ZERO_UM + error_um - estimated_um])
            writer.displacement(make.displacement(now_s, um))
    writer.close()


@pytest.mark.parametrize("every", [1, 5])
def test_displacements_say_what_the_model_left_since_they_began(tmp_path: Path, every: int) -> None:
    configuration = measured_machine(tmp_path)
    fill_displacements(configuration, make.EPOCH_S, [0], lambda day: 0.2, every=every)
    with HistoryReader(configuration.history.path) as reader:
        (recording,) = recordings_from_history(configuration, reader, UM_PER_UNIT, from_utc_s=0.0, to_utc_s=4e9)
    assert recording.time_s[-1] == 7800.0 and recording.rows == 130 // every + 1
    found = [each for each in errors_of(configuration) if each.axis == "z"]
    assert len(found) == 13 and {(each.source, each.model_id) for each in found} == {("displacement", "m1")}
    for number, each in enumerate(found, 1):
        grown_um = 20.0 * (1.0 - np.exp(-10.0 * number / 40.0))
        assert each.without_um == pytest.approx(grown_um) and each.left_um == pytest.approx(0.2 * grown_um, abs=0.01)
        assert each.with_um == pytest.approx(each.left_um, abs=0.01)
    fill_displacements(configuration, make.EPOCH_S + DAY_S, [0], lambda day: 0.2, references=2)
    assert len([each for each in errors_of(configuration) if each.axis == "z"]) == 13, "an hour each is too short"


def test_the_command_says_it_and_ends_with_1_when_the_model_in_force_is_worn(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    content = yaml.safe_load(sample_configuration())
    content["history"]["path"] = str(tmp_path / "h.sqlite")
    path.write_text(yaml.safe_dump(content))
    configuration = load_configuration(path)
    start_s = time.time() - 190 * DAY_S
    fill(configuration, start_s, 180, lambda day: 0.1 + 0.4 * day / 180.0, on=False)  # never commissioned
    clock = make.StillClock(start_s)
    writer = HistoryWriter(
        configuration.history.path, clock=clock, machine=MachineLayout.from_configuration(configuration)
    )
    writer.start()
    for at_s in (start_s + 1000 * DAY_S, start_s + 181 * DAY_S):  # the clock was ahead, and is set right
        clock.utc_s = at_s
        writer.cnc_sample(make.cnc_sample(at_s))
    writer.close()
    done = CliRunner().invoke(main, ["model", "drift", "--config", str(path)])
    assert done.exit_code == 1, done.output
    assert "axis z, model m1: 360 probe values; leaves" in done.output and "train it anew" in done.output
    done = CliRunner().invoke(main, ["model", "drift", "--config", str(path), "--bound", "0.9", "--json", "-"])
    assert done.exit_code == 0, done.output
    (found,) = json.loads(done.stdout)["models"]
    assert found["axis"] == "z" and found["drift"]["bound"] == 0.9 and not found["retrain"]
    late_s = start_s + 200 * DAY_S
    writer = HistoryWriter(
        configuration.history.path,
        clock=make.StillClock(late_s),
        machine=MachineLayout.from_configuration(configuration),
    )
    writer.start()
    writer.cnc_sample(make.cnc_sample(late_s))
    writer.close()
    done = CliRunner().invoke(main, ["model", "drift", "--config", str(path), "--last", "2d"])
    assert done.exit_code == 0 and "nothing to judge by" in done.output
    fill(configuration, start_s + 1000 * DAY_S, 60, lambda day: 0.1, model_id="m2", on=False)
    done = CliRunner().invoke(main, ["model", "drift", "--config", str(path), "--last", "90d"])
    assert "model m2: 120 probe values" in done.output, "the store of a replay is of another time"
    done = CliRunner().invoke(main, ["model", "drift", "--config", str(path), "--last", "9d"])
    assert "1 week is too few; it takes 16 to ask for training" in done.output, done.output


def test_an_alarm_names_the_axis_whose_model_wears_out_and_ends_with_another_model(tmp_path: Path) -> None:
    configuration = machine(tmp_path)
    fill(configuration, make.EPOCH_S, 180, lambda day: 0.1 + 0.4 * day / 180.0, on=False)
    (found,) = worn_models(configuration, make.EPOCH_S + 180 * DAY_S)
    assert (found.kind, found.subject) == ("model", "wears out, axis z") and "plan to train it anew" in found.text
    fill(configuration, make.EPOCH_S + 180 * DAY_S, 2, lambda day: 0.1, model_id="m2", on=False)
    assert list(worn_models(configuration, make.EPOCH_S + 183 * DAY_S)) == []
