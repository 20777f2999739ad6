"""A step that is not made at once: added when it would come, and faded out."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

FADE_MIN = 2.0
"""Time constant [min]; a step of 20 um has 0.13 um left after ten minutes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fading:
    """What is added so that something goes on from where it was."""

    amount: FloatArray
    since_min: float = 0.0
    """When it was that much [min]."""

    def at(self, time_min: float) -> FloatArray:
        """Return what is left of it."""
        left: FloatArray = self.amount * np.exp(-max(time_min - self.since_min, 0.0) / FADE_MIN)
        return left


def hidden_step(before: FloatArray, after: FloatArray, time_min: float) -> Fading:
    """Return what lets a value go on from `before` though it is `after` from now on."""
    return Fading(amount=before - after, since_min=time_min)
