"""The cut of an end mill: engagement, and how displacement becomes force.

A tooth at the angle ``phi``, clockwise from the normal of the feed, stands in the direction
``(sin phi, cos phi)``. When the tool moves outwards there, the chip becomes thicker:
``h = dx sin phi + dy cos phi`` with ``dx = x(t) - x(t - T_a)`` (equations 1-3 and 1-4 of the dissertation).

Beyond the dissertation, a tool may have a helix, by which the edge lags the further behind its tip the higher it is;
uneven pitches, so that each tooth finds what was left another time ago; and a flank that rubs on the wave it cuts,
which damps (`Cut.process_damping_n_per_m`).
"""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray

LEAST_IMMERSION = 1e-6
"""Radial depth over diameter; less is no cut."""
STEEPEST_HELIX_RAD = math.radians(75.0)
SAME_PITCH_RAD = 1e-9
LEAST_LAG_RAD = 1e-6
"""An edge that lags less stands straight."""


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
    diameter_m: float = 0.0
    """Diameter of the tool [m]; needed with a helix or process damping only."""
    helix_rad: float = 0.0
    """Helix angle of the edges [rad]; 0: straight."""
    pitch_rad: tuple[float, ...] = ()
    """Angles from each tooth to the one that cuts after it, as many as teeth [rad]; empty: all alike."""
    process_damping_n_per_m: float = 0.0
    """C of ``F = -C b v / V``: force along the normal of the surface against the speed v along it, for the width b of
    the cut and the cutting speed V [N/m] (Tyler and Schmitz, J. Manuf. Process. 15, 2013)."""

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
        self._check_edges()

    def _check_edges(self) -> None:
        if not 0.0 <= self.helix_rad <= STEEPEST_HELIX_RAD:
            raise StabilityError(
                f"a helix of {math.degrees(self.helix_rad):g} deg is none of an end mill; give 0 to "
                f"{math.degrees(STEEPEST_HELIX_RAD):g} deg"
            )
        if not 0.0 <= self.process_damping_n_per_m < math.inf:
            raise StabilityError(f"process damping of {self.process_damping_n_per_m:g} N/m is none; give 0 or more")
        if (self.helix_rad or self.process_damping_n_per_m) and not self.diameter_m > 0.0:
            raise StabilityError("a helix and process damping need the diameter of the tool")
        if not self.pitch_rad:
            return
        if len(self.pitch_rad) != self.teeth:
            raise StabilityError(f"{len(self.pitch_rad)} pitches for {self.teeth} teeth; give one pitch for each tooth")
        turn = sum(self.pitch_rad)
        if min(self.pitch_rad) <= 0.0 or abs(turn - 2.0 * math.pi) > 1e-6:
            raise StabilityError(
                f"the pitches add up to {math.degrees(turn):g} deg; give angles above 0 that add up to 360 deg"
            )

    @property
    def pitches_rad(self) -> tuple[float, ...]:
        """Angles from each tooth to the one that cuts after it [rad]."""
        return self.pitch_rad or (2.0 * math.pi / self.teeth,) * self.teeth

    @property
    def repeats_after(self) -> int:
        """After how many teeth the pitches come again: 1 where they are all alike."""
        pitches = self.pitches_rad
        for count in range(1, self.teeth):
            if self.teeth % count == 0 and all(
                abs(pitches[i] - pitches[(i + count) % self.teeth]) < SAME_PITCH_RAD for i in range(self.teeth)
            ):
                return count
        return self.teeth

    @property
    def beyond_straight(self) -> tuple[str, ...]:
        """What of the cut is beyond straight, even, undamped teeth: keys of a case file."""
        found = {
            "helix_deg": self.helix_rad > 0.0,
            "pitch_deg": self.repeats_after > 1,
            "process_damping_n_per_m": self.process_damping_n_per_m > 0.0,
        }
        return tuple(key for key, there in found.items() if there)

    def straight(self) -> "Cut":
        """Return the same cut with straight, even, undamped teeth."""
        return replace(self, helix_rad=0.0, pitch_rad=(), process_damping_n_per_m=0.0)

    def lag_rad(self, depth_mm: FloatArray) -> FloatArray:
        """Return by which angle the edge at some depths of cut [mm] lags behind its tip [rad], of their shape."""
        if not self.helix_rad:
            return np.zeros(np.shape(depth_mm))
        lag: FloatArray = 2e-3 * np.asarray(depth_mm) * math.tan(self.helix_rad) / self.diameter_m
        return lag


def engagement_rad(mode: MillingMode, radial_depth_mm: float, diameter_mm: float) -> tuple[float, float]:
    """Return the angles at which a tooth enters and leaves the work.

    Result: entry and exit [rad], clockwise from the normal of the feed. Raises StabilityError when the immersion is out
    of range.

    `mode`: up-milling, down-milling or slot. `radial_depth_mm`: radial depth of cut a_e [mm]; the diameter for a slot.
    `diameter_mm`: diameter of the tool [mm].
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


def edge_matrices(cut: Cut, angle_rad: FloatArray, lag_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directional coefficients of one edge, and those of its rubbing, as means over its length.

    Result: two arrays of the shape (..., 2, 2), dimensionless: force = depth K_tc [A] (x(t) - x(t - T)) of the cut, and
    force = -depth C / V [D] dx/dt of the process damping.

    `angle_rad`: angle of the edge's tip [rad], any shape (...). `lag_rad`: by which angle the other end of the edge
    lags behind it [rad], of a shape that goes with the first.
    """
    straight = np.asarray(lag_rad) < LEAST_LAG_RAD
    if bool(np.all(straight)):
        turned = np.mod(angle_rad, 2.0 * math.pi)
        engaged = (turned > cut.start_rad) & (turned < cut.exit_rad)
        sine, cosine = np.sin(turned) * engaged, np.cos(turned) * engaged
        squares = [sine * sine, sine * cosine, cosine * cosine]
    else:
        lag = np.where(straight, LEAST_LAG_RAD, lag_rad)
        ahead, behind = _squares_up_to(cut, angle_rad), _squares_up_to(cut, angle_rad - lag)
        squares = [(high - low) / lag for high, low in zip(ahead, behind, strict=True)]
    both, mixed, cosines = squares
    ratio = cut.radial_ratio
    cutting = [[-(mixed + ratio * both), -(cosines + ratio * mixed)], [both - ratio * mixed, mixed - ratio * cosines]]
    rubbing = [[both, mixed], [mixed, cosines]]
    return np.moveaxis(np.array(cutting), (0, 1), (-2, -1)), np.moveaxis(np.array(rubbing), (0, 1), (-2, -1))


def _squares_up_to(cut: Cut, angle_rad: FloatArray) -> tuple[FloatArray, ...]:
    """Return the integrals of sin^2, sin cos and cos^2 over all engaged angles from 0 to some angles."""
    turns = np.floor(angle_rad / (2.0 * math.pi))
    within = np.clip(angle_rad - 2.0 * math.pi * turns, cut.start_rad, cut.exit_rad)

    def integrals(angle: FloatArray) -> tuple[FloatArray, ...]:
        double = 2.0 * angle
        return angle / 2.0 - np.sin(double) / 4.0, -np.cos(double) / 4.0, angle / 2.0 + np.sin(double) / 4.0

    ends = np.array([cut.start_rad, cut.exit_rad])
    return tuple(
        part - whole[0] + turns * (whole[1] - whole[0])
        for part, whole in zip(integrals(within), integrals(ends), strict=True)
    )


def tooth_passing_hz(speed_rpm: float, teeth: int) -> float:
    """Return the tooth-passing frequency [Hz]."""
    return speed_rpm * teeth / 60.0
