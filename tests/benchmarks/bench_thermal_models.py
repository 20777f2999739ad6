"""What thermal models reach on a real recording, and what training and using them takes with 302 sensors.

    python tests/benchmarks/bench_thermal_models.py recording fl_thermal_46h_15s.csv [--only a,c,four,faults]
    python tests/benchmarks/bench_thermal_models.py sensors [--families default,gaussian,lags,ridge,increments]

`recording`: "a" trains on hours 0-32 and tests 32-46.3, "c" leaves each spindle cycle out in turn, "four" trains on any
four of the cycles and tests the others, "faults" lets every sensor fail in the test of "a". `sensors` makes up 46 h of
302 sensors with a body that no sensor sees, trains every family in a process of its own, loads its model in another,
and estimates sample by sample. Nothing here passes or fails.
"""

import argparse
import gc
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from daemon.model_release.loading import LoadedModel
from daemon.model_release.side_load import pack, unpack
from daemon.telemetry.metrics import give_memory_back, keep_one_heap
from daemon.workbench.thermal.evaluation import Protocol, evaluate, read_recordings
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.training.folds import cycles
from models.thermal.training.inputs import build_inputs
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES
from models.thermal.training.train_family import train_family
from models.thermal.training.trial import Fault, Tester
from models.thermal.training.trust import judge

SAMPLE_S, HOURS, SENSORS, CHANNELS = 60.0, 46, 302, 5
TRAIN, TEST, FAULT_H, CYCLES = (0.0, 32.0), (32.0, 46.3), 36.0, 4
FAULTS = (("stuck", 0.0), ("step", 5.0), ("open", 0.0), ("drift", 1.0))


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    of_recording = commands.add_parser("recording", help="figures on a real recording")
    of_recording.add_argument("file", type=Path)
    of_recording.add_argument("--only", default="a,c,probes,four,faults")
    of_sensors = commands.add_parser("sensors", help="time and memory with 302 sensors")
    of_sensors.add_argument("--families", default="default,gaussian,lags,ridge,increments")
    for name in ("train", "use"):
        hidden = commands.add_parser(name, help="one step of `sensors`, in a process of its own")
        hidden.add_argument("family")
        hidden.add_argument("model", type=Path)
    wanted = parser.parse_args()
    if wanted.command == "recording":
        on_recording(wanted.file, wanted.only.split(","))
    elif wanted.command == "sensors":
        with tempfile.TemporaryDirectory() as folder:
            for family in wanted.families.split(","):
                for step in ("train", "use"):
                    arguments = [sys.executable, __file__, step, family, str(Path(folder) / f"{family}.json")]
                    subprocess.run(arguments, check=True)
    else:
        {"train": train, "use": use}[wanted.command](wanted.family, wanted.model)


def on_recording(file: Path, only: Sequence[str]) -> None:
    """Print the figures on a real recording."""
    recordings, _ = read_recordings([file], None, _silent)
    if "a" in only:
        _say("A", evaluate(recordings, SAMPLE_S, "default", Protocol(train_hours=TRAIN, test_hours=TEST), _silent))
    if "c" in only:
        _say("C", evaluate(recordings, SAMPLE_S, "default", Protocol(leave_out="cycles"), _silent))
    if "probes" in only:
        for name, split in (("A", {"train_hours": TRAIN, "test_hours": TEST}), ("C", {"leave_out": "cycles"})):
            protocol = Protocol(probe_min=60.0, **split)  # type: ignore[arg-type]
            _say(f"{name} with an hourly probe", evaluate(recordings, SAMPLE_S, "default", protocol, _silent))
    if "four" in only:
        any_four(recordings)
    if "faults" in only:
        faults = tuple(Fault(kind=kind, sensor="each", at_hours=FAULT_H, amount=amount) for kind, amount in FAULTS)  # type: ignore[arg-type]
        protocol = Protocol(train_hours=TRAIN, test_hours=TEST, faults=faults)
        found = evaluate(recordings, SAMPLE_S, "default", protocol, _silent)["faults"]
        for kind, _ in FAULTS:
            of_kind = [one for one in found if one["kind"] == kind]
            worst = max(of_kind, key=lambda one: one["max_ratio"])
            missed = [one["sensor"] for one in of_kind if one["found_after_min"] is None]
            print(f"{kind}: at most {worst['max_ratio']:.2f} times ({worst['sensor']}), not found: {missed or 'none'}")


def _silent(what: str, done: int, total: int) -> None:
    """Print no progress."""


def _say(name: str, found: dict[str, Any]) -> None:
    mean, channels = found["mean"], found["channels"].values()
    lowest = min(one["band_coverage"] for one in channels)
    print(
        f"{name}: {mean['reduction_rmse']:.1%} / {mean['reduction_max']:.1%}, on line "
        f"{mean['online']['reduction_rmse']:.1%}; {mean['rmse_um']:.2f} / {mean['max_um']:.2f} um; band covers "
        f"{mean['band_coverage']:.0%}, {lowest:.0%} at least, {mean['band_width_um']:.1f} um; "
        f"{found['false_alarms']} false alarms",
        flush=True,
    )


def any_four(recordings: Sequence[Recording]) -> None:
    """Print what is left of the other cycles with any four as training, pooled over their rows, mean over channels."""
    plain = build_inputs(recordings, sample_s=SAMPLE_S, lags_min=(), speed_lags_min=())
    found = cycles(plain, np.ones(plain.rows, dtype=np.bool_))
    shares, covered = [], []
    for some in combinations(range(len(found)), CYCLES):
        trained = np.any([found[index] for index in some], axis=0)
        prepared = prepare(recordings, SAMPLE_S, RECIPES["default"], trained)
        inputs, problem = prepared.inputs, prepared.problem
        trust = judge(inputs, prepared.rows, prepared.fold, problem)
        tester = Tester(inputs, problem.fit(), None, None, None, prepared.rows)
        trials = [tester.run("", np.flatnonzero(mask)) for i, mask in enumerate(found) if i not in some]
        measured, left = np.vstack([t.measured_um for t in trials]), np.vstack([t.residual_um for t in trials])
        rmse = [np.sqrt(np.nanmean(np.square(table), axis=0)) for table in (left, measured)]
        largest = [np.nanmax(np.abs(table), axis=0) for table in (left, measured)]
        shares.append([float(1.0 - (of[0] / of[1]).mean()) for of in (rmse, largest)])
        half = np.vstack([trust.band_um * t.band_factor[:, None] for t in trials])
        covered.append(float((np.abs(left) <= half).mean()))
        names = " ".join(str(index + 1) for index in some)
        print(f"  cycles {names}: {shares[-1][0]:.1%} / {shares[-1][1]:.1%}, band {covered[-1]:.0%}", flush=True)
    mean = np.mean(shares, axis=0)
    print(f"any {CYCLES} cycles, {len(shares)} splits: {mean[0]:.1%} / {mean[1]:.1%}, band {np.mean(covered):.0%}")


def made_up() -> Recording:
    """Return 46 h of 302 sensors: heat by twelve loads, a slow body that moves the tool unseen, and what bends."""
    rng = np.random.default_rng(3)
    minutes = np.arange(60.0 * HOURS)
    count = len(minutes)
    load = np.repeat(rng.uniform(0.0, 1.0, 12), count // 12 + 1)[:count]
    load *= np.tile(np.r_[np.ones(150), np.zeros(80)], count // 230 + 1)[:count]
    heat = np.column_stack([load, np.square(load), np.sin(minutes / 230.0)])
    body: FloatArray = np.hstack(list(lag_table(minutes, heat, (8.0, 35.0, 200.0))))
    degc = 22.0 + 10.0 * body[:, :6] @ rng.uniform(0.0, 1.0, (6, SENSORS)) + rng.normal(0.0, 0.02, (count, SENSORS))
    bends = np.square(body) @ rng.normal(0.0, 30.0, (9, CHANNELS)) + np.cumsum(rng.normal(0.0, 0.1, (count, 1)), axis=0)
    um = body @ rng.normal(0.0, 20.0, (9, CHANNELS)) + bends + rng.normal(0.0, 0.1, (count, CHANNELS))
    return Recording(
        name="made up",
        time_s=60.0 * minutes,
        speed_rpm=5000.0 * load,
        temperature_names=tuple(f"T{index + 1}" for index in range(SENSORS)),
        temperatures_degc=degc,
        displacement_names=tuple(f"c{index + 1}" for index in range(CHANNELS)),
        displacements_um=um,
    )


def train(family: str, file: Path) -> None:
    """Print what training takes, and keep the model."""
    keep_one_heap()  # as `toolpoint thermal train` does
    recording = made_up()
    before_mib = _most_mib()
    began_s = time.process_time()
    made = train_family([recording], family, sample_s=SAMPLE_S, created="2026-01-01T00:00:00Z")
    took_s, most_mib = time.process_time() - began_s, _most_mib()
    file.write_text(made.model.to_json(), encoding="utf-8")
    with file.with_suffix(".packed").open("wb", buffering=0) as packed:  # as the process beside the daemon leaves it
        pack(LoadedModel(model=model_from_json(file.read_bytes(), file.name), inhibit=""), packed)
    members = made.hyper_parameters.get("members", made.hyper_parameters.get("family", ""))
    print(f"{family} ({members})")
    print(f"  training: {took_s:.1f} s of processor time, {most_mib:.0f} MiB at most ({before_mib:.0f} before)")


def use(family: str, file: Path) -> None:
    """Print what a loaded model adds to a process, and what an estimate takes."""
    keep_one_heap()
    recording = made_up()
    assert recording.speed_rpm is not None
    degc = recording.temperatures_degc.copy()
    ones = np.ones((600, 600))
    ones @ ones, np.linalg.inv(np.eye(100))  # what linear algebra takes once, whatever it works on
    del ones
    gc.collect()
    give_memory_back()
    before_mib = _now_mib()
    with file.with_suffix(".packed").open("rb") as packed:
        model = unpack(packed.fileno()).model
    assert model is not None
    loaded_mib = _now_mib() - before_mib
    assert model.sensor_names == recording.temperature_names
    online = model.runtime(Machine(components={}))
    online.on_sample(0.0, degc[0], 0.0)
    online.set_reference(OnlineReference(time_min=0.0, now_min=0.0, degc=degc[0]))
    absent, spent = np.zeros(SENSORS, dtype=np.bool_), []
    for row in range(1, 600):
        online.on_sample(float(row), degc[row], float(recording.speed_rpm[row]))
        at_s = time.process_time()
        online.estimate(float(row), degc[row], absent)
        spent.append(1e3 * (time.process_time() - at_s))
    gc.collect()
    print(f"  file {file.stat().st_size / 2**20:.1f} MiB; adds {loaded_mib:.1f} MiB when loaded, ", end="")
    print(
        f"{_now_mib() - before_mib:.1f} after {len(spent)} estimates, each {np.median(spent):.3f} ms of processor time"
    )


def _most_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _now_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


if __name__ == "__main__":
    main()
