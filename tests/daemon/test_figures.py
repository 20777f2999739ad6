"""Figures as data: phases without false lines, words of marks said once."""

import numpy as np

from daemon.workbench.dynamics.pictures import phase_deg
from daemon.workbench.figures import _named_marks


def test_a_phase_that_crosses_half_a_turn_draws_no_line_across_the_picture() -> None:
    turning = np.exp(1j * np.radians(np.array([170.0, 178.0, 184.0, 190.0])))
    phase = phase_deg(turning)
    assert np.isnan(phase[2]) and np.allclose(phase[[0, 1, 3]], (170.0, 178.0, -170.0))
    steps = np.diff(phase)
    assert (np.abs(steps[np.isfinite(steps)]) <= 180.0).all()


def test_bearings_of_one_group_are_named_once_in_their_middle() -> None:
    marks = [(10.0, "front"), (30.0, "front"), (200.0, "rear"), (400.0, "front")]
    assert _named_marks(marks) == [(20.0, "front"), (200.0, "rear"), (400.0, "front")]
