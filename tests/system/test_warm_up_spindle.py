"""The simulated spindle's finite elements mill through warm-up; their user knows them by an impact campaign."""

import numpy as np
import pytest

from config.machine.stability_case import StabilityCase, load_stability_case
from daemon.simulation.warm_up.run import WarmUpRequest, WarmUpRun, warm_up
from drivers.sim.machine.heat import INDEX
from drivers.sim.spindle.milling import MillingCuts, arc_of, mill
from drivers.sim.spindle.spindle_beam import END_MILL_16, SpindleBeam
from drivers.sim.spindle.spindle_bearings import bearings, nominal_bearings
from drivers.sim.spindle.warming_spindle import WarmingBeams
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
        "minutes": 8,
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


def test_the_modes_that_mill_are_the_response_of_the_finite_elements() -> None:
    node_degc = np.full(len(INDEX), 26.0)
    modes = WarmingBeams(END_MILL_16).at(node_degc)
    beam = SpindleBeam(nominal_bearings("x"), with_tool=True, tool=END_MILL_16)
    frequency_hz = np.arange(300.0, 1500.0, 1.0)
    true = beam.modes(bearings(node_degc, "x")).receptance(frequency_hz)
    assert modes.lead_s is not None
    own, s = np.zeros(len(frequency_hz), dtype=complex), 2j * np.pi * frequency_hz
    for place, axis in enumerate(modes.axis):
        if axis == 0:
            angular = 2.0 * np.pi * modes.frequency_hz[place]
            gain = angular**2 / modes.stiffness_n_per_m[place]
            below = s**2 + 2.0 * modes.damping_ratio[place] * angular * s + angular**2
            own += gain * (1.0 + modes.lead_s[place] * s) / below
    assert np.abs(own - true).max() < 0.05 * np.abs(true).max()


def test_a_mode_with_a_lead_moves_as_its_receptance_says() -> None:
    """A slot by many straight teeth is a constant force; the tool point then rests at force over stiffness."""
    one = np.ones(1)
    start, end = arc_of("slot", 8e-3, 16e-3)
    found = []
    for lead_s in (0.0, 2e-5):
        cuts = MillingCuts(
            teeth=4,
            speed_rpm=9000.0 * one,
            axial_depth_m=1e-4 * one,
            first_bearing_rad=start * one,
            last_bearing_rad=end * one,
            tangential_n_per_m2=8e8 * one,
            radial_n_per_m2=2.4e8 * one,
            feed_per_tooth_m=5e-5 * one,
            feed_direction_rad=0.0 * one,
            mode_frequency_hz=600.0 * np.ones((1, 1)),
            mode_damping_ratio=0.05 * np.ones((1, 1)),
            mode_stiffness_n_per_m=1e7 * np.ones((1, 1)),
            mode_axis=(0,),
            mode_lead_s=lead_s * np.ones((1, 1)),
        )
        samples = list(mill(cuts, 40, 100))[-800:]
        force = np.array([sample.force_n[0, 0] for sample in samples])
        moved = np.array([sample.displacement_m[0, 0] for sample in samples])
        found.append(moved.mean() / force.mean())
    assert np.allclose(found, 1e-7, rtol=5e-3)
