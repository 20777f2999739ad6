"""Stability lobes as records, whatever method found them, and what no method can use."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.milling import tooth_passing_hz

FEED_STEP_DEG = 22.5
"""Between the feed directions that are looked at; opposite ones are equal [deg]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LobeMinimum:
    """The lowest point of the lobes within a range of speeds."""

    speed_rpm: float
    depth_mm: float
    chatter_hz: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StabilityLobes:
    """The lower envelope of all lobes over spindle speed."""

    speed_rpm: FloatArray
    """Ascending and evenly spaced [1/min], shape (n,)."""
    limiting_depth_mm: FloatArray
    """Axial depth up to which the cut is stable [mm], shape (n,); inf where no lobe limits it."""
    chatter_hz: FloatArray
    """Frequency of the chatter at that depth [Hz], shape (n,); NaN where no lobe limits it."""
    minimum: LobeMinimum | None
    """Of the lobes themselves within the range of speeds, not of the sampled speeds; None: no limit found."""
    feed_deg: float
    warnings: tuple[str, ...] = ()
    max_depth_mm: float = math.inf
    """The depth up to which limits were looked for [mm]."""

    def with_warnings(self, warnings: tuple[str, ...]) -> "StabilityLobes":
        """Return the same lobes with warnings put first."""
        return replace(self, warnings=(*warnings, *self.warnings))


def lowest_of(each: Sequence[StabilityLobes]) -> StabilityLobes:
    """Return the lowest of several lobes at each of their common speeds.

    `feed_deg` of the result belongs to the lowest minimum.
    """
    depths = np.array([lobes.limiting_depth_mm for lobes in each])
    chosen = np.argmin(depths, axis=0)
    columns = np.arange(depths.shape[1])
    lowest = min(each, key=lambda lobes: lobes.minimum.depth_mm if lobes.minimum else np.inf)
    return StabilityLobes(
        speed_rpm=lowest.speed_rpm,
        limiting_depth_mm=depths[chosen, columns],
        chatter_hz=np.array([lobes.chatter_hz for lobes in each])[chosen, columns],
        minimum=lowest.minimum,
        feed_deg=lowest.feed_deg,
        warnings=tuple(dict.fromkeys(text for lobes in each for text in lobes.warnings)),
        max_depth_mm=lowest.max_depth_mm,
    )


def check_range(from_rpm: float, to_rpm: float, points: int) -> None:
    """Refuse speeds that are no range. Raises StabilityError."""
    if not 0.0 < from_rpm < to_rpm or points < 2:
        raise StabilityError(
            f"{points} points from {from_rpm:g} to {to_rpm:g} 1/min are no range; "
            "give at least 2 points and a first speed above 0 and below the last"
        )


def check_lines(frequency_hz: FloatArray, teeth: int, from_rpm: float, to_rpm: float) -> tuple[str, ...]:
    """Return warnings about the band of a sampled FRF.

    Raises StabilityError when the FRF ends below the highest tooth-passing frequency or begins above it.

    `frequency_hz`: its ascending frequencies [Hz], shape (n,). `teeth`: number of teeth. `from_rpm`, `to_rpm`: range of
    speeds [1/min].
    """
    low, high = float(frequency_hz[0]), float(frequency_hz[-1])
    first, last = tooth_passing_hz(from_rpm, teeth), tooth_passing_hz(to_rpm, teeth)
    if high < last or low > last:
        raise StabilityError(
            f"the FRF covers {low:g} to {high:g} Hz, but {teeth} teeth at {from_rpm:g} to {to_rpm:g} 1/min pass at "
            f"{first:g} to {last:g} Hz; measure or model the FRF over that band, or narrow the range of speeds"
        )
    if low > first:
        return (
            f"the FRF begins at {low:g} Hz, above the lowest tooth-passing frequency of {first:g} Hz: "
            "a resonance below it would not be seen",
        )
    return ()
