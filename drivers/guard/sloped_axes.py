"""Axes with a slope: where they stand is read, and what estimate and compensation are there, not at the pivot.

A SINUMERIK follows the axis, so that what it adds for the slope is known wherever the axis stands. A FANUC and LinuxCNC
keep what the guard put in where it was called last, and nobody says where that was.
"""

from dataclasses import dataclass

import numpy as np

from config.schema import Configuration
from drivers.guard.text import guard_axes
from models.records import FloatArray

NOWHERE = -(10**9)
SAME_PLACE_MM = 5.0
"""Values that were measured so near to each other count from one zero [mm]: a cold machine errs along an axis, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopedAxis:
    axis: str
    slope: str
    """Entry of `compensation.axes` that is its slope."""
    pivot_mm: float
    letter: str
    """Of the axis on the control."""
    position: str | None
    """Entry of `cnc.axis_positions` that reads where it stands; None: nothing does."""
    follows: bool
    """The control puts the slope in for where the axis stands now."""

    @property
    def places_unread(self) -> str:
        """Return why it is not known where the axis stands, '' where its position is read."""
        if self.position is not None:
            return ""
        return (
            f"it has a slope ({self.slope}), and cnc.axis_positions does not read where {self.letter} is: add an entry"
        )

    @property
    def unknown_share(self) -> str:
        """Return why what is applied for the slope is not known where the axis stands, '' where it is."""
        if self.follows:
            return ""
        return (
            f"the control keeps what its slope ({self.slope}) was where the guard was called last, and does not say "
            f"where that was: measure while {self.slope} is switched off and at zero"
        )

    @property
    def silent(self) -> str:
        """Return what is said where the control gives no position although it is read."""
        return (
            f"it has a slope ({self.slope}), and the control did not say where {self.letter} stood: reference the axis"
        )

    def why_unknown(self, applied_um_per_m: float = np.nan) -> str:
        """Return why estimate or compensation was not known where the axis stood, with so much applied of the slope."""
        return self.places_unread or (self.unknown_share if applied_um_per_m != 0.0 else "") or self.silent

    def along_m(self, mm: FloatArray | float) -> FloatArray:
        """Return the distance from the pivot [m], NaN where the position is not known."""
        return np.asarray(1e-3 * (np.asarray(mm, dtype=np.float64) - self.pivot_mm))


def sloped_axes(configuration: Configuration) -> dict[str, SlopedAxis]:
    compensation, cnc = configuration.compensation, configuration.cnc
    if not compensation.slopes:
        return {}
    letters = guard_axes(compensation.axes, cnc.guard)
    read = {one.axis: name for name, one in cnc.axis_positions.items()}
    return {
        slope.of: SlopedAxis(
            axis=slope.of,
            slope=name,
            pivot_mm=slope.pivot_mm,
            letter=letters[slope.of].letter,
            position=read.get(letters[slope.of].letter),
            follows=cnc.is_sinumerik,
        )
        for name, slope in compensation.slopes.items()
    }


def added_um(per_m: FloatArray | float, along_m: FloatArray | float) -> FloatArray:
    """Return what a slope adds at a distance from its pivot [um, um/m, m]; nothing where it is 0, wherever that is."""
    per_m = np.asarray(per_m, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(per_m == 0.0, 0.0, per_m * along_m))


def place_of(mm: float) -> int:
    """Return a number that positions near to each other share; `NOWHERE` where it is not known [mm]."""
    return round(mm / SAME_PLACE_MM) if np.isfinite(mm) else NOWHERE
