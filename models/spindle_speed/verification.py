"""Verifies a chosen speed beyond the zeroth order, whose pockets have too steep flanks; denies what it cannot verify.

Where teeth cut one after the other, the true boundary leaves that of the zeroth-order solution at the low end of a
pocket by several per cent of the speed. Modes are fitted to the response, and the vibration must die away fast enough
in every feed direction, at the speed, at both ends of its tolerance and in between.
"""

import math
from dataclasses import replace

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray
from models.stability.collocation import radius_bounds
from models.stability.frf_modal_fit import ModalFit, fit_modes
from models.stability.milling import Cut, tooth_passing_hz
from models.stability.response import (
    ComplexArray,
    ModalResponse,
    Mode,
    SampledResponse,
    ToolPointResponse,
    check_finite,
)
from models.stability.semi_discretisation import swept_radii

THINNED_LINES = 250
"""A response of more lines than twice this is thinned out before the fit, but for its peaks."""
LEAST_DECAY_PER_S = 10.0
"""What a tooth leaves falls to a third within a tenth of a second; slower, the surface shows it, and a small error of
the dynamics turns it into chatter."""
LEAST_SHARE = 0.5
"""Of the decay of the slowest mode without a cut, where that is slow itself."""
AT_ONCE = 9
"""So many speeds are computed at a time."""
MOST_SPEEDS = 100
"""On either side of a speed; more take too long."""
OUTSIDE_DAMPING = 0.05
"""At least, of modes outside the band: only their flexibility shows inside it."""


class StabilityVerification:
    """Says whether the vibration of a cut dies away fast enough, by the spectral radius over a tooth passing.

    `cut`: engagement and cutting coefficients. `feeds_deg`: directions of the feed against X [deg]; the cut must be
    stable in all of them. `least_decay_per_s`: slowest decay that counts as stable [1/s].
    """

    def __init__(
        self, cut: Cut, feeds_deg: tuple[float, ...] = (0.0,), least_decay_per_s: float = LEAST_DECAY_PER_S
    ) -> None:
        self._cut, self._feeds_deg, self._least_decay_per_s = cut, feeds_deg, least_decay_per_s
        self._fitted: tuple[ToolPointResponse | None, ModalResponse | None] = (None, None)
        self._fits: dict[int, ModalFit] = {}

    def is_stable(self, response: ToolPointResponse, speed_rpm: float, depth_mm: float, tolerance: float) -> bool:
        """Return whether `denial` has nothing against a speed."""
        return not self.denial(response, speed_rpm, depth_mm, tolerance)

    def denial(self, response: ToolPointResponse, speed_rpm: float, depth_mm: float, tolerance: float) -> str:
        """Return why a depth cannot be cut at a speed and within its tolerance, '' when it can.

        Result: also where no modes follow the response, or vibrations are too many from tooth to tooth: what cannot be
        verified is denied.

        `response`: the tool point; an axis that acts on the other denies every speed. `speed_rpm`: the chosen speed
        [1/min]. `depth_mm`: axial depth of cut [mm]. `tolerance`: share of the speed to both sides.
        """
        try:
            modes = self.modes(response)
        except (StabilityError, np.linalg.LinAlgError) as error:
            return f"the dynamics cannot be verified: {error}"
        try:
            every_rpm = speed_rpm * _speeds_within(modes, tooth_passing_hz(speed_rpm, self._cut.teeth), tolerance)
            for first in range(0, len(every_rpm), AT_ONCE):
                if chatters := self._chatter(modes, every_rpm[first : first + AT_ONCE], depth_mm):
                    return chatters
        except (StabilityError, np.linalg.LinAlgError) as error:
            return f"{speed_rpm:.0f} 1/min cannot be verified: {error}"
        return ""

    def _chatter(self, modes: ModalResponse, speeds_rpm: FloatArray, depth_mm: float) -> str:
        """Return at which speed and in which direction a vibration does not die away, '' where all do."""
        radius = self._radius(modes, speeds_rpm, depth_mm)
        over = ~(radius <= self._limits(modes, speeds_rpm))
        if not over.any():
            return ""
        feed, place = np.unravel_index(int(np.argmax(np.where(over, radius, 0.0))), radius.shape)
        return (
            f"at {speeds_rpm[place]:.0f} 1/min and feed direction {self._feeds_deg[int(feed)]:g} deg the vibration at "
            f"{depth_mm:g} mm does not die away fast enough"
        )

    def _radius(self, modes: ModalResponse, speeds_rpm: FloatArray, depth_mm: float) -> FloatArray:
        """Return at least the spectral radius, shape (n_feeds, n_speeds)."""
        if self._cut.beyond_straight:
            return swept_radii(modes, self._cut, self._feeds_deg, speeds_rpm, depth_mm)
        _, radius = radius_bounds(
            modes,
            self._cut,
            feeds_deg=self._feeds_deg,
            speeds_rpm=speeds_rpm.tolist(),
            depth_mm=depth_mm,
            limits=self._limits(modes, speeds_rpm),
        )
        return radius

    def modes(self, response: ToolPointResponse) -> ModalResponse:
        """Return the modes of a response; raises StabilityError where none follow it."""
        if isinstance(response, ModalResponse):
            return response
        known, modes = self._fitted
        if known is response and modes is not None:
            return modes
        if not isinstance(response, SampledResponse):
            raise StabilityError("this kind of response has neither modes nor samples")
        samples = response.receptance
        check_finite(response.frequency_hz, samples)
        if samples[:, 0, 1].any() or samples[:, 1, 0].any():
            raise StabilityError("one axis acts on the other, and such an FRF has no modes of its own here")
        found = ModalResponse(xx=self._axis(response, 0), yy=self._axis(response, 1))
        if not found.modes():
            raise StabilityError("both directions are rigid, so no cut can chatter; give modes or an FRF for one")
        self._fitted = (response, found)
        return found

    def _axis(self, response: SampledResponse, axis: int) -> tuple[Mode, ...]:
        """Return the modes of one axis, from those of the response before; none where it is rigid."""
        receptance = response.receptance[:, axis, axis]
        if not receptance.any():
            return ()
        lines = _thinned(receptance)
        frequency_hz = response.frequency_hz[lines]
        fit = fit_modes(frequency_hz, receptance[lines], start=self._fits.get(axis))
        if fit.warnings:
            raise StabilityError(fit.warnings[0])
        self._fits[axis] = fit
        return tuple(_believed(mode, frequency_hz) for mode in fit.modes)

    def _limits(self, modes: ModalResponse, speeds_rpm: FloatArray) -> FloatArray:
        """Return the largest spectral radius that is stable at each speed."""
        slowest_per_s = min(mode.damping_ratio * mode.angular_rad_s for mode in modes.modes())
        decay_per_s = min(self._least_decay_per_s, LEAST_SHARE * slowest_per_s)
        limits: FloatArray = np.exp(-decay_per_s * 60.0 / (speeds_rpm * self._cut.teeth))
        return limits


def _speeds_within(modes: ModalResponse, passing_hz: float, tolerance: float) -> FloatArray:
    """Return the speeds to verify, as shares of one, the ends first.

    Raises StabilityError where they would be too many.

    They lie so close that the phase of no resonance, which vibrates ``f / passing_hz`` times from tooth to tooth,
    passes by more than half its width between two of them. `passing_hz`: tooth-passing frequency [Hz].
    """
    apart = min(mode.damping_ratio / max(mode.frequency_hz / passing_hz, 1.0) for mode in modes.modes())
    if tolerance > MOST_SPEEDS * apart:
        raise StabilityError(
            f"more than {2 * MOST_SPEEDS} speeds within its tolerance would have to be looked at; lower "
            "tolerance_percent"
        )
    count = math.ceil(tolerance / apart)
    between = tolerance * np.arange(1, count) / max(count, 1)
    shares: FloatArray = 1.0 + np.concatenate(([-tolerance, 0.0, tolerance], between, -between))
    return shares


def _thinned(receptance: ComplexArray) -> np.ndarray:
    """Return the places of the lines that are fitted: some all over the band, all of them around a peak."""
    count = len(receptance)
    every = max(count // THINNED_LINES, 1)
    taken = np.zeros(count, dtype=bool)
    taken[::every] = True
    size = np.abs(receptance)
    for peak in (np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1).tolist():
        if size[peak] == size[max(peak - every, 0) : peak + every + 1].max():
            taken[max(peak - every, 0) : peak + every + 1] = True
    return np.flatnonzero(taken)


def _believed(mode: Mode, frequency_hz: FloatArray) -> Mode:
    """Return a mode with no less damping than the samples can tell."""
    if frequency_hz[0] <= mode.frequency_hz <= frequency_hz[-1]:
        return mode
    return replace(mode, damping_ratio=max(mode.damping_ratio, OUTSIDE_DAMPING))
