"""The hot-and-ice experiment of section 2.3 of the dissertation on the simulated machine: what is moved when."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from config.schema import Configuration
from daemon.simulation.demonstration import switch_on, watch
from daemon.simulation.processes import RunningSimulation
from drivers.sim.machine.packs import PackScript
from models.thermal.linear import LinearModel
from models.thermal.training.making import increment_model

Mode = Literal["temperature", "compensation"]

ICE_DEGC, HOT_DEGC = 2.0, 42.0
"""Temperatures of the packs (chosen)."""
LAG_S = 40.0
"""Time constant of the sensor on its pack: the middle of what the simulator's glued sensors have [s]."""
CHANGE_DEGC = 0.1875
"""A reading shows the move when it differs by three steps of the TMP102: its noise reaches two."""
DWELL_S = 300.0
"""Time on each pack [s]; the dissertation needed more than 5 min until the temperature stood still."""
LEAD_S = {"temperature": 60.0, "compensation": 240.0}
"""Before the first move the sensor stands still on ice, and compensation is switched on [s]."""
REFERENCE_AT_S = 120.0
TEMPERATURE_MACRO = 549
AXIS, CHANNEL = "y", "Y1"
MODEL_UM_PER_K = 0.1
"""Sensitivity of the experiment's model to the moved sensor: 4 um from pack to pack, some of the machine's size."""
POLL_REAL_S = {"temperature": 0.5, "compensation": 0.05}
"""Between two polls of the CNC in wall time [s]: as on a real machine; compensation has to see the guard in time."""
BELIEVE_ALL = {"noise_degc": 1000.0, "max_change_degc": 1000.0, "max_gap_change_degc": 1000.0}
"""Cleansing rules that hold no step back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    mode: Mode
    cleansing: bool
    switches: int
    speed: float
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """The experiment on one machine."""

    experiment: Experiment
    line: str
    cycle_period_s: float
    script: PackScript
    until_s: float
    """By then the last move must have reached the macro [s]."""


def latency_machine(base: dict[str, Any], experiment: Experiment, folder: Path) -> dict[str, Any]:
    """Return the machine's description for the experiment, from the demonstration's; writes its model into `folder`."""
    speed, cleansing = experiment.speed, base["temperatures"].setdefault("cleansing", {})
    base["cnc"]["poll_period_s"] = max(0.5, POLL_REAL_S[experiment.mode] * speed)
    sensor = moved_sensor(base)
    if experiment.mode == "temperature":
        base["cnc"]["temperature_macro"] = {
            "sensor": sensor,
            "macro": TEMPERATURE_MACRO,
            "cleansed": experiment.cleansing,
        }
        return base
    if not experiment.cleansing:
        cleansing.update(BELIEVE_ALL)
    path = folder / "latency_model.json"
    path.write_text(one_sensor_model(sensor).to_json(), encoding="utf-8")
    compensation = base["compensation"]
    compensation["model_file"] = str(path)
    compensation["allow_writable_model_directory"] = True
    for name, axis in compensation["axes"].items():
        axis.pop("tool_term", None)
        axis.pop("estimate", None)
        if name == AXIS:
            axis["estimate"] = CHANNEL
    return base


def moved_sensor(base: dict[str, Any]) -> int:
    """Return the ID of the sensor that is moved: the first TMP102."""
    return next(int(s["id"]) for s in base["temperatures"]["sensors"] if s.get("device", "TMP102") == "TMP102")


def one_sensor_model(sensor: int) -> LinearModel:
    """Return a model that follows one sensor over any swing between the packs."""
    swing_k = np.array([2.0 * (HOT_DEGC - ICE_DEGC)])
    return increment_model(
        model_id="latency-experiment",
        kind="increments",
        channels=(CHANNEL,),
        sensor_ids=(sensor,),
        sensor_names=(f"T{sensor}",),
        coefficients_um_per_k=np.array([[MODEL_UM_PER_K]]),
        drift_um_per_min=np.zeros(1),
        lowest_increment_k=-swing_k,
        highest_increment_k=swing_k,
        band_um=np.full(1, np.nan),
        training=(),
        created="2026-01-01T00:00:00+00:00",
        test_pairs=[(np.array([30.0]), np.array([20.0]))],
    )


def setting_of(experiment: Experiment, configuration: Configuration) -> Setting:
    """Return when the sensor is moved and which macro is watched.

    The phases within the sampling cycle are random, one in each of as many equal parts of the cycle as there are
    moves, in random order: ten moves then cover the cycle as evenly as a thousand would.
    """
    rng = np.random.default_rng(experiment.seed)
    sensor = next(s.id for s in configuration.temperatures.sensors if s.device == "TMP102")
    line = next(line for line in configuration.temperatures.lines if sensor in line.sensor_ids)
    count, period_s = experiment.switches, line.cycle_period_s
    phases = (rng.permutation(count) + rng.uniform(0.0, 1.0, count)) / count
    dwell_s = period_s * np.ceil(DWELL_S / period_s)
    moves_s = LEAD_S[experiment.mode] + dwell_s * np.arange(count) + period_s * phases
    macro = TEMPERATURE_MACRO if experiment.mode == "temperature" else configuration.cnc.macros.values[AXIS]
    script = PackScript(
        sensor=sensor,
        ice_degc=ICE_DEGC,
        hot_degc=HOT_DEGC,
        lag_s=LAG_S,
        change_degc=CHANGE_DEGC,
        moves_s=tuple(float(move_s) for move_s in moves_s),
        macro=macro,
    )
    held_back = experiment.cleansing or experiment.mode == "compensation"
    tail_s = dwell_s if held_back else 3.0 * period_s + experiment.speed
    return Setting(
        experiment=experiment,
        line=line.name,
        cycle_period_s=period_s,
        script=script,
        until_s=float(moves_s[-1] + tail_s),
    )


def write_script(script: PackScript, path: Path) -> None:
    path.write_text(yaml.safe_dump(json.loads(json.dumps(asdict(script)))), encoding="utf-8")


def perform(running: RunningSimulation, setting: Setting) -> None:
    """Let the experiment happen; in mode compensation set the reference and switch on before the first move."""
    if setting.experiment.mode == "compensation":
        watch(running, REFERENCE_AT_S, lambda _: None, 0.2)
        running.client.ask("reference")
        switch_on(running)
    watch(running, setting.until_s, lambda _: None, 1.0)
