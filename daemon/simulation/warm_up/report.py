"""The warm-up as JSON and as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daemon.simulation.warm_up.run import WarmUpRequest, WarmUpRun
from daemon.workbench.figures import Axes, Curve, Figure, save
from models.records import FloatArray

NAMES = {"programmed": "programmed speed", "rule": "published rule", "tuned": "tuned"}
"""Strategy -> words."""


def warm_up_content(runs: Sequence[WarmUpRun], request: WarmUpRequest) -> dict[str, Any]:
    low, high = request.limits.range_rpm(request.demand.programmed_rpm)
    return {
        "programmed_rpm": request.demand.programmed_rpm,
        "depth_mm": request.demand.depth_mm,
        "range_rpm": [low, high],
        "machine_seed": request.machine_seed,
        "day_seed": request.day_seed,
        "strategies": {run.strategy: _run(run) for run in runs},
    }


def _run(run: WarmUpRun) -> dict[str, Any]:
    return {
        "share_stable": run.share_stable,
        "removed_cm3_per_min": run.removed_cm3_per_min(stable_only=False),
        "removed_while_stable_cm3_per_min": run.removed_cm3_per_min(stable_only=True),
        "lowest_limiting_depth_mm": run.lowest_limit_mm,
        "alarms": sorted({minute.pair.alarm for minute in run.minutes if minute.pair.alarm}),
        "minutes": [
            {
                "time_min": minute.time_min,
                "speed_rpm": minute.pair.speed_rpm,
                "feed_mm_min": minute.pair.feed_mm_min,
                "state": minute.pair.state,
                "chatter": not minute.stable,
                "limiting_depth_mm": minute.limiting_depth_mm,
                "true_resonance_hz": minute.true_hz,
                "estimated_resonance_hz": minute.estimated_hz,
            }
            for minute in run.minutes
        ],
    }


def in_words(run: WarmUpRun) -> str:
    """Return what a person wants to know of a run."""
    return (
        f"{NAMES[run.strategy]}: stable for {run.share_stable:.0%} of the time, "
        f"{run.removed_cm3_per_min(stable_only=True):.1f} cm3/min without chatter, "
        f"lowest limiting depth {run.lowest_limit_mm:.2f} mm"
    )


def warm_up_picture(path: Path, runs: Sequence[WarmUpRun], request: WarmUpRequest) -> None:
    """Draw limiting depth, chatter, spindle speed and resonances over time."""
    depth_mm = request.demand.depth_mm
    times = np.array([minute.time_min for minute in runs[0].minutes])
    limits = [_limits(run) for run in runs]
    level = np.array([depth_mm, depth_mm])
    limits.append(Curve(x=times[[0, -1]], y=level, label=f"milled {depth_mm:g} mm", style="dashed"))
    speeds = [
        Curve(x=times, y=np.array([each.pair.speed_rpm for each in run.minutes]), label=NAMES[run.strategy])
        for run in runs
    ]
    chatter = [
        Curve(
            x=times, y=_share_so_far(run), label=NAMES[run.strategy],
            style="dashed" if run.strategy == "tuned" else "solid",
        )
        for run in runs
    ]  # fmt: skip
    axes = [
        Axes(y_label="limiting depth [mm]", curves=limits),
        Axes(y_label="chatter so far", curves=chatter),
        Axes(y_label="speed [1/min]", curves=speeds),
        Axes(x_label="time of milling [min]", y_label="resonance [Hz]", curves=_resonances(runs[-1])),
    ]
    save(path, Figure(title="Milling through warm-up", axes=axes, heights=(190, 130, 190, 190), shared_x=True))


def _limits(run: WarmUpRun) -> Curve:
    found = [(each.time_min, each.limiting_depth_mm) for each in run.minutes if each.limiting_depth_mm is not None]
    return Curve(
        x=np.array([at for at, _ in found]), y=np.array([limit for _, limit in found]), label=NAMES[run.strategy]
    )


def _share_so_far(run: WarmUpRun) -> FloatArray:
    chatter = np.array([not minute.stable for minute in run.minutes], dtype=np.float64)
    share: FloatArray = np.cumsum(chatter) / np.arange(1, len(chatter) + 1)
    return share


def _resonances(run: WarmUpRun) -> list[Curve]:
    times = np.array([minute.time_min for minute in run.minutes])
    lines = []
    for axis in run.minutes[0].true_hz:
        true = np.array([minute.true_hz[axis] for minute in run.minutes])
        estimated = np.array([minute.estimated_hz.get(axis, np.nan) for minute in run.minutes])
        lines.append(Curve(x=times, y=true, label=f"{axis.upper()}, true"))
        lines.append(Curve(x=times, y=estimated, label=f"{axis.upper()}, estimated", style="dashed"))
    return lines
