"""Finds machines of a fleet that are otherwise than all others, and what explains it: turned or exchanged columns.

A machine of which the others know far less than of each other spoils what all of them learn, so nothing is learned from
it. Where displacements go with what the others say when they are turned round, that is told, and so is where two
temperatures fit when they are changed back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.exchanged_sensors import exchanged_in_one
from models.records import FloatArray
from models.thermal.training.fleet.fleet import Summary, evenly, sharing_of
from models.thermal.training.fleet.sharing import usual_motion

FEWEST_MACHINES = 4
"""With fewer machines nobody knows which of them is right ..."""
FEWEST_COMPARED = 5
"""... and with fewer than these, which of them is strange where nothing explains it."""
MOST_ODD = 0.25
"""No more of the machines than this are taken to be odd."""
STRANGE = 2.5
"""So many times the error that others leave, in the middle, a machine leaves of which the others know too little. Of
sound sisters whose physics scatter by 20 %, on 13 made-up types of machine, none left more than 1.8 times as much."""
TURNED_LEAVES = 0.8
"""Turned round, less than this of the error is left, root mean square, ..."""
TURNED_HELPS = 0.5
"""... and less than this of what is left as it is, which is more than all of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Odd:
    """A machine of which the others know too little."""

    left: float
    """What the others leave of its error for what counts (`usual_motion`), root mean square, mean over the channels."""
    usual: float
    """The same of a machine in the middle."""
    turned: tuple[int, ...]
    """Places of the channels that read the wrong way round."""


def odd_machines(summaries: Sequence[Summary]) -> dict[str, Odd]:
    """Return the machines from which nothing is to be learned.

    The clearest is found first, and the others are looked at again without it, because it spoils what they say.
    """
    found: dict[str, Odd] = {}
    kept = evenly(len(summaries))
    sharing = sharing_of(summaries, kept)
    while len(found) < int(MOST_ODD * len(summaries)):
        right = [place for place, one in enumerate(summaries) if one.machine not in found]
        counts_um = usual_motion(np.array([summaries[place].products.rmse_um() for place in right]))
        looked_at = []
        for place, of_machine_um in zip(right, counts_um, strict=True):
            others = [row for row, at in enumerate(kept) if at != place and at in right]
            looked_at.append(_left(summaries[place], sharing.members(others).mean(axis=0), of_machine_um))
        usual = float(np.median([left for left, _ in looked_at]))
        strange = STRANGE * usual if len(right) >= FEWEST_COMPARED else np.inf
        odd = {
            summaries[place].machine: Odd(left=left, usual=usual, turned=turned)
            for place, (left, turned) in zip(right, looked_at, strict=True)
            if turned or left > strange
        }
        if not odd:
            break
        clearest = max(odd, key=lambda machine: odd[machine].left)
        found[clearest] = odd[clearest]
    return found


def _left(one: Summary, mean: FloatArray, counts_um: FloatArray) -> tuple[float, tuple[int, ...]]:
    """Return what the others leave of the error of a machine, by what counts, and the channels that are turned."""
    before_um2 = one.products.since_yy
    moves = before_um2 > 0.0
    as_it_is, turned = (one.products.left_um2(sign * mean) for sign in (1.0, -1.0))
    against = (as_it_is > before_um2) & (turned < TURNED_HELPS**2 * as_it_is) & (turned < TURNED_LEAVES**2 * before_um2)
    left_um = np.sqrt(as_it_is / one.products.rows)
    left = float((left_um[moves] / counts_um[moves]).mean()) if moves.any() else 0.0
    return left, tuple(np.flatnonzero(against).tolist())


def exchanged_sensors(summaries: Sequence[Summary]) -> dict[str, tuple[str, str, float]]:
    """Return the machines on which two sensors are exchanged, by what all others say, and by how much that is [K]."""
    tested = [(one.machine, one.tested) for one in summaries if one.tested is not None]
    if len(tested) < FEWEST_MACHINES:
        return {}
    found = {}
    squares = [one.squares_k2.astype(np.float64) for _, one in tested]
    for (machine, its), pair in zip(tested, exchanged_in_one(squares), strict=True):
        if pair is not None and all(its.columns[place] for place in pair[0]):
            one, other = (its.columns[place] for place in pair[0])
            found[machine] = one, other, pair[1]
    return found


def sentences(
    odd: Mapping[str, Odd], exchanged: Mapping[str, tuple[str, str, float]], channels: tuple[str, ...]
) -> dict[str, list[str]]:
    """Return what is said of each machine that was found."""
    found: dict[str, list[str]] = {}
    for machine, (one, other, by_k) in exchanged.items():
        found[machine] = [
            f"column {one} does what {other} does on the other machines, and {other} what {one} does there "
            f"({by_k:.2g} K off): the two seem to be exchanged. Look where their cables go, and exchange the two names "
            "in the header of its files, or what the configuration says of the two"
        ]
    for machine, its in odd.items():
        if its.turned:
            verb = "reads" if len(its.turned) == 1 else "read"
            sentence = (
                f"{' and '.join(channels[at] for at in its.turned)} {verb} the wrong way round, by what all other "
                "machines say; nothing was learned from this machine. Look how its sensor was mounted, change the sign "
                "of the column, and train again"
            )
        else:
            sentence = (
                f"what the other machines know is wrong by {its.left:.0%} of what it moves, and {its.usual:.0%} on a "
                "usual one, so nothing was learned from it: sensors or channels may be swapped, it may have changed "
                "between its recordings, or it is of another type"
            )
        found.setdefault(machine, []).append(sentence)
    return found
