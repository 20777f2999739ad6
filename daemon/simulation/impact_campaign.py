"""An impact campaign on the simulated machine as files, as a person brings them from a machine."""

import shutil
from pathlib import Path

import numpy as np

from config.loader import load_configuration
from config.machine.spindle import spindle_folder
from config.machines import shipped_file
from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.spindle.impact_campaign import run_campaign

SPINDLE = "simulated_machine"
BAND_HZ = (300.0, 2500.0)


def labelled_sensors() -> list[SensorConfig]:
    """Return the labelled sensors of the published machine: those at the spindle, and the room's."""
    return [each for each in load_configuration(shipped_file("cfrpmt.yaml")).temperatures.sensors if each.label]


def write_campaign(folder: Path, day_seed: int, step_hz: float) -> tuple[int, float]:
    """Run a campaign on a cold day and write it; return the number of responses and the duration [min]."""
    frequency_hz = np.arange(BAND_HZ[0], BAND_HZ[1] + 0.5 * step_hz, step_hz)
    campaign = run_campaign(Day.draw(day_seed, start="cold"), labelled_sensors(), frequency_hz)
    campaign.write(folder)
    shutil.copyfile(spindle_folder() / f"{SPINDLE}.yaml", folder / "spindle.yaml")
    return len(campaign.impacts), float(campaign.time_s[-1]) / 60.0
