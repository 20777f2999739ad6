"""The resonance followed from temperatures against the simulator's truth, with a model fitted on the simulator's hits.

The model comes from one impact campaign on one day (seed 3) through files and the command's own functions. It is
judged on other days: the same machine in other weather, with warm-up, idle and cutting of the shipped part program.
Truth is the damped mode of the simulator's own finite elements, followed by its shape.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from true_resonance import TrueResonance, watched_day

from config.loader import load_configuration
from config.machine.published_bearings import load_bounds
from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from config.machines import shipped_file
from daemon.simulation.impact_campaign import labelled_sensors, write_campaign
from daemon.workbench.dynamics.campaign import CampaignResult, read_run, run_campaign
from daemon.workbench.dynamics.identifying import Band
from drivers.sim.machine.day import Day
from drivers.sim.nc.program import MINUTE_S, STANDSTILL, Block, PartProgram, demo_program
from drivers.sim.spindle.impact_campaign import AXES
from models.records import FloatArray
from models.thermomechanics.tool_point import ToolPointDynamics, ToolPointTracker

CAMPAIGN_DAY = 3
TOLERANCE_HZ = 10.0
FREQUENCY_HZ = 300.0 + 1.5625 * np.arange(640)
SPINDLE = spindle_folder() / "simulated_machine.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "hits"
    write_campaign(path, CAMPAIGN_DAY, 6.25)
    return path


@pytest.fixture(scope="module")
def result(folder: Path) -> CampaignResult:
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    run = read_run(folder, folder / "temperatures.csv", configuration, Band(to_hz=1500.0))
    return run_campaign(
        [run],
        read_spindle(SPINDLE),
        SPINDLE,
        load_bounds(),
        signals=None,
        parameter_sets=(5,),
        least_squares=False,
        progress=lambda *_: None,
    )


def other_day(seed: int, start: str) -> Day:
    """Return another day of the machine that was hit: other weather and deviations, the same hall."""
    machine = Day.draw(CAMPAIGN_DAY)
    weather = Day.draw(seed, start=start)  # type: ignore[arg-type]
    return replace(
        weather,
        capacity_factors=machine.capacity_factors,
        conductance_factors=machine.conductance_factors,
        heat_factors=machine.heat_factors,
        structure_factors=machine.structure_factors,
        ambient=replace(weather.ambient, mean_degc=machine.ambient.mean_degc),
        chiller_set_degc=machine.chiller_set_degc,
    )


def working_day() -> PartProgram:
    """Return warm-up, three parts, an hour of idle without the chiller, three parts, idle."""
    first, *part = demo_program().blocks
    rest = Block(sequence_number=STANDSTILL, kind="idle", duration_s=60 * MINUTE_S, chiller=False)
    return PartProgram(number=1000, blocks=(first, *part * 3, rest, *part * 3, rest))


def followed(result: CampaignResult, day: Day, hours: float) -> tuple[FloatArray, list[ToolPointDynamics]]:
    """Return errors [Hz] by time and axis, shape (n, 2), every ten minutes, and what was said then."""
    sensors = labelled_sensors()
    labels: dict[str, list[int]] = {}
    for index, sensor in enumerate(sensors):
        labels.setdefault(sensor.label or "", []).append(index)
    spindle = read_spindle(SPINDLE)
    tracker = ToolPointTracker(
        result.model, {axis: spindle.assembly("tool") for axis in AXES}, labels, frequency_hz=FREQUENCY_HZ
    )
    truth = {axis: TrueResonance(axis) for axis in AXES}
    errors, said = [], []
    for time_s, degc, body in watched_day(day, working_day(), sensors, hours=hours, sample_s=60.0):
        signals = np.array([degc[labels[name]].mean() for name in result.model.signals])
        dynamics = tracker.renew_from(time_s, signals)
        true = {axis: truth[axis].at(body.thermal_nodes()) for axis in AXES} if time_s % 600.0 == 0.0 else None
        if true is not None and dynamics is not None and not dynamics.inhibit:
            errors.append([dynamics.resonance_hz[axis] - true[axis] for axis in AXES])
            said.append(dynamics)
    return np.array(errors), said


Days = Callable[[int, str], tuple[FloatArray, list[ToolPointDynamics]]]


@pytest.fixture(scope="module")
def days(result: CampaignResult) -> Days:
    """Each day is followed once, for eight hours."""
    return cache(lambda seed, start: followed(result, other_day(seed, start), 8.0))


@pytest.mark.parametrize(("seed", "start"), [(11, "cold"), (12, "warm")])
def test_the_resonance_stays_within_10_hz_of_the_truth_over_another_day(days: Days, seed: int, start: str) -> None:
    errors, said = days(seed, start)
    assert len(errors) > 40
    assert np.abs(errors).max() < TOLERANCE_HZ, np.round(errors, 1).tolist()
    moved = np.ptp([[each.resonance_hz[axis] for axis in AXES] for each in said], axis=0)
    assert (moved > 2.0 * TOLERANCE_HZ).all(), "a day on which nothing moves proves nothing"
    assert all(each.axes[axis].resonance.continuous for each in said for axis in AXES)


def test_a_constant_would_not_pass(days: Days) -> None:
    errors, said = days(11, "cold")
    told = np.array([[each.resonance_hz[axis] for axis in AXES] for each in said])
    constant = errors - told + told.mean(axis=0)
    assert np.abs(constant).max() > TOLERANCE_HZ


def test_like_signals_share_a_group_and_one_of_each_is_used(result: CampaignResult) -> None:
    groups = {frozenset(group) for group in result.selection.groups}
    assert frozenset({"IR"}) in groups
    assert frozenset({"Room"}) in groups
    assert any({"A", "B"} <= group for group in groups)
    assert len(result.model.signals) == len(groups)
