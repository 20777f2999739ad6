"""Temperature of the hall around the simulated machine."""

from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

GRID_S = 60.0
"""Spacing of the stored profile [s]; between its points the temperature is interpolated."""
HORIZON_POINTS = 14 * 24 * 60
"""Length of the stored profile (14 days); after it the random part repeats."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AmbientProfile:
    """What the air of the hall does."""

    seed: int
    mean_degc: float
    daily_amplitude_k: float
    warmest_at_s: float
    """Time of the warmest moment of each day, in seconds since the start of the simulation."""
    wander_k: float
    """Standard deviation of the random walk (one that is drawn back to its mean) [K]."""
    wander_time_s: float
    """Time in which the walk forgets where it was [s]."""
    disturbances_per_day: float
    """Doors, sun, neighbours: sudden changes that fade away."""
    disturbance_k: float
    """Standard deviation of their heights [K]."""
    disturbance_time_s: float
    """Time in which one fades to 37 % [s]."""


class Ambient:
    """The hall's temperature as a function of time, the same for the same profile."""

    def __init__(self, profile: AmbientProfile) -> None:
        self._profile = profile
        self._random_k = _random_part(profile)

    def outside_degc(self, time_s: float) -> float:
        """Return the temperature of the hall [degC] at `time_s` [s] since the start."""
        profile = self._profile
        angle = 2.0 * np.pi * (time_s - profile.warmest_at_s) / 86400.0
        position = (time_s / GRID_S) % (HORIZON_POINTS - 1)
        index = int(position)
        fraction = position - index
        random_k = (1.0 - fraction) * self._random_k[index] + fraction * self._random_k[index + 1]
        return float(profile.mean_degc + profile.daily_amplitude_k * np.cos(angle) + random_k)


def _random_part(profile: AmbientProfile) -> FloatArray:
    """Return random walk plus disturbances on the grid [K]."""
    if profile.wander_k == 0.0 and profile.disturbance_k == 0.0:
        return np.zeros(HORIZON_POINTS)
    rng = np.random.default_rng(profile.seed)
    keep = np.exp(-GRID_S / profile.wander_time_s)
    fade = np.exp(-GRID_S / profile.disturbance_time_s)
    steps = rng.normal(0.0, profile.wander_k * np.sqrt(1.0 - keep**2), HORIZON_POINTS)
    hits = rng.random(HORIZON_POINTS) < profile.disturbances_per_day * GRID_S / 86400.0
    heights = np.where(hits, rng.normal(0.0, profile.disturbance_k, HORIZON_POINTS), 0.0)
    random_k = np.empty(HORIZON_POINTS)
    wander = disturbance = 0.0
    for index in range(HORIZON_POINTS):
        random_k[index] = wander + disturbance
        wander = keep * wander + steps[index]
        disturbance = fade * (disturbance + heights[index])
    return random_k
