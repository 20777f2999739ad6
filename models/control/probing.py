"""What a probe or displacement measurement during production does: it corrects the model's offset.

The part of the thermal error that the model misses is taken as an offset that wanders at random from the reference on
and, left alone, returns towards zero: as fast and as far as what was left out in training did (an Ornstein-Uhlenbeck
process). A measurement with noise moves the estimate of it by the Kalman gain; without noise the gain is one, which is
a full reset. The same filter serves the output and the evaluation of
recordings. A correction is bounded, so that one wrong measurement cannot do much harm.
"""

from dataclasses import dataclass, replace

import numpy as np

from models.model_file import ModelError, Numbers
from models.records import FloatArray

REPEATED_MIN = 2.0
"""A second value of an axis within this time [min] is a repeat reading: their difference is the probe's noise."""
ENOUGH_REPEATED = 3
"""Fewer repeat readings do not tell the noise; until then a probe resets the offset fully."""

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

    def begin(self, time_min: float) -> "BiasState":
        """Return the state at a reference, where the offset is zero by definition; the noise is still known."""
        zeros = np.zeros_like(self.bias_um)
        return replace(self, time_min=time_min, bias_um=zeros, variance_um2=zeros, seen_min=zeros * np.nan)


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

    def advanced(self, state: BiasState, time_min: float) -> BiasState:
        """Return the state at a later time [min]: the offset returns, and less is known of it."""
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
            bias_um=kept * state.bias_um,
            variance_um2=kept**2 * state.variance_um2 + gained_um2,
        )

    def correct(self, state: BiasState, time_min: float, residual_um: FloatArray) -> BiasState:
        """Return the state after a measurement.

        Parameters
        ----------
        state
            Before it.
        time_min
            Its time [min], not before that of the state.
        residual_um : shape (n_channels,)
            Measured minus estimated by the model alone [um], NaN for a channel that was not
            measured, which keeps its offset. Under compensation, measured is what the probe saw
            minus what was applied.

        """
        known = np.isfinite(residual_um)
        residual_um = np.where(known, residual_um, 0.0)
        again = known & (time_min - state.seen_min <= REPEATED_MIN)
        repeated = state.repeated + again
        repeated_um2 = state.repeated_um2 + np.where(again, np.square(residual_um - state.seen_um), 0.0)
        learned = np.where(repeated >= ENOUGH_REPEATED, 0.5 * repeated_um2 / np.maximum(repeated, 1.0), 0.0)
        noise_um2 = np.where(np.isnan(self.noise_um), learned, np.square(self.noise_um))
        state = self.advanced(state, time_min)
        variance = state.variance_um2
        gain = np.ones_like(noise_um2)
        np.divide(variance, variance + noise_um2, out=gain, where=(noise_um2 > 0.0) & np.isfinite(variance))
        step = np.where(known, gain * (residual_um - state.bias_um), 0.0)
        return replace(
            state,
            time_min=time_min,
            bias_um=state.bias_um + np.clip(step, -self.largest_step_um, self.largest_step_um),
            variance_um2=np.where(known, gain * noise_um2, variance),
            seen_min=np.where(known, time_min, state.seen_min),
            seen_um=np.where(known, residual_um, state.seen_um),
            repeated=repeated,
            repeated_um2=repeated_um2,
        )


def full_reset(channels: int) -> BiasFilter:
    """Return the filter by which every measurement resets the offset, which then stays."""
    nothing = np.zeros(channels)
    return BiasFilter(wander_um2_per_min=nothing + np.inf, noise_um=nothing, largest_step_um=nothing + np.inf)
