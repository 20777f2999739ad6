"""Whether an input of temperatures answers from memory: all its numbers stand, where one of them nearly always changes.

A box, a gateway or a program whose own sensors have gone silent often goes on sending what it read last. Each number is
possible, and so is each one that stands; that all of them stand is told by how often any of them changed until then.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray

REMEMBERED = 200
"""How often numbers change is the mean of so many readings."""
FEWEST = 180
"""It is judged from so many readings on."""
BLOCK = 20
"""Of so many readings in a row, those in which it changed least often count: numbers that are rounded to tenths of a
kelvin or more change again and again where they lie between two steps, and stand for minutes where they do not."""
FORGOTTEN = 0.003
"""By this share of the difference such a block is forgotten with each one after it: within a day."""
MOST_CHANGING = 0.9
"""A share above it is taken for this: a few readings alike are no proof."""
IMPROBABLE = 14.0
"""Natural logarithm of how improbable standing numbers must be: one in a million."""
LEAST_S = 300.0
"""And they must have stood for so long [s]."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StandingInput:
    """What is known of one input from one reading to the next."""

    degc: FloatArray
    """Latest number of each sensor [degC], NaN before the first."""
    readings: int = 0
    changing: float = 0.0
    """Share of the readings in which any number changed, of the last ones."""
    least: float = 1.0
    """The smallest such share of a block that was no answer from memory."""
    block: tuple[int, int] = (0, 0)
    """Of the block that has begun how many readings there were, and in how many of them any number changed."""
    proven: bool = True
    """Its numbers have changed about as often as before since it answered from memory last."""
    improbable: float = 0.0
    """How improbable it is that the numbers stand as long as they do, natural logarithm."""
    since_s: float = 0.0
    """Since when they stand [s]."""

    def stands_s(self, now_s: float) -> float:
        """Return for how long the input has answered from memory [s]; 0 where nothing says so."""
        stood_s = now_s - self.since_s
        return stood_s if self.improbable >= IMPROBABLE and stood_s >= LEAST_S else 0.0


def renewed_input(before: StandingInput, degc: FloatArray, now_s: float) -> StandingInput:
    """Return what is known of an input after a reading.

    `degc`, shape (n_sensors,): numbers as read [degC], NaN where there is none. `now_s`: time of the reading [s].
    """
    told = np.isfinite(degc)
    both = told & np.isfinite(before.degc)
    latest = np.where(told, degc, before.degc)
    if not both.any():
        return replace(before, degc=latest, improbable=0.0, since_s=now_s)
    changed = bool((degc[both] != before.degc[both]).any())
    share = 1.0 / min(before.readings + 1, REMEMBERED)
    likely = min(before.changing, before.least) if before.readings >= FEWEST else 0.0
    least, changing, proven = before.least, before.changing, before.proven
    block = (before.block[0] + 1, before.block[1] + changed)
    if changed and before.stands_s(now_s):
        proven, block, changing = False, (0, 0), max(changing, least)
    elif block[0] >= BLOCK and not proven:
        proven, block = block[1] / block[0] >= least / 2.0, (0, 0)
    elif block[0] >= BLOCK and changed:
        kept = least + FORGOTTEN * max(changing - least, 0.0)
        least, block = min(kept, block[1] / block[0]), (0, 0)
    return StandingInput(
        degc=latest,
        readings=before.readings + 1,
        changing=changing + share * (float(changed) - changing) if proven else changing,
        least=least,
        block=block,
        proven=proven,
        improbable=0.0 if changed else before.improbable - math.log1p(-min(likely, MOST_CHANGING)),
        since_s=now_s if changed else before.since_s,
    )
