"""Cleansing: the source's rule, its bounds, and that it never latches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from config.schema.temperatures import CleansingConfig
from models.cleanse import CleansingResult, CleansingRules, CleansingState, age_s, cleanse_cycle, initial_state
from models.quality import Quality, Reason
from models.recordings.jumps import remove_jumps_at_switching, remove_sudden_jumps, scatter_um
from models.records import FloatArray

RULES = CleansingRules()
PERIOD_S = 10.0
ONE = np.array([0])
FLOATS = st.floats(-19.0, 99.0)


def feed(
    state: CleansingState, degc: float, now_s: float, rules: CleansingRules = RULES, reason: Reason = Reason.NONE
) -> CleansingResult:
    quality = Quality.GOOD if reason is Reason.NONE else Quality.MISSING
    codes = np.array([quality], dtype=np.uint8), np.array([reason], dtype=np.uint8)
    return cleanse_cycle(rules, state, ONE, np.array([degc]), *codes, now_s, PERIOD_S)


def verdict(result: CleansingResult) -> tuple[Quality, Reason]:
    return Quality(int(result.quality[0])), Reason(int(result.reason[0]))


def settled(degc: float = 20.0, now_s: float = 0.0) -> CleansingState:
    return feed(initial_state(1), degc, now_s).state


def test_the_rules_mirror_the_configuration() -> None:
    assert CleansingRules(**CleansingConfig().model_dump()) == RULES


def test_a_change_of_one_kelvin_is_accepted_and_a_larger_one_holds_the_previous_value() -> None:
    accepted = feed(settled(), 21.0, PERIOD_S)
    assert (accepted.degc[0], verdict(accepted)) == (21.0, (Quality.GOOD, Reason.NONE))
    held = feed(settled(), 21.0625, PERIOD_S)
    assert (held.degc[0], verdict(held)) == (20.0, (Quality.HELD, Reason.RATE))


def test_after_a_gap_the_allowed_change_grows_with_its_length() -> None:
    gap_s = 50.0  # 10 s of one cycle, 40 s of gap: 1 + 6 * 40 / 60 = 5 K
    assert verdict(feed(settled(), 25.0, gap_s)) == (Quality.GOOD, Reason.NONE)
    assert verdict(feed(settled(), 25.0625, gap_s)) == (Quality.HELD, Reason.RATE)


def test_a_new_level_is_believed_at_the_third_sample_that_agrees() -> None:
    state, outcomes = settled(), []
    for cycle, degc in enumerate((60.0, 60.25, 60.5, 60.5625), start=1):
        result = feed(state, degc, cycle * PERIOD_S)
        state = result.state
        outcomes.append((float(result.degc[0]), verdict(result)[0]))
    assert outcomes == [(20.0, Quality.HELD), (20.0, Quality.HELD), (60.5, Quality.GOOD), (60.5625, Quality.GOOD)]


def test_samples_that_do_not_agree_release_nothing() -> None:
    state = settled()
    for cycle, degc in enumerate((60.0, 60.3, 60.6), start=1):  # 60.6 is 0.6 K from the first
        result = feed(state, degc, cycle * PERIOD_S)
        state = result.state
    assert verdict(result) == (Quality.HELD, Reason.RATE)
    assert state.rejected_count[0] == 1


def test_an_accepted_sample_forgets_the_rejected_ones() -> None:
    state = settled()
    for cycle, degc in enumerate((60.0, 60.0, 20.0, 60.0, 60.0), start=1):
        result = feed(state, degc, cycle * PERIOD_S)
        state = result.state
    assert verdict(result) == (Quality.HELD, Reason.RATE)


@pytest.mark.parametrize("degc", [-20.0625, 100.0625, 327.67])
def test_impossible_values_are_never_believed_however_often_they_come(degc: float) -> None:
    state = settled()
    for cycle in range(1, 6):
        result = feed(state, degc, cycle * PERIOD_S)
        state = result.state
        assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.OUT_OF_RANGE))


def test_a_missing_value_is_held_with_its_own_reason_until_it_is_stale() -> None:
    state = settled()
    for now_s in (10.0, 60.0):
        result = feed(state, np.nan, now_s, reason=Reason.DUPLICATE_ID)
        state = result.state
        assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.DUPLICATE_ID))
    result = feed(state, np.nan, 60.1, reason=Reason.DUPLICATE_ID)
    assert np.isnan(result.degc[0])
    assert verdict(result) == (Quality.MISSING, Reason.STALE)


def test_a_sensor_that_never_spoke_is_missing_for_the_reason_it_came_with() -> None:
    result = feed(initial_state(1), np.nan, 1e6, reason=Reason.QUARANTINED)
    assert verdict(result) == (Quality.MISSING, Reason.QUARANTINED)
    assert age_s(result.state, 1e6)[0] == np.inf


def test_a_value_that_the_driver_flagged_is_not_looked_at() -> None:
    result = feed(settled(), 20.5, PERIOD_S, reason=Reason.RESET)
    assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.RESET))


def test_a_value_that_is_no_number_never_counts_as_accepted() -> None:
    result = feed(settled(), np.nan, PERIOD_S)
    assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.NOT_RECEIVED))


def test_only_the_line_that_was_given_changes_and_the_old_state_stays() -> None:
    state = initial_state(5)
    codes = np.zeros(2, dtype=np.uint8)
    result = cleanse_cycle(RULES, state, np.array([3, 1]), np.array([30.0, 10.0]), codes, codes, 5.0, PERIOD_S)
    np.testing.assert_array_equal(result.state.accepted_degc, [np.nan, 10.0, np.nan, 30.0, np.nan])
    np.testing.assert_array_equal(age_s(result.state, 7.0), [np.inf, 2.0, np.inf, 2.0, np.inf])
    assert np.isnan(state.accepted_degc).all()
    with pytest.raises(ValueError, match="read-only"):
        result.state.accepted_degc[0] = 1.0


@given(
    disturbance=st.lists(st.tuples(FLOATS, st.sampled_from([Reason.NONE, Reason.NOT_RECEIVED])), max_size=12),
    level=FLOATS,
    first=FLOATS,
)
def test_a_steady_level_is_always_believed_within_the_release(
    disturbance: list[tuple[float, Reason]], level: float, first: float
) -> None:
    state, cycle = settled(first), 0
    for degc, reason in disturbance:
        cycle += 1
        state = feed(state, degc, cycle * PERIOD_S, reason=reason).state
    for _ in range(RULES.release_after_samples):
        cycle += 1
        result = feed(state, level, cycle * PERIOD_S)
        state = result.state
    assert (result.degc[0], verdict(result)) == (level, (Quality.GOOD, Reason.NONE))


@given(samples=st.lists(st.floats(-60.0, 400.0), min_size=1, max_size=40), step_s=st.floats(1.0, 300.0))
def test_what_is_accepted_is_measured_possible_and_within_the_bound_or_agreed(
    samples: list[float], step_s: float
) -> None:
    state, accepted, at_s = settled(), 20.0, 0.0
    for number, degc in enumerate(samples, start=1):
        now_s = number * step_s
        result = feed(state, degc, now_s)
        quality, reason = verdict(result)
        assert (quality == Quality.GOOD) == (reason == Reason.NONE)
        if quality == Quality.GOOD:
            assert result.degc[0] == degc
            assert RULES.min_degc <= degc <= RULES.max_degc
            allowed = RULES.max_change_degc + RULES.max_rate_degc_per_min / 60.0 * max(0.0, now_s - at_s - PERIOD_S)
            agreed = state.rejected_count[0] + 1 >= RULES.release_after_samples
            assert abs(degc - accepted) <= allowed or agreed
            accepted, at_s = degc, now_s
        elif quality == Quality.HELD:
            assert result.degc[0] == accepted
            assert now_s - at_s <= RULES.stale_after_s
        else:
            assert np.isnan(result.degc[0])
            assert now_s - at_s > RULES.stale_after_s
        state = result.state


def test_jumps_at_switching_are_taken_off_what_follows() -> None:
    speed = np.array([0.0, 0.0, 5000.0, 5000.0, 0.0, 0.0])
    raw = np.array([0.0, 1.0, 6.0, 7.0, 3.0, 3.5])
    np.testing.assert_allclose(remove_jumps_at_switching(raw, speed), [0.0, 1.0, 1.0, 2.0, 2.0, 2.5])
    np.testing.assert_array_equal(raw, [0.0, 1.0, 6.0, 7.0, 3.0, 3.5])


def test_small_variations_and_jumps_without_switching_stay() -> None:
    speed = np.array([0.0, 5000.0, 9000.0, 9000.0])
    raw = np.array([[0.0, 0.0], [3.0, -3.1], [9.0, -9.0], [9.0, -19.0]])
    np.testing.assert_allclose(remove_jumps_at_switching(raw, speed), [[0, 0], [3, 0], [9, -5.9], [9, -15.9]])


def test_a_jump_across_missing_samples_is_found() -> None:
    speed = np.array([0.0, np.nan, 5000.0, 5000.0])
    raw = np.array([1.0, np.nan, np.nan, 11.0])
    np.testing.assert_allclose(remove_jumps_at_switching(raw, speed), [1.0, np.nan, np.nan, 1.0])


def test_speeds_and_displacements_must_go_together() -> None:
    with pytest.raises(ValueError, match="4 displacement rows"):
        remove_jumps_at_switching(np.zeros(4), np.zeros(3))
    with pytest.raises(ValueError, match="threshold_um"):
        remove_jumps_at_switching(np.zeros(4), np.zeros(4), -1.0)


def switched(period_s: float, *, jump_um: float, noise_um: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two warm-ups of 40 um over 12 min, with a jump while the spindle turns; times [s], displacements, speed."""
    time_s = np.arange(0.0, 4 * 3600.0, period_s)
    on = (time_s // 3600.0) % 2 == 1
    since_s = time_s % 3600.0
    warm_um = 40.0 * np.where(on, 1.0 - np.exp(-since_s / 720.0), np.exp(-since_s / 720.0) * (time_s > 3600.0))
    noise = np.random.default_rng(4).normal(0.0, noise_um, len(time_s))
    return time_s, (warm_um + jump_um * on + noise)[:, None], np.where(on, 3000.0, 0.0)


@pytest.mark.parametrize("period_s", [10.0, 60.0, 300.0])
@pytest.mark.parametrize("noise_um", [0.0, 1.0])
def test_quick_warming_slow_sampling_and_noise_are_no_jump(period_s: float, noise_um: float) -> None:
    time_s, um, speed_rpm = switched(period_s, jump_um=0.0, noise_um=noise_um)
    np.testing.assert_array_equal(remove_sudden_jumps(time_s, um, speed_rpm, 3.0), um)


@pytest.mark.parametrize("period_s", [10.0, 60.0])
def test_a_sudden_jump_is_taken_out_and_the_warming_stays(period_s: float) -> None:
    time_s, smooth, speed_rpm = switched(period_s, jump_um=0.0)
    _, jumping, _ = switched(period_s, jump_um=12.0)
    left = remove_sudden_jumps(time_s, jumping, speed_rpm, 3.0) - smooth
    assert np.abs(left).max() < 3.5  # the warming of one minute, which nobody can tell from a part of the jump
    with_gap = np.where(((time_s > 3500.0) & (time_s < 5000.0))[:, None], np.nan, smooth)
    np.testing.assert_array_equal(remove_sudden_jumps(time_s, with_gap, speed_rpm, 3.0), with_gap)


def test_scatter_is_what_does_not_move_smoothly() -> None:
    rng = np.random.default_rng(3)
    smooth = 40.0 * np.sin(np.arange(2000.0) / 60.0)[:, None]
    assert scatter_um([smooth])[0] < 0.001
    assert scatter_um([smooth + rng.normal(0.0, 0.5, smooth.shape), smooth[:2]])[0] == pytest.approx(0.5, rel=0.1)
    assert scatter_um([smooth[:3]])[0] == 0.0
