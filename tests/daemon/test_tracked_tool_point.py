"""A spindle model with the published regressions as a source of speeds: it answers, and its flags block."""

from pathlib import Path

import numpy as np
import pytest

from config.machine.published_bearings import published_model
from config.machine.spindle_chain import read_spindle
from models.spindle_speed.tracked_tool_point import TrackedToolPoint
from models.stability.response import SampledResponse
from models.thermomechanics.tool_point import ToolPointTracker

LABELS = {"IR": [0, 1], "A": [2], "F": [3], "Room": [4]}
DEGC = np.array([25.0, 25.2, 22.5, 23.0, 20.0])


@pytest.fixture(scope="module")
def tracker() -> ToolPointTracker:
    return new_tracker()


def new_tracker() -> ToolPointTracker:
    spindle = read_spindle(Path("simulated_machine"))
    frequency_hz = np.arange(300.0, 1500.0, 2.0)
    return ToolPointTracker(
        published_model(), {"x": spindle.assembly(), "y": spindle.assembly()}, LABELS, frequency_hz=frequency_hz
    )


def test_it_answers_with_the_trackers_response_and_flags(tracker: ToolPointTracker) -> None:
    estimator = TrackedToolPoint(tracker, LABELS)
    known = estimator.renew(0.0, DEGC)
    assert known is not None
    assert "need those of 4 and 10 min ago, which are missing; the oldest are 0.0 min old" in known.inhibit
    assert set(known.resonance_hz) == {"x", "y"}
    assert isinstance(known.response, SampledResponse)
    assert np.abs(known.response.receptance[:, 0, 0]).max() > 0.0
    assert not known.response.receptance[:, 0, 1].any()
    assert known.flagged_ends
    again = estimator.renew(10.0, DEGC)
    assert again is not None
    assert again.flagged_ends is known.flagged_ends


def test_temperatures_that_are_missing_between_older_ones_are_said_to_be() -> None:
    """It said that the changes need 10 min, and that 11.7 min are there."""
    estimator = TrackedToolPoint(new_tracker(), LABELS)
    for time_s in (0.0, 700.0):
        known = estimator.renew(time_s, DEGC)
    assert known is not None
    assert "need those of 4 and 10 min ago, which are missing; the oldest are 11.7 min old" in known.inhibit


def test_a_flagged_property_at_its_other_end_is_another_response(tracker: ToolPointTracker) -> None:
    known = TrackedToolPoint(tracker, LABELS).renew(100.0, DEGC)
    assert known is not None
    others = [end for end in known.flagged_ends if end is not None]
    for end in others:
        assert isinstance(end.response, SampledResponse)
        assert isinstance(known.response, SampledResponse)
        assert not np.allclose(end.response.receptance, known.response.receptance, rtol=1e-6, atol=0.0)
    assert others or None in known.flagged_ends


def test_a_signal_that_stands_on_fewer_than_half_of_its_sensors_is_not_followed(tracker: ToolPointTracker) -> None:
    labels = LABELS | {"IR": [0, 1, 5]}
    estimator = TrackedToolPoint(tracker, labels)
    degc = np.append(DEGC, 25.1)
    reasons = []
    for missing in ([], [0], [0, 1], [0, 1, 5], []):
        reading = degc.copy()
        reading[missing] = np.nan
        known = estimator.renew(100.0 + 5.0 * len(reasons), reading)
        assert known is not None
        reasons.append(known.inhibit)
    few = "only 1 of 3 sensors of IR have a value"
    assert [few in reason for reason in reasons] == [False, False, True, False, False]
