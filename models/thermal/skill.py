"""Compares the errors that probes and displacement sensors measure with what the estimate would leave of them."""

from dataclasses import dataclass, replace

import numpy as np

LEAST_PAIRS = 10
"""Fewer measurements prove nothing."""
MARGIN = 1.25
"""The estimate does harm when it leaves so many times the error that there would be without it."""
MOST_PAIRS = 60
"""So many latest measurements count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SkillRecord:
    """The latest measurements of one axis since a reference."""

    measured_um: tuple[float, ...] = ()
    """Error without compensation [um]."""
    left_um: tuple[float, ...] = ()
    """The same minus the estimate [um]."""


def with_measurement(record: SkillRecord, measured_um: float, estimated_um: float) -> SkillRecord:
    """Return the record with one more measurement.

    Result: unchanged when a number is not finite.

    Parameters
    ----------
    record
        Before it.
    measured_um
        Error since the reference without compensation: measured minus applied [um].
    estimated_um
        Estimate at the same instant [um].

    """
    if not (np.isfinite(measured_um) and np.isfinite(estimated_um)):
        return record
    keep = 1 - MOST_PAIRS
    return replace(
        record,
        measured_um=(*record.measured_um[keep:], measured_um),
        left_um=(*record.left_um[keep:], measured_um - estimated_um),
    )


def rms_um(values_um: tuple[float, ...]) -> float:
    """Return the root mean square [um]; 0 without values."""
    return float(np.sqrt(np.mean(np.square(values_um)))) if values_um else 0.0


def does_harm(record: SkillRecord, least_error_um: float) -> bool:
    """Return whether the estimate leaves more than there would be without it.

    Result: true when what is left exceeds `MARGIN` times the measured error, and `least_error_um`.

    `record`: at least `LEAST_PAIRS` measurements are needed for a verdict. `least_error_um`: while both are below this,
    neither says anything [um].
    """
    if len(record.left_um) < LEAST_PAIRS:
        return False
    left = rms_um(record.left_um)
    return left > max(MARGIN * rms_um(record.measured_um), least_error_um)
