"""Sisters of the simulated machine: the same type, built with other physics, on whatever day."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from drivers.sim.machine.day import SPREAD, Day


def on_sister(day: Day, machine: int, spread: float = SPREAD) -> Day:
    """Return a day as it is on a sister machine.

    Every capacity, conductance, heat source and coefficient of the structure of a sister departs from nominal by a
    factor of its own, always the same for the same machine; what differs from day to day comes on top.

    Parameters
    ----------
    day
        A day of the machine of the parameters.
    machine
        Number of the sister, 0 or more; 0 is the machine of the parameters itself.
    spread
        Largest relative departure of a sister's physics from nominal.

    """
    if machine == 0:
        return day
    rng = np.random.default_rng([machine, 211])

    def other(factors: Mapping[str, float]) -> dict[str, float]:
        """Return the day's factors times the sister's."""
        own = 1.0 + spread * rng.uniform(-1.0, 1.0, len(factors))
        return {name: factor * mine for (name, factor), mine in zip(factors.items(), own.tolist(), strict=True)}

    return replace(
        day,
        capacity_factors=other(day.capacity_factors),
        conductance_factors=other(day.conductance_factors),
        heat_factors=other(day.heat_factors),
        structure_factors=other(day.structure_factors),
    )
