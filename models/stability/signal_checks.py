"""Checks that a recording of an accelerometer is good enough for a verdict on chatter."""

import numpy as np

from models.errors import StabilityError
from models.records import FloatArray

FAINTEST_M_S2, LOUDEST_M_S2 = 1e-9, 1e9
"""Range of the largest acceleration of a recording; outside, its unit or its scale is wrong [m/s^2]."""
SHORTEST_WINDOW = 16
"""A spectrum of fewer samples has no lines to tell apart."""


def check_length(samples: int, sample_rate_hz: float, window: int) -> None:
    """Refuse a signal that is shorter than a window, or sampled too slowly for one.

    Raises StabilityError saying how long, or how fast, to record.

    `samples`: how many there are. `sample_rate_hz`: samples per second [Hz]. `window`: how many a spectrum needs.
    """
    if window < SHORTEST_WINDOW:
        raise StabilityError(
            f"{sample_rate_hz:.3g} samples a second show no vibration of a cut; are the times of the recording in s?"
        )
    if samples < window:
        raise StabilityError(
            f"{samples} samples at {sample_rate_hz:g} Hz are {samples / sample_rate_hz:.3g} s; a spectrum needs "
            f"{window} ({window / sample_rate_hz:.2g} s): record longer, or analyse a longer part"
        )


def check_clipping(acceleration_m_s2: FloatArray) -> None:
    """Refuse a signal that does not move, is no acceleration, or stays at its largest or smallest value.

    A signal stays there as only a limit makes it.

    Raises StabilityError saying what is wrong and what to do.

    `acceleration_m_s2`: shape (n,) [m/s^2].
    """
    lowest, highest = float(acceleration_m_s2.min()), float(acceleration_m_s2.max())
    if lowest == highest:
        raise StabilityError(
            f"the recording stands at {lowest:g} m/s^2 from beginning to end; check the sensor and its cable"
        )
    largest = max(-lowest, highest)
    if not FAINTEST_M_S2 <= largest <= LOUDEST_M_S2:
        raise StabilityError(
            f"the largest acceleration of the recording is {largest:g} m/s^2, which no accelerometer reads; check unit "
            "and scale"
        )
    for extreme, name in ((highest, "upper"), (lowest, "lower")):
        at_limit = acceleration_m_s2 == extreme
        count = int(at_limit.sum())
        values = acceleration_m_s2[~at_limit]
        if count < 5 or not len(values):
            continue
        next_value = float(values.max() if name == "upper" else values.min())
        edges = np.flatnonzero(np.diff(np.concatenate(([0], at_limit.astype(np.int8), [0]))))
        longest = int((edges[1::2] - edges[::2]).max())
        if longest >= 4 or count > 4 * int(np.sum(acceleration_m_s2 == next_value)):
            raise StabilityError(
                f"the recording is clipped: {count} samples stand at its {name} end of {extreme:g} m/s^2; "
                "set a wider range of the amplifier and record again"
            )
