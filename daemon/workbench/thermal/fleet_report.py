"""What the training of a fleet says: how good a type is on machines that were left out, and which one to look at."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from daemon.workbench.thermal.fleet import FleetTraining
from models.records import FloatArray
from models.thermal.training.fleet.fleet import LeftOut
from models.thermal.training.fleet.sharing import usual_motion

WORSE = 1.1
"""Errors that grow to this times what they are without a model, or on a usual machine, are told."""


def summary(result: FleetTraining, path: Path | None) -> dict[str, Any]:
    """Return what was learned, and how good it is on machines that were left out, for JSON."""
    made = result.machine_type
    left_out = {
        one.machine: [each for each in result.left_out if each.machine == one.machine] for one in result.summaries
    }
    contradicting = contradictions(result.left_out, made.channels)
    return {
        "type": {
            "file": None if path is None else str(path),
            "type_id": made.type_id,
            "sensors": len(made.parts),
            "directions": made.space.directions.shape[1],
            "lags_min": list(made.space.layout.lags_min),
            "speed_lags_min": list(made.space.layout.speed_lags_min),
            "channels": list(made.channels),
            "machines_kept": list(made.machines),
        },
        "machines": [
            {
                "machine": one.machine,
                "recordings": one.recordings,
                "stale_recordings": one.stale,
                "own_model": one.how,
                "warnings": [*result.odd.get(one.machine, ()), *one.warnings, *contradicting.get(one.machine, ())],
                "left_out": [_left_out(each, made.channels) for each in left_out[one.machine]],
            }
            for one in result.summaries
        ],
        "left_out": _together(result.left_out),
        "refused": [
            {
                "machine": one.machine,
                "recording": None if one.recording is None else str(one.recording),
                "why": one.why,
            }
            for one in result.refused
        ],
    }


def contradictions(left_out: Sequence[LeftOut], channels: tuple[str, ...]) -> dict[str, list[str]]:
    """Return a sentence for each machine that was left out, and for which what the others know is of little use."""
    with_none = [one for one in left_out if one.recordings == 0]
    counts_um = usual_motion(np.array([one.without_um for one in with_none])) if with_none else ()
    found = {}
    for one, of_machine_um in zip(with_none, counts_um, strict=True):
        worse = [
            f"{name} {1.0 - left_um / without_um:.0%}"
            for name, without_um, left_um, counts in zip(
                channels, one.without_um, one.with_prior_um, of_machine_um, strict=True
            )
            if left_um > WORSE * counts and without_um > 0.0
        ]
        if worse:
            found[one.machine] = [
                f"what the other machines know makes it worse than nothing ({', '.join(worse)} of the error gone): "
                "channels may be swapped, or it is of another type: train once without it, and see whether the others "
                "gain"
            ]
    return found


def _left_out(one: LeftOut, channels: tuple[str, ...]) -> dict[str, Any]:
    def named(rmse_um: FloatArray) -> dict[str, float]:
        """Return figures by channel."""
        return dict(zip(channels, rmse_um.tolist(), strict=True))

    return {
        "recordings": one.recordings,
        "tested_on": one.tested_on,
        "rmse_um": {
            "without": named(one.without_um),
            "alone": None if one.alone_um is None else named(one.alone_um),
            "with_prior": named(one.with_prior_um),
        },
        "reduction_rmse": {
            "alone": None if one.alone_um is None else reduction(one.without_um, one.alone_um),
            "with_prior": reduction(one.without_um, one.with_prior_um),
        },
        "taken_over": one.how,
    }


def reduction(without_um: FloatArray, left_um: FloatArray) -> float:
    """Return the share of the error that is gone, mean over the channels that move."""
    moves = without_um > 0.0
    return float(1.0 - (left_um[moves] / without_um[moves]).mean()) if moves.any() else 0.0


def _together(left_out: Sequence[LeftOut]) -> list[dict[str, Any]]:
    """Return mean and worst reduction over the machines that were left out, by number of their own recordings."""
    found = []
    for count in sorted({one.recordings for one in left_out}):
        of_count = [one for one in left_out if one.recordings == count]
        prior = [reduction(one.without_um, one.with_prior_um) for one in of_count]
        alone = [reduction(one.without_um, one.alone_um) for one in of_count if one.alone_um is not None]
        found.append(
            {
                "recordings": count,
                "machines": len(of_count),
                "with_prior": {"mean": float(np.mean(prior)), "worst": min(prior)},
                "alone": {"mean": float(np.mean(alone)), "worst": min(alone)} if alone else None,
            }
        )
    return found
