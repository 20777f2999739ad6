"""What a probe or displacement measurement during production does: it corrects the model's offset.

The part of the thermal error that the model misses is taken as an offset that wanders at random from the reference on
and, left alone, returns towards zero: as fast and as far as what was left out in training did (an Ornstein-Uhlenbeck
process). A measurement with noise moves the estimate of it by the Kalman gain; without noise the gain is one, which is
a full reset. The same filter serves the output and the evaluation of
recordings. A correction is bounded, so that one wrong measurement cannot do much harm.

A model whose changes between measurements are worse than none (the wrong sign, another machine) is not followed
between them: the offset takes its changes back, and the measurement alone holds.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from models.model_file import ModelError, Numbers
from models.records import FloatArray

BoolArray = npt.NDArray[np.bool_]
REPEATED_MIN = 2.0
"""A second value of an axis within this time [min] is a repeat reading: their difference is the probe's noise."""
ENOUGH_REPEATED = 3
"""Fewer repeat readings do not tell the noise; until then a probe resets the offset fully."""

HARM_DEVIATIONS = 3.0
"""A model's changes do harm when they leave more of the changes between measurements than none would, by more than this
many deviations of what the model is known to miss."""
HARM_KEPT = 0.9
"""Of what earlier intervals said of that, this share counts at the next measurement."""
ADVANCED_MIN = 1.0
"""The output's offset is let return in steps of this time [min]: it is kept for a restart whenever it changes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Wander:
    """How what a model misses wanders, per channel or axis, as training found it.

    Raises ModelError when the two do not fit together.
    """

    um2_per_min: Numbers
    """Variance that it gains per minute [um^2/min]."""
    correlation_min: Numbers
    """Time constant with which it returns to zero [min]."""

    def __post_init__(self) -> None:
        if self.um2_per_min.shape != self.correlation_min.shape or self.um2_per_min.ndim != 1:
            raise ModelError("probing", "um2_per_min and correlation_min have other shapes")
        if not ((self.um2_per_min >= 0.0) & (self.correlation_min > 0.0)).all():
            raise ModelError("probing", "holds a variance that is negative, or a time that is not positive")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BiasState:
    """The offset that is added to the model's estimate; arrays of shape (n_channels,), or of the axes."""

    time_min: float
    """When it was last corrected [min]."""
    bias_um: FloatArray
    """Offset per channel [um]."""
    variance_um2: FloatArray
    """Its variance at that time [um^2]; infinite where nothing is known of it."""
    seen_min: FloatArray
    """When each was last measured [min], NaN before."""
    seen_um: FloatArray
    """What was measured then minus the model alone [um]."""
    repeated: FloatArray
    """Number of repeat readings."""
    repeated_um2: FloatArray
    """Sum of the squares of their differences [um^2]."""
    estimate_um: FloatArray
    """What the model said at `time_min` [um]."""
    told_min: FloatArray
    """When each began or was last measured [min]; NaN where that is not known ..."""
    told_estimate_um: FloatArray
    """... what the model said then [um] ..."""
    told_um: FloatArray
    """... and what was measured minus that [um]."""
    harm_um2: FloatArray
    """What the model's changes have left of those between measurements beyond what none would, in squares [um^2]."""
    follows: BoolArray
    """Whether the model is followed between measurements; else they alone count."""

    def begin(self, time_min: float) -> "BiasState":
        """Return the state at a reference, where the offset is zero by definition; the noise is still known."""
        zeros = np.zeros_like(self.bias_um)
        return replace(
            unknown_bias(len(zeros), time_min),
            variance_um2=zeros,
            repeated=self.repeated,
            repeated_um2=self.repeated_um2,
            told_min=zeros + time_min,
        )


def unknown_bias(channels: int, time_min: float) -> BiasState:
    """Return the state in which nothing is known: the next measurement resets the offset fully."""
    zeros = np.zeros(channels)
    return BiasState(
        time_min=time_min,
        bias_um=zeros,
        variance_um2=zeros + np.inf,
        seen_min=zeros * np.nan,
        seen_um=zeros,
        repeated=zeros,
        repeated_um2=zeros,
        estimate_um=zeros,
        told_min=zeros * np.nan,
        told_estimate_um=zeros,
        told_um=zeros,
        harm_um2=zeros,
        follows=np.ones(channels, dtype=np.bool_),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BiasFilter:
    """How the offset wanders and how far it may be corrected.

    Raises ValueError when a variance or bound is negative or not a number.
    """

    wander_um2_per_min: FloatArray
    """Variance that the offset gains per minute [um^2/min], shape (n_channels,); infinite: every probe resets it."""
    noise_um: FloatArray
    """Standard deviation of a measurement [um], shape (n_channels,); 0 resets the offset fully, NaN: repeat readings
    tell it."""
    largest_step_um: FloatArray
    """Largest correction by one measurement [um], shape (n_channels,); may be infinite."""
    correlation_min: FloatArray | None = None
    """Time constant with which the offset returns to zero [min], shape (n_channels,); None: it stays."""

    def __post_init__(self) -> None:
        positive = np.all(self.largest_step_um > 0.0)
        if not (np.all(self.wander_um2_per_min >= 0.0) and not np.any(self.noise_um < 0.0) and positive):
            raise ValueError("wander and noise must not be negative, and the largest step must be positive")
        if self.correlation_min is not None and not np.all(self.correlation_min > 0.0):
            raise ValueError("a correlation time must be positive")

    def begin(self, time_min: float) -> BiasState:
        """Return the state at a reference, where the offset is zero by definition."""
        return unknown_bias(len(self.wander_um2_per_min), time_min).begin(time_min)

    def advanced(self, state: BiasState, time_min: float, estimate_um: FloatArray | None = None) -> BiasState:
        """Return the state at a later time [min]: the offset returns, and less is known of it.

        `estimate_um`, shape (n_channels,): what the model says then [um]; where it is not followed its change since the
        state is taken back. None: it is taken to have said what it said before.
        """
        if estimate_um is not None:
            known = np.where(np.isfinite(estimate_um), estimate_um, state.estimate_um)
            back_um = np.where(state.follows, 0.0, known - state.estimate_um)
            state = replace(state, bias_um=state.bias_um - back_um, estimate_um=known)
        elapsed_min = max(time_min - state.time_min, 0.0)
        if elapsed_min == 0.0:
            return state
        gained_um2, kept = self.wander_um2_per_min * elapsed_min, np.ones_like(state.bias_um)
        if self.correlation_min is not None:
            kept = np.exp(-elapsed_min / self.correlation_min)
            lasting = np.isfinite(self.correlation_min) & np.isfinite(gained_um2)
            most_um2 = 0.5 * np.where(lasting, self.wander_um2_per_min * self.correlation_min, 0.0)
            gained_um2 = np.where(lasting, most_um2 * (1.0 - kept**2), gained_um2)
        return replace(
            state,
            time_min=time_min,
            bias_um=np.where(state.follows, kept, 1.0) * state.bias_um,
            variance_um2=kept**2 * state.variance_um2 + gained_um2,
        )

    def _told(self, state: BiasState, residual_um: FloatArray, known: BoolArray, noise_um2: FloatArray) -> BiasState:
        """Return the state with what a measurement tells of the model's changes since the one before."""
        if self.correlation_min is None or not (modelled := np.isfinite(self.wander_um2_per_min)).any():
            return state
        elapsed_min = np.nan_to_num(state.time_min - state.told_min, nan=np.inf)
        wander, lasts_min = np.where(modelled, (self.wander_um2_per_min, self.correlation_min), 1.0)
        missed_um2 = wander * lasts_min * -np.expm1(-elapsed_min / lasts_min)
        left_um = residual_um - state.told_um
        change_um = left_um + state.estimate_um - state.told_estimate_um
        told = known & modelled & np.isfinite(state.told_min)
        harm_um2 = np.where(
            told, HARM_KEPT * state.harm_um2 + np.square(left_um) - np.square(change_um), state.harm_um2
        )
        limit_um2 = HARM_DEVIATIONS**2 * (missed_um2 + 2.0 * noise_um2)
        return replace(
            state,
            told_min=np.where(known, state.time_min, state.told_min),
            told_estimate_um=np.where(known, state.estimate_um, state.told_estimate_um),
            told_um=np.where(known, residual_um, state.told_um),
            harm_um2=harm_um2,
            follows=np.where(told, harm_um2 <= limit_um2, state.follows),
        )

    def correct(
        self, state: BiasState, time_min: float, residual_um: FloatArray, estimate_um: FloatArray | None = None
    ) -> BiasState:
        """Return the state after a measurement.

        `time_min`: its time [min], not before that of the state. `residual_um`, shape (n_channels,): measured minus
        estimated by the model alone [um], NaN for a channel that was not measured, which keeps its offset. Under
        compensation, measured is what the probe saw minus what was applied. `estimate_um`, shape (n_channels,): what
        the model says then [um], see `advanced`.
        """
        known = np.isfinite(residual_um)
        residual_um = np.where(known, residual_um, 0.0)
        again = known & (time_min - state.seen_min <= REPEATED_MIN)
        repeated = state.repeated + again
        repeated_um2 = state.repeated_um2 + np.where(again, np.square(residual_um - state.seen_um), 0.0)
        learned = np.where(repeated >= ENOUGH_REPEATED, 0.5 * repeated_um2 / np.maximum(repeated, 1.0), 0.0)
        noise_um2 = np.where(np.isnan(self.noise_um), learned, np.square(self.noise_um))
        state = self._told(self.advanced(state, time_min, estimate_um), residual_um, known, noise_um2)
        variance = np.where(state.follows, state.variance_um2, np.inf)
        gain = np.ones_like(noise_um2)
        np.divide(variance, variance + noise_um2, out=gain, where=(noise_um2 > 0.0) & np.isfinite(variance))
        step = np.where(known, gain * (residual_um - state.bias_um), 0.0)
        return replace(
            state,
            time_min=time_min,
            bias_um=state.bias_um + np.clip(step, -self.largest_step_um, self.largest_step_um),
            variance_um2=np.where(known, gain * noise_um2, state.variance_um2),
            seen_min=np.where(known, time_min, state.seen_min),
            seen_um=np.where(known, residual_um, state.seen_um),
            repeated=repeated,
            repeated_um2=repeated_um2,
        )


def full_reset(channels: int) -> BiasFilter:
    """Return the filter by which every measurement resets the offset, which then stays."""
    nothing = np.zeros(channels)
    return BiasFilter(wander_um2_per_min=nothing + np.inf, noise_um=nothing, largest_step_um=nothing + np.inf)
