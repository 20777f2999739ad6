"""The cut of an end mill: engagement, and how displacement becomes force.

A tooth at the angle ``phi``, clockwise from the normal of the feed, stands in the direction
``(sin phi, cos phi)``. When the tool moves outwards there, the chip becomes thicker:
``h = dx sin phi + dy cos phi`` with ``dx = x(t) - x(t - T_a)`` (equations 1-3 and 1-4 of the dissertation).
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray

LEAST_IMMERSION = 1e-6
"""Radial depth over diameter; less is no cut."""


class MillingMode(StrEnum):
    """Which side of the tool is in the work."""

    UP = "up"
    DOWN = "down"
    SLOT = "slot"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """Everything about the cut that is not speed, depth or structure."""

    teeth: int
    start_rad: float
    """Angle at which a tooth enters, clockwise from the normal of the feed [rad]."""
    exit_rad: float
    """Angle at which it leaves [rad]."""
    tangential_n_per_m2: float
    """Tangential cutting coefficient K_tc [N/m^2]."""
    radial_ratio: float
    """K_rc / K_tc."""

    def __post_init__(self) -> None:
        """Refuse what is no cut. Raises StabilityError."""
        if self.teeth < 1:
            raise StabilityError(f"a tool with {self.teeth} teeth cuts nothing; give at least 1")
        if not 0.0 <= self.start_rad < self.exit_rad <= math.pi + 1e-12:
            raise StabilityError(
                f"the engagement from {self.start_rad:g} to {self.exit_rad:g} rad is none; "
                "angles grow from the entry to the exit within 0 to pi"
            )
        if not self.tangential_n_per_m2 > 0.0:
            raise StabilityError("the tangential cutting coefficient must be above 0 N/m^2")


def engagement_rad(mode: MillingMode, radial_depth_mm: float, diameter_mm: float) -> tuple[float, float]:
    """Return the angles at which a tooth enters and leaves the work.

    Result: entry and exit [rad], clockwise from the normal of the feed. Raises StabilityError when the immersion is out
    of range.

    Parameters
    ----------
    mode
        Up-milling, down-milling or slot.
    radial_depth_mm
        Radial depth of cut a_e [mm]; the diameter for a slot.
    diameter_mm
        Diameter of the tool [mm].

    """
    if not diameter_mm > 0.0:
        raise StabilityError(f"the diameter {diameter_mm:g} mm is none; give the tool's diameter in mm")
    if not LEAST_IMMERSION * diameter_mm <= radial_depth_mm <= diameter_mm:
        raise StabilityError(
            f"the radial depth {radial_depth_mm:g} mm is outside 0 to {diameter_mm:g} mm, the diameter, of which a "
            "millionth is the least; give the width that is really cut"
        )
    if mode is MillingMode.SLOT:
        if radial_depth_mm < diameter_mm:
            raise StabilityError(
                f"a slot is as wide as the tool ({diameter_mm:g} mm), not {radial_depth_mm:g} mm; "
                "say up or down, or give the diameter as radial depth"
            )
        return 0.0, math.pi
    swept = 2.0 * math.asin(math.sqrt(radial_depth_mm / diameter_mm))
    return (0.0, swept) if mode is MillingMode.UP else (math.pi - swept, math.pi)


def mean_directional_matrix(cut: Cut) -> FloatArray:
    """Return the directional coefficients a_xx .. a_yy averaged over a turn (5-5).

    Result: shape (2, 2), dimensionless: force = 1/2 depth K_tc [a] (x(t) - x(t - T_a)).
    """
    ends = np.array([cut.start_rad, cut.exit_rad])
    sine, cosine, ratio = np.sin(2.0 * ends), np.cos(2.0 * ends), cut.radial_ratio
    terms = np.array(
        [
            [cosine - 2.0 * ratio * ends + ratio * sine, -sine - 2.0 * ends + ratio * cosine],
            [-sine + 2.0 * ends + ratio * cosine, -cosine - 2.0 * ratio * ends - ratio * sine],
        ]
    )
    matrix: FloatArray = cut.teeth / (4.0 * math.pi) * (terms[..., 1] - terms[..., 0])
    return matrix


def directional_matrix(cut: Cut, angle_rad: FloatArray) -> FloatArray:
    """Return the directional coefficients at given angles of the first tooth, all teeth added.

    Result: shape (n, 2, 2), dimensionless: force = depth K_tc [A] (x(t) - x(t - T_a)). Its mean over a turn is half of
    `mean_directional_matrix`.

    `cut`: the cut. `angle_rad`: angle of the first tooth [rad], shape (n,); the others follow at equal pitch.
    """
    pitch = 2.0 * math.pi / cut.teeth
    angles = np.mod(angle_rad[:, None] + pitch * np.arange(cut.teeth), 2.0 * math.pi)
    engaged = ((angles > cut.start_rad) & (angles < cut.exit_rad)).astype(np.float64)
    sine, cosine = np.sin(angles) * engaged, np.cos(angles) * engaged
    towards_x = -(cosine + cut.radial_ratio * sine)
    towards_y = sine - cut.radial_ratio * cosine
    rows = [
        [np.sum(towards_x * sine, axis=1), np.sum(towards_x * cosine, axis=1)],
        [np.sum(towards_y * sine, axis=1), np.sum(towards_y * cosine, axis=1)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def tooth_passing_hz(speed_rpm: float, teeth: int) -> float:
    """Return the tooth-passing frequency [Hz]."""
    return speed_rpm * teeth / 60.0
