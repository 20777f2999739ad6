"""Recordings that do not go with the others: one that contradicts them, and a machine that has changed since.

Both are found by what fits without a recording say of it, and proved by what is left of the other recordings once it is
left out. Nothing is left out by itself: a person decides. Runs that are the wrong way round have been left out before
(`models.thermal.training.reversed_runs`).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray
from models.thermal.features import BoolArray, IntArray
from models.thermal.training.families import Fit, Problem, fold_numbers, held_out_um, relative_rmse
from models.thermal.training.inputs import Inputs

AGAINST = -0.5
"""A channel that goes with the estimate of the others by a lower correlation than this contradicts them."""
MOVED_SHARE = 0.2
"""What is measured of it, and estimated, must move by this share of what the other recordings do."""
FEWEST_OTHERS = 2
"""So many other folds must be left when one is left out: of two that differ, nobody knows which is wrong."""
BETTER = 0.8
"""Without what does not go with the others, no more than this share of what was left of the error may remain."""
GOOD_SHARE = 0.05
"""Where no more of the error remains with everything in training, a change is not worth a word."""
MOST_LATER_FITS = 6
"""A change is proved on no more than so many of the recordings after it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction:
    """A recording of which a channel moves against what the others say."""

    recording: int
    channel: int
    correlation: float
    """Of measured and estimated since the first row."""
    remains: tuple[float, float]
    """RMSE with / without a model on the other recordings, with and without it in training."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """The first recording from which the machine behaves otherwise."""

    recording: int
    remains: tuple[float, float]
    """RMSE with / without a model from there on, trained on everything and on what is recent."""


def contradictions(inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem) -> tuple[Contradiction, ...]:
    """Return the recordings that contradict the others, each with its worst channel.

    `inputs`, `rows`, `fold`: training rows and their folds, see `inner_folds`. `problem`: the prepared family.
    """
    numbers = fold_numbers(rows, fold)
    if len(numbers) <= FEWEST_OTHERS or len(inputs.recording_names) <= FEWEST_OTHERS:
        return ()
    try:
        fits = {number: problem.fit(frozenset({number})) for number in numbers}
        found = []
        for recording in range(len(inputs.recording_names)):
            of_recording = rows & (inputs.recording == recording)
            number = _only_fold(of_recording, fold)
            if number is None:
                continue
            worst = _worst_channel(inputs, rows, of_recording, fits[number])
            if worst is None:
                continue
            remains = _without(inputs, rows, fold, problem, fits, number)
            if remains[1] <= BETTER * remains[0]:
                found.append(
                    Contradiction(recording=recording, channel=worst[0], correlation=worst[1], remains=remains)
                )
    except DatasetError:
        return ()
    return tuple(found)


def _only_fold(rows: BoolArray, fold: IntArray) -> int | None:
    """Return the fold that holds all rows of a recording; None where it is cut into several."""
    numbers = np.unique(fold[rows])
    return int(numbers[0]) if len(numbers) == 1 and numbers[0] >= 0 else None


def _worst_channel(inputs: Inputs, rows: BoolArray, of_recording: BoolArray, fit: Fit) -> tuple[int, float] | None:
    measured, estimated = held_out_um(inputs, of_recording, fit)
    if not measured:
        return None
    error_um, estimate_um = np.vstack(measured), np.vstack(estimated)
    usual_um = np.nanstd(inputs.measured_um[rows & ~of_recording], axis=0)
    sizes = np.minimum(_size(error_um), _size(estimate_um))
    product = np.sqrt((np.square(error_um).sum(axis=0)) * np.square(estimate_um).sum(axis=0))
    correlation = np.divide((error_um * estimate_um).sum(axis=0), product, out=np.zeros(len(sizes)), where=product > 0)
    against = np.where(sizes >= MOVED_SHARE * usual_um, correlation, 0.0)
    channel = int(np.argmin(against))
    return (channel, float(against[channel])) if against[channel] <= AGAINST else None


def _size(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def _without(
    inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem, fits: Mapping[int, Fit], out: int
) -> tuple[float, float]:
    """Return what remains of the error of the other folds, with one fold in training and without."""
    others = [number for number in fits if number != out]
    alone = {number: problem.fit(frozenset({number, out})) for number in others}
    both = ({number: fits[number] for number in others}, alone)
    before, after = (relative_rmse(inputs, rows, fold, each) for each in both)
    return before, after


def change_of_regime(inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem) -> Change | None:
    """Return from which recording on the machine behaves otherwise, None where it does not or it does not matter.

    What is recent must predict what is recent better than everything together does. Parameters as for
    `contradictions`.
    """
    numbers = fold_numbers(rows, fold)
    if len(numbers) < 2 * FEWEST_OTHERS + 1:
        return None
    try:
        place = _hardest(inputs, rows, fold, problem, numbers)
        if place is None:
            return None
        earlier, later = frozenset(numbers[:place]), numbers[place:][-MOST_LATER_FITS:]
        everything = {number: problem.fit(frozenset({number})) for number in later}
        recent = {number: problem.fit(earlier | {number}) for number in later}
        remains = relative_rmse(inputs, rows, fold, everything), relative_rmse(inputs, rows, fold, recent)
    except DatasetError:
        return None
    if remains[0] <= GOOD_SHARE or not remains[1] <= BETTER * remains[0]:
        return None
    first = int(inputs.recording[np.flatnonzero(rows & (fold == numbers[place]))[0]])
    return Change(recording=first, remains=remains) if first > 0 else None


def _hardest(inputs: Inputs, rows: BoolArray, fold: IntArray, problem: Problem, numbers: list[int]) -> int | None:
    """Return the place of the fold that the ones before it predict worst against how they are predicted themselves."""
    found = []
    for place in range(FEWEST_OTHERS, len(numbers) - FEWEST_OTHERS + 1):
        fit = problem.fit(frozenset(numbers[place:]))
        found.append(relative_rmse(inputs, rows, fold, {numbers[place]: fit}))
    if not found or not np.isfinite(found).any():
        return None
    return FEWEST_OTHERS + int(np.nanargmax(found))


def sentences(inputs: Inputs, against: tuple[Contradiction, ...], change: Change | None) -> tuple[str, ...]:
    """Return what is said of recordings that do not go with the others, and what to do."""
    said = [
        f"recording {inputs.recording_names[one.recording]} contradicts the others: its channel "
        f"{inputs.channels[one.channel]} moves against what they say (correlation {one.correlation:.2f}), and without "
        f"it {one.remains[1]:.0%} of the others' left-out error remain, not {one.remains[0]:.0%}; check the sign and "
        f"the wiring of that channel, or leave it out with --without {inputs.recording_names[one.recording]}"
        for one in against
    ]
    if change is not None and not against:
        recent = len(inputs.recording_names) - change.recording
        said.append(
            f"from recording {inputs.recording_names[change.recording]} on the machine behaves otherwise than before: "
            f"trained on the last {recent} recordings alone {change.remains[1]:.0%} of their left-out error remain, "
            f"trained on all {change.remains[0]:.0%}; if it was repaired, moved or set otherwise, train on what is "
            f"recent with --recent {recent}"
        )
    return tuple(said)
