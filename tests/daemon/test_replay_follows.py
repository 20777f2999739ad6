"""A replay says for how much of the time the output followed, and ends with 1 when it did not, with every family."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from thermal_runs import run

from daemon.cli import main
from daemon.cli.simulate.replay import report
from daemon.history.reader import EventRecord
from daemon.simulation.replaying import LEAST_SHARE, following, pauses


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


@pytest.mark.parametrize(
    ("reason", "advice"),
    [
        ("no link to the CNC", "play it again at --speed 150"),
        (
            "held too long, so a person must switch it on again; the reason then: temperatures are stale (468 s old)",
            "play it again at --speed 150",
        ),
        ("reference of request 2 refused: no temperature has arrived in the last 60 s", "play it again at --speed 150"),
        ("no valid reference: the NC program has not passed its positioning", "play it again at --speed 150"),
        ("confidence 0.10 is below 0.70 (outside the domain)", "record 2 runs like it"),
        ("the level of sensor 2 by 2.0 K has changed", "look at that sensor in the recording"),
        (
            "confidence 0.00 is below 0.70 (the level of sensor 2 has changed since the reference)",
            "look at that sensor in the recording",
        ),
    ],
)
def test_a_replay_that_was_not_followed_says_what_to_do(reason: str, advice: str) -> None:
    found = following([event(50.0, f"ACTIVE -> HOLD: {reason}")], 100.0, 200.0)
    assert advice in found.advice(600.0)
    followed = following([event(50.0, "ARMED -> ACTIVE: following the estimate")], 100.0, 200.0)
    assert followed.advice(600.0) == ""


def test_a_computer_that_was_too_busy_is_told_though_the_output_was_active() -> None:
    times_s = [15.0 * cycle for cycle in range(400)]
    assert pauses(times_s, 15.0, 600.0) == "" == pauses([], 15.0, 600.0)
    assert pauses(times_s[:100] + times_s[105:], 15.0, 600.0) == "", "once a minute and a half"
    said = pauses(times_s[:100] + times_s[160:], 15.0, 600.0)  # 1.5 um instead of 0.2 on such a computer
    assert "for 15% of the time played" in said and "at most 915 s" in said and "--speed 150" in said


def test_names_in_brackets_stand_in_the_table_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """`Z [mm]` was called Z, and a name with [/ ended the replay with a traceback after all was played."""
    figures = {case: {"rmse_um": 1.0, "max_um": 2.0} for case in ("without", "with")}
    channels = {"Z [mm]": figures, "Y [/mm]": figures}
    found = {"following": {"active_share": 1.0}, "warnings": [], "advice": [], "channels": channels}
    report(Path("run [a].csv"), found, None)
    said = capsys.readouterr().out
    assert all(name in said for name in ("Z [mm]", "Y [/mm]", "run [a].csv"))


def played(tmp_path: Path, recording: Path, model: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-P", "-m", "daemon.cli", "replay", str(recording), "--model", str(model), "--json", "-"]
    return subprocess.run([*command, *options], capture_output=True, text=True, check=False, cwd=tmp_path)


@pytest.mark.slow
@pytest.mark.wires
def test_rises_since_the_start_are_played_and_followed(tmp_path: Path) -> None:
    """They could not be played at all; with lags the sensors were blamed for standing 20 K above training's middle.

    `thermal evaluate` runs each other family as the daemon does.
    """
    paths = [run(tmp_path, number) for number in range(1, 6)]
    for path in paths:
        head, *rows = path.read_text(encoding="utf-8").splitlines()
        table = np.array([row.split(",") for row in rows], dtype=np.float64)
        table[:, 2:5] -= table[0, 2:5]
        np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    model = tmp_path / "model.json"
    arguments = ["thermal", "train", *map(str, paths[:-1]), "--model", "lags", "-o", str(model)]
    trained = CliRunner().invoke(main, arguments)
    assert trained.exit_code == 0, trained.output
    done = played(tmp_path, paths[-1], model, "--speed", "60", "--to-hours", "0.3")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["following"]["active_share"] >= LEAST_SHARE and "ACTIVE for" in done.stderr
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
