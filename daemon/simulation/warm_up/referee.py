"""Whether the cuts of a warm-up chatter, by the time-domain simulation with the machine's true modes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from config.machine.stability_case import StabilityCase
from drivers.sim.spindle.milling import MillingCuts, arc_of, is_stable
from drivers.sim.spindle.warming_spindle import VibrationModes
from models.records import FloatArray
from models.spindle_speed.strategies import SpeedInForce

PASSINGS = 150
STEPS_PER_PERIOD = 50
LEAST_STEPS = 120
"""Steps per tooth passing, and per period of the fastest mode, of the simulated cut."""
SLICES = 12
"""Of a helical edge."""
DEPTHS = 8
DEEPEST, SHALLOWEST = 4.0, 0.25
"""A limiting depth is looked for between these multiples of the programmed depth, in two rounds of `DEPTHS`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CutState:
    """The machine in the middle of one cut."""

    pair: SpeedInForce
    modes: VibrationModes
    """The true ones."""
    estimated_hz: dict[str, float]

    @property
    def true_hz(self) -> dict[str, float]:
        """The resonance that responds most, per axis [Hz]."""
        found = {}
        height = 1.0 / (self.modes.stiffness_n_per_m * self.modes.damping_ratio)
        for axis, name in enumerate("xy"):
            places = [place for place, of in enumerate(self.modes.axis) if of == axis]
            if places:
                place = max(places, key=lambda each: float(height[each]))
                damping = float(self.modes.damping_ratio[place])
                found[name] = float(self.modes.frequency_hz[place] * np.sqrt(max(1.0 - 2.0 * damping**2, 0.0)))
        return found


class WarmUpReferee:
    """Simulates cuts of one case side by side."""

    def __init__(self, case: StabilityCase, feed_per_tooth_mm: float) -> None:
        self._cut = cut = case.cut()
        self._teeth, self._tangential = case.teeth, cut.tangential_n_per_m2
        self._radial = cut.tangential_n_per_m2 * cut.radial_ratio
        radial_mm = case.radial_depth_mm or case.diameter_mm
        self._arc = arc_of(case.milling, radial_mm * 1e-3, case.diameter_mm * 1e-3)
        self._feed_rad = float(np.radians(float(case.feed_deg)))
        self._feed_m = feed_per_tooth_mm * 1e-3

    def stable(self, states: Sequence[CutState], depth_mm: FloatArray) -> np.ndarray:
        """Return whether each state is stable at its depth [mm], shape (n,)."""
        speed_rpm = np.array([state.pair.speed_rpm for state in states])
        same = np.ones(len(states))
        frequency_hz = np.array([state.modes.frequency_hz for state in states])
        periods = float(np.max(frequency_hz.max(axis=1) * 60.0 / (speed_rpm * self._teeth)))
        helical, rubbing = self._cut.helix_rad > 0.0, self._cut.process_damping_n_per_m
        cutting_speed_m_s = np.pi * self._cut.diameter_m * speed_rpm / 60.0
        cuts = MillingCuts(
            teeth=self._teeth,
            speed_rpm=speed_rpm,
            axial_depth_m=depth_mm * 1e-3,
            first_bearing_rad=self._arc[0] * same,
            last_bearing_rad=self._arc[1] * same,
            tangential_n_per_m2=self._tangential * same,
            radial_n_per_m2=self._radial * same,
            feed_per_tooth_m=self._feed_m * same,
            feed_direction_rad=self._feed_rad * same,
            mode_frequency_hz=frequency_hz,
            mode_damping_ratio=np.array([state.modes.damping_ratio for state in states]),
            mode_stiffness_n_per_m=np.array([state.modes.stiffness_n_per_m for state in states]),
            mode_axis=states[0].modes.axis,
            mode_lead_s=None if states[0].modes.lead_s is None else np.array([state.modes.lead_s for state in states]),
            helix_lag_rad=self._cut.lag_rad(depth_mm) if helical else None,
            slices=SLICES if helical else 1,
            pitch_rad=self._cut.pitch_rad,
            # Uneven teeth that chatter out of the cut may repeat their motion turn by turn, and would count as stable.
            keeps_contact=bool(self._cut.pitch_rad),
            damping_n_s_per_m=rubbing * depth_mm * 1e-3 / cutting_speed_m_s if rubbing else None,
        )
        return is_stable(cuts, PASSINGS, max(LEAST_STEPS, int(np.ceil(STEPS_PER_PERIOD * periods))))

    def limiting_depths_mm(self, states: Sequence[CutState], programmed_mm: float) -> FloatArray:
        """Return the depth up to which each state is stable [mm], between 0 and `DEEPEST` times the programmed one."""
        lower = np.full(len(states), SHALLOWEST * programmed_mm)
        upper = np.full(len(states), DEEPEST * programmed_mm)
        found = np.zeros(len(states))
        for _ in range(2):
            depths = np.geomspace(lower, upper, DEPTHS)
            stable = self.stable(list(states) * DEPTHS, depths.ravel()).reshape(depths.shape)
            count = np.cumprod(stable, axis=0).sum(axis=0)
            columns = np.arange(len(states))
            found = np.where(count > 0, depths[np.maximum(count - 1, 0), columns], found)
            lower = np.where(count > 0, found, 0.2 * SHALLOWEST * programmed_mm)
            upper = depths[np.minimum(count, DEPTHS - 1), columns]
            upper = np.where(upper > lower, upper, lower * 1.01)
        return found
