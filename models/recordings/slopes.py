"""Divides a displacement that was measured along an axis into what it is at one position, and a slope."""

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray

SLOPE_SUFFIX = "_per_m"
"""The channel of a slope is called after its displacement: in micrometres, `Z1` and `Z1_per_m` read alike."""
SMALLEST_SPREAD_MM = 10.0
"""Standard deviation of the positions of one pass; with a smaller one noise makes the slope."""
FEWEST_ROWS = 4
"""A pass of fewer rows shows no slope: there and back at two positions."""


def offset_and_slope(
    time_s: FloatArray, position_mm: FloatArray, displacement_um: FloatArray, *, pivot_mm: float, pass_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return what a displacement was at a position [um], and how it grew along the axis [um/m], both of shape (n,).

    For every row the straight line ``offset + slope (position - pivot)`` that fits the rows within half of `pass_s`
    before and after best (least squares); NaN where these hold too few values or positions that are too close.

    Raises DatasetError where that is so in every row.

    `time_s`, shape (n,): increasing times [s]. `position_mm`, shape (n,): position of the axis [mm], NaN where it is
    not known. `displacement_um`, shape (n,): what was measured there [um], NaN where missing. `pivot_mm`: where the
    slope adds nothing [mm]. `pass_s`: time in which the axis comes to all positions and back [s]; what the machine
    grows in it is averaged.
    """
    known = np.isfinite(position_mm) & np.isfinite(displacement_um)
    x_m = np.where(known, (position_mm - pivot_mm) * 1e-3, 0.0)
    level_um = float(np.median(displacement_um[known])) if known.any() else 0.0
    y_um = np.where(known, displacement_um - level_um, 0.0)
    first = np.searchsorted(time_s, time_s - pass_s / 2.0, side="left")
    stop = np.searchsorted(time_s, time_s + pass_s / 2.0, side="right")

    def within(values: FloatArray) -> FloatArray:
        sums = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(sums[stop] - sums[first])

    count = within(known.astype(np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_m, mean_um = within(x_m) / count, within(y_um) / count
        variance_m2 = within(x_m * x_m) / count - mean_m**2
        slope = (within(x_m * y_um) / count - mean_m * mean_um) / variance_m2
        shown = (count >= FEWEST_ROWS) & (variance_m2 >= (SMALLEST_SPREAD_MM * 1e-3) ** 2)
    if not shown.any():
        raise DatasetError(
            f"no {pass_s:g} s of the recording hold {FEWEST_ROWS} displacements at positions that lie far enough apart "
            f"(standard deviation {SMALLEST_SPREAD_MM:g} mm); measure at two or more positions of the axis in turn"
        )
    offset_um = np.where(shown, mean_um - slope * mean_m + level_um, np.nan)
    return offset_um, np.where(shown, slope, np.nan)
