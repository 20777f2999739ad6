"""A milling cut in the time domain: teeth, chips, regeneration, loss of contact.

Many cuts are simulated side by side, step by step. Nothing is linearised and no equation of the
stability library is used: each tooth removes what stands between it and the surface that the teeth
before it left, and a tooth that has left the material cuts nothing, however far back the last cut
at that place lies.

Frame: x along the feed, y to its left; the spindle turns clockwise seen from above. `bearing` is the
angle of a tooth counter-clockwise from the feed, so that it falls as time goes on.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from models.records import FloatArray

SILENT = 1e-9
"""Change from tooth to tooth, in feeds per tooth, below which nothing moves any more."""
FADED = 0.5
"""A stable cut's vibration falls at least to this share between the two windows of `is_stable`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MillingCuts:
    """Cuts side by side; every array has one entry per cut unless its shape says otherwise."""

    teeth: int
    """The same for all."""
    speed_rpm: FloatArray
    axial_depth_m: FloatArray
    first_bearing_rad: FloatArray
    """Where teeth leave the air and meet the work: the larger bearing of the arc [rad]."""
    last_bearing_rad: FloatArray
    """Where they leave it [rad]."""
    tangential_n_per_m2: FloatArray
    radial_n_per_m2: FloatArray
    feed_per_tooth_m: FloatArray
    feed_direction_rad: FloatArray
    """Against the machine's X, counter-clockwise [rad]."""
    mode_frequency_hz: FloatArray
    """Shape (n_cuts, n_modes)."""
    mode_damping_ratio: FloatArray
    """Shape (n_cuts, n_modes)."""
    mode_stiffness_n_per_m: FloatArray
    """Shape (n_cuts, n_modes)."""
    mode_axis: tuple[int, ...]
    """0 for a mode along the machine's X, 1 along Y, for each mode."""
    mode_lead_s: FloatArray | None = None
    """The tool point moves by a mode's coordinate and by its speed times this, shape (n_cuts, n_modes); None: 0."""
    helix_lag_rad: FloatArray | None = None
    """Angle by which the edge's top lags behind its tip [rad]; None: straight edges."""
    slices: int = 1
    """Axial slices of a helical edge."""
    pitch_rad: tuple[float, ...] = ()
    """Angles from each tooth to the one that cuts after it [rad], the same for all cuts; empty: all alike."""
    keeps_contact: bool = False
    """Teeth never leave the material, as the linear theory has it: their chips may be thinner than none."""
    damping_n_s_per_m: FloatArray | None = None
    """By what the flank of an engaged edge resists a speed along the normal of the surface; None: by nothing."""


def arc_of(milling: str, radial_depth_m: float, diameter_m: float) -> tuple[float, float]:
    """Return the bearings [rad] at which teeth meet and leave the work.

    The front half of the tool cuts. Up-milling has the work on the left of the feed, where a tooth
    meets it at 90 degrees; down-milling has it on the right.
    """
    if milling == "slot":
        return math.pi / 2.0, -math.pi / 2.0
    inner = math.asin(1.0 - 2.0 * radial_depth_m / diameter_m)
    return (math.pi / 2.0, inner) if milling == "up" else (-inner, -math.pi / 2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class MillingSample:
    """The state after one step."""

    displacement_m: FloatArray
    """Of the tool along X and Y of the machine, shape (n_cuts, 2)."""
    acceleration_m_s2: FloatArray
    """Shape (n_cuts, 2)."""
    force_n: FloatArray
    """On the tool along X and Y of the machine, shape (n_cuts, 2)."""


def mill(cuts: MillingCuts, passings: int, steps_per_passing: int = 400) -> Iterator[MillingSample]:
    """Yield the state after every step of so many tooth passings, from rest at the first contact."""
    count = len(cuts.speed_rpm)
    step_s = (60.0 / (cuts.speed_rpm * cuts.teeth * steps_per_passing))[:, None]
    edges = _Edges(cuts, steps_per_passing)
    axis = np.array(cuts.mode_axis)
    angular = 2.0 * np.pi * cuts.mode_frequency_hz
    mass = cuts.mode_stiffness_n_per_m / angular**2
    drag = 2.0 * cuts.mode_damping_ratio * angular
    place = np.zeros_like(angular)
    speed = np.zeros_like(angular)
    force = edges.force(0, np.zeros((count, 2)), np.zeros((count, 2)))
    change = force[:, axis] / mass
    to_axes = np.eye(2)[axis]
    lead_s = np.zeros_like(angular) if cuts.mode_lead_s is None else cuts.mode_lead_s
    half_step_s, half_step_s2, ahead_s, stiffness = 0.5 * step_s, 0.5 * step_s**2, step_s + lead_s, angular**2
    slowed = 1.0 + half_step_s * drag
    for step in range(1, passings * steps_per_passing + 1):
        place = place + step_s * speed + half_step_s2 * change
        moved = (place + lead_s * (speed + step_s * change)) @ to_axes
        force = edges.force(step, moved, (speed + ahead_s * change) @ to_axes)
        push = force[:, axis] / mass - stiffness * place
        speed = (speed + half_step_s * (change + push)) / slowed
        change = push - drag * speed
        yield MillingSample(displacement_m=moved, acceleration_m_s2=change @ to_axes, force_n=force)


class _Edges:
    """The cutting edges over stations around the tool, and the surface that each station carries.

    Tables have the shape (stations, n_cuts, slices): in the row of an edge's tip, a slice finds the station where it
    stands, behind the tip by its lag.
    """

    def __init__(self, cuts: MillingCuts, steps_per_passing: int) -> None:
        self._around = cuts.teeth * steps_per_passing
        width = 2.0 * np.pi / self._around
        lag = np.zeros(len(cuts.speed_rpm)) if cuts.helix_lag_rad is None else cuts.helix_lag_rad
        middles = (np.arange(cuts.slices) + 0.5) / cuts.slices if cuts.helix_lag_rad is not None else np.zeros(1)
        station = (np.arange(self._around)[:, None, None] - np.rint(lag[:, None] * middles / width)) % self._around
        bearing = np.mod(1.5 * np.pi - width * station, 2.0 * np.pi) - np.pi
        before = (cuts.first_bearing_rad[:, None] - bearing) / width + 0.5
        behind = (bearing - cuts.last_bearing_rad[:, None]) / width + 0.5
        self._share = np.clip(before, 0.0, 1.0) * np.clip(behind, 0.0, 1.0)
        self._fed = cuts.feed_per_tooth_m[:, None] * np.cos(bearing)
        self._surface = -self._fed
        bearing += cuts.feed_direction_rad[:, None]
        self._cosine, self._sine = np.cos(bearing), np.sin(bearing)
        self._tangential = (cuts.tangential_n_per_m2 * cuts.axial_depth_m / cuts.slices)[:, None]
        self._radial = (cuts.radial_n_per_m2 * cuts.axial_depth_m / cuts.slices)[:, None]
        pitches = np.array(cuts.pitch_rad or (2.0 * np.pi / cuts.teeth,) * cuts.teeth)
        self._ahead = np.rint(-np.concatenate(([0.0], np.cumsum(pitches)[:-1])) / width).astype(np.intp)
        self._feeds = (pitches * cuts.teeth / (2.0 * np.pi))[:, None, None]
        self._keeps_contact = cuts.keeps_contact
        self._damping = None if cuts.damping_n_s_per_m is None else (cuts.damping_n_s_per_m / cuts.slices)[:, None]

    def force(self, step: int, displacement_m: FloatArray, speed_m_s: FloatArray) -> FloatArray:
        """Return the force on the tool in machine axes [N], and cut the surface, shapes (n_cuts, 2)."""
        tips = (step + self._ahead) % self._around
        cosine, sine, share, left = self._cosine[tips], self._sine[tips], self._share[tips], self._surface[tips]
        reach = displacement_m[:, :1] * cosine + displacement_m[:, 1:] * sine
        chip = reach - left if self._keeps_contact else np.maximum(reach - left, 0.0)
        cut = reach if self._keeps_contact else np.maximum(left, reach)
        self._surface[tips] = np.where(share > 0.0, cut, 0.0) - self._feeds * self._fed[tips]
        tangential, radial = self._tangential * share * chip, self._radial * share * chip
        if self._damping is not None:
            outwards = speed_m_s[:, :1] * cosine + speed_m_s[:, 1:] * sine
            radial += self._damping * share * np.where((chip > 0.0) | self._keeps_contact, outwards, 0.0)
        along_x, along_y = -tangential * sine - radial * cosine, tangential * cosine - radial * sine
        return np.stack((along_x.sum(axis=(0, 2)), along_y.sum(axis=(0, 2))), axis=1)


def is_stable(cuts: MillingCuts, passings: int = 300, steps_per_passing: int = 400) -> np.ndarray:
    """Return, per cut, whether what differs from one tooth passing (turn, at uneven pitches) to the next dies away."""
    every = cuts.teeth if cuts.pitch_rad else 1
    periods = passings // every
    before = np.zeros((len(cuts.speed_rpm), 2))
    changes = np.zeros((periods, len(cuts.speed_rpm)))
    with np.errstate(over="ignore", invalid="ignore"):  # what keeps contact grows beyond all numbers
        for number, sample in enumerate(mill(cuts, periods * every, steps_per_passing), start=1):
            if number % (steps_per_passing * every) == 0:
                change = np.linalg.norm(sample.displacement_m - before, axis=1)
                changes[number // (steps_per_passing * every) - 1] = change
                before = sample.displacement_m
        window = max(periods // 8, 4)
        early = np.sqrt(np.mean(changes[periods // 2 : periods // 2 + window] ** 2, axis=0))
        late = np.sqrt(np.mean(changes[-window:] ** 2, axis=0))
        stable: np.ndarray = (late < FADED * early) | (late < SILENT * cuts.feed_per_tooth_m)
    return stable


__all__ = ["MillingCuts", "MillingSample", "arc_of", "is_stable", "mill"]
