"""Cleansing: the dissertation's rule, its bounds, and that it never latches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.cleanse import CleansingResult, CleansingRules, CleansingState, age_s, cleanse_cycle, initial_state
from models.quality import Quality, Reason
from models.recordings.jumps import remove_jumps_at_switching, remove_sudden_jumps
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
    return initial_state(1, np.array([degc]), np.array([now_s]))


def fed(state: CleansingState, *degc: float, begin_s: float = PERIOD_S) -> list[CleansingResult]:
    """Feed one sample a cycle; return what became of each."""
    results: list[CleansingResult] = []
    for cycle, each in enumerate(degc):
        results.append(feed(results[-1].state if results else state, each, begin_s + cycle * PERIOD_S))
    return results


def counted(results: list[CleansingResult]) -> list[bool]:
    return [verdict(result)[0] is Quality.GOOD for result in results]


def test_a_change_within_the_noise_counts_at_once_and_a_larger_one_when_the_next_agrees() -> None:
    assert counted(fed(settled(), 20.25)) == [True]
    first, second = fed(settled(), 21.0, 21.0)
    assert (first.degc[0], verdict(first)) == (20.0, (Quality.HELD, Reason.UNCONFIRMED))
    assert (second.degc[0], verdict(second)) == (21.0, (Quality.GOOD, Reason.NONE))
    assert not second.returned[0] and not second.new_level[0]


def test_a_larger_change_than_allowed_holds_the_previous_value() -> None:
    held = feed(settled(), 21.0625, PERIOD_S)
    assert (held.degc[0], verdict(held)) == (20.0, (Quality.HELD, Reason.RATE))


def test_after_a_gap_the_allowed_change_grows_with_its_length_and_is_capped() -> None:
    gap_s = 50.0  # 10 s of one cycle, 40 s of gap: 1 + 6 * 40 / 60 = 5 K
    assert verdict(feed(settled(), 25.0, gap_s)) == (Quality.HELD, Reason.UNCONFIRMED)
    assert verdict(feed(settled(), 25.0625, gap_s)) == (Quality.HELD, Reason.RATE)
    assert counted(fed(settled(), 25.0, 25.0, begin_s=gap_s)) == [False, True]
    after_an_hour = fed(settled(), *9 * [25.5], begin_s=3600.0)
    assert counted(after_an_hour) == 8 * [False] + [True], "5.5 K is more than any gap explains"
    assert {verdict(result)[0] for result in after_an_hour[:8]} == {Quality.MISSING}


def test_a_new_level_counts_at_the_third_sample_that_agrees() -> None:
    results = fed(settled(), 24.0, 24.25, 24.5, 24.5625)
    assert counted(results) == [False, False, True, True]
    assert [result.degc[0] for result in results] == [20.0, 20.0, 24.5, 24.5625]
    assert [bool(result.new_level[0]) for result in results] == [False, False, True, False]


def test_samples_that_do_not_agree_with_the_one_before_release_nothing() -> None:
    results = fed(settled(), 24.0, 24.3, 24.9)
    assert counted(results) == 3 * [False]
    assert results[-1].state.waiting_count[0] == 1


def test_an_accepted_sample_forgets_those_that_waited() -> None:
    assert counted(fed(settled(), 24.0, 24.0, 20.0, 24.0, 24.0)) == [False, False, True, False, False]


@pytest.mark.parametrize("gap_s", [70.0, 150.0, 3600.0, 1e6])
@pytest.mark.parametrize("wrong_degc", [19.0, 20.5, 23.0, 28.0, 33.75])
def test_one_corrupt_frame_after_a_silence_never_counts(gap_s: float, wrong_degc: float) -> None:
    results = fed(settled(), wrong_degc, 20.0, 20.0, 20.0, begin_s=gap_s)
    assert counted(results)[-1], "the sensor itself comes back"
    assert {float(result.degc[0]) for result in results if verdict(result)[0] is Quality.GOOD} == {20.0}


def test_a_first_value_counts_when_three_agree() -> None:
    results = fed(initial_state(1), 33.75, 20.0, 20.0, 20.0)
    assert counted(results) == [False, False, False, True]
    assert results[-1].returned[0] and not results[-1].new_level[0]
    assert verdict(results[0]) == (Quality.MISSING, Reason.UNCONFIRMED)


def test_what_a_previous_run_accepted_is_the_past_of_the_first_values() -> None:
    equal_wrong = 3 * [28.0]
    assert counted(fed(settled(now_s=-20.0), *equal_wrong, 20.0)) == 3 * [False] + [True]


@pytest.mark.parametrize("step_k", [0.4, 0.9, -1.0])
def test_a_sensor_that_warms_quickly_is_followed_one_sample_later(step_k: float) -> None:
    ramp = [50.0 + step_k * cycle for cycle in range(1, 40)]
    results = fed(settled(50.0), *ramp)
    off = [abs(result.degc[0] - degc) for result, degc in zip(results, ramp, strict=True)]
    assert max(off) <= 2.0 * abs(step_k) + 1e-9
    assert counted(results)[1::2] == len(ramp[1::2]) * [True] and not any(r.new_level[0] for r in results)
    assert all(r.straight[0] for r in results[1::2]), "it moves, it is no other level"


def test_what_is_no_straight_line_from_the_past_is_another_level() -> None:
    for degc in ((21.3, 22.6), (20.9, 20.9), (20.9, 22.4), (22.0, 22.9)):
        assert not any(result.straight[0] for result in fed(settled(), *degc)), degc
    assert not any(result.straight[0] for result in fed(settled(), 20.9, 21.8, 22.7, begin_s=3600.0)), "after a gap"


def test_a_far_level_that_drifts_is_found_too() -> None:
    assert any(counted(fed(settled(), *(40.0 + 0.3 * cycle for cycle in range(10)), begin_s=1e5)))


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


def test_a_value_that_the_driver_flagged_is_not_looked_at() -> None:
    result = feed(settled(), 20.5, PERIOD_S, reason=Reason.RESET)
    assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.RESET))


def test_a_value_that_is_no_number_never_counts_as_accepted() -> None:
    result = feed(settled(), np.nan, PERIOD_S)
    assert (result.degc[0], verdict(result)) == (20.0, (Quality.HELD, Reason.NOT_RECEIVED))


def test_only_the_line_that_was_given_changes_and_the_old_state_stays() -> None:
    first = state = initial_state(5)
    codes = np.zeros(2, dtype=np.uint8)
    for now_s in (-15.0, -5.0, 5.0):
        result = cleanse_cycle(RULES, state, np.array([3, 1]), np.array([30.0, 10.0]), codes, codes, now_s, PERIOD_S)
        state = result.state
    np.testing.assert_array_equal(result.state.accepted_degc, [np.nan, 10.0, np.nan, 30.0, np.nan])
    np.testing.assert_array_equal(age_s(result.state, 7.0), [np.inf, 2.0, np.inf, 2.0, np.inf])
    assert np.isnan(first.accepted_degc).all()
    with pytest.raises(ValueError, match="read-only"):
        result.state.accepted_degc[0] = 1.0


@given(
    disturbance=st.lists(st.tuples(FLOATS, st.sampled_from([Reason.NONE, Reason.NOT_RECEIVED])), max_size=12),
    level=FLOATS,
    first=FLOATS,
)
def test_a_steady_level_always_counts_once_enough_samples_have_agreed(
    disturbance: list[tuple[float, Reason]], level: float, first: float
) -> None:
    state, cycle = settled(first), 0
    for degc, reason in disturbance:
        cycle += 1
        state = feed(state, degc, cycle * PERIOD_S, reason=reason).state
    results = fed(state, *RULES.far_level_after_samples * [level], begin_s=(cycle + 1) * PERIOD_S)
    assert (results[-1].degc[0], verdict(results[-1])) == (level, (Quality.GOOD, Reason.NONE))


@given(
    samples=st.lists(st.one_of(st.none(), st.sampled_from([20.0, 20.2, 20.7, 24.0, 28.0, 33.75]), FLOATS), max_size=60),
    period_s=st.floats(1.0, 300.0),
)
def test_no_single_sample_above_the_noise_ever_counts(samples: list[float | None], period_s: float) -> None:
    """Whatever came before: what counts and is not near what counted agrees with the sample before it, or goes on
    with it in a line from what counted."""
    state, before, accepted, accepted_at_s = settled(), None, 20.0, 0.0
    for number, degc in enumerate(samples, start=1):
        now_s = number * period_s
        reason = Reason.NOT_RECEIVED if degc is None else Reason.NONE
        result = feed(state, np.nan if degc is None else degc, now_s, reason=reason)
        state, quality = result.state, verdict(result)[0]
        if quality is Quality.GOOD:
            assert degc is not None
            near = abs(degc - accepted) <= RULES.noise_degc
            steps = [0.0] if before is None else [0.0, *((before - accepted) / n for n in range(1, number))]
            agrees = [
                abs(degc - before - step) <= RULES.agree_within_degc + 1e-9
                for step in steps
                if before is not None and abs(step) <= RULES.max_change_degc
            ]
            assert near or any(agrees)
            accepted, accepted_at_s = degc, now_s
        elif quality is Quality.HELD:
            assert result.degc[0] == accepted
            assert now_s - accepted_at_s <= RULES.stale_after_s
        else:
            assert np.isnan(result.degc[0])
            assert now_s - accepted_at_s > RULES.stale_after_s
        before = degc if degc is not None else before


def test_jumps_at_switching_are_taken_off_what_follows() -> None:
    speed = np.array([0.0, 0.0, 5000.0, 5000.0, 0.0, 0.0])
    raw = np.array([0.0, 1.0, 6.0, 7.0, 3.0, 3.5])
    np.testing.assert_allclose(remove_jumps_at_switching(raw, speed), [0.0, 1.0, 1.0, 2.0, 2.0, 2.5])
    np.testing.assert_array_equal(raw, [0.0, 1.0, 6.0, 7.0, 3.0, 3.5])


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


@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([0.01, 0.2, 0.4]),
    odd=st.sampled_from(["", "nan", "quality", "age", "range", "waiting", "never"]),
)
def test_a_cycle_in_which_all_is_near_is_judged_as_any_other(seed, spread, odd):
    rng = np.random.default_rng(seed)
    rules, count, now_s = RULES, 6, 100.0
    accepted, at_s = 20.0 + rng.normal(0.0, 1.0, count), rng.uniform(45.0, 95.0, count)
    state = initial_state(count, accepted, at_s)
    indices = np.array([4, 1, 2], dtype=np.intp)
    measured = accepted[indices] + rng.uniform(-spread, spread, 3)
    quality, reason = np.zeros(3, dtype=np.uint8), np.zeros(3, dtype=np.uint8)
    if odd == "nan":
        measured[1] = np.nan
    elif odd == "quality":
        quality[1], reason[1] = Quality.MISSING, Reason.NOT_RECEIVED
    elif odd == "range":
        measured[1] = 100.0 + measured[1]
    elif odd != "":
        arrays = {name: np.array(getattr(state, name)) for name in CleansingState.__slots__}
        if odd == "age":
            arrays["accepted_at_s"][1] = now_s - 60.5
        elif odd == "never":
            arrays["accepted_degc"][1], arrays["accepted_at_s"][1] = np.nan, -np.inf
        else:
            arrays["waiting_degc"][[1, 2]], arrays["waiting_count"][[1, 2]] = 25.0, 2
        state = CleansingState(**arrays)
    found = cleanse_cycle(rules, state, indices, measured, quality, reason, now_s, 10.0)
    beside = (
        np.append(indices, 5),
        np.append(measured, np.nan),
        np.append(quality, np.uint8(0)),
        np.append(reason, np.uint8(0)),
    )
    judged = cleanse_cycle(rules, state, *beside, now_s, 10.0)  # a sensor that has to be judged is in the cycle too
    for name in ("degc", "quality", "reason", "returned", "new_level"):
        np.testing.assert_array_equal(getattr(found, name), getattr(judged, name)[:3])
        assert getattr(found, name).dtype == getattr(judged, name).dtype
    for name in CleansingState.__slots__:
        np.testing.assert_array_equal(getattr(found.state, name), getattr(judged.state, name))
    if odd in ("", "waiting") and spread < 0.3:
        assert found.degc.tolist() == measured.tolist()
