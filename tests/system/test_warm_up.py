"""Milling through warm-up: what tuning the spindle speed brings, and what it must never cost."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from config.machine.stability_case import load_stability_case
from daemon.cli import main
from daemon.simulation.warm_up.run import WarmUpRequest, WarmUpRun, warm_up
from models.spindle_speed.choice import SpeedDemand, SpeedLimits

CASE = """\
teeth: 4
diameter_mm: 10
radial_depth_mm: 5
milling: down
kt_n_per_m2: 8.0e8
kr_ratio: 0.3
x: {modes: [{frequency_hz: 620, damping_ratio: 0.02, stiffness_n_per_m: 6.0e6}]}
y: {modes: [{frequency_hz: 680, damping_ratio: 0.02, stiffness_n_per_m: 7.0e6}]}
feed_deg: 0
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, WarmUpRun]:
    """The warm-up of a machine by each strategy."""
    path = tmp_path_factory.mktemp("warm_up") / "case.yaml"
    path.write_text(CASE, encoding="utf-8")
    request = WarmUpRequest(
        demand=SpeedDemand(programmed_rpm=9200.0, depth_mm=4.5, tolerance_fraction=0.02),
        limits=SpeedLimits(machine_lowest_rpm=1000.0, machine_highest_rpm=12000.0, within_fraction=0.2),
        minutes=14,
        dynamics="case",
        machine_seed=1,
        day_seed=11,
        limit_every_min=None,
    )
    return {run.strategy: run for run in warm_up(load_stability_case(path), request)}


@pytest.mark.slow
def test_tuning_is_never_stable_for_less_of_the_time_than_the_rule(runs: dict[str, WarmUpRun]) -> None:
    assert runs["tuned"].share_stable >= runs["rule"].share_stable
    assert runs["tuned"].share_stable >= runs["programmed"].share_stable
    removed = {name: each.removed_cm3_per_min(stable_only=True) for name, each in runs.items()}
    assert removed["tuned"] >= removed["programmed"]


@pytest.mark.slow
def test_without_tuning_warming_brings_chatter(runs: dict[str, WarmUpRun]) -> None:
    assert runs["programmed"].share_stable < 1.0


@pytest.mark.slow
def test_the_tuner_sees_an_estimate_and_not_the_truth(runs: dict[str, WarmUpRun]) -> None:
    minutes = runs["tuned"].minutes
    errors = np.array([minute.estimated_hz[axis] / minute.true_hz[axis] - 1.0 for minute in minutes for axis in "xy"])
    assert 1e-4 < np.abs(errors).max() < 0.03
    drift = minutes[-1].true_hz["x"] / minutes[0].true_hz["x"] - 1.0
    assert drift > 0.01


@pytest.mark.slow
def test_the_command_prints_shares_and_draws(tmp_path: Path) -> None:
    path, picture = tmp_path / "case.yaml", tmp_path / "warm.png"
    path.write_text(CASE, encoding="utf-8")
    words = ["stability", "warm-up", "--programmed-rpm", "9200", "--depth-mm", "4.5", "--minutes", "5", "--json", "-"]
    words += ["--dynamics", "case"]
    result = CliRunner().invoke(main, [*words, "--picture", str(picture), str(path)])
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)["strategies"]
    assert set(found) == {"programmed", "rule", "tuned"}
    for run in found.values():
        assert run["share_stable"] == np.mean([not minute["chatter"] for minute in run["minutes"]])
        assert run["lowest_limiting_depth_mm"] > 0.0
    assert picture.stat().st_size > 10_000
