"""What is believed of a measured value: the source's rules, bounded so that they cannot latch for ever."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.quality import Quality, Reason
from models.records import CodeArray, FloatArray

IntArray = npt.NDArray[np.int64]


IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingRules:
    """What is accepted of a temperature; the fields are those of the configuration."""

    max_change_degc: float = 1.0
    """Largest change within one cycle [degC]."""
    max_rate_degc_per_min: float = 6.0
    """Growth of the allowed change with the time that a gap lasts [degC/min]."""
    release_after_samples: int = 3
    """So many successive rejected samples that agree are a new level."""
    agree_within_degc: float = 0.5
    """Largest spread of samples that agree [degC]."""
    min_degc: float = -20.0
    max_degc: float = 100.0
    stale_after_s: float = 60.0
    """A held value that is older is missing [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingState:
    """What cleansing remembers, one entry per sensor of the machine. Never changed in place."""

    accepted_degc: FloatArray
    """Last accepted value [degC], NaN where there was none."""
    accepted_at_s: FloatArray
    """Its time [s], -inf where there was none."""
    rejected_min_degc: FloatArray
    """Lowest of the rejected samples that agree so far [degC], NaN where there is none."""
    rejected_max_degc: FloatArray
    """Highest of them [degC]."""
    rejected_count: IntArray
    """How many of them."""

    def __post_init__(self) -> None:
        for array in (
            self.accepted_degc,
            self.accepted_at_s,
            self.rejected_min_degc,
            self.rejected_max_degc,
            self.rejected_count,
        ):
            array.flags.writeable = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingResult:
    """One cycle after cleansing; the arrays follow the cycle's own order."""

    state: CleansingState
    degc: FloatArray
    """Measured where quality is GOOD, the last accepted value where HELD, else NaN [degC]."""
    quality: CodeArray
    reason: CodeArray


def initial_state(sensor_count: int) -> CleansingState:
    """Return the state before the first cycle of a machine with `sensor_count` sensors."""
    return CleansingState(
        accepted_degc=np.full(sensor_count, np.nan),
        accepted_at_s=np.full(sensor_count, -np.inf),
        rejected_min_degc=np.full(sensor_count, np.nan),
        rejected_max_degc=np.full(sensor_count, np.nan),
        rejected_count=np.zeros(sensor_count, dtype=np.int64),
    )


def age_s(state: CleansingState, now_s: float) -> FloatArray:
    """Return the time since each sensor's last accepted value.

    Parameters
    ----------
    state
        State after the last cycle.
    now_s
        Time on the clock of the cycles [s].

    Returns
    -------
    numpy.ndarray, shape (n_sensors,)
        Age [s]; inf where no value was ever accepted.

    """
    return np.maximum(now_s - state.accepted_at_s, 0.0)


def cleanse_cycle(
    rules: CleansingRules,
    state: CleansingState,
    indices: IndexArray,
    measured_degc: FloatArray,
    quality: CodeArray,
    reason: CodeArray,
    now_s: float,
    cycle_period_s: float,
) -> CleansingResult:
    """Accept, hold or miss each value of one line's cycle.

    The source (section 3.3.1) keeps the previous value when a temperature changes by more than
    1 degC, which never lets go of it after a real step. Here the allowed change is
    ``max_change + max_rate * (elapsed - cycle_period)`` since the last accepted value, and a
    rejected level is believed once `release_after_samples` successive rejected samples lie within
    `agree_within_degc` of each other. A held value that grows too old is missing.

    Parameters
    ----------
    rules
        What is accepted.
    state
        State after the previous cycle of any line.
    indices : shape (n,)
        Place of each value of the cycle in the machine's sensor order, each at most once.
    measured_degc : shape (n,)
        Measured temperatures [degC], NaN where none.
    quality, reason : shape (n,)
        Codes of the driver; a value that is not GOOD is not looked at.
    now_s
        Time of the cycle [s].
    cycle_period_s
        Time from one cycle of this line to the next [s].

    Returns
    -------
    CleansingResult
        The new state, and values, quality and reason in the order of `indices`.

    """
    usable = (quality == Quality.GOOD) & np.isfinite(measured_degc)
    in_range = usable & (measured_degc >= rules.min_degc) & (measured_degc <= rules.max_degc)
    previous_degc, previous_at_s = state.accepted_degc[indices], state.accepted_at_s[indices]
    known = np.isfinite(previous_degc)
    elapsed_s = now_s - previous_at_s
    gap_s = np.maximum(elapsed_s - cycle_period_s, 0.0)
    allowed_degc = rules.max_change_degc + rules.max_rate_degc_per_min / 60.0 * gap_s
    within = in_range & (~known | (np.abs(measured_degc - previous_degc) <= allowed_degc))
    lowest, highest, count = _count_agreeing(rules, state, indices, measured_degc, in_range & ~within)
    accepted = within | (in_range & (count >= rules.release_after_samples))

    held = ~accepted & known & (elapsed_s <= rules.stale_after_s)
    why = np.where(reason == Reason.NONE, np.uint8(Reason.NOT_RECEIVED), reason)
    why = np.where(usable, np.where(in_range, np.uint8(Reason.RATE), np.uint8(Reason.OUT_OF_RANGE)), why)
    why = np.where(accepted, np.uint8(Reason.NONE), np.where(held | ~known, why, np.uint8(Reason.STALE)))
    verdict = np.where(accepted, np.uint8(Quality.GOOD), np.where(held, np.uint8(Quality.HELD), np.uint8(2)))
    return CleansingResult(
        state=_updated(state, indices, accepted, measured_degc, now_s, lowest, highest, count),
        degc=np.where(accepted, measured_degc, np.where(held, previous_degc, np.nan)),
        quality=verdict.astype(np.uint8),
        reason=why.astype(np.uint8),
    )


def _count_agreeing(
    rules: CleansingRules,
    state: CleansingState,
    indices: IndexArray,
    measured_degc: FloatArray,
    rejected: npt.NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Extend, or begin anew, the group of rejected samples that agree; others keep theirs."""
    old_lowest, old_highest = state.rejected_min_degc[indices], state.rejected_max_degc[indices]
    old_count = state.rejected_count[indices]
    lowest, highest = np.fmin(old_lowest, measured_degc), np.fmax(old_highest, measured_degc)
    agrees = (old_count > 0) & (highest - lowest <= rules.agree_within_degc)
    lowest, highest = np.where(agrees, lowest, measured_degc), np.where(agrees, highest, measured_degc)
    count = np.where(agrees, old_count + 1, 1)
    return (
        np.where(rejected, lowest, old_lowest),
        np.where(rejected, highest, old_highest),
        np.where(rejected, count, old_count),
    )


def _updated(
    state: CleansingState,
    indices: IndexArray,
    accepted: npt.NDArray[np.bool_],
    measured_degc: FloatArray,
    now_s: float,
    lowest: FloatArray,
    highest: FloatArray,
    count: IntArray,
) -> CleansingState:
    accepted_degc, accepted_at_s = state.accepted_degc.copy(), state.accepted_at_s.copy()
    rejected_min_degc, rejected_max_degc = state.rejected_min_degc.copy(), state.rejected_max_degc.copy()
    rejected_count = state.rejected_count.copy()
    taken = indices[accepted]
    accepted_degc[taken] = measured_degc[accepted]
    accepted_at_s[taken] = now_s
    rejected_min_degc[indices] = np.where(accepted, np.nan, lowest)
    rejected_max_degc[indices] = np.where(accepted, np.nan, highest)
    rejected_count[indices] = np.where(accepted, 0, count)
    return CleansingState(
        accepted_degc=accepted_degc,
        accepted_at_s=accepted_at_s,
        rejected_min_degc=rejected_min_degc,
        rejected_max_degc=rejected_max_degc,
        rejected_count=rejected_count,
    )
