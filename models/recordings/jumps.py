"""Takes jumps off displacements that are not thermal: at switching of the spindle, and sudden ones."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from models.records import FloatArray

JUMP_SCATTERS = 6.0
"""A jump exceeds its threshold by so many standard deviations of the noise."""


def remove_jumps_at_switching(
    displacement_um: FloatArray, speed_rpm: FloatArray, threshold_um: float = 3.0
) -> FloatArray:
    """Return displacements without the jumps at which the spindle was switched on or off.

    For training data only; tests and reports use the raw displacements (section 3.3.1 of the
    source). Where the spindle starts or stops between two samples and a channel varies by more
    than the threshold between them, that variation is taken off all later samples of the channel.

    Result: a new array; the argument is not changed. Raises ValueError when the lengths differ or the threshold is
    negative.

    `displacement_um`, shape (n,) or (n, n_channels): displacements [um]; a missing sample (NaN) stays missing, and the
    variation is then taken between the nearest samples before and after. `speed_rpm`, shape (n,): spindle speed
    [1/min]; the spindle is on where it is not zero. Unknown (NaN) repeats the previous state. `threshold_um`: smaller
    variations are left alone [um].
    """
    if speed_rpm.ndim != 1 or len(speed_rpm) != len(displacement_um):
        raise ValueError(f"{len(displacement_um)} displacement rows need as many speeds, got shape {speed_rpm.shape}")
    if not threshold_um >= 0:
        raise ValueError(f"threshold_um must not be negative, got {threshold_um}")
    channels = displacement_um.reshape(len(displacement_um), -1)
    cleansed = channels.copy()
    on = _spindle_on(speed_rpm)
    for channel in range(channels.shape[1]):
        rows = np.flatnonzero(np.isfinite(channels[:, channel]))
        variation_um = np.diff(channels[rows, channel])
        jump = (on[rows][1:] != on[rows][:-1]) & (np.abs(variation_um) > threshold_um)
        cleansed[rows[1:], channel] -= np.cumsum(np.where(jump, variation_um, 0.0))
    return cleansed.reshape(displacement_um.shape)


def remove_sudden_jumps(
    time_s: FloatArray, displacement_um: FloatArray, speed_rpm: FloatArray, threshold_um: float
) -> FloatArray:
    """Return displacements without the jumps at which the spindle was switched on or off, whatever the sampling.

    `remove_jumps_at_switching` looks at variations over a minute, which on a slowly sampled recording, on a
    quick machine or with a noisy sensor are warming or noise rather than a jump. Here the threshold grows with the
    time between the samples, from a minute on, and with the noise; and only what the variation has beyond the
    next one counts, because warming goes on where a jump does not.

    Result of shape (n, n_channels): a new array; what a jump has beyond the next variation is taken off all later
    samples.

    `time_s`, shape (n,): increasing times [s]. `displacement_um`, shape (n, n_channels): displacements [um], NaN where
    missing. `speed_rpm`, shape (n,): spindle speed [1/min]; NaN repeats the previous state. `threshold_um`: smaller
    jumps are left alone [um].
    """
    cleansed, on = displacement_um.copy(), _spindle_on(speed_rpm)
    for channel in range(displacement_um.shape[1]):
        rows = np.flatnonzero(np.isfinite(displacement_um[:, channel]))
        if len(rows) < 3:
            continue
        values = displacement_um[rows, channel]
        variation_um = np.diff(values)
        after_um = np.append(variation_um[1:], 0.0)
        goes_on_um = np.where(variation_um * after_um > 0.0, after_um, 0.0)
        beyond_um = variation_um - goes_on_um
        least_um = threshold_um * np.maximum(np.diff(time_s[rows]) / 60.0, 1.0)
        least_um += JUMP_SCATTERS * scatter_um([values[:, None]])[0]
        jump = (on[rows][1:] != on[rows][:-1]) & (np.abs(variation_um) - np.abs(goes_on_um) > least_um)
        cleansed[rows[1:], channel] -= np.cumsum(np.where(jump, beyond_um, 0.0))
    return cleansed


def scatter_um(segments: Sequence[FloatArray]) -> FloatArray:
    """Return the standard deviation of what is noise in displacements, robust against what moves smoothly.

    Third differences are zero for a parabola; those of white noise have sqrt(20) times its deviation.

    Result of shape (n_channels,): [um]; zeros where no stretch has four rows with a value.

    `segments`: displacements of stretches without a hole [um], each of shape (n, n_channels), NaN where missing.
    """
    differences = np.vstack([np.diff(segment, n=3, axis=0) for segment in segments])
    known = [column[np.isfinite(column)] for column in differences.T]
    return np.array([1.4826 * np.median(np.abs(c)) / np.sqrt(20.0) if len(c) else 0.0 for c in known])


def _spindle_on(speed_rpm: FloatArray) -> npt.NDArray[np.bool_]:
    known = np.isfinite(speed_rpm)
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(speed_rpm)), -1))
    on = np.abs(np.where(known, speed_rpm, 0.0)) > 0.0
    return np.where(last_known >= 0, on[np.maximum(last_known, 0)], False)
