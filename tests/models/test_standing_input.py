"""An input that answers from memory is told by how often its numbers changed; a quiet one is not taken for one."""

import numpy as np
import pytest

from models.standing_input import LEAST_S, StandingInput, renewed_input

PERIOD_S = 10.0
NOTHING = StandingInput(degc=np.full(4, np.nan))


def fed(rows, state=NOTHING):
    """Return how long it has stood after each row."""
    found = []
    for row in rows:
        now_s = PERIOD_S * (len(found) + 1)
        state = renewed_input(state, np.asarray(row, dtype=float), now_s)
        found.append(state.stands_s(now_s))
    return np.array(found)


def noisy(count, step_k, noise_k, seed):
    rng = np.random.default_rng(seed)
    return np.round((20.0 + np.array([0.01, 0.33, 0.52, 0.77]) + rng.normal(0, noise_k, (count, 4))) / step_k) * step_k


def test_numbers_that_stand_though_they_always_changed_are_found_after_five_minutes():
    rows = noisy(360, 0.0625, 0.02, 3)
    stood = fed(np.concatenate([rows, np.tile(rows[-1], (60, 1)), rows]))
    assert not stood[: 360 + 29].any() and stood[360 + 31 : 420].all() and not stood[421:].any()
    assert stood[360 + 31] >= LEAST_S


@pytest.mark.parametrize("between_min", [4, 6, 30])
def test_numbers_that_change_once_and_stand_again_are_found_again(between_min):
    """The box is started anew, or says another unit for a while, and its sensors are as silent as before."""
    rows = noisy(360, 0.0625, 0.02, 3)
    again = 60 + 6 * between_min
    stood = fed(
        np.concatenate(
            [rows, np.tile(rows[-1], (60, 1)), np.tile(rows[-2], (again - 60, 1)), np.tile(rows[-1], (60, 1)), rows]
        )
    )
    assert stood[360 + again + 31 : 420 + again].all() and not stood[421 + again :].any()


@pytest.mark.parametrize("seed", range(5))
def test_a_machine_that_cools_into_a_quiet_night_answers_from_no_memory(seed):
    """A day's run of 8 K, then 14 h of rest, in steps of a tenth without any noise: the hardest to tell."""
    rng = np.random.default_rng(seed)
    hours = np.arange(0.0, 24.0, PERIOD_S / 3600.0)
    run_k = np.where(hours < 8.0, 1.0 - np.exp(-hours), np.exp(-(hours - 8.0) / rng.uniform(1.0, 3.0)))
    degc = (
        20.0 + np.outer(8.0 * run_k, rng.uniform(0.3, 1.0, 4)) + np.outer(np.sin(hours / 3.8), rng.uniform(0.2, 1.0, 4))
    )
    assert not fed(np.round(degc / 0.1) * 0.1).any()


def warmed(count, step_k, seed):
    """Eight hours of a machine that runs for four, as sensors with a little noise say it in steps."""
    rng = np.random.default_rng(seed)
    constants_min, rises_k = 40.0 * rng.uniform(0.6, 1.6, count), 10.0 * rng.uniform(0.3, 1.2, count)
    minutes = np.arange(0.0, 480.0, PERIOD_S / 60.0)[:, None]
    warm = (1.0 - np.exp(-np.minimum(minutes, 240.0) / constants_min)) * np.exp(
        -np.maximum(minutes - 240.0, 0.0) / constants_min
    )
    return np.round((20.0 + rises_k * warm + rng.normal(0.0, 0.02, warm.shape)) / step_k) * step_k


def test_a_few_rounded_numbers_that_flicker_between_two_steps_and_then_stand_hardly_ever_answer_from_memory():
    """Where a temperature lies between two steps they change all the time, and beside that they stand for minutes."""
    inputs = [(count, step_k, seed) for count, step_k in ((1, 0.5), (2, 0.1), (2, 0.5), (3, 0.5)) for seed in range(6)]
    told = [one for one in inputs if fed(warmed(*one), StandingInput(degc=np.full(one[0], np.nan))).any()]
    assert len(told) <= 4, told


@pytest.mark.parametrize(("count", "step_k"), [(2, 0.01), (10, 0.1)])
def test_numbers_that_flickered_all_the_time_are_found_still_after_five_minutes(count, step_k):
    rows = warmed(count, step_k, 3)[:1080]
    stood = fed([*rows, *np.tile(rows[-1], (40, 1))], StandingInput(degc=np.full(count, np.nan)))
    assert not stood[:1080].any() and stood[1080 + 31 :].all()


def test_one_that_has_just_begun_or_has_no_value_is_not_judged():
    assert not fed(np.tile([20.0, 21.0, 22.0, 23.0], (400, 1))).any(), "it has never changed"
    rows = noisy(100, 0.0625, 0.02, 3)
    assert not fed([*rows, *np.tile(rows[-1], (80, 1))]).any()
    assert not fed([*noisy(360, 0.0625, 0.02, 3), *np.full((100, 4), np.nan)]).any(), "silent is another fault"
