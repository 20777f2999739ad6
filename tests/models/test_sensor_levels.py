"""What a sensor's level says of the past."""

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


def seen(now_s: float, degc: FloatArray, jump_k: FloatArray, *, returned: bool = False) -> BelievedValues:
    """Believed values of three sensors, of which the first may have returned."""
    back = np.array([returned, False, False])
    nothing = np.zeros(3, dtype=bool)
    at_s = np.full(3, now_s)
    return BelievedValues(
        now_s=now_s,
        indices=np.arange(3),
        degc=degc,
        returned=back,
        new_level=nothing,
        jump_k=jump_k,
        stale=nothing,
        at_s=at_s,
    )


def back_at_a_doubted_level() -> SensorLevels:
    """Levels after the first of three sensors has come back 3 K off."""
    still = np.zeros(3)
    levels = with_past(first_levels(3), np.array([20.0, np.nan, np.nan]), np.array([0.0, -np.inf, -np.inf]))
    levels = renewed_levels(
        levels, np.zeros(3, dtype=np.intp), seen(100.0, np.array([23.0, 20.0, 20.0]), still, returned=True)
    )
    assert levels.away_s == {0: 0.0} and doubted(levels).tolist() == [True, False, False]
    return levels


def test_a_sensor_that_jumps_and_is_where_it_was_when_a_person_trusted_it_makes_nothing_unknown() -> None:
    levels = trusted(trusted_anew(back_at_a_doubted_level(), np.zeros(3, dtype=bool)))
    assert not doubted(levels).any()
    for now_s, degc, jump_k in ((1e6, 25.0, 2.0), (1e6 + 60.0, 23.0, -2.0)):
        jumped = np.array([jump_k, 0.0, 0.0])
        levels = renewed_levels(levels, np.zeros(3, dtype=np.intp), seen(now_s, np.array([degc, 20.0, 20.0]), jumped))
    assert levels.gaps == () and [by_k for *_, by_k in levels.jumps] == [2.0, -2.0]


def test_a_sensor_that_is_doubted_since_the_reference_stays_so_whoever_trusts_the_temperatures_of_then() -> None:
    levels = trusted(back_at_a_doubted_level())
    assert levels.away_s == {0: 0.0} and doubted(levels).tolist() == [True, False, False]
