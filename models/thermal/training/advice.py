"""What to record next: sentences for recordings that support less of a model than there could be."""

from collections.abc import Mapping

import numpy as np

from models.recordings.jumps import scatter_um
from models.thermal.features import BoolArray
from models.thermal.training.folds import fold_segments
from models.thermal.training.inputs import Inputs

ENOUGH = 5
"""From so many whole runs or cycles on, what is left out tells families apart."""
SHORT_RUN_MIN = 120.0
"""Shorter runs say nothing of what takes hours."""
TELLS_APART = 8
"""Families that are equally good on so many whole runs or cycles are equally good: nothing more need be recorded."""
SAME = 0.005
"""Families that leave so much more or less of the left-out error are not told apart."""
NOISE_FACTOR = 4.0
"""A channel moves when its values between 5 and 95 % span more than so many times the scatter of neighbouring rows."""


def advice(inputs: Inputs, rows: BoolArray, independent: int) -> tuple[str, ...]:
    """Return what to record next, and why; nothing where the recordings are enough.

    `inputs` and `rows`: the recordings and the training rows. `independent`: how many whole runs or cycles can be left
    out in turn.
    """
    spans_min = [float(np.ptp(inputs.time_min[rows & (inputs.run == run)])) for run in np.unique(inputs.run[rows])]
    longest_min = max(spans_min, default=0.0)
    found = []
    if independent < ENOUGH:
        hours = max(2.0, np.ceil(longest_min / 60.0)) if len(spans_min) > 1 else 4.0
        found.append(
            f"{independent or 'no'} whole run(s) or cycle(s) can be left out, which tells families and sensors apart "
            f"badly: record {ENOUGH - independent} more runs of about {hours:.0f} h, each from a machine at rest, half "
            "of the time warming at another speed than before and half standing still"
        )
    if longest_min < SHORT_RUN_MIN:
        found.append(
            f"the longest run lasts {longest_min:.0f} min, so nothing that takes longer can be learned: record at "
            f"least one run of {2.0 * SHORT_RUN_MIN / 60.0:.0f} h with the cooling after it"
        )
    noise_um = scatter_um([inputs.measured_um[part] for part in fold_segments(inputs, rows)])
    for channel, name in enumerate(inputs.channels):
        values = inputs.measured_um[rows, channel]
        of_runs = [values[inputs.run[rows] == run] for run in np.unique(inputs.run[rows])]
        spans_um = [float(np.subtract(*np.nanquantile(each, (0.95, 0.05)))) for each in of_runs if len(each)]
        if max(spans_um, default=0.0) <= NOISE_FACTOR * noise_um[channel]:
            found.append(
                f"channel {name} moved by {max(spans_um, default=0.0):.2g} um, no more than its noise: nothing can be "
                "learned about it; record runs in which its axis warms, or leave the channel out"
            )
    return tuple(found)


def indistinct(chosen: str, relative_rmse: Mapping[str, float], independent: int) -> tuple[str, ...]:
    """Return what to record where families cannot be told apart; nothing where they can, or need not be.

    `chosen`: the family that was taken. `relative_rmse`: what each family leaves of the left-out error. `independent`:
    how many whole runs or cycles can be left out in turn.
    """
    own = relative_rmse.get(chosen, float("nan"))
    same = [name for name, left in relative_rmse.items() if name != chosen and abs(left - own) <= SAME]
    if not same or independent >= TELLS_APART:
        return ()
    return (
        f"{' and '.join([chosen, *same])} leave the same of the left-out error within {SAME:.1%}, so these recordings "
        f"cannot tell them apart and {chosen} was taken; to tell them apart record {TELLS_APART - independent} more "
        "runs, each at speeds and with pauses that no run has had yet",
    )
