"""Every family of thermal models on every machine of the zoo: `make thermal-zoo`, or this script.

Each machine's recordings are left out in three groups (every third recording together, each recording when there are
three), and every family is trained on the others by its own recipe. `--forward` trains on the first two thirds of the
recordings instead, and tests the others: what is past predicts what comes, a change of regime included. A figure is
the share of the root mean square error that is gone, each recording counted from its own first row: pooled over the
recordings, then averaged over the channels. A recording that was measured with a channel reversed is trained on like
the others, because nobody knows, but not tested.

The last columns: the family that hindsight would choose, and by how many points the default lies above it; then what
the machine would get of the default on line, by its confidence, the share of the time in which the output would follow
it, and in how many trials a channel got worse than nothing.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from zoo_machines import ROSTER, SEED, Machine, chosen, recordings, reversed_run, write

from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import usable_recordings
from models.records import FloatArray
from models.thermal.family import ThermalModel
from models.thermal.training.inputs import Inputs, build_inputs, with_sensors
from models.thermal.training.left_out_sensors import left_out_sensors
from models.thermal.training.online import Followed, compensated_um, follow, following_share
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES
from models.thermal.training.train_family import MOST_WATCHED, model_of
from models.thermal.training.trial import Tester, Trial, since_first_known, trial_rows
from models.thermal.training.trust import Trust, judge
from models.thermal.training.watch_fit import fit_watch

SAMPLE_S = 60.0
GROUPS = 3
NEAR_POINTS = 2.0
"""The default is near the best family when it is no more than so many points below."""
DEFAULT = "default"
HARM = 1.02
"""A trial in which a channel has more than so many times the error without a model counts as worse than nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How the machines are tried."""

    families: tuple[str, ...] = tuple(RECIPES)
    probe_min: float | None = None
    forward: bool = False
    seed: int = SEED


def splits(count: int, *, forward: bool) -> list[tuple[list[int], list[int]]]:
    """Return which recordings are trained on and which are tested, in turn."""
    if forward:
        first = max(2, round(2 * count / 3))
        return [(list(range(first)), list(range(first, count)))]
    tests = [list(range(group, count, GROUPS)) for group in range(min(GROUPS, count))]
    return [([run for run in range(count) if run not in test], test) for test in tests]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Online:
    """What the machine would get of the default on one trial."""

    left_um: FloatArray
    """What remains of the error [um], shape (n, n_channels)."""
    followed: Followed


def trials(
    used: Sequence[Recording], train: Sequence[int], test: Sequence[int], family: str, probe_min: float | None
) -> tuple[list[Trial], Trust | None, list[Online]]:
    """Return a family's trials on recordings that it has not seen, and how far the default is trusted and followed."""
    plain = build_inputs(used, sample_s=SAMPLE_S, lags_min=(), speed_lags_min=())
    trained = np.isin(plain.recording, train)
    dropped = left_out_sensors(used, SAMPLE_S, trained)
    kept = [with_sensors(r, [name for name in plain.sensor_names if name not in dropped]) for r in used]
    prepared = prepare(kept, SAMPLE_S, RECIPES[family], trained, probe_min)
    inputs, problem, rows = prepared.inputs, prepared.problem, prepared.rows
    fit = problem.fit()
    found = [
        Tester(inputs, fit, None, probe_min, None, rows).run(family, part)
        for part in trial_rows(inputs, np.isin(inputs.recording, test))
    ]
    if family != DEFAULT:
        return found, None, []
    trust = judge(inputs, rows, prepared.fold, problem, probe_min=probe_min)
    watched = inputs.layout.sensors <= MOST_WATCHED
    watch = fit_watch(kept, SAMPLE_S, rows, prepared.fold) if watched else None
    model = model_of(family, kept, prepared, fit, trust, watch)
    return found, trust, [online(model, inputs, trial, probe_min, trust) for trial in found]


def online(model: ThermalModel, inputs: Inputs, trial: Trial, probe_min: float | None, trust: Trust) -> Online:
    """Return what the machine would get of a model on a trial."""
    followed, time_min = follow(model, inputs, trial.rows), inputs.time_min[trial.rows]
    held_um = compensated_um(followed, time_min, trial.measured_um, probe_min, trust.bias_filter)
    return Online(left_um=since_first_known(trial.measured_um - held_um), followed=followed)


def figures(found: Sequence[Trial], left_um: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the RMSE without a model [um] and the share of it that is gone where so much is left, over all trials."""
    measured, residual = np.vstack([t.measured_um for t in found]), np.vstack(left_um)
    without, remains = (np.sqrt(np.nanmean(np.square(table), axis=0)) for table in (measured, residual))
    return float(without.mean()), float(1.0 - (remains / without).mean())


def bands(found: Iterable[tuple[Trial, Trust]]) -> tuple[float, float]:
    """Return the share of the residuals inside the band, and its mean width [um]; NaN where there is no band."""
    inside, width = [], []
    for trial, trust in found:
        half = trust.band_um * trial.band_factor[:, None]
        known = np.isfinite(trial.residual_um) & np.isfinite(half)
        inside.append((np.abs(trial.residual_um) <= half)[known])
        width.append(2.0 * half[known])
    shares, widths = np.concatenate(inside), np.concatenate(width)
    return (float(shares.mean()), float(widths.mean())) if len(shares) else (float("nan"), float("nan"))


def try_machine(machine: Machine, options: Options) -> dict[str, Any]:
    """Return the figures of all families on one machine."""
    began = time.process_time()
    used, _ = usable_recordings([recording.downsampled(SAMPLE_S) for recording in recordings(machine, options.seed)])
    wrong = reversed_run(machine)
    reductions: dict[str, float | None] = {}
    found: dict[str, Any] = {"name": machine.name, "half": machine.half, "reductions": reductions}
    for family in options.families:
        done: list[Trial] = []
        got: list[Online] = []
        trusted: list[tuple[Trial, Trust]] = []
        refused = 0
        try:
            for train, test in splits(len(used), forward=options.forward):
                tested = [run for run in test if run != wrong]
                part, trust, on_line = trials(used, train, tested, family, options.probe_min)
                done, got = done + part, got + on_line
                if trust is not None:
                    trusted += [(trial, trust) for trial in part]
                    refused += trust.refused is not None
        except (DatasetError, np.linalg.LinAlgError) as error:
            found.setdefault("refusals", {})[family] = str(error)
            reductions[family] = None
            continue
        found["nothing_um"], reductions[family] = figures(done, [trial.residual_um for trial in done])
        if trusted:
            found |= what_it_gets(done, got)
            found["band_coverage"], found["band_width_um"] = bands(trusted)
            found["refused_models"] = refused
    found["seconds"] = time.process_time() - began
    return found | judged(reductions)


def what_it_gets(done: Sequence[Trial], got: Sequence[Online]) -> dict[str, Any]:
    """Return what the machine gets on line, how often the output follows, and in how many trials it does harm."""
    pairs = [(trial.measured_um, one.left_um) for trial, one in zip(done, got, strict=True)]
    rms = [[np.sqrt(np.nanmean(np.square(um), axis=0)) for um in pair] for pair in pairs]
    return {
        "online": figures(done, [one.left_um for one in got])[1],
        "active": following_share([one.followed for one in got]),
        "worse_online": sum(bool((left > HARM * without).any()) for without, left in rms),
    }


def judged(reductions: dict[str, float | None]) -> dict[str, Any]:
    """Return the best single family in hindsight, and how many points the default lies above it."""
    single = {name: value for name, value in reductions.items() if value is not None and name != DEFAULT}
    if not single:
        return {"best": None, "points": None}
    best = max(single, key=lambda name: single[name])
    default = reductions.get(DEFAULT)
    return {"best": best, "points": None if default is None else 100.0 * (default - single[best])}


def line(found: dict[str, Any], families: Sequence[str]) -> str:
    """Return one machine's line of the table."""
    machine = next(one for one in ROSTER if one.name == found["name"])
    cells = [f"{_percent(found['reductions'].get(family)):>{max(len(family), 6)}}" for family in families]
    points = "-" if found["points"] is None else f"{found['points']:+.1f}"
    return (
        f"{found['name']:18} {found['half']:7} {machine.runs:3} x {machine.hours[1]:4g} h {machine.sample_s:5g} s "
        f"{machine.sensors:4} {found.get('nothing_um', float('nan')):7.1f}  {' '.join(cells)}  "
        f"{found['best'] or '-':13} {points:>6}  {_band(found)}  {_percent(found.get('online')):>7} "
        f"{_percent(found.get('active')):>6} {found.get('worse_online', '-'):>5}  {' '.join(sorted(machine.traits))}"
    )


def head(families: Sequence[str]) -> str:
    """Return the first line of the table."""
    cells = " ".join(f"{family:>{max(len(family), 6)}}" for family in families)
    return (
        f"{'machine':18} {'half':7} {'recordings':>12} {'every':>7} {'T':>4} {'none um':>7}  {cells}  "
        f"{'best family':13} {'points':>6}  {'band':>15}  {'on line':>7} {'active':>6} {'worse':>5}  what is odd"
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f}"


def _band(found: dict[str, Any]) -> str:
    if not np.isfinite(found.get("band_coverage", float("nan"))):
        return f"{'-':>15}"
    return f"{found['band_coverage']:6.0%} {found['band_width_um']:5.1f} um"


def summary(all_found: Sequence[dict[str, Any]], half: str) -> dict[str, Any] | None:
    """Return how near the default is to the best family on a half; None without machines."""
    known = [found for found in all_found if found["half"] == half and found["points"] is not None]
    if not known:
        return None
    points = np.array([found["points"] for found in known])
    shares = np.array([found["reductions"][DEFAULT] for found in known])
    return {
        "half": half,
        "machines": len(known),
        "near": float((points >= -NEAR_POINTS).mean()),
        "mean_points": float(points.mean()),
        "worst_points": float(points.min()),
        "mean_default": float(shares.mean()),
        "mean_best": float(np.mean([found["reductions"][found["best"]] for found in known])),
    } | on_line(known)


def on_line(known: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what machines of a half get on line, in the mean, and on how many of them that is near the estimate."""
    lost = np.array([found["reductions"][DEFAULT] - found["online"] for found in known])
    return {
        "mean_online": float(np.mean([found["online"] for found in known])),
        "near_online": float((100.0 * lost <= NEAR_POINTS).mean()),
        "mean_active": float(np.mean([found["active"] for found in known])),
        "worse_online": sum(found["worse_online"] for found in known),
    }


def _say(found: dict[str, Any]) -> str:
    return (
        f"{found['half']}: {found['machines']} machines; default {found['mean_default']:.1%} in the mean, the best "
        f"family of each in hindsight {found['mean_best']:.1%};\n  no more than {NEAR_POINTS:g} points below it on "
        f"{found['near']:.0%}, {found['mean_points']:+.1f} points in the mean, {found['worst_points']:+.1f} at worst;\n"
        f"  on line {found['mean_online']:.1%} "
        f"in the mean, within {NEAR_POINTS:g} points of the estimate on {found['near_online']:.0%}, following "
        f"{found['mean_active']:.0%} of the time, worse than nothing in {found['worse_online']} trials"
    )


def _arguments(given: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--half", choices=["tuning", "judging"], help="machines of this half only")
    parser.add_argument("--machines", type=int, metavar="N", help="the first N machines only")
    parser.add_argument("--only", metavar="NUMBERS", help="these machines only, by number: 3,17")
    parser.add_argument("--families", help="these only, separated by commas (default: all)")
    parser.add_argument("--probe-minutes", type=float, help="a probe resets the offset so often [min]")
    parser.add_argument("--forward", action="store_true", help="train on the first two thirds, test the others")
    parser.add_argument("--seed", type=int, default=SEED, help="of all machines (default: %(default)s)")
    parser.add_argument("--processes", type=int, default=2, help="at a time (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write the recordings there instead, with maps")
    return parser.parse_args(given)


def main(given: Sequence[str] | None = None) -> int:
    """Print the table; return the exit status."""
    wanted = _arguments(given)
    machines = list(chosen(wanted.half, wanted.machines))
    if wanted.only:
        numbers = {int(number) for number in wanted.only.split(",")}
        machines = [machine for machine in machines if machine.number in numbers]
    if wanted.write is not None:
        for machine in machines:
            print(write(machine, wanted.write, wanted.seed)[0].parent)
        return 0
    families = tuple(wanted.families.split(",")) if wanted.families else tuple(RECIPES)
    if unknown := sorted(set(families) - set(RECIPES)):
        print(f"there is no family {', '.join(unknown)}; there are {', '.join(RECIPES)}", file=sys.stderr)
        return 2
    options = Options(families=families, probe_min=wanted.probe_minutes, forward=wanted.forward, seed=wanted.seed)
    for half in ("tuning", "judging"):
        print(f"{half}: machines {', '.join(str(m.number) for m in machines if m.half == half) or 'none'}")
    print(head(families), flush=True)
    found = []
    with ProcessPoolExecutor(wanted.processes) as pool:
        for one in pool.map(partial(try_machine, options=options), machines):
            found.append(one)
            print(line(one, families), flush=True)
    halves = [each for half in ("tuning", "judging") if (each := summary(found, half)) is not None]
    print("\n".join(_say(each) for each in halves))
    print(f"{sum(one['seconds'] for one in found):.0f} s of processor time")
    if wanted.json is not None:
        wanted.json.write_text(json.dumps({"machines": found, "halves": halves}, indent=2), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
