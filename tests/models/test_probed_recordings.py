"""Recordings whose displacements a probe measured every 10 to 60 min, while temperatures were read every minute."""

from dataclasses import replace

import numpy as np
import pytest

from daemon.workbench.thermal.evaluation import Protocol, evaluate
from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import recording_findings, usable_recordings
from models.thermal.features import lag_table
from models.thermal.training.folds import fold_segments, inner_folds
from models.thermal.training.inputs import build_inputs
from models.thermal.training.train_family import train_family
from models.thermal.training.watch_fit import fit_watch

SENSORS = 5
HOURS = 5


def run(number: int, every_min: int | None = None) -> Recording:
    """Return a warm-up of a spindle with a body behind it; `every_min`: measured so often, None: in every row."""
    rng = np.random.default_rng(number)
    time_min = np.arange(60.0 * HOURS)
    rpm = np.repeat(rng.choice([0.0, 2000.0, 4000.0, 6000.0], HOURS), 60)
    heat = ((rpm / 6000.0) ** 1.5)[:, None]
    fast, slow = lag_table(time_min, np.hstack([heat, heat]), (20.0, 90.0))
    body = np.column_stack([fast[:, 0], slow[:, 1]])
    shares = np.random.default_rng(99).uniform(0.2, 1.0, (2, SENSORS))
    um = 40.0 * body[:, :1] + 25.0 * body[:, 1:] + rng.normal(0.0, 0.3, (len(rpm), 1))
    if every_min is not None:
        um[np.arange(len(um)) % every_min != 0] = np.nan
    return Recording(
        name=f"run {number}",
        time_s=60.0 * time_min,
        speed_rpm=rpm,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=21.0 + 12.0 * body @ shares + rng.normal(0.0, 0.03, (len(rpm), SENSORS)),
        displacement_names=("Z",),
        displacements_um=um,
    )


def test_a_value_that_is_repeated_until_the_next_one_is_told_and_zeros_between_are_none() -> None:
    whole = run(1)
    um = whole.displacements_um
    held, between = um[np.arange(len(um)) // 30 * 30], np.where((np.arange(len(um)) % 30 == 0)[:, None], um, 0.0)
    (said,) = [one for one in recording_findings(replace(whole, displacements_um=held)) if one.column == "Z"]
    assert "repeats its value for 30 min as a rule" in said.sentence and said.row == 2
    coarse = replace(whole, displacements_um=np.round(um / 5.0) * 5.0)
    assert [one for one in recording_findings(coarse) if "repeats" in one.sentence] == [], "a sensor may be coarse"
    possible = replace(whole, displacements_um=between).without_impossible()
    assert np.array_equal(possible.displacements_um, np.where(between == 0.0, np.nan, between), equal_nan=True)
    turned = recording_findings(replace(whole, displacements_um=-between))
    assert any(one.sentence.startswith("0 um cannot be") for one in turned), "a probe the other way round has -0"


def test_a_displacement_that_was_set_to_zero_on_the_way_is_told() -> None:
    whole = run(1)
    assert [one for one in recording_findings(whole) if one.column == "Z"] == []
    um = whole.displacements_um.copy()
    um[150:] -= 35.0
    (said,) = [one for one in recording_findings(replace(whole, displacements_um=um)) if one.column == "Z"]
    assert said.row == 151 and "jumps by -3" in said.sentence and "Cut the file there" in said.sentence
    um = whole.displacements_um.copy()
    um[150] -= 35.0
    assert [one for one in recording_findings(replace(whole, displacements_um=um)) if one.column == "Z"] == [], (
        "it returns"
    )


def test_a_machine_that_is_probed_now_and_then_is_learned() -> None:
    recordings, _ = usable_recordings([run(number, 30) for number in range(4)])
    found = evaluate(recordings, 60.0, "default", Protocol(leave_out="runs"), lambda *_: None)
    assert found["mean"]["reduction_rmse"] > 0.9
    assert found["mean"]["online"]["reduction_rmse"] > 0.9
    assert found["false_alarms"] == 0
    assert found["refused"] is None


def test_channels_that_are_never_measured_in_one_row_are_to_be_taken_one_at_a_time() -> None:
    """Record longer, it said, which does not help."""
    whole = [run(number) for number in range(3)]
    rows = np.arange(60 * HOURS)
    probed = [np.where((rows % 20 == at)[:, None], whole[0].displacements_um, np.nan) for at in (0, 10)]
    both = [replace(one, displacement_names=("Y", "Z"), displacements_um=np.hstack(probed)) for one in whole]
    with pytest.raises(DatasetError, match="measured in different rows: name one at a time under displacements"):
        train_family(both, "ridge", sample_s=60.0, created="", progress=lambda *_: None)


def test_rows_in_which_nothing_was_measured_are_no_hole_and_the_rows_of_another_fold_are_one() -> None:
    inputs = build_inputs([run(1, 20)], sample_s=60.0)
    rows = inputs.trainable()
    assert rows.sum() == 3 * HOURS
    assert [len(part) for part in fold_segments(inputs, rows)] == [3 * HOURS]
    rows[np.flatnonzero(rows)[10]] = False
    assert [len(part) for part in fold_segments(inputs, rows)] == [10, 3 * HOURS - 11]


def test_the_watch_learns_from_the_temperatures_between_two_probes() -> None:
    probed, whole = ([run(number, every) for number in range(3)] for every in (20, None))
    inputs = [build_inputs(each, sample_s=60.0, lags_min=(), speed_lags_min=()) for each in (probed, whole)]
    rows = [each.trainable() for each in inputs]
    watches = [
        fit_watch(each, 60.0, used, inner_folds(table, used)[0])
        for each, table, used in zip((probed, whole), inputs, rows, strict=True)
    ]
    np.testing.assert_allclose(watches[0].slew_k_per_min, watches[1].slew_k_per_min, rtol=0.1)
    np.testing.assert_allclose(watches[0].threshold_k, watches[1].threshold_k, rtol=0.2)


def test_too_few_probes_are_refused_and_so_is_a_channel_that_died() -> None:
    with pytest.raises(DatasetError, match=r"of 600 training rows 4 are complete.*column Z misses 99% of them"):
        train_family([run(1, 240), run(2, 240)], "default", sample_s=60.0, created="2026-11-27T00:00:00Z")
    um = np.hstack([run(1).displacements_um, run(1).displacements_um])
    um[140:, 1] = np.nan
    died = replace(run(1), displacement_names=("Z", "X"), displacements_um=um)
    with pytest.raises(DatasetError, match=r"column X misses 53% of them"):
        train_family([died], "default", sample_s=60.0, created="2026-11-27T00:00:00Z")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("family", ["ridge", "increments"])
def test_a_sensor_that_was_dead_in_one_of_several_recordings_is_said_and_the_others_are_trained_on(family: str) -> None:
    recordings = [run(number) for number in range(6)]
    degc = recordings[2].temperatures_degc.copy()
    degc[:, 1] = np.nan
    recordings[2] = replace(recordings[2], temperatures_degc=degc)
    used, warnings = usable_recordings(recordings)
    assert any("run 2: column T2: no value at all in this recording" in one for one in warnings)
    assert not any("stands still" in one for one in warnings)
    trained = train_family(used, family, sample_s=60.0, created="2026-11-27T00:00:00Z")
    assert "T2" not in trained.left_out and [one.name for one in trained.model.training] == [
        f"run {number}" for number in range(6) if number != 2
    ]
    with pytest.raises(DatasetError, match="column T2: no value at all; take the column out"):
        usable_recordings([recordings[2]])
