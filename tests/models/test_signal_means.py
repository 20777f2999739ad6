"""The mean of a label does not jump when one of its sensors leaves."""

import numpy as np
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from models.thermomechanics.history import SignalMeans

NAN = float("nan")


def test_a_sensor_that_leaves_does_not_move_the_mean() -> None:
    means = SignalMeans([[0, 1, 2], [3]])
    assert means.renew(np.array([30.0, 34.0, 38.0, 20.0])).tolist() == [34.0, 20.0]
    assert means.renew(np.array([30.0, 34.0, NAN, 20.0])).tolist() == [34.0, 20.0]
    assert means.renew(np.array([31.0, 36.0, NAN, 20.0])).tolist() == [35.5, 20.0]
    returned = means.renew(np.array([31.0, 36.0, 40.0, 20.0]))
    assert np.allclose(returned, [107.0 / 3.0, 20.0])


def test_without_any_sensor_there_is_no_mean_and_the_missing_one_goes_on_afterwards() -> None:
    means = SignalMeans([[0, 1]])
    assert means.renew(np.array([NAN, 22.0])).tolist() == [22.0]
    assert means.renew(np.array([20.0, 22.0])).tolist() == [21.0]
    assert np.isnan(means.renew(np.array([NAN, NAN]))[0])
    assert means.renew(np.array([24.0, NAN])).tolist() == [25.0]


@hypothesis_settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.sets(st.integers(0, 3), max_size=3)), max_size=30))
def test_sensors_that_warm_alike_have_their_true_mean_whoever_is_away(history: list[tuple[float, set[int]]]) -> None:
    means, degc = SignalMeans([range(4)]), np.array([20.0, 24.0, 31.0, 22.5])
    means.renew(degc)
    for change_k, away in history:
        degc = degc + change_k
        read = degc.copy()
        read[list(away)] = np.nan
        assert np.isclose(means.renew(read)[0], degc.mean())
