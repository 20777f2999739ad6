"""A fault campaign from a machine's description to its result."""

import gc
import resource
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from config.loader import load_configuration
from config.machines import shipped_file
from daemon.simulation.faults.campaign import Campaign
from daemon.simulation.faults.models import CampaignModels
from daemon.simulation.faults.result import Result
from daemon.simulation.faults.script import Happening, campaign
from daemon.simulation.processes import write_simulation_configuration
from drivers.sim.nc.program import RETREAT

POLL_S = 2.0
"""The CNC is polled this often; a safe point lasts 5 s [s]."""
TICK_S = 3.0
"""The output is renewed this often without a new estimate, so that it is not always just after a poll [s]."""


def run_campaign(
    base: dict[str, Any],
    directory: Path,
    *,
    days: float,
    seed: int,
    progress: Callable[[str], None],
    script: Sequence[Happening] | None = None,
) -> Result:
    """Run a campaign on the machine that `base` describes; files go to `directory`."""
    spent_s = _processor_s()
    base["cnc"]["poll_period_s"] = POLL_S
    base["compensation"].setdefault("output", {})["tick_s"] = TICK_S
    output = base["compensation"]["output"]
    output["safe_sequence_numbers"] = [*output.get("safe_sequence_numbers", []), RETREAT]
    base["compensation"].setdefault("reference", {})["retreat_sequence_numbers"] = [RETREAT]
    lines = load_configuration(shipped_file("cfrpmt.yaml")).temperatures.lines
    happenings = campaign(days, seed, lines) if script is None else script
    models = CampaignModels.beside(Path(base["compensation"]["model_file"]), directory, happenings)
    base["compensation"]["model_file"] = str(models.path)
    path, configuration = write_simulation_configuration(base, directory, speed=1.0)
    running = Campaign(
        configuration, path, directory, days=days, seed=seed, progress=progress, script=happenings, models=models
    )
    gc.collect()
    gc.freeze()  # what is there now stays until the end: looking for garbage in it again and again takes time
    try:
        result = running.run()
    finally:
        gc.unfreeze()
    result.processor_s = _processor_s() - spent_s
    return result


def _processor_s() -> float:
    """Return the processor time of this process and of those that it has started and that have ended [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)
