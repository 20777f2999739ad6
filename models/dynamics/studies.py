"""Design studies: how modes react to elastic moduli, and what they are compared by."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.dynamics.mac import at_points, modal_assurance
from models.dynamics.modes import Mode

MAC_POINTS = 200
"""Evenly spaced points at which shapes are compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeChange:
    """How one mode differs from the one it is compared with."""

    frequency_hz: float
    change_percent: float
    """Of the frequency, against the base [%]."""
    mac: float
    """Likeness of the shapes (4-39)."""


def mode_changes(base: Sequence[Mode], varied: Sequence[Mode]) -> list[ModeChange]:
    """Return how modes differ, each compared with the base mode of its rank."""
    changes = []
    for one, two in zip(base, varied, strict=False):
        ends = max(one.position_m[0], two.position_m[0]), min(one.position_m[-1], two.position_m[-1])
        wanted = np.linspace(*ends, MAC_POINTS)
        mac = modal_assurance(
            at_points(one.position_m, one.displacement, wanted), at_points(two.position_m, two.displacement, wanted)
        )
        change = 100.0 * (two.frequency_hz / one.frequency_hz - 1.0)
        changes.append(ModeChange(frequency_hz=two.frequency_hz, change_percent=change, mac=mac))
    return changes
