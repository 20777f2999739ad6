"""The demonstration on a computer that is too slow for it: said, with a speed that it can."""

from daemon.simulation.demonstration import StallWatch, too_slow


def test_a_computer_that_is_too_slow_is_told_which_speed_it_can() -> None:
    told = too_slow(stall_s=0.120, speed=60.0, cycle_period_s=5.0)
    assert "too slow, or too busy, for --speed 60" in told
    assert "waited 120 ms for its turn, and a line that is silent for 50 ms has ended its pass" in told
    assert told.endswith("use --speed 5")
    assert too_slow(stall_s=0.120, speed=5.0, cycle_period_s=5.0) == "", "the advice holds"


def test_a_computer_that_keeps_up_is_told_nothing() -> None:
    assert too_slow(stall_s=0.002, speed=60.0, cycle_period_s=5.0) == ""


def test_where_no_speed_helps_other_programs_are_to_end() -> None:
    assert too_slow(stall_s=5.0, speed=60.0, cycle_period_s=5.0).endswith("end other programs")


def test_the_watch_measures_and_ends() -> None:
    with StallWatch() as stalls:
        pass
    assert stalls.worst_s >= 0.0
