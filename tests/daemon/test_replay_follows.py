"""A replay says for how much of the time the output followed, and ends with 1 when it did not, with every family."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from thermal_runs import run

from daemon.cli import main
from daemon.history.series import EventRecord
from daemon.simulation.replaying import LEAST_SHARE, WHOLE_SHARE, allowed_change_k, following, played_otherwise
from daemon.simulation.simulation import as_sent
from models.recordings.dataset import Recording
from models.records import FloatArray


def event(time_s: float, text: str, kind: str = "state") -> EventRecord:
    return EventRecord(time_s=time_s, kind=kind, text=text, person="daemon")


def test_the_share_of_each_state_comes_from_the_changes() -> None:
    events = [
        event(90.0, "OFF -> ARMED: switched on"),
        event(95.0, "no change", "notice"),
        event(110.0, "ARMED -> ACTIVE: following the estimate"),
        event(150.0, "ACTIVE -> HOLD: confidence 0.10 is below 0.70 (outside: of\nthe domain)"),
        event(400.0, "HOLD -> ACTIVE: following the estimate"),
    ]
    found = following(events, 100.0, 200.0)
    assert found.states == pytest.approx({"ARMED": 0.1, "ACTIVE": 0.4, "HOLD": 0.5})
    assert found.active_share == pytest.approx(0.4)
    assert "ACTIVE) for 40% of the time played, mostly because: confidence 0.10 is below" in found.warning


def test_an_output_that_went_back_is_named_by_its_cause_and_a_sensor_by_its_column() -> None:
    events = [
        event(100.0, "ARMED -> ACTIVE: following the estimate"),
        event(110.0, "ACTIVE -> HOLD: the level of sensor 2 by 2.0 K has changed"),
        event(115.0, "HOLD -> RETREAT: held too long: the level of sensor 2 by 2.0 K has changed"),
        event(120.0, "RETREAT -> OFF: the guard applies zero"),
    ]
    found = following(events, 100.0, 200.0, names={1: "T1", 2: "Bett [°C]"})
    assert found.states["OFF"] == pytest.approx(0.8)
    assert found.why == "held too long: the level of sensor 2 (Bett [°C]) by 2.0 K has changed"


@pytest.mark.parametrize(
    ("reason", "advice"),
    [
        ("no link to the CNC", "play it again at --speed 150"),
        ("held too long: temperatures are stale (468 s old)", "play it again at --speed 150"),
        ("reference of request 2 refused: no temperature has arrived in the last 60 s", "play it again at --speed 150"),
        ("no valid reference: the NC program has not passed its positioning", "play it again at --speed 150"),
        ("confidence 0.10 is below 0.70 (outside the domain)", "record 2 runs like it"),
        ("the level of sensor 2 by 2.0 K has changed", "look at that sensor in the recording"),
    ],
)
def test_a_replay_that_was_not_followed_says_what_to_do(reason: str, advice: str) -> None:
    found = following([event(50.0, f"ACTIVE -> HOLD: {reason}")], 100.0, 200.0)
    assert advice in found.advice(600.0)
    followed = following([event(50.0, "ARMED -> ACTIVE: following the estimate")], 100.0, 200.0)
    assert followed.advice(600.0) == ""


def made(degc: FloatArray, sample_s: float) -> Recording:
    rows = len(degc)
    return Recording(
        name="fast.csv",
        time_s=sample_s * np.arange(float(rows)),
        speed_rpm=None,
        temperature_names=("T1", "Motor [°C]"),
        temperatures_degc=np.column_stack([np.full(rows, 20.0), degc]),
        displacement_names=("Z",),
        displacements_um=np.zeros((rows, 1)),
    )


def test_a_sensor_that_is_faster_than_the_default_allows_is_named_with_what_the_machine_needs() -> None:
    fast = 20.0 + np.array([0.0, 4.0, 8.0, 12.0, 15.0, 17.0, 18.0, 18.5])
    allowed_k, note = allowed_change_k(made(fast, 60.0), 15.0)
    assert allowed_k == pytest.approx(1.5) and "Motor [°C] by 1.0 K" in note and "max_change_degc: 1.5" in note
    spike = np.where(np.arange(8) == 4, 40.0, 20.0)
    step = np.where(np.arange(8) >= 4, 40.0, 20.0)
    for harmless in (20.0 + 0.1 * np.arange(8.0), spike, step):
        assert allowed_change_k(made(harmless, 60.0), 15.0) == (1.0, "")


def test_temperatures_that_begin_at_zero_and_are_no_rises_are_named_before_they_are_played() -> None:
    cold = made(np.concatenate([np.full(8, 0.02), np.linspace(0.02, 3.0, 52)]), 15.0)
    (said,) = played_otherwise(cold, cold)
    assert "begins at 0 degC (Motor [°C])" in said and "--from-hours" in said
    later = cold.part(20, 60)
    assert played_otherwise(cold, later) == []
    rises = replace(cold, temperatures_degc=cold.temperatures_degc - cold.temperatures_degc[0])
    (said,) = played_otherwise(rises, rises.part(20, 60))
    assert "played from 20 degC on" in said


def test_an_output_that_followed_throughout_is_not_warned_of_and_one_without_events_never_did() -> None:
    whole = following([event(50.0, "ARMED -> ACTIVE: following the estimate")], 100.0, 200.0)
    assert (whole.active_share, whole.why, whole.warning) == (1.0, "", "")
    never = following([], 100.0, 200.0)
    assert (never.active_share, never.states) == (0.0, {"OFF": 1.0}) and "was not switched on" in never.warning
    assert 0.0 < LEAST_SHARE < WHOLE_SHARE <= 1.0


def played(tmp_path: Path, recording: Path, model: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-P", "-m", "daemon.cli", "replay", str(recording), "--model", str(model), "--json", "-"]
    return subprocess.run([*command, *options], capture_output=True, text=True, check=False, cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.wires
@pytest.mark.parametrize("family", ["default", "gaussian", "increments"])
def test_what_training_makes_is_followed(tmp_path: Path, family: str) -> None:
    """Half of a run that the model has not seen: a mean of families, a process, and a model without lags.

    The other families are models of these kinds; `thermal evaluate` runs each as the daemon does, and rises since the
    start are played with two of them.
    """
    paths = [str(run(tmp_path, number)) for number in range(1, 7)]
    model = tmp_path / "model.json"
    trained = CliRunner().invoke(main, ["thermal", "train", *paths[:-1], "--model", family, "-o", str(model)])
    assert trained.exit_code == 0, trained.output
    done = played(tmp_path, Path(paths[-1]), model, "--speed", "60", "--to-hours", "0.4")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["following"]["active_share"] >= LEAST_SHARE and "ACTIVE for" in done.stderr
    assert all(each["with"]["rmse_um"] < each["without"]["rmse_um"] for each in found["channels"].values())


def test_rises_are_sent_as_temperatures_whichever_hours_of_them_are_played() -> None:
    """A node that sends 0 degC is taken for one that was reset; where the axes stand is no temperature."""
    degc = np.column_stack([np.linspace(0.0, 7.0, 8), np.linspace(100.0, 107.0, 8)])
    rises = replace(made(degc[:, 0], 60.0), temperature_names=("T1", "Z_mm"), temperatures_degc=degc)
    rises = replace(rises, axis_positions=("Z_mm",))
    np.testing.assert_array_equal(as_sent(rises).temperatures_degc, degc + np.array([20.0, 0.0]))
    warm = replace(rises, temperatures_degc=degc + np.array([3.0, 0.0]))
    assert as_sent(warm) is warm


@pytest.mark.slow
@pytest.mark.wires
@pytest.mark.parametrize("family", ["ridge", "lags"])
def test_rises_since_the_start_are_played_and_followed(tmp_path: Path, family: str) -> None:
    """They could not be played at all; with lags the sensors were blamed for standing 20 K above training's middle."""
    paths = [run(tmp_path, number) for number in range(1, 7)]
    for path in paths:
        head, *rows = path.read_text(encoding="utf-8").splitlines()
        table = np.array([row.split(",") for row in rows], dtype=np.float64)
        table[:, 2:5] -= table[0, 2:5]
        np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    model = tmp_path / "model.json"
    arguments = ["thermal", "train", *map(str, paths[:-1]), "--model", family, "-o", str(model)]
    trained = CliRunner().invoke(main, arguments)
    assert trained.exit_code == 0, trained.output
    done = played(tmp_path, paths[-1], model, "--speed", "60", "--from-hours", "0.2", "--to-hours", "0.6")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["following"]["active_share"] >= LEAST_SHARE
    assert all(each["with"]["rmse_um"] < each["without"]["rmse_um"] for each in found["channels"].values())


@pytest.mark.slow
@pytest.mark.wires
def test_a_replay_that_the_output_did_not_follow_says_why_and_ends_with_1(tmp_path: Path) -> None:
    """A spindle four times as fast as in training: the estimate must not be followed, and that is said."""
    paths = [run(tmp_path, number) for number in range(1, 5)]
    model = tmp_path / "model.json"
    arguments = ["thermal", "train", *map(str, paths[:-1]), "--model", "lags", "-o", str(model)]
    trained = CliRunner().invoke(main, arguments)
    assert trained.exit_code == 0, trained.output
    head, *rows = paths[-1].read_text(encoding="utf-8").splitlines()
    fast = [",".join([time, "24000", *others]) for time, _, *others in (row.split(",") for row in rows)]
    paths[-1].write_text("\n".join([head, *fast]) + "\n", encoding="utf-8")
    done = played(tmp_path, paths[-1], model, "--speed", "60", "--to-hours", "0.2")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)["following"]
    assert found["active_share"] < LEAST_SHARE and found["why"]
    assert "warning: the output followed the estimate (ACTIVE) for" in done.stderr and found["why"] in done.stderr
