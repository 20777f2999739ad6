"""Refuses responses whose numbers the file's structure explains only in another unit."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path

from models.dynamics.bearings import CondensedShaft
from models.dynamics.identification import level_range_m_per_n
from models.dynamics.measurement import Measurement, MeasurementError
from models.dynamics.plausibility import check_level, other_readings

NO_FIT = 1.0
"""Root mean square of |log(H / H_meas)| above which other units are tried."""
HOPELESS = 2.0
"""The same above which a response is refused even when no other unit explains it: a factor of seven."""
BETTER = 4.0
"""Another unit explains a response when it fits this many times better."""
LINES = 400
"""About so many of the frequencies are used to try other units."""

Fit = Callable[[Measurement], float]
"""Response -> root mean square of |log(H / H_meas)| of the best fit."""


def refuse_other_units(measured: Measurement, log_error: float, fit: Fit) -> None:
    """Refuse a response that was fitted badly and fits in another unit, or not at all; raises MeasurementError."""
    if log_error <= NO_FIT:
        return
    thinned = measured.thinned(LINES)
    for what, other in other_readings(thinned):
        if fit(other) * BETTER < log_error:
            raise MeasurementError(
                f"the structure of the file cannot give these receptances from {_band(measured)} in m/N over Hz: on "
                f"average they are off by a factor of {math.exp(log_error):.2g}. It can with numbers {what}; convert "
                "them, or name the columns after what they hold"
            )
    if log_error > HOPELESS:
        raise MeasurementError(
            f"the structure of the file cannot give these receptances from {_band(measured)} with any properties; on "
            f"average they are off by a factor of {math.exp(log_error):.2g}. Check the units (m/N, Hz), where it was "
            "hit and measured, and the dimensions of the file"
        )


def refuse_levels(shaft: CondensedShaft, responses: Iterable[tuple[Path, Measurement]]) -> None:
    """Refuse responses that the shaft cannot give in m/N over Hz; raises MeasurementError naming the file."""
    lowest, highest = level_range_m_per_n(shaft)
    for file, measured in responses:
        try:
            check_level(measured, lowest, highest)
        except MeasurementError as error:
            raise MeasurementError(f"{file}: {error}") from error


def _band(measured: Measurement) -> str:
    return f"{measured.frequency_hz[0]:g} to {measured.frequency_hz[-1]:g} Hz"
