"""What a probe or displacement measurement during production does: it corrects the model's offset.

The part of the thermal error that the model misses is taken as an offset that wanders at random.
A measurement with noise moves the estimate of it by the Kalman gain; without noise the gain is one,
which is a full reset. A correction is bounded, so that one wrong measurement cannot do much harm.
"""

from dataclasses import dataclass, replace

import numpy as np

from models.records import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BiasState:
    """The offset that is added to the model's estimate."""

    time_min: float
    """When it was last corrected [min]."""
    bias_um: FloatArray
    """Offset per channel [um], shape (n_channels,)."""
    variance_um2: FloatArray
    """Its variance at that time [um^2], shape (n_channels,)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BiasFilter:
    """How the offset wanders and how far it may be corrected.

    Raises ValueError when a variance or bound is negative or not a number.
    """

    wander_um2_per_min: FloatArray
    """Variance that the offset gains per minute [um^2/min], shape (n_channels,)."""
    noise_um: FloatArray
    """Standard deviation of a measurement [um], shape (n_channels,); 0 resets the offset fully."""
    largest_step_um: FloatArray
    """Largest correction by one measurement [um], shape (n_channels,); may be infinite."""

    def __post_init__(self) -> None:
        positive = np.all(self.largest_step_um > 0.0)
        if not (np.all(self.wander_um2_per_min >= 0.0) and np.all(self.noise_um >= 0.0) and positive):
            raise ValueError("wander and noise must not be negative, and the largest step must be positive")

    def begin(self, time_min: float) -> BiasState:
        """Return the state at a reference, where the offset is zero by definition."""
        zeros = np.zeros(len(self.wander_um2_per_min))
        return BiasState(time_min=time_min, bias_um=zeros, variance_um2=zeros.copy())

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
        variance = state.variance_um2 + self.wander_um2_per_min * max(time_min - state.time_min, 0.0)
        total = variance + np.square(self.noise_um)
        gain = np.divide(variance, total, out=np.ones_like(variance), where=total > 0.0)
        known = np.isfinite(residual_um)
        step = np.where(known, gain * (np.where(known, residual_um, 0.0) - state.bias_um), 0.0)
        return replace(
            state,
            time_min=time_min,
            bias_um=state.bias_um + np.clip(step, -self.largest_step_um, self.largest_step_um),
            variance_um2=np.where(known, (1.0 - gain) * variance, variance),
        )


def wander_um2_per_min(time_min: FloatArray, residual_um: FloatArray, over_min: float) -> FloatArray:
    """Return the variance that a residual gains per minute, from its changes over some time.

    Result of shape (n_channels,): [um^2/min]; zeros when the record is shorter than that.

    Parameters
    ----------
    time_min : shape (n,)
        Increasing times [min].
    residual_um : shape (n, n_channels)
        Measured minus estimated on rows that were not trained on [um], NaN where missing.
    over_min
        Time over which changes are taken [min]: that between two probes.

    """
    later = np.searchsorted(time_min, time_min + over_min)
    begins = np.flatnonzero(later < len(time_min))
    if not len(begins):
        return np.zeros(residual_um.shape[1])
    change = residual_um[later[begins]] - residual_um[begins]
    known = np.isfinite(change)
    total = np.where(known, np.square(change), 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(known.sum(axis=0), 1) / over_min)


def probed_residual_um(
    time_min: FloatArray,
    residual_um: FloatArray,
    probe_min: float,
    bias_filter: BiasFilter | None = None,
    noise_um: FloatArray | None = None,
) -> FloatArray:
    """Return residuals when a probe corrects the offset at regular times.

    Result of shape (n, n_channels): a probe holds from the row in which it is taken.

    Parameters
    ----------
    time_min : shape (n,)
        Times [min]; the reference is the first of them.
    residual_um : shape (n, n_channels)
        Measured minus estimated without probing [um], NaN where missing.
    probe_min
        Time between two probes [min].
    bias_filter
        How a probe corrects; None resets the offset fully.
    noise_um : shape (n, n_channels)
        Error of a probe at each row [um]; None for none.

    """
    if bias_filter is None:
        channels = residual_um.shape[1]
        bias_filter = BiasFilter(
            wander_um2_per_min=np.ones(channels), noise_um=np.zeros(channels), largest_step_um=np.full(channels, np.inf)
        )
    state = bias_filter.begin(float(time_min[0]))
    corrected = np.empty_like(residual_um)
    due_min = float(time_min[0]) + probe_min
    for row, now_min in enumerate(time_min):
        corrected[row] = residual_um[row] - state.bias_um
        if now_min >= due_min - 1e-9:
            seen_um = residual_um[row] if noise_um is None else residual_um[row] + noise_um[row]
            state = bias_filter.correct(state, float(now_min), seen_um)
            corrected[row] = residual_um[row] - state.bias_um
            due_min += probe_min * max(1.0, np.floor((now_min - due_min) / probe_min + 1.0))
    return corrected
