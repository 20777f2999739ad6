"""The evaluation of the dissertation's models by training sets and sensors: updated factors against refits.

Run by hand: `python tests/benchmarks/bench_thermal_evaluation.py [--campaign FOLDER] [--refits 60 | --all]`.
Without a folder a campaign is simulated first. Refits are scikit-learn's LinearRegression, one for each
number of sets, number of sensors and model; without --all some are drawn evenly, timed, and scaled up to
all of them. Every refit is also compared with the updated result. Nothing here passes or fails.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from sklearn.linear_model import LinearRegression

from config.recordings.thermal_campaign import load_thermal_campaign
from daemon.simulation.simulated_model import published_sensors
from daemon.simulation.thermal_campaign import run_thermal_campaign
from daemon.workbench.thermal.figures.campaign import Campaign, read_campaign
from models.recordings.jumps import remove_jumps_at_switching
from models.records import FloatArray
from models.thermal.training.campaign_study import (
    Key,
    ResidualMap,
    measured_channel,
    random_sensor_order,
    residual_maps,
)
from models.thermal.training.published import MODELS, OUTPUTS, PublishedSet, channel_um

TARGET_S, TARGET_RATIO = 60.0, 50.0


class Refits:
    """Training rows of all sets, written out, and scikit-learn fits on parts of them."""

    def __init__(self, campaign: Campaign, order: np.ndarray[tuple[int], np.dtype[np.intp]]) -> None:
        self.order = order
        self.tests = campaign.tests
        self.inputs, self.outputs, self.length_inputs, self.stops = [], [], [], []
        rows = 0
        for each in campaign.training:
            speed = each.recording.speed_rpm
            assert speed is not None
            um = np.column_stack([channel_um(each.recording, name) for name in OUTPUTS])
            self.outputs.append(np.diff(remove_jumps_at_switching(um, speed), axis=0))
            self.inputs.append(np.diff(each.recording.temperatures_degc, axis=0))
            self.length_inputs.append(np.diff(each.length_inputs, axis=0))
            rows += len(self.inputs[-1])
            self.stops.append(rows)
        self.x, self.y, self.length_x = np.vstack(self.inputs), np.vstack(self.outputs), np.vstack(self.length_inputs)
        self._length: dict[int, LinearRegression] = {}

    def largest_um(self, key: Key, sets: int, sensors: int) -> float:
        """Fit one model from scratch and return its largest residual while the spindle turns [um]."""
        model, group = key
        stop, columns = self.stops[sets - 1], np.sort(self.order[:sensors])
        output = OUTPUTS.index("Z1" if model == "Z1+TL" else model)
        fit = LinearRegression().fit(self.x[:stop][:, columns], self.y[:stop, output])
        return max(self._largest(fit, each, model, columns, sets) for each in self.tests[group])

    def _largest(
        self,
        fit: LinearRegression,
        each: PublishedSet,
        model: str,
        columns: np.ndarray[tuple[int], np.dtype[np.intp]],
        sets: int,
    ) -> float:
        estimate_um = since_start(fit, each.change_k[:, columns], each.elapsed_min)
        if model == "Z1+TL":
            change = each.length_inputs - each.length_inputs[0]
            estimate_um -= since_start(self._length_fit(sets), change, each.elapsed_min)
        residual_um = each.error_um(measured_channel(model)) - estimate_um
        return float(np.abs(residual_um[each.rotating]).max())

    def _length_fit(self, sets: int) -> LinearRegression:
        """TL does not depend on the number of sensors: fitted once for each number of sets, in favour of refitting."""
        if sets not in self._length:
            stop = self.stops[sets - 1]
            self._length[sets] = LinearRegression().fit(self.length_x[:stop], self.y[:stop, 2] - self.y[:stop, 1])
        return self._length[sets]


def since_start(fit: LinearRegression, change: FloatArray, elapsed_min: FloatArray) -> FloatArray:
    """Sum of the predicted increments since the first row."""
    estimate_um: FloatArray = change @ fit.coef_ + fit.intercept_ * elapsed_min
    return estimate_um


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaign", type=Path)
    parser.add_argument("--refits", type=int, default=60)
    parser.add_argument("--all", action="store_true", help="refit everything; takes long")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = chosen.campaign
        if folder is None:
            folder = Path(made)
            wall, processor = time.perf_counter(), time.process_time()
            run_thermal_campaign(folder, load_thermal_campaign(), published_sensors(), seed=1)
            print(f"campaign: {time.perf_counter() - wall:.1f} s, processor {time.process_time() - processor:.1f} s")
        campaign = read_campaign(folder, lambda *_: None)
    order = random_sensor_order(len(campaign.temperature_names), 1)
    walls, processors = [], []
    for _ in range(3):
        wall, processor = time.perf_counter(), time.process_time()
        maps = residual_maps(campaign.training, campaign.tests, order, intercept=True)
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    sets, sensors = len(campaign.training), len(order)
    count = sets * sensors * len(MODELS)
    print(
        f"updated: {sets} x {sensors} x {len(MODELS)} models = {count} fits with their residuals on all tests: "
        f"{min(walls):.2f} s, processor {min(processors):.2f} s (target {TARGET_S:g} s)"
    )
    refit(Refits(campaign, order), maps, None if chosen.all else chosen.refits, (sets, sensors), min(processors))


def refit(
    refits: Refits, maps: dict[Key, ResidualMap], drawn: int | None, shape: tuple[int, int], updated_s: float
) -> None:
    """Time refits, compare them, and print the ratio."""
    sets, sensors = shape
    cases = [(model, k, n) for model in MODELS for k in range(1, sets + 1) for n in range(1, sensors + 1)]
    if drawn is not None:
        rng = np.random.default_rng(1)
        cases = [cases[i] for i in rng.choice(len(cases), size=min(drawn, len(cases)), replace=False)]
    spent_s, wall_s, worst = 0.0, 0.0, 0.0
    for model, k, n in cases:
        wall, processor = time.perf_counter(), time.process_time()
        found = {group: refits.largest_um((model, group), k, n) for group in list(refits.tests)[:1]}
        spent_s += time.process_time() - processor
        wall_s += time.perf_counter() - wall
        for group, value in found.items():
            mine = float(maps[model, group].max_um[k - 1, n - 1])
            worst = max(worst, abs(mine - value) / value)
    scale = sets * sensors * len(MODELS) / len(cases)
    print(
        f"refitted: {len(cases)} fits in {wall_s:.1f} s, processor {spent_s:.1f} s; all would take "
        f"{wall_s * scale:.0f} s, processor {spent_s * scale:.0f} s"
    )
    print(f"largest relative difference of a largest residual: {worst:.1e}")
    print(f"updated is {spent_s * scale / updated_s:.0f} times faster in processor time (target {TARGET_RATIO:g})")


if __name__ == "__main__":
    main()
