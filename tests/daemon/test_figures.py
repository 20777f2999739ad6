"""Figures as data: phases without false lines, words of marks said once."""

import numpy as np

from daemon.workbench.dynamics.pictures import phase_deg
from daemon.workbench.figures import Axes, Curve, Figure, _named_marks, _plotly


def test_a_phase_that_crosses_half_a_turn_draws_no_line_across_the_picture() -> None:
    turning = np.exp(1j * np.radians(np.array([170.0, 178.0, 184.0, 190.0])))
    phase = phase_deg(turning)
    assert np.isnan(phase[2]) and np.allclose(phase[[0, 1, 3]], (170.0, 178.0, -170.0))
    steps = np.diff(phase)
    assert (np.abs(steps[np.isfinite(steps)]) <= 180.0).all()


def test_bearings_of_one_group_are_named_once_in_their_middle() -> None:
    marks = [(10.0, "front"), (30.0, "front"), (200.0, "rear"), (400.0, "front")]
    assert _named_marks(marks) == [(20.0, "front"), (200.0, "rear"), (400.0, "front")]


def test_the_title_stands_above_the_words_of_marks() -> None:
    curve = Curve(x=np.arange(3.0), y=np.arange(3.0), label="measured")
    marked = Axes(title="Z: measured", curves=[curve], marks=[(0.0, "day1.csv"), (1.0, "day2.csv"), (2.0, "day3.csv")])
    drawn = _plotly(Figure(title="Z", axes=[marked, Axes(title="Z: left", curves=[curve])], heights=(320, 240)))
    shifts = {note.text: note.yshift for note in drawn.layout.annotations}
    highest = max(shifts[name] for name in ("day1.csv", "day2.csv", "day3.csv"))
    assert shifts["Z: measured"] >= highest + 14 and shifts["Z: left"] == 0
