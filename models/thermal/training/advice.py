"""What to record next: sentences for recordings that support less of a model than there could be."""

import shlex
from collections.abc import Mapping, Sequence

import numpy as np

from models.recordings.findings import counted
from models.recordings.jumps import scatter_um
from models.thermal.features import BoolArray
from models.thermal.training.evaluation import NOISE_FACTOR, ResidualMetrics, spans_um
from models.thermal.training.folds import FEWEST_CYCLES, cycles, fold_segments
from models.thermal.training.inputs import Inputs

ENOUGH = 5
"""From so many whole runs or cycles on, what is left out tells families apart."""
SHORT_RUN_MIN = 120.0
"""Shorter runs say nothing of what takes hours."""
TELLS_APART = 8
"""Families that are equally good on so many whole runs or cycles are equally good: nothing more need be recorded."""
SAME = 0.005
"""Families that leave so much more or less of the left-out error are not told apart."""


def advice(inputs: Inputs, rows: BoolArray, independent: int) -> tuple[str, ...]:
    """Return what to record next, and why; nothing where the recordings are enough.

    `inputs` and `rows`: the recordings and the training rows. `independent`: how many whole runs or cycles can be left
    out in turn.
    """
    independent = whole_runs(inputs, rows, independent)
    spans_min = [float(np.ptp(inputs.time_min[rows & (inputs.run == run)])) for run in np.unique(inputs.run[rows])]
    longest_min = max(spans_min, default=0.0)
    found = []
    if independent < ENOUGH:
        hours = max(2.0, np.ceil(longest_min / 60.0)) if len(spans_min) > 1 else 4.0
        found.append(
            f"{independent or 'no'} whole {'runs or cycles' if independent > 1 else 'run or cycle'} can be left out, "
            "which tells families and sensors apart badly and makes a wide band: record "
            f"{more_runs(ENOUGH - independent)} of about {hours:.0f} h, {'each ' * (ENOUGH - independent > 1)}"
            "from a machine at rest, half of the time warming at another speed than before and half standing still"
        )
    if longest_min < SHORT_RUN_MIN:
        found.append(
            f"the longest run lasts {longest_min:.0f} min, so nothing that takes longer can be learned: record at "
            f"least one run of {2.0 * SHORT_RUN_MIN / 60.0:.0f} h with the cooling after it"
        )
    return (*found, *still_channels(inputs, rows))


def still_channels(inputs: Inputs, rows: BoolArray) -> tuple[str, ...]:
    """Return what to do about channels that hardly move; `inputs` and `rows`: the recordings and the training rows."""
    of_runs = [inputs.measured_um[rows & (inputs.run == run)] for run in np.unique(inputs.run[rows])]
    noise_um = scatter_um([inputs.measured_um[part] for part in fold_segments(inputs, rows)])
    return tuple(
        f"channel {name} moved by {span_um:.2g} um, no more than its noise: nothing can be learned about it, and it "
        "has no say in what is chosen; record runs in which its axis warms, or leave the channel out"
        for name, span_um, noise in zip(inputs.channels, spans_um(of_runs), noise_um, strict=True)
        if span_um <= NOISE_FACTOR * noise
    )


def whole_runs(inputs: Inputs, rows: BoolArray, independent: int) -> int:
    """Return how many whole runs or cycles there are, see `advice`: stretches of a run without cycles are none."""
    runs = len(np.unique(inputs.run[rows]))
    if runs >= FEWEST_CYCLES or (inputs.speed_rpm is not None and len(cycles(inputs, rows)) >= FEWEST_CYCLES):
        return independent
    return min(independent, runs) if runs > 1 else 0


def more_runs(count: int) -> str:
    """Return a number of runs to record, such as `1 more run`."""
    return counted(count, "more run")


def worse_channels(held_out: ResidualMetrics | None, explained: Sequence[str] = ()) -> tuple[str, ...]:
    """Return what to do about channels of which a model leaves more than there was, on what it had not seen.

    `held_out`: residuals on that. `explained`: channels of which is said already why.
    """
    if held_out is None:
        return ()
    good = [name for name, share in zip(held_out.channels, held_out.relative_rmse, strict=True) if share < 1.0]
    offered = f"train without it (--channels {shlex.quote(','.join(good))}), or " if good else ""
    return tuple(
        f"channel {name}: on what was left out the model leaves {with_um:.3g} um of {without_um:.3g} um, which is no "
        f"better than no compensation; let no axis follow it: {offered}record {more_runs(2)} in which this channel "
        "moves by several times as much, each warming at another speed and then cooling"
        for name, with_um, without_um in zip(
            held_out.channels, held_out.rmse_with_um, held_out.rmse_without_um, strict=True
        )
        if with_um >= without_um > 0.0 and name not in explained
    )


def indistinct(chosen: str, relative_rmse: Mapping[str, float], independent: int) -> tuple[str, ...]:
    """Return what to record where families cannot be told apart; nothing where they can, or need not be.

    `chosen`: the family that was taken. `relative_rmse`: what each family leaves of the left-out error. `independent`:
    how many whole runs or cycles can be left out in turn.
    """
    own = relative_rmse.get(chosen, float("nan"))
    same = [name for name, left in relative_rmse.items() if name != chosen and abs(left - own) <= SAME]
    if not same or independent >= TELLS_APART:
        return ()
    more = more_runs(TELLS_APART - independent) + (
        " in all" if independent < ENOUGH else ""
    )  # as `advice` asks for some
    return (
        f"these recordings cannot tell {', '.join(map(repr, [chosen, *same]))} apart, which leave the same of the "
        f"left-out error within {SAME:.1%}; {chosen!r} was taken. To tell them apart record "
        f"{more}{', each' * (TELLS_APART - independent > 1)} at speeds and with "
        "pauses that no run has had yet",
    )
