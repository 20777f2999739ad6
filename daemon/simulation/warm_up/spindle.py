"""The machine of a warm-up whose tool point is that of the simulated spindle's finite elements.

What is known of it is what a real user would measure: an impact campaign at the bare nose on an earlier day goes
through files into `toolpoint dynamics campaign`, which gives a model of the bearings over temperature; the tool point
follows from that model, the spindle file and the tool. Truth and estimate share no formula.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from config.loader import load_configuration
from config.machine.published_bearings import load_bounds
from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from config.machine.stability_case import StabilityCase
from config.machines import shipped_file
from daemon.simulation.impact_campaign import SPINDLE, labelled_sensors
from daemon.workbench.dynamics.campaign import read_run, run_campaign
from daemon.workbench.dynamics.identifying import Band
from drivers.sim.machine.day import Day
from drivers.sim.machine.heat import INDEX
from drivers.sim.spindle.impact_campaign import AXES, RECORDING_FILE
from drivers.sim.spindle.impact_campaign import run_campaign as hit
from drivers.sim.spindle.spindle_beam import END_MILL_10, END_MILL_16, MountedTool
from drivers.sim.spindle.spindle_bearings import COLD_DEGC
from drivers.sim.spindle.warming_spindle import VibrationModes, WarmingBeams
from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.tool_point import ToolPointEstimator
from models.spindle_speed.tracked_tool_point import TrackedToolPoint
from models.thermomechanics.regression import ThermomechanicalModel
from models.thermomechanics.tool_point import ToolPointTracker

TOOLS: dict[float, tuple[MountedTool, str]] = {10.0: (END_MILL_10, SPINDLE), 16.0: (END_MILL_16, f"{SPINDLE}_16mm")}
"""Diameter [mm] -> the tool of the simulated machine, and the shipped spindle file that its user has of it."""
HIT_HZ = np.arange(300.0, 1500.1, 6.25)
TRACKED_HZ = np.arange(300.0, 4000.1, 3.125)
"""Frequencies of the campaign, and of the estimated tool point [Hz]."""
CAMPAIGN_SEED = 100_000


class SpindleMachine:
    """The simulated machine with one of its tools."""

    def __init__(self, case: StabilityCase, machine_seed: int, day_seed: int) -> None:
        """Run the campaign on a day of the machine's past; raises StabilityError for a tool that it does not have."""
        if case.diameter_mm not in TOOLS:
            have = " and ".join(f"{diameter:g}" for diameter in TOOLS)
            raise StabilityError(
                f"the simulated machine has end mills of {have} mm, not {case.diameter_mm:g} mm; change diameter_mm, "
                "or mill with the modes of the case: --dynamics case"
            )
        tool, self._spindle = TOOLS[case.diameter_mm]
        self.sensors = labelled_sensors()
        past = Day.draw(CAMPAIGN_SEED * (machine_seed + 1), start="cold")
        self.day = _same_machine(past, Day.draw(day_seed, start="cold"))
        self._beams = WarmingBeams(tool)
        self._model = _identified(past, machine_seed)
        self._labels: dict[str, list[int]] = {}
        for index, sensor in enumerate(self.sensors):
            self._labels.setdefault(sensor.label or "", []).append(index)
        cold = self._beams.at(np.full(len(INDEX), COLD_DEGC))
        height = 1.0 / (cold.stiffness_n_per_m * cold.damping_ratio)
        self.softer_axis = AXES[cold.axis[int(np.argmax(height))]]

    def at(self, node_degc: FloatArray) -> VibrationModes:
        """Return the true modes at the temperatures of all nodes [degC]."""
        return self._beams.at(node_degc)

    def estimator(self) -> ToolPointEstimator:
        """Return the tool point from the model of the bearings, afresh."""
        return TrackedToolPoint(self._tracker(), self._labels)

    def _tracker(self) -> ToolPointTracker:
        spindle = read_spindle(Path(self._spindle))
        assemblies = {axis: spindle.assembly("tool") for axis in self._model.axes}
        return ToolPointTracker(self._model, assemblies, self._labels, frequency_hz=TRACKED_HZ)


def _same_machine(machine: Day, weather: Day) -> Day:
    """Return another day of a machine: its body and its hall, other weather and deviations."""
    return replace(
        weather,
        capacity_factors=machine.capacity_factors,
        conductance_factors=machine.conductance_factors,
        heat_factors=machine.heat_factors,
        structure_factors=machine.structure_factors,
        ambient=replace(weather.ambient, mean_degc=machine.ambient.mean_degc),
        chiller_set_degc=machine.chiller_set_degc,
    )


def _identified(day: Day, machine_seed: int) -> ThermomechanicalModel:
    """Return the bearings over temperature as the campaign's command finds them from files."""
    configuration = load_configuration(shipped_file("cfrpmt.yaml"))
    file = spindle_folder() / f"{SPINDLE}.yaml"
    with tempfile.TemporaryDirectory(prefix="toolpoint-campaign-") as name:
        folder = Path(name)
        hit(day, labelled_sensors(), HIT_HZ, machine_seed=machine_seed).write(folder)
        run = read_run(folder, folder / RECORDING_FILE, configuration, Band(to_hz=float(HIT_HZ[-1])))
        return run_campaign(
            [run], read_spindle(file), file, load_bounds(), signals=None, progress=lambda *_: None
        ).model
