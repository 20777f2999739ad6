"""Roughness of a milled surface from its profile, per depth of cut."""

from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray

FEWEST_POINTS = 20
GAUSSIAN = np.sqrt(np.log(2.0) / np.pi)
"""Constant of the profile filter of ISO 16610-21: half transmission at the cut-off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Roughness:
    """Amplitude parameters of one profile, after its mean line is removed."""

    ra_um: float
    """Arithmetical mean height [um]."""
    rq_um: float
    """Root mean square height [um]."""
    rz_um: float
    """Mean over five equal parts of highest peak plus deepest valley [um]."""
    points: int


def profile_roughness(position_mm: FloatArray, height_um: FloatArray, cutoff_mm: float | None = None) -> Roughness:
    """Return the roughness of a profile.

    Result: of the whole profile; with a cut-off half of it is left out at both ends. Raises StabilityError with too few
    points, uneven spacing, or a cut-off longer than half the profile.

    `position_mm`: evenly spaced along the profile [mm], shape (n,). `height_um`: shape (n,) [um]. `cutoff_mm`: cut-off
    of the Gaussian filter that takes waviness away [mm]; None: only the mean line is removed.
    """
    if len(position_mm) != len(height_um) or len(height_um) < FEWEST_POINTS:
        raise StabilityError(f"a profile of {len(height_um)} points is too short; give at least {FEWEST_POINTS}")
    spacing = np.diff(position_mm)
    spacing_mm = float(np.median(spacing))
    if not spacing_mm > 0.0 or bool(np.any(np.abs(spacing - spacing_mm) > 0.5 * spacing_mm)):
        raise StabilityError("the positions of the profile are not evenly spaced and ascending; export it anew")
    line = np.polyfit(position_mm, height_um, 1)
    rest = height_um - np.polyval(line, position_mm)
    if cutoff_mm is not None:
        rest = _without_waviness(rest, spacing_mm, cutoff_mm)
    rest = rest - rest.mean()
    parts = np.array_split(rest, 5)
    return Roughness(
        ra_um=float(np.abs(rest).mean()),
        rq_um=float(np.sqrt(np.mean(rest**2))),
        rz_um=float(np.mean([part.max() - part.min() for part in parts])),
        points=len(rest),
    )


def _without_waviness(heights: FloatArray, spacing_mm: float, cutoff_mm: float) -> FloatArray:
    half = int(cutoff_mm / spacing_mm / 2.0 + 1e-6)
    if half < 1 or 4 * half > len(heights):
        raise StabilityError(
            f"a cut-off of {cutoff_mm:g} mm does not fit a profile of {len(heights) * spacing_mm:g} mm with points "
            f"{spacing_mm:g} mm apart; it must be longer than two points and at most half the profile"
        )
    offsets = np.arange(-2 * half, 2 * half + 1) * spacing_mm
    weights = np.exp(-np.pi * (offsets / (GAUSSIAN * cutoff_mm)) ** 2)
    waviness = np.convolve(heights, weights / weights.sum())[2 * half : 2 * half + len(heights)]
    return (heights - waviness)[half:-half]


def roughness_per_depth(
    depth_mm: FloatArray, position_mm: FloatArray, height_um: FloatArray, cutoff_mm: float | None = None
) -> dict[float, Roughness]:
    """Return the roughness of each depth of cut [mm], in ascending depth.

    Every array has the shape (n,); rows with the same depth form one profile. Raises StabilityError as
    `profile_roughness`, naming the depth.
    """
    found = {}
    for depth in np.unique(depth_mm).tolist():
        rows = depth_mm == depth
        try:
            found[float(depth)] = profile_roughness(position_mm[rows], height_um[rows], cutoff_mm)
        except StabilityError as error:
            raise StabilityError(f"depth {depth:g} mm: {error}") from None
    return found
