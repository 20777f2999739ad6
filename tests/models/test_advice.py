"""What to record next is said for recordings that support less than there could be, and for no others."""

from dataclasses import replace

import numpy as np

from models.recordings.dataset import Recording
from models.thermal.training.advice import advice, worse_channels
from models.thermal.training.evaluation import ResidualMetrics
from models.thermal.training.inputs import Inputs, build_inputs


def inputs(runs: int, minutes: int, still: bool = False) -> Inputs:
    rng = np.random.default_rng(0)
    rise = 1.0 - np.exp(-np.arange(float(minutes)) / 40.0)
    recordings = []
    for number in range(runs):
        um = np.column_stack([20.0 * rise, 0.0 * rise if still else 9.0 * rise]) + rng.normal(0.0, 0.3, (minutes, 2))
        recordings.append(
            Recording(
                name=f"run {number}",
                time_s=60.0 * np.arange(float(minutes)),
                speed_rpm=None,
                temperature_names=("T1",),
                temperatures_degc=(20.0 + 5.0 * rise)[:, None],
                displacement_names=("y", "z"),
                displacements_um=um,
            )
        )
    return build_inputs(recordings, sample_s=60.0, lags_min=(), speed_lags_min=())


def said(of: Inputs, independent: int) -> tuple[str, ...]:
    return advice(of, np.ones(of.rows, dtype=np.bool_), independent)


def test_enough_runs_that_are_long_enough_need_no_advice() -> None:
    assert said(inputs(5, 180), 5) == ()


def test_few_runs_get_a_number_of_runs_a_length_and_an_alternation() -> None:
    (sentence,) = said(inputs(2, 180), 2)
    assert "record 3 more runs of about 3 h" in sentence and "standing still" in sentence


def test_a_channel_that_is_no_better_with_the_model_is_named_with_what_to_do() -> None:
    columns = np.array([[30.0, 4.0, 0.0], [90.0, 9.0, 0.0], [2.0, 5.0, 0.0], [6.0, 12.0, 0.0]])
    metrics = ResidualMetrics(
        channels=("Weg Z", "y", "x"),
        rmse_without_um=columns[0],
        max_without_um=columns[1],
        rmse_with_um=columns[2],
        max_with_um=columns[3],
    )
    (sentence,) = worse_channels(metrics)
    assert sentence.startswith("channel y: on what was left out the model leaves 5 um of 4 um")
    assert "--channels 'Weg Z,x'" in sentence and "record 2 more runs" in sentence
    assert worse_channels(metrics, explained=["y"]) == () == worse_channels(None)


def test_a_channel_that_never_moves_is_named_and_one_with_gaps_is_not() -> None:
    (sentence,) = said(inputs(5, 180, still=True), 5)
    assert sentence.startswith("channel z moved by") and "leave the channel out" in sentence
    whole = inputs(5, 180)
    gaps = np.where(np.arange(whole.rows)[:, None] % 7 == 0, np.nan, whole.measured_um)
    assert said(replace(whole, measured_um=gaps), 5) == ()
