"""Sees in the CNC's samples when work has been positioned, and when a reference has ended."""

from models.records import CncSample

CLOCK_STEP_S = 1.0
"""The CNC's clock going back by more than this means that it was switched off [s]."""
CLOCK_GAP_REAL_S = 2.0
"""After a silence as long as this the CNC's clock is held against ours [s of the wall clock]."""
CLOCK_DRIFT = 0.02
"""Share of the elapsed time by which two clocks may differ."""


def power_cycled(previous: CncSample | None, sample: CncSample) -> bool:
    """Whether the control was switched off between two samples."""
    if previous is None:
        return False
    if sample.power_on_count != previous.power_on_count or sample.clock_s < previous.clock_s - CLOCK_STEP_S:
        return True
    if sample.time.real_s - previous.time.real_s < CLOCK_GAP_REAL_S:
        return False
    elapsed_s = sample.time.monotonic_s - previous.time.monotonic_s
    return clock_restarted(sample.clock_s - previous.clock_s, elapsed_s)


def clock_restarted(advance_s: float, elapsed_s: float) -> bool:
    """Whether the CNC's clock went on by less than the time that has passed here."""
    return advance_s < elapsed_s - max(2.0 * CLOCK_STEP_S, CLOCK_DRIFT * elapsed_s)


def clocks_differ(advance_s: float, elapsed_s: float) -> bool:
    """Whether the CNC's clock went on by less or by more than the time that has passed here."""
    return abs(advance_s - elapsed_s) > max(2.0 * CLOCK_STEP_S, CLOCK_DRIFT * abs(elapsed_s))
