"""Chooses a spindle speed: by the dissertation's rule (5-9), or among all pockets by limiting depth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.spindle_speed.tuning import SpeedChoice
from models.stability.lobes import StabilityLobes

SLOWEST_RPM, FASTEST_RPM = 1e-3, 1e7
"""Beyond these no spindle turns."""


def resonance_speed_rpm(resonance_hz: float, offset_hz: float, teeth: int, lobe: int) -> float:
    """Return the speed of equation 5-9, ``60 (f_r - f_o) / (n_T k_c)``.

    Result: spindle speed [1/min]. Raises StabilityError when teeth or lobe are below 1, nothing is left of the
    resonance, or no spindle turns so fast or slowly.

    `resonance_hz`: tracked resonance f_r [Hz]. `offset_hz`: signed distance f_o that the tooth passing keeps below it
    [Hz]. `teeth`: n_T (printed as n_r in the dissertation). `lobe`: k_c, 1 for the fastest pocket.
    """
    if teeth < 1 or lobe < 1:
        raise StabilityError(f"{teeth} teeth and lobe {lobe} give no speed; both count from 1")
    if not (math.isfinite(resonance_hz) and math.isfinite(offset_hz) and resonance_hz - offset_hz > 0.0):
        raise StabilityError(
            f"a resonance of {resonance_hz:g} Hz less an offset of {offset_hz:g} Hz leaves no frequency; "
            "the offset is signed and small against the resonance"
        )
    speed_rpm = 60.0 * (resonance_hz - offset_hz) / (teeth * lobe)
    if not SLOWEST_RPM <= speed_rpm <= FASTEST_RPM:
        raise StabilityError(
            f"a resonance of {resonance_hz:g} Hz less an offset of {offset_hz:g} Hz gives {speed_rpm:.4g} 1/min with "
            f"{teeth} teeth and lobe {lobe:g}, which no spindle turns at; check all four"
        )
    return speed_rpm


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedLimits:
    """What bounds the spindle speed."""

    machine_lowest_rpm: float
    machine_highest_rpm: float
    tool_highest_rpm: float = math.inf
    within_fraction: float = math.inf
    """Greatest change against the programmed speed, as a share of it."""

    def range_rpm(self, programmed_rpm: float) -> tuple[float, float]:
        """Return the lowest and highest speed allowed [1/min].

        Raises StabilityError when the limits leave nothing.
        """
        low = max(self.machine_lowest_rpm, programmed_rpm * max(1.0 - self.within_fraction, 0.0))
        high = min(self.machine_highest_rpm, self.tool_highest_rpm, programmed_rpm * (1.0 + self.within_fraction))
        if not 0.0 < low < high:
            raise StabilityError(
                f"the limits of machine ({self.machine_lowest_rpm:g} to {self.machine_highest_rpm:g} 1/min), tool "
                f"({self.tool_highest_rpm:g}) and +-{self.within_fraction:.0%} of {programmed_rpm:g} 1/min leave no "
                "range; program a speed inside machine and tool, or widen the limits"
            )
        return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedDemand:
    """What a speed has to be stable to."""

    programmed_rpm: float
    depth_mm: float
    """Programmed axial depth of cut [mm]."""
    margin_fraction: float = 0.2
    """The limiting depth must exceed the programmed one by this share of it."""
    tolerance_fraction: float = 0.01
    """It must do so within this share of the speed to both sides: resonances are known no better."""


def choose_speed(
    lobes: StabilityLobes,
    demand: SpeedDemand,
    *,
    range_rpm: tuple[float, float] | None = None,
    candidates_rpm: Sequence[float] | None = None,
) -> SpeedChoice:
    """Return the speed nearest to the programmed one that is stable to the demand.

    Both axes are checked, because the lobes hold both.

    Result: the programmed speed with an alarm when nothing is stable to the demand. Raises StabilityError when depth,
    margin or tolerance are out of range.

    `lobes`: over the range of speeds that is allowed, better a little beyond it. `demand`: programmed speed and depth,
    margin and tolerance. `range_rpm`: lowest and highest speed allowed [1/min]; None: those of the lobes.
    `candidates_rpm`: speeds to choose among, such as those of equation 5-9 [1/min]; None: all.
    """
    if not demand.depth_mm > 0.0 or demand.margin_fraction < 0.0 or not 0.0 <= demand.tolerance_fraction < 0.5:
        raise StabilityError(
            f"a depth of {demand.depth_mm:g} mm with a margin of {demand.margin_fraction:.0%} and a tolerance of "
            f"{demand.tolerance_fraction:.0%} cannot be met; depth above 0, margin at least 0, tolerance below 50 %"
        )
    speeds = lobes.speed_rpm
    meets = _worst_within(lobes, demand.tolerance_fraction) >= demand.depth_mm * (1.0 + demand.margin_fraction)
    low, high = range_rpm or (float(speeds[0]), float(speeds[-1]))
    offered = _inside(speeds if candidates_rpm is None else candidates_rpm, low, high)
    places = _nearest_places(speeds, offered)
    stable = offered[meets[places]]
    programmed = demand.programmed_rpm
    if (
        candidates_rpm is None
        and low <= programmed <= high
        and meets[_nearest_places(speeds, np.array([programmed]))[0]]
    ):
        stable = np.array([programmed])
    if not len(stable):
        what = "no speed" if candidates_rpm is None else f"none of {len(candidates_rpm)} speeds of the rule"
        at_ends = [_depth_at(lobes, low), _depth_at(lobes, high)]  # between two speeds of the lobes there may be none
        best = float(np.nanmax([*at_ends, *lobes.limiting_depth_mm[(speeds >= low) & (speeds <= high)]]))
        return SpeedChoice(
            speed_rpm=programmed,
            limiting_depth_mm=_depth_at(lobes, programmed),
            pocket_rpm=(programmed, programmed),
            alarm=f"{what} between {low:.0f} and {high:.0f} 1/min is stable to {demand.depth_mm:g} mm with a "
            f"margin of {demand.margin_fraction:.0%} (at most {best:.3g} mm anywhere); the programmed "
            f"{programmed:g} 1/min stays: cut less deep or widen the limits",
        )
    chosen = float(stable[np.argmin(np.abs(stable - programmed))])
    return SpeedChoice(
        speed_rpm=chosen,
        limiting_depth_mm=_depth_at(lobes, chosen),
        pocket_rpm=_pocket(speeds, meets, int(_nearest_places(speeds, np.array([chosen]))[0])),
    )


def deepest_speed(
    lobes: StabilityLobes, demand: SpeedDemand, range_rpm: tuple[float, float] | None = None
) -> SpeedChoice | None:
    """Return the speed that bears most within the tolerance to both sides, for when none bears depth and margin.

    None when even there the limiting depth is below the programmed one. Its pocket bears the depth so too.

    The parameters are those of `choose_speed`; the margin of the demand is not asked for.
    """
    speeds, depths = lobes.speed_rpm, lobes.limiting_depth_mm
    low, high = range_rpm or (float(speeds[0]), float(speeds[-1]))
    inside = np.flatnonzero((speeds >= low) & (speeds <= high))
    worst = _worst_within(lobes, demand.tolerance_fraction)
    place = int(inside[np.argmax(worst[inside])])
    if depths[place] < demand.depth_mm:
        return None
    meets = worst >= demand.depth_mm
    meets[place] = True
    return SpeedChoice(
        speed_rpm=float(speeds[place]),
        limiting_depth_mm=float(depths[place]),
        pocket_rpm=_pocket(speeds, meets, place),
        margin_met=False,
    )


def stable_range_rpm(lobes: StabilityLobes, demand: SpeedDemand, speed_rpm: float) -> tuple[float, float]:
    """Return the ends of the range around a speed [1/min] in which the lobes meet the demand."""
    stable = _worst_within(lobes, demand.tolerance_fraction) >= demand.depth_mm * (1.0 + demand.margin_fraction)
    return _pocket(lobes.speed_rpm, stable, int(_nearest_places(lobes.speed_rpm, np.array([speed_rpm]))[0]))


def limiting_depth_mm(lobes: StabilityLobes, speed_rpm: float) -> float:
    """Return the limiting depth at a speed [1/min], NaN outside the lobes [mm]."""
    return _depth_at(lobes, speed_rpm)


def least_depth_mm(lobes: StabilityLobes, speed_rpm: float, fraction: float) -> float:
    """Return the lowest limiting depth within a share of a speed [1/min] to both sides, NaN outside the lobes [mm]."""
    beside = np.abs(lobes.speed_rpm - speed_rpm) <= fraction * speed_rpm
    return float(np.min([limiting_depth_mm(lobes, speed_rpm), *lobes.limiting_depth_mm[beside]]))


def rule_candidates_rpm(
    resonances_hz: Sequence[float], offset_hz: float, teeth: int, range_rpm: tuple[float, float]
) -> tuple[float, ...]:
    """Return the speeds of equation 5-9 for the resonances of both axes and every lobe within a range [1/min].

    Raises StabilityError as `resonance_speed_rpm`.
    """
    found = []
    for resonance_hz in resonances_hz:
        fastest = resonance_speed_rpm(resonance_hz, offset_hz, teeth, 1)
        first, last = max(math.ceil(fastest / range_rpm[1]), 1), math.floor(fastest / range_rpm[0])
        found += [fastest / lobe for lobe in range(first, last + 1)]
    return tuple(sorted(found))


def _worst_within(lobes: StabilityLobes, fraction: float) -> FloatArray:
    """Return the lowest limiting depth within a share of each speed to both sides, shape (n,)."""
    speeds, depths = lobes.speed_rpm, lobes.limiting_depth_mm
    first = np.searchsorted(speeds, speeds * (1.0 - fraction), side="left")
    last = np.searchsorted(speeds, speeds * (1.0 + fraction), side="right")
    return np.array([depths[begin:end].min() for begin, end in zip(first.tolist(), last.tolist(), strict=True)])


def _nearest_places(speeds: FloatArray, wanted: FloatArray) -> np.ndarray:
    spacing = float(speeds[1] - speeds[0])
    places: np.ndarray = np.clip(np.rint((wanted - speeds[0]) / spacing), 0, len(speeds) - 1).astype(np.intp)
    return places


def _inside(speeds: Sequence[float] | FloatArray, low: float, high: float) -> FloatArray:
    offered = np.asarray(speeds, dtype=np.float64)
    return offered[(offered >= low) & (offered <= high)]


def _depth_at(lobes: StabilityLobes, speed_rpm: float) -> float:
    if not lobes.speed_rpm[0] <= speed_rpm <= lobes.speed_rpm[-1]:
        return math.nan
    return float(np.interp(speed_rpm, lobes.speed_rpm, lobes.limiting_depth_mm))


def _pocket(speeds: FloatArray, meets: np.ndarray, place: int) -> tuple[float, float]:
    """Return the ends of the unbroken stable range around a place."""
    outside = np.flatnonzero(~meets)
    below, above = outside[outside < place], outside[outside > place]
    first = int(below[-1]) + 1 if len(below) else 0
    last = int(above[0]) - 1 if len(above) else len(speeds) - 1
    return float(speeds[first]), float(speeds[last])
