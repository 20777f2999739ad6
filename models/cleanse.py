"""Which measured temperatures count: a change is bounded, and what is above the noise counts once readings agree.

One corrupt frame must not move anything, whenever it comes: a first value, and a change above the
noise, after a gap too, count only after further readings agree with them. A rejected level cannot
latch for ever either: it counts once enough readings agree.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from models.quality import ACCEPTED, GOOD, Quality, Reason
from models.records import CodeArray, FloatArray

IntArray = npt.NDArray[np.int64]
IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingRules:
    """What is accepted of a temperature; the fields are those of the configuration, or of each value of a cycle."""

    noise_degc: float | FloatArray = 0.3
    """A change within one cycle up to this counts at once [degC]; a larger one when the next sample agrees."""
    max_change_degc: float | FloatArray = 1.0
    """Largest change within one cycle [degC]."""
    max_rate_degc_per_min: float = 6.0
    """Growth of the allowed change with the time that a gap lasts [degC/min]."""
    max_gap_change_degc: float = 5.0
    """Largest allowed change after a gap, however long it was [degC]."""
    release_after_samples: int = 3
    """So many successive samples that agree are a first value, a value after a gap, or a new level."""
    far_level_after_samples: int = 9
    """So many it takes for a level farther from the last accepted value than a gap explains."""
    agree_within_degc: float | FloatArray = 0.5
    """Largest difference where one sample agrees with the next, or with the line that leads to it [degC]."""
    min_degc: float = -20.0
    max_degc: float = 100.0
    stale_after_s: float = 60.0
    """A held value that is older is missing [s]; a sensor that comes back after that begins anew."""


WARMS_K_PER_MIN, GOES_ON_K_PER_MIN = 2.0, 1.2
"""So fast a sensor may warm within one cycle that lasts long, and over several that agree [K/min]."""
HELD_PERIODS = 2.5
"""A sensor whose value is older than so many cycles of its line has missed two."""


def rules_of_period(rules: CleansingRules, cycle_period_s: float) -> CleansingRules:
    """Return the rules of an input that is read once in a period [s]: where that is long, a cycle sees more change."""
    period_min, most_degc = cycle_period_s / 60.0, rules.max_gap_change_degc
    return replace(
        rules,
        max_change_degc=np.maximum(rules.max_change_degc, min(WARMS_K_PER_MIN * period_min, most_degc)),
        agree_within_degc=np.maximum(rules.agree_within_degc, min(GOES_ON_K_PER_MIN * period_min, most_degc)),
        stale_after_s=max(rules.stale_after_s, HELD_PERIODS * cycle_period_s),
    )


def widened(rules: CleansingRules, by: FloatArray) -> CleansingRules:
    """Return the rules of a cycle's values whose sensors scatter, each by so much more than others."""
    if (by <= 1.0).all():
        return rules
    return replace(
        rules,
        noise_degc=rules.noise_degc * by,
        max_change_degc=rules.max_change_degc * by,
        agree_within_degc=rules.agree_within_degc * by,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingState:
    """State of the cleansing, one entry per sensor of the machine. Never changed in place."""

    accepted_degc: FloatArray
    """Last accepted value [degC], NaN where there was none."""
    accepted_at_s: FloatArray
    """Its time [s], -inf where there was none."""
    waiting_degc: FloatArray
    """Latest of the samples that agree and do not count yet [degC], NaN where there is none."""
    waiting_count: IntArray
    """How many of them."""

    def __post_init__(self) -> None:
        for array in (self.accepted_degc, self.accepted_at_s, self.waiting_degc, self.waiting_count):
            array.flags.writeable = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CleansingResult:
    """One cycle after cleansing; the arrays follow the cycle's own order."""

    state: CleansingState
    degc: FloatArray
    """Measured where quality is GOOD, the last accepted value where HELD, else NaN [degC]."""
    quality: CodeArray
    reason: CodeArray
    returned: npt.NDArray[np.bool_]
    """Which values are accepted for the first time, or after a gap in which the last accepted one grew too old."""
    new_level: npt.NDArray[np.bool_]
    """Which values are accepted though they are farther from the last accepted one than the elapsed time allows."""
    straight: npt.NDArray[np.bool_]
    """Which are accepted because they go on as those before them did: the sensor moves fast, it is no other level."""


def initial_state(
    sensor_count: int, accepted_degc: FloatArray | None = None, accepted_at_s: FloatArray | None = None
) -> CleansingState:
    """Return the state before the first cycle of a machine with `sensor_count` sensors.

    `sensor_count`: number of the machine's sensors. `accepted_degc`, `accepted_at_s`, shape (n_sensors,), optional:
    what a previous run accepted last [degC], NaN where nothing, and when [s]: the past that first values are held
    against.
    """
    degc = np.full(sensor_count, np.nan) if accepted_degc is None else np.array(accepted_degc, dtype=np.float64)
    at_s = np.full(sensor_count, -np.inf) if accepted_at_s is None else np.array(accepted_at_s, dtype=np.float64)
    return CleansingState(
        accepted_degc=degc,
        accepted_at_s=np.where(np.isfinite(degc), at_s, -np.inf),
        waiting_degc=np.full(sensor_count, np.nan),
        waiting_count=np.zeros(sensor_count, dtype=np.int64),
    )


def age_s(state: CleansingState, now_s: float) -> FloatArray:
    """Return the time since each sensor's last accepted value.

    Result: of shape (n_sensors,): age [s]; inf where no value was ever accepted.

    `state`: state after the last cycle. `now_s`: time on the clock of the cycles [s].
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

    The dissertation (section 3.3.1) keeps the previous value when a temperature changes by more than
    1 degC, which never lets go of it after a real step. Here the allowed change is
    ``min(max_change + max_rate * (elapsed - cycle_period), max_gap_change)`` since the last accepted
    value. How many samples, each within `agree_within_degc` of the one before, it takes until the
    latest counts depends on how far it is from that value:

    ================================================================  =======================
    change up to `noise_degc`, after a gap too                        1
    change up to the allowed one, no gap                              2
    change up to `max_change_degc` after more than `stale_after_s`    2
    first value, or allowed change after more than `stale_after_s`    `release_after_samples`
    larger, but at most `max_gap_change_degc`, no gap                 `release_after_samples`
    anything else                                                     `far_level_after_samples`
    ================================================================  =======================

    Meanwhile the last accepted value is held until it is too old, and then missing.

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
    if (usual := _all_near(rules, state, indices, measured_degc, quality, now_s)) is not None:
        return usual
    usable = (quality == Quality.GOOD) & np.isfinite(measured_degc)
    in_range = usable & (measured_degc >= rules.min_degc) & (measured_degc <= rules.max_degc)
    previous_degc, previous_at_s = state.accepted_degc[indices], state.accepted_at_s[indices]
    known = np.isfinite(previous_degc)
    returning = ~known | ((elapsed_s := now_s - previous_at_s) > rules.stale_after_s)
    change_degc = np.where(known, np.abs(measured_degc - previous_degc), 0.0)
    allowed_degc = _allowed(rules, np.where(known, np.maximum(elapsed_s - cycle_period_s, 0.0), 0.0))
    needed = _samples_needed(rules, np.where(known, change_degc, np.inf), allowed_degc, returning)
    waits = in_range & (needed > 1)
    waiting_degc, count, straight = _count_agreeing(rules, state, indices, measured_degc, waits, returning)
    accepted = in_range & ((needed == 1) | (count >= needed))
    held = ~accepted & known & (elapsed_s <= rules.stale_after_s)
    unconfirmed = returning | (change_degc <= allowed_degc)
    why = np.where(usable, np.where(in_range, _doubted(unconfirmed), np.uint8(Reason.OUT_OF_RANGE)), _unusable(reason))
    keeps_reason = held | ~known | in_range | (reason == Reason.OTHER_UNIT)
    why = np.where(accepted, np.uint8(Reason.NONE), np.where(keeps_reason, why, np.uint8(Reason.STALE)))
    verdict = np.where(accepted, np.uint8(Quality.GOOD), np.where(held, np.uint8(Quality.HELD), np.uint8(2)))
    return CleansingResult(
        state=_updated(state, indices, accepted, measured_degc, now_s, waiting_degc, count),
        degc=np.where(accepted, measured_degc, np.where(held, previous_degc, np.nan)),
        quality=verdict.astype(np.uint8),
        reason=why.astype(np.uint8),
        returned=accepted & returning,
        new_level=accepted & (change_degc > allowed_degc),
        straight=accepted & straight,
    )


def _all_near(
    rules: CleansingRules,
    state: CleansingState,
    indices: IndexArray,
    measured_degc: FloatArray,
    quality: CodeArray,
    now_s: float,
) -> CleansingResult | None:
    """Return the result where every value counts at once, which is nearly always; None where one has to be judged."""
    change_degc = np.abs(measured_degc - state.accepted_degc[indices])
    near = change_degc <= np.minimum(rules.noise_degc, rules.max_change_degc)  # a NaN is not
    near &= measured_degc >= rules.min_degc
    near &= measured_degc <= rules.max_degc
    near &= quality == GOOD
    near &= now_s - state.accepted_at_s[indices] <= rules.stale_after_s
    if not near.all():
        return None
    count = len(indices)
    return CleansingResult(
        state=_updated(state, indices, near, measured_degc, now_s, np.full(count, np.nan), np.zeros(count, np.int64)),
        degc=measured_degc.copy(),
        quality=np.full(count, GOOD, dtype=np.uint8),
        reason=np.full(count, ACCEPTED, dtype=np.uint8),
        returned=np.zeros(count, dtype=np.bool_),
        new_level=np.zeros(count, dtype=np.bool_),
        straight=np.zeros(count, dtype=np.bool_),
    )


def _allowed(rules: CleansingRules, gap_s: FloatArray) -> FloatArray:
    """Return the change that is allowed after gaps [s]: it grows with them up to a bound [degC]."""
    grown_degc = rules.max_change_degc + rules.max_rate_degc_per_min / 60.0 * gap_s
    return np.minimum(grown_degc, np.maximum(rules.max_gap_change_degc, rules.max_change_degc))


def _unusable(reason: CodeArray) -> CodeArray:
    """Return the driver's reasons for values that it does not call GOOD."""
    return np.where(reason == Reason.NONE, np.uint8(Reason.NOT_RECEIVED), reason)


def _doubted(unconfirmed: npt.NDArray[np.bool_]) -> CodeArray:
    """Return why possible values do not count yet."""
    return np.where(unconfirmed, np.uint8(Reason.UNCONFIRMED), np.uint8(Reason.RATE))


def _samples_needed(
    rules: CleansingRules, change_degc: FloatArray, allowed_degc: FloatArray, returning: npt.NDArray[np.bool_]
) -> IntArray:
    """Return how many samples that agree each value takes to count."""
    first = np.isinf(change_degc)
    near = change_degc <= np.where(returning, rules.max_change_degc, allowed_degc)
    several = first | (change_degc <= np.where(returning, allowed_degc, rules.max_gap_change_degc))
    needed = np.where(near, 2, np.where(several, rules.release_after_samples, rules.far_level_after_samples))
    return np.where(change_degc <= rules.noise_degc, 1, needed).astype(np.int64)


def _goes_on(
    rules: CleansingRules, state: CleansingState, indices: IndexArray, measured_degc: FloatArray
) -> npt.NDArray[np.bool_]:
    """Return which samples lie on the line from the last accepted value through those that wait: it warms fast."""
    before_degc, count = state.waiting_degc[indices], state.waiting_count[indices]
    step_degc = (before_degc - state.accepted_degc[indices]) / np.maximum(count, 1)
    near = np.abs(measured_degc - before_degc - step_degc) <= rules.agree_within_degc
    return np.asarray((count > 0) & near & (np.abs(step_degc) <= rules.max_change_degc))


def _count_agreeing(
    rules: CleansingRules,
    state: CleansingState,
    indices: IndexArray,
    measured_degc: FloatArray,
    waits: npt.NDArray[np.bool_],
    returning: npt.NDArray[np.bool_],
) -> tuple[FloatArray, IntArray, npt.NDArray[np.bool_]]:
    """Extend, or begin anew, the run of samples that agree and do not count yet; other sensors keep theirs.

    Result: also which samples go on in a line, see `_goes_on`.
    """
    straight = waits & ~returning & _goes_on(rules, state, indices, measured_degc)
    before_degc, before_count = state.waiting_degc[indices], state.waiting_count[indices]
    agrees = (before_count > 0) & (np.abs(measured_degc - before_degc) <= rules.agree_within_degc) | straight
    return (
        np.where(waits, measured_degc, before_degc),
        np.where(waits, np.where(agrees, before_count + 1, 1), before_count),
        straight,
    )


def _updated(
    state: CleansingState,
    indices: IndexArray,
    accepted: npt.NDArray[np.bool_],
    measured_degc: FloatArray,
    now_s: float,
    waiting_degc: FloatArray,
    count: IntArray,
) -> CleansingState:
    accepted_degc, accepted_at_s = state.accepted_degc.copy(), state.accepted_at_s.copy()
    waiting, waiting_count = state.waiting_degc.copy(), state.waiting_count.copy()
    taken = indices[accepted]
    accepted_degc[taken] = measured_degc[accepted]
    accepted_at_s[taken] = now_s
    waiting[indices] = np.where(accepted, np.nan, waiting_degc)
    waiting_count[indices] = np.where(accepted, 0, count)
    return CleansingState(
        accepted_degc=accepted_degc, accepted_at_s=accepted_at_s, waiting_degc=waiting, waiting_count=waiting_count
    )
