"""One day of the simulated machine: everything that differs from day to day."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.sim.machine.heat import SOURCES
from drivers.sim.machine.parameters import AIR_LINKS, LINKS, NODES, OIL_LINKS, OUTSIDE_LINKS
from models.records import FloatArray

Start = Literal["cold", "warm"]

SPREAD = 0.2
"""Largest relative departure of a capacity, conductance, heat source or deformation coefficient from nominal."""
STRUCTURE = (
    "ram_um_per_k",
    "cast_um_per_k",
    "housing_um_per_k",
    "cover_um_per_k",
    "shaft_um_per_k",
    "bearing_um_per_k",
    "bed_um_per_k",
    "column_um_per_k",
    "tilt_um_per_m_k",
    "ram_tilt_um_per_m_k",
    "column_tilt_um_per_m_k",
    "ram_drop_um_per_k",
)
"""Coefficients of the structure that differ from day to day, so that no regression knows them."""
CHILLER_OVER_COLD_K = 2.2
"""Set temperature of the chiller over the hall's mean (chosen: a cold machine's oil warms up first) [K]."""


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


def _link_names() -> tuple[str, ...]:
    conduction = [f"{link.first}-{link.second}" for link in (*LINKS, *OIL_LINKS)]
    return (*conduction, *(f"{name}-air" for name in AIR_LINKS), *(f"{name}-outside" for name in OUTSIDE_LINKS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """Parameters of one simulated day. Factors multiply the nominal values."""

    seed: int
    start: Start
    """Cold: switched off for days. Warm: after ten hours of rotation and standby."""
    capacity_factors: dict[str, float]
    conductance_factors: dict[str, float]
    heat_factors: dict[str, float]
    structure_factors: dict[str, float]
    start_deviation_k: dict[str, float]
    """How far each node of the cold machine is from the hall's temperature [K]."""
    chiller_set_degc: float
    ambient: AmbientProfile

    @classmethod
    def nominal(cls, *, start: Start = "cold") -> "Day":
        """Return the day on which every factor is 1 and the hall stays at 20 degC."""
        ambient = AmbientProfile(
            seed=0,
            mean_degc=20.0,
            daily_amplitude_k=0.0,
            warmest_at_s=0.0,
            wander_k=0.0,
            wander_time_s=3600.0,
            disturbances_per_day=0.0,
            disturbance_k=0.0,
            disturbance_time_s=900.0,
        )
        return cls(
            seed=0,
            start=start,
            capacity_factors=dict.fromkeys(NODES, 1.0),
            conductance_factors=dict.fromkeys(_link_names(), 1.0),
            heat_factors=dict.fromkeys(SOURCES, 1.0),
            structure_factors=dict.fromkeys(STRUCTURE, 1.0),
            start_deviation_k=dict.fromkeys(NODES, 0.0),
            chiller_set_degc=ambient.mean_degc + CHILLER_OVER_COLD_K,
            ambient=ambient,
        )

    @classmethod
    def draw(cls, seed: int, *, start: Start | None = None) -> "Day":
        """Return a random day, always the same for the same seed; `start` None: drawn as well."""
        rng = np.random.default_rng(seed)

        def factors(names: tuple[str, ...]) -> dict[str, float]:
            drawn = 1.0 + SPREAD * rng.uniform(-1.0, 1.0, len(names))
            return dict(zip(names, drawn.tolist(), strict=True))

        structure_rng = np.random.default_rng([seed, 7])
        structure_factors = dict(
            zip(STRUCTURE, (1.0 + SPREAD * structure_rng.uniform(-1.0, 1.0, len(STRUCTURE))).tolist(), strict=True)
        )
        drawn_start: Start = "cold" if rng.random() < 0.5 else "warm"
        mean_degc = float(rng.uniform(19.0, 23.0))
        ambient = AmbientProfile(
            seed=int(rng.integers(2**31)),
            mean_degc=mean_degc,
            daily_amplitude_k=float(rng.uniform(0.3, 1.2)),
            warmest_at_s=float(rng.uniform(0.0, 86400.0)),
            wander_k=float(rng.uniform(0.1, 0.4)),
            wander_time_s=float(rng.uniform(1.0, 4.0)) * 3600.0,
            disturbances_per_day=float(rng.uniform(2.0, 8.0)),
            disturbance_k=float(rng.uniform(0.2, 0.8)),
            disturbance_time_s=float(rng.uniform(300.0, 1200.0)),
        )
        return cls(
            seed=seed,
            start=start or drawn_start,
            capacity_factors=factors(tuple(NODES)),
            conductance_factors=factors(_link_names()),
            heat_factors=factors(tuple(SOURCES)),
            structure_factors=structure_factors,
            start_deviation_k=dict(zip(NODES, rng.uniform(-0.25, 0.25, len(NODES)).tolist(), strict=True)),
            chiller_set_degc=mean_degc + CHILLER_OVER_COLD_K + float(rng.uniform(-0.4, 0.4)),
            ambient=ambient,
        )
