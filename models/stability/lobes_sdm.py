"""Stability lobes from spectral radii: the first depth at which that of one tooth passing is 1.

Radii come from the collocation in the engaged arc, which needs fewest unknowns and follows any immersion; where a mode
vibrates too often from tooth to tooth for it, or the number of steps is given, from the semi-discretisation.
"""

import numpy as np

from models.records import FloatArray
from models.stability.collocation import follows, spectral_radii
from models.stability.lobes import FEED_STEP_DEG, LobeMinimum, StabilityLobes, check_range, lowest_of
from models.stability.milling import Cut, directional_matrix
from models.stability.response import ModalResponse
from models.stability.semi_discretisation import (
    SemiDiscretisation,
    chatter_frequency_hz,
    default_steps,
    semi_discretisation,
    spectral_radius,
)
from models.stability.state_space import state_space
from models.units import mm_from_m

LEVELS = 48
"""Depths tried at each speed, in a geometric row, before the first limit is narrowed down."""
SHALLOWEST = 0.5
DEEPEST = 60.0
"""First and, by default, last of these depths, in multiples of `typical_depth_mm`."""
LOOKED_INTO = 0.9
"""A depth whose radius is above this and above its neighbours' may hide an island of instability beside it."""
ISLAND_POINTS, ISLAND_ROUNDS = 9, 3
NARROWING_POINTS = 3
NARROWING_ROUNDS = 3
MINIMUM_POINTS = 9
MINIMUM_ROUNDS = 3
LOWEST_CANDIDATES = 3


def typical_depth_mm(response: ModalResponse, cut: Cut) -> float:
    """Return the order of magnitude of the limiting depth [mm]: loop gain 1 where it is greatest over frequency."""
    receptances = response.receptance_m_per_n(response.frequencies_hz(0.0))
    pitch, arc = 2.0 * np.pi / cut.teeth, cut.exit_rad - cut.start_rad
    angles = np.linspace(0.0, pitch, 721) if arc > pitch else cut.start_rad + arc * (np.arange(720) + 0.5) / 720
    coupled = np.square(np.abs(directional_matrix(cut, angles))).sum(axis=1)
    moved = np.square(np.abs(receptances)).sum(axis=2)
    gain_m_per_n = float(np.sqrt(moved @ coupled.T).mean(axis=1).max()) * min(arc / pitch, 1.0)
    return mm_from_m(1.0 / (cut.tangential_n_per_m2 * gain_m_per_n))


def semi_discretised_lobes(
    response: ModalResponse,
    cut: Cut,
    *,
    from_rpm: float,
    to_rpm: float,
    points: int,
    feed_deg: float = 0.0,
    max_depth_mm: float | None = None,
    steps: int | None = None,
) -> StabilityLobes:
    """Return the lobes between two spindle speeds, flip lobes with them.

    Result: inf where the cut is stable up to the greatest depth. Raises StabilityError when the range is none or
    nothing can move.

    Parameters
    ----------
    response
        Modes of the structure, in machine axes.
    cut
        Engagement and cutting coefficients.
    from_rpm, to_rpm
        Range of speeds [1/min].
    points
        Number of evenly spaced speeds.
    feed_deg
        Direction of the feed against X [deg].
    max_depth_mm
        Greatest depth tried [mm]; None takes 60 times `typical_depth_mm`. An island of instability
        is looked for wherever the radius has a maximum over depth, sampled every 11 %.
    steps
        Steps per tooth passing of the semi-discretisation; None: by collocation.

    """
    check_range(from_rpm, to_rpm, points)
    methods = _Methods(response, cut, feed_deg, steps)
    typical_mm = typical_depth_mm(response, cut)
    deepest_mm = max_depth_mm or DEEPEST * typical_mm
    levels_mm = np.geomspace(min(SHALLOWEST * typical_mm, 0.5 * deepest_mm), deepest_mm, LEVELS)
    speed_rpm = np.linspace(from_rpm, to_rpm, points)
    limits = np.array([_limit_mm(methods, speed, levels_mm) for speed in speed_rpm.tolist()])
    chatter_hz = np.array(
        [_chatter_hz(methods, *pair) for pair in zip(speed_rpm.tolist(), limits.tolist(), strict=True)]
    )
    minimum = _minimum(methods, speed_rpm, limits, levels_mm)
    warnings = () if minimum else (f"stable everywhere up to {deepest_mm:.4g} mm, the greatest depth tried",)
    return StabilityLobes(
        speed_rpm=speed_rpm,
        limiting_depth_mm=limits,
        chatter_hz=chatter_hz,
        minimum=minimum,
        feed_deg=feed_deg,
        warnings=warnings,
        max_depth_mm=deepest_mm,
    )


def limiting_depth(
    response: ModalResponse,
    cut: Cut,
    *,
    speed_rpm: float,
    feed_deg: float,
    max_depth_mm: float | None = None,
    steps: int | None = None,
) -> tuple[float, float]:
    """Return the limiting depth [mm] at one speed [1/min] and the frequency of its chatter [Hz].

    Result: inf and NaN where the cut is stable up to the greatest depth. Else as `semi_discretised_lobes`.
    """
    methods = _Methods(response, cut, feed_deg, steps)
    typical_mm = typical_depth_mm(response, cut)
    deepest_mm = max_depth_mm or DEEPEST * typical_mm
    levels_mm = np.geomspace(min(SHALLOWEST * typical_mm, 0.5 * deepest_mm), deepest_mm, LEVELS)
    limit_mm = _limit_mm(methods, speed_rpm, levels_mm)
    return limit_mm, _chatter_hz(methods, speed_rpm, limit_mm)


def semi_discretised_over_feed_directions(
    response: ModalResponse,
    cut: Cut,
    *,
    from_rpm: float,
    to_rpm: float,
    points: int,
    max_depth_mm: float | None = None,
    steps: int | None = None,
) -> StabilityLobes:
    """Return, at each speed, the lowest lobes over feed directions `FEED_STEP_DEG` [deg] apart; else as above."""
    return lowest_of(
        [
            semi_discretised_lobes(
                response,
                cut,
                from_rpm=from_rpm,
                to_rpm=to_rpm,
                points=points,
                feed_deg=float(feed_deg),
                max_depth_mm=max_depth_mm,
                steps=steps,
            )
            for feed_deg in np.arange(0.0, 180.0, FEED_STEP_DEG)
        ]
    )


class _Methods:
    """Spectral radii at any speed; prepared steps are kept per number of steps."""

    def __init__(self, response: ModalResponse, cut: Cut, feed_deg: float, steps: int | None) -> None:
        self._response, self._cut, self._feed_deg, self._steps = response, cut, feed_deg, steps
        self._structure = state_space(response, feed_deg)
        self._prepared: dict[int, SemiDiscretisation] = {}

    def radii(self, speed_rpm: float, depths_mm: FloatArray) -> FloatArray:
        """Return the spectral radius at a spindle speed [1/min] and depths [mm], shape (n,)."""
        if self._steps is None and follows(self._response, self._cut, speed_rpm, float(depths_mm.max())):
            return spectral_radii(
                self._response, self._cut, feed_deg=self._feed_deg, speed_rpm=speed_rpm, depths_mm=depths_mm
            )
        return spectral_radius(self.at(speed_rpm), speed_rpm, depths_mm)

    def at(self, speed_rpm: float) -> SemiDiscretisation:
        """Return the discretised cut at a spindle speed [1/min]."""
        steps = self._steps or default_steps(self._structure, self._cut, speed_rpm)
        if steps not in self._prepared:
            self._prepared[steps] = semi_discretisation(self._structure, self._cut, steps)
        return self._prepared[steps]


def _limit_mm(methods: _Methods, speed_rpm: float, levels_mm: FloatArray) -> float:
    """Return the first depth with spectral radius 1 [mm], inf when there is none."""
    radius = methods.radii(speed_rpm, levels_mm)
    depths, radius = _with_islands(methods, speed_rpm, levels_mm, radius)
    low_mm, low = 0.0, 0.0
    high_mm, high = np.inf, np.inf
    for number in range(NARROWING_ROUNDS + 1):
        if number:
            depths = np.linspace(low_mm, high_mm, NARROWING_POINTS + 2)[1:-1]
            radius = methods.radii(speed_rpm, depths)
        unstable = np.flatnonzero(radius >= 1.0)
        first = int(unstable[0]) if len(unstable) else len(depths)
        if first > 0:
            low_mm, low = float(depths[first - 1]), float(radius[first - 1])
        if first < len(depths):
            high_mm, high = float(depths[first]), float(radius[first])
        if not np.isfinite(high_mm):
            return np.inf
    if low_mm == 0.0 or high <= low:
        return high_mm
    return low_mm + (high_mm - low_mm) * (1.0 - low) / (high - low)


def _with_islands(
    methods: _Methods, speed_rpm: float, depths_mm: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return depths and radii with those around every maximum below the first unstable depth, ascending."""
    unstable = np.flatnonzero(radius >= 1.0)
    end = int(unstable[0]) if len(unstable) else len(radius)
    for place in range(1, end - 1):
        if radius[place] < LOOKED_INTO or radius[place] < max(radius[place - 1], radius[place + 1]):
            continue
        low_mm, high_mm = float(depths_mm[place - 1]), float(depths_mm[place + 1])
        for _ in range(ISLAND_ROUNDS):
            between = np.linspace(low_mm, high_mm, ISLAND_POINTS + 2)[1:-1]
            found = methods.radii(speed_rpm, between)
            if bool(np.any(found >= 1.0)):
                depths = np.concatenate((depths_mm[:place], between))
                together = np.concatenate((radius[:place], found))
                order = np.argsort(depths, kind="stable")
                return depths[order], together[order]
            top, width = float(between[int(np.argmax(found))]), (high_mm - low_mm) / (ISLAND_POINTS + 1)
            low_mm, high_mm = top - width, top + width
    return depths_mm, radius


def _chatter_hz(methods: _Methods, speed_rpm: float, limit_mm: float) -> float:
    if not np.isfinite(limit_mm):
        return np.nan
    return chatter_frequency_hz(methods.at(speed_rpm), speed_rpm, limit_mm)[0]


def _minimum(
    methods: _Methods, speed_rpm: FloatArray, limits_mm: FloatArray, levels_mm: FloatArray
) -> LobeMinimum | None:
    """Return the lowest point of the lobes, searched between the sampled speeds."""
    padded = np.concatenate(([np.inf], limits_mm, [np.inf]))
    bottoms = np.flatnonzero(np.isfinite(limits_mm) & (limits_mm <= padded[:-2]) & (limits_mm <= padded[2:]))
    if not len(bottoms):
        return None
    found: list[tuple[float, float]] = []
    for bottom in bottoms[np.argsort(limits_mm[bottoms])][:LOWEST_CANDIDATES].tolist():
        best = float(limits_mm[bottom]), float(speed_rpm[bottom])
        low, high = speed_rpm[max(bottom - 1, 0)], speed_rpm[min(bottom + 1, len(speed_rpm) - 1)]
        for _ in range(MINIMUM_ROUNDS):
            trial = np.linspace(low, high, MINIMUM_POINTS)
            best = min(best, *((_limit_mm(methods, speed, levels_mm), speed) for speed in trial.tolist()))
            width = (high - low) / (MINIMUM_POINTS - 1)
            low, high = max(best[1] - width, speed_rpm[0]), min(best[1] + width, speed_rpm[-1])
        found.append(best)
    depth_mm, speed = min(found)
    return LobeMinimum(speed_rpm=speed, depth_mm=depth_mm, chatter_hz=_chatter_hz(methods, speed, depth_mm))
