"""Rolling means, block means, stretches without a gap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.align import RollingMean
from models.recordings.blocks import block_means


def test_the_mean_covers_the_last_minute_and_leaves_missing_values_out() -> None:
    rolling = RollingMean(60.0)
    rolling.add(0.0, np.array([100.0, 100.0, 100.0]))
    rolling.add(30.0, np.array([1.0, np.nan, np.nan]))
    rolling.add(60.0, np.array([3.0, 5.0, np.nan]))
    np.testing.assert_array_equal(rolling.mean(), [2.0, 5.0, np.nan])


def test_vectors_out_of_order_count_and_one_of_before_the_window_leaves_the_mean_whole() -> None:
    rolling = RollingMean(60.0)
    rolling.add(100.0, np.array([1.0]))
    rolling.add(95.0, np.array([3.0]))
    assert rolling.mean()[0] == 2.0
    rolling.add(0.0, np.array([7.0]))
    assert rolling.mean()[0] == 2.0


def test_what_a_sensor_said_until_now_is_left_out_and_what_it_says_next_counts() -> None:
    rolling = RollingMean(60.0)
    rolling.leave_out(np.array([True, False]))
    rolling.add(0.0, np.array([1.0, 2.0]))
    rolling.leave_out(np.array([True, False]))
    np.testing.assert_array_equal(rolling.mean(), [np.nan, 2.0])
    rolling.add(10.0, np.array([7.0, 4.0]))
    np.testing.assert_array_equal(rolling.mean(), [7.0, 3.0])


def test_what_cannot_be_averaged_is_refused() -> None:
    with pytest.raises(ValueError, match="window_s"):
        RollingMean(0.0)
    rolling = RollingMean(60.0)
    with pytest.raises(ValueError, match="no vector"):
        rolling.mean()
    rolling.add(0.0, np.zeros(3))
    with pytest.raises(ValueError, match="sensors"):
        rolling.add(1.0, np.zeros(4))
    with pytest.raises(ValueError, match="finite"):
        rolling.add(float("nan"), np.zeros(3))


@given(st.lists(st.tuples(st.floats(0.1, 40.0), st.one_of(st.just(np.nan), st.floats(-50.0, 50.0))), min_size=1))
def test_the_rolling_mean_is_the_mean_of_what_lies_in_the_window(steps: list[tuple[float, float]]) -> None:
    rolling, times, values = RollingMean(60.0), np.cumsum([step for step, _ in steps]), [v for _, v in steps]
    for time_s, value in zip(times, values, strict=True):
        rolling.add(float(time_s), np.array([value]))
    inside = [v for t, v in zip(times, values, strict=True) if t > times[-1] - 60.0 and not np.isnan(v)]
    expected = sum(inside) / len(inside) if inside else np.nan
    np.testing.assert_allclose(rolling.mean()[0], expected, atol=1e-9)


def test_block_means_keep_gaps_and_partial_blocks() -> None:
    time_s = np.array([0.0, 15.0, 30.0, 45.0, 60.0, 240.0, 255.0])
    values = np.array(
        [[1.0, np.nan], [2.0, np.nan], [3.0, np.nan], [4.0, np.nan], [9.0, 1.0], [5.0, np.nan], [7.0, 2.0]]
    )
    start_s, means = block_means(time_s, values, 60.0)
    np.testing.assert_array_equal(start_s, [0.0, 60.0, 240.0])
    np.testing.assert_array_equal(means, [[2.5, np.nan], [9.0, 1.0], [6.0, 2.0]])
    np.testing.assert_array_equal(block_means(time_s, values[:, 0], 60.0)[1], [2.5, 9.0, 6.0])
