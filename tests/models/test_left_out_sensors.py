"""Temperatures that are often missing: left out where the others do nearly as well, kept where only they tell."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import DatasetError, Recording
from models.thermal.training.inputs import build_inputs
from models.thermal.training.left_out_sensors import left_out_sensors
from models.thermal.training.online import follow, following_share
from models.thermal.training.train_family import train_family

MINUTES = 300
HOLES_MIN = (60, 130, 220)


def runs(count: int = 5, seed: int = 1) -> list[Recording]:
    """Two bodies of their own load each: two sensors see the first, one alone sees the second."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        heat = np.repeat(rng.uniform(0.0, 10.0, (MINUTES // 30, 2)), 30, axis=0)
        body = np.zeros((MINUTES, 2))
        for row in range(1, MINUTES):
            body[row] = body[row - 1] + (heat[row] - body[row - 1]) / np.array([20.0, 30.0])
        degc = 20.0 + body @ np.array([[1.0, 0.8, 0.0], [0.0, 0.1, 1.0]])
        made.append(
            Recording(
                name=f"run {number + 1}",
                time_s=60.0 * np.arange(float(MINUTES)),
                speed_rpm=None,
                temperature_names=("near", "far", "column"),
                temperatures_degc=degc + rng.normal(0.0, 0.02, degc.shape),
                displacement_names=("Z",),
                displacements_um=(body @ [4.0, 3.0])[:, None] + rng.normal(0.0, 0.1, (MINUTES, 1)),
            )
        )
    return made


def with_holes(recordings: list[Recording], name: str, holes_min: tuple[int, ...], long_min: int) -> list[Recording]:
    """Take away what one sensor sent for a while after each of some times."""
    made = []
    for recording in recordings:
        degc = recording.temperatures_degc.copy()
        for begin in holes_min:
            degc[begin : begin + long_min, recording.temperature_names.index(name)] = np.nan
        made.append(replace(recording, temperatures_degc=degc))
    return made


def test_what_the_others_stand_for_is_left_out_when_it_is_often_missing() -> None:
    assert left_out_sensors(runs(), 60.0) == {}
    (name, why), *others = left_out_sensors(with_holes(runs(), "far", HOLES_MIN, 15), 60.0).items()
    assert name == "far" and not others
    assert why.startswith("missing in 15% of its training rows, in which the machine would get little")


def test_what_alone_tells_of_a_part_is_kept() -> None:
    assert left_out_sensors(with_holes(runs(), "column", HOLES_MIN, 7), 60.0) == {}


def test_what_was_missing_once_is_kept() -> None:
    once = with_holes(runs()[:1], "far", (60,), 120) + runs()[1:]
    assert left_out_sensors(once, 60.0) == {}


def test_what_was_repaired_is_kept() -> None:
    repaired = with_holes(runs()[:2], "far", HOLES_MIN, 45) + runs()[2:]
    assert left_out_sensors(repaired, 60.0) == {}
    assert "far" in left_out_sensors(repaired[::-1], 60.0), "it began to fail"


def test_what_was_built_in_later_is_kept() -> None:
    later = with_holes(runs(12)[:2], "far", (0,), MINUTES) + runs(12)[2:]
    assert left_out_sensors(later, 60.0) == {}


def test_what_falls_silent_together_with_what_is_often_missing_goes_with_it() -> None:
    """A line that falls silent again and again has other sensors too; alone such a silence means nothing."""
    recordings = runs()
    for number, one in enumerate(recordings):
        wall = one.temperatures_degc[:, 1:2] + np.random.default_rng(number).normal(0.0, 0.02, (MINUTES, 1))
        degc, names = np.hstack([one.temperatures_degc, wall]), (*one.temperature_names, "wall")
        recordings[number] = replace(one, temperature_names=names, temperatures_degc=degc)
    recordings[1:2] = with_holes(recordings[1:2], "wall", HOLES_MIN, 45)
    assert left_out_sensors(recordings, 60.0) == {}
    assert set(left_out_sensors(with_holes(recordings, "far", HOLES_MIN, 45), 60.0)) == {"far", "wall"}


def test_rows_that_are_not_trained_on_have_no_say() -> None:
    recordings = runs()[:4] + with_holes(runs()[4:], "far", HOLES_MIN, 45)
    first = np.arange(5 * MINUTES) < 4 * MINUTES
    assert left_out_sensors(recordings, 60.0, first) == {}
    assert "far" in left_out_sensors(recordings, 60.0, ~first)


def test_a_run_that_reads_the_wrong_way_round_has_no_say() -> None:
    recordings = with_holes(runs(), "far", HOLES_MIN, 15)
    recordings[2] = replace(recordings[2], displacements_um=-recordings[2].displacements_um)
    assert "far" in left_out_sensors(recordings, 60.0)


def test_what_is_missing_together_is_not_all_left_out() -> None:
    recordings = runs()
    for name in recordings[0].temperature_names:
        recordings = with_holes(recordings, name, HOLES_MIN, 7)
    assert left_out_sensors(recordings, 60.0) == {}
    nothing = [replace(one, temperatures_degc=np.full_like(one.temperatures_degc, 20.0)) for one in runs()]
    with pytest.raises(DatasetError, match="no temperature can be used: near: constant at 20"):
        left_out_sensors(nothing, 60.0)


def test_the_machine_follows_while_a_sensor_is_missing_that_the_model_was_made_without() -> None:
    """The same test day, on which the sensor falls silent too, with models of both kinds of training days."""
    day = with_holes(runs(6, seed=2)[5:], "far", HOLES_MIN, 40)
    shares = {}
    for kind, trained in (("whole", runs()), ("holes", with_holes(runs(), "far", HOLES_MIN, 15))):
        made = train_family(trained, "ridge", sample_s=60.0, created="2026-01-01T00:00:00+00:00")
        inputs = build_inputs(day, sample_s=60.0, lags_min=(), speed_lags_min=())
        shares[kind] = following_share([follow(made.model, inputs, np.arange(inputs.rows))])
        assert ("far" in made.left_out) == (kind == "holes")
    assert shares["holes"] == 1.0 and shares["whole"] < 0.7
