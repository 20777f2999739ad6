"""The simulated spindle's finite elements mill through warm-up; their user knows them by an impact campaign."""

import numpy as np
import pytest

from config.machine.stability_case import StabilityCase, load_stability_case
from daemon.simulation.warm_up.run import WarmUpRequest, WarmUpRun, warm_up
from models.spindle_speed.choice import SpeedDemand, SpeedLimits

CASE = """\
teeth: 4
diameter_mm: 16
radial_depth_mm: 8
milling: down
kt_n_per_m2: 8.0e8
kr_ratio: 0.3
x: {modes: [{frequency_hz: 600, damping_ratio: 0.02, stiffness_n_per_m: 1.0e7}]}
y: rigid
feed_deg: 0
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> StabilityCase:
    path = tmp_path_factory.mktemp("case") / "case.yaml"
    path.write_text(CASE, encoding="utf-8")
    return load_stability_case(path)


def request(**changes: object) -> WarmUpRequest:
    given: dict[str, object] = {
        "demand": SpeedDemand(programmed_rpm=10000.0, depth_mm=4.0, tolerance_fraction=0.02),
        "limits": SpeedLimits(machine_lowest_rpm=1000.0, machine_highest_rpm=12000.0, within_fraction=0.25),
        "minutes": 5,
        "limit_every_min": None,
    }
    return WarmUpRequest(**(given | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def runs(case: StabilityCase) -> dict[str, WarmUpRun]:
    return {run.strategy: run for run in warm_up(case, request())}


@pytest.mark.slow
def test_tuning_is_never_stable_for_less_of_the_time_and_removes_more(runs: dict[str, WarmUpRun]) -> None:
    assert runs["programmed"].share_stable < 1.0
    assert runs["tuned"].share_stable >= runs["rule"].share_stable
    removed = {name: run.removed_cm3_per_min(stable_only=True) for name, run in runs.items()}
    assert removed["tuned"] > max(removed["programmed"], removed["rule"])


@pytest.mark.slow
def test_the_user_sees_an_estimate_that_follows_the_truth(runs: dict[str, WarmUpRun]) -> None:
    minutes = runs["tuned"].minutes
    true = np.array([minute.true_hz["x"] for minute in minutes])
    estimated = np.array([minute.estimated_hz["x"] for minute in minutes])
    assert np.ptp(true) > 10.0
    assert 0.01 < np.abs(estimated - true).max() < 10.0
