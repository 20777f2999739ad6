"""What a sensor's level says of the past."""

from dataclasses import replace

import numpy as np
import pytest

from models.records import FloatArray
from models.sensor_levels import (
    BelievedValues,
    SensorLevels,
    doubted,
    first_levels,
    renewed_levels,
    trusted,
    trusted_anew,
    undone,
    unshifted,
    with_gap,
    with_past,
)


@pytest.mark.parametrize(
    ("time_s", "mean_s", "known"),
    [(100.0, 60.0, True), (101.0, 60.0, False), (200.0, 60.0, False), (230.0, 60.0, False), (261.0, 60.0, True)]
    + [(200.0, 0.0, False), (201.0, 0.0, True)],
)
def test_of_a_mean_that_holds_some_of_a_gap_nothing_is_known(time_s: float, mean_s: float, known: bool) -> None:
    levels = with_gap(first_levels(2), 100.0, 200.0, np.array([1]))
    degc = unshifted(levels, time_s, np.array([20.0, 21.0]), mean_s=mean_s)
    np.testing.assert_array_equal(degc, [20.0, 21.0 if known else np.nan])


def seen(now_s: float, degc: FloatArray, jump_k: FloatArray | None = None, returned: int = 0) -> BelievedValues:
    """Believed values of all sensors, of which so many, the first, have returned."""
    nothing = np.zeros(len(degc), dtype=np.bool_)
    return BelievedValues(
        now_s=now_s,
        indices=np.arange(len(degc)),
        degc=degc,
        returned=np.arange(len(degc)) < returned,
        new_level=nothing,
        jump_k=np.zeros(len(degc)) if jump_k is None else jump_k,
        stale=nothing,
        at_s=np.full(len(degc), now_s),
    )


def back_at_a_doubted_level(back: int = 1, count: int = 3) -> SensorLevels:
    """Levels after the first of some sensors have come back 3 K off."""
    here = np.arange(count) < back
    levels = with_past(first_levels(count), np.where(here, 20.0, np.nan), np.where(here, 0.0, -np.inf))
    levels = renewed_levels(levels, np.arange(count), seen(100.0, np.where(here, 23.0, 20.0), returned=back))
    assert levels.away_s == dict.fromkeys(range(back), 0.0) and doubted(levels).tolist() == here.tolist()
    return levels


def test_of_a_whole_line_that_came_back_wrong_and_is_right_again_nothing_is_known_meanwhile() -> None:
    levels, line = back_at_a_doubted_level(130, 200), np.arange(200) < 130
    levels = renewed_levels(levels, np.arange(200), seen(500.0, np.full(200, 20.0), np.where(line, -3.0, 0.0)))
    assert not doubted(levels).any() and sorted(undone(first_levels(200), levels)) == [*range(130)]
    np.testing.assert_array_equal(unshifted(levels, 300.0, np.full(200, 23.0)), np.where(line, np.nan, 23.0))


def test_a_machine_whose_sensors_all_jump_and_jump_back_is_told_of_the_past_as_it_was() -> None:
    levels, count = first_levels(302), 302
    for now_s, degc, jump_k in ((0.0, 20.0, 0.0), (100.0, 22.0, 2.0), (200.0, 20.0, -2.0)):
        levels = renewed_levels(levels, np.arange(count), seen(now_s, np.full(count, degc), np.full(count, jump_k)))
    np.testing.assert_allclose(unshifted(levels, 50.0, np.full(count, 20.0)), 20.0)
    np.testing.assert_allclose(unshifted(levels, 150.0, np.full(count, 22.0)), 20.0)


def test_a_sensor_that_jumps_and_is_where_it_was_when_a_person_trusted_it_makes_nothing_unknown() -> None:
    levels = trusted(trusted_anew(back_at_a_doubted_level(), np.zeros(3, dtype=bool)))
    assert not doubted(levels).any()
    for now_s, degc, jump_k in ((1e6, 25.0, 2.0), (1e6 + 60.0, 23.0, -2.0)):
        jumped = np.array([jump_k, 0.0, 0.0])
        levels = renewed_levels(levels, np.arange(3), seen(now_s, np.array([degc, 20.0, 20.0]), jumped))
    assert levels.gaps == () and [by_k for *_, by_k in levels.jumps] == [2.0, -2.0]


def test_a_sensor_that_is_doubted_since_the_reference_stays_so_whoever_trusts_the_temperatures_of_then() -> None:
    levels = trusted(back_at_a_doubted_level())
    assert levels.away_s == {0: 0.0} and doubted(levels).tolist() == [True, False, False]


def test_a_sensor_that_goes_back_from_a_third_level_to_a_doubted_one_is_doubted() -> None:
    levels, still = back_at_a_doubted_level(), np.full(3, 20.0)
    gone = replace(seen(200.0, np.array([np.nan, 20.0, 20.0])), stale=np.array([True, False, False]))
    levels = renewed_levels(levels, np.arange(3), gone)
    far = replace(seen(300.0, still + [20.0, 0.0, 0.0], returned=1), new_level=np.array([True, False, False]))
    levels = renewed_levels(levels, np.arange(3), far)
    assert levels.shift_k[0] == pytest.approx(17.0)
    levels = renewed_levels(levels, np.arange(3), seen(400.0, still + [3.0, 0.0, 0.0], np.array([-17.0, 0.0, 0.0])))
    assert levels.shift_k[0] == 0.0 and abs(levels.uncertainty_k[0]) >= 3.0


@pytest.mark.parametrize("back_k", [0.0, 3.0], ids=["jumped back with its last value", "jumped with its last value"])
def test_a_sensor_that_left_with_a_jump_and_came_back_wrong_is_told_of_the_past_as_it_was(back_k: float) -> None:
    levels, lines, still = first_levels(3), np.arange(3), np.full(3, 20.0)
    for now_s, off_k in ((0.0, 0.0), (100.0, 8.0), (200.0, back_k)):
        now = still + [off_k, 0.0, 0.0]
        jump_k = 0.0 if not now_s else float(now[0] - levels.degc[0])
        levels = renewed_levels(levels, lines, seen(now_s, now, np.array([jump_k, 0.0, 0.0])))
    gone = replace(seen(300.0, np.array([np.nan, 20.0, 20.0])), stale=np.array([True, False, False]))
    levels = renewed_levels(levels, lines, replace(gone, at_s=np.full(3, 200.0)))
    levels = renewed_levels(levels, lines, seen(500.0, still - [4.0, 0.0, 0.0], returned=1))
    levels = renewed_levels(levels, lines, seen(600.0, still, np.array([4.0, 0.0, 0.0])))
    assert not doubted(levels).any()
    for time_s, off_k in ((50.0, 0.0), (100.0, 8.0), (150.0, 8.0), (200.0, back_k), (400.0, -4.0)):
        told = unshifted(levels, time_s, still + [off_k, 0.0, 0.0])
        assert np.isnan(told[0]) or told[0] == 20.0, time_s


@pytest.mark.parametrize("positioned", [False, True])
def test_a_sensor_that_jumps_back_but_for_what_changed_meanwhile_keeps_no_more_of_its_shift(positioned: bool) -> None:
    levels, lines = with_past(first_levels(3), np.full(3, 20.0), np.zeros(3)), np.arange(3)
    came = replace(seen(700.0, np.array([27.5, 20.0, 20.0]), returned=3), new_level=np.array([True, False, False]))
    levels = renewed_levels(levels, lines, came)
    assert levels.shift_k[0] == pytest.approx(7.5) and levels.uncertainty_k[0] == pytest.approx(0.5)
    if positioned:
        levels = trusted_anew(levels, np.zeros(3, dtype=bool))
    levels = renewed_levels(levels, lines, seen(900.0, np.array([21.3, 20.0, 20.0]), np.array([-6.2, 0.0, 0.0])))
    assert levels.shift_k[0] == pytest.approx(1.3) and levels.degc[0] == pytest.approx(20.0)
    assert levels.uncertainty_k[0] == pytest.approx(0.0 if positioned else 0.5)
    assert unshifted(levels, 800.0, np.array([27.5, 20.0, 20.0]))[0] == pytest.approx(20.0)


def went_silent(count: int, rise_k: float, constant_min: float, away_min: float) -> SensorLevels:
    """Levels of sensors each alone on its component, after the first has warmed for 10 min and then been silent."""

    def degc(minute: float) -> FloatArray:
        return 20.0 + np.where(np.arange(count) == 0, rise_k * (1.0 - np.exp(-minute / constant_min)), 0.0)

    levels, lines, gone = first_levels(count), np.arange(count), np.arange(count) == 0
    for minute in range(11):
        levels = renewed_levels(levels, lines, seen(60.0 * minute, degc(minute)))
    for minute in range(11, 10 + round(away_min)):
        still = replace(seen(60.0 * minute, np.where(gone, np.nan, degc(minute))), stale=gone)
        levels = renewed_levels(levels, lines, replace(still, at_s=np.where(gone, 600.0, 60.0 * minute)))
    back_min = 10.0 + away_min
    return renewed_levels(levels, lines, seen(60.0 * back_min, degc(back_min), returned=1))


@pytest.mark.parametrize("away_min", [3.0, 10.0])
def test_a_sensor_of_a_warm_up_that_slows_down_while_it_is_silent_is_itself(away_min: float) -> None:
    """A straight line would have it 0.2 and 1.2 K farther than it is."""
    assert not doubted(went_silent(4, rise_k=4.0, constant_min=8.0, away_min=away_min)).any()


def test_a_sensor_that_stands_still_from_the_moment_it_falls_silent_is_as_near() -> None:
    levels, lines, gone = first_levels(4), np.arange(4), np.arange(4) == 0
    for minute in range(11):
        levels = renewed_levels(levels, lines, seen(60.0 * minute, np.where(gone, 20.0 + 0.2 * minute, 20.0)))
    away = replace(seen(720.0, np.where(gone, np.nan, 20.0)), stale=gone)
    levels = renewed_levels(levels, lines, replace(away, at_s=np.where(gone, 600.0, 720.0)))
    levels = renewed_levels(levels, lines, seen(2400.0, np.where(gone, 22.0, 20.0), returned=1))
    assert not doubted(levels).any(), "a straight line would have it 6 K higher"
