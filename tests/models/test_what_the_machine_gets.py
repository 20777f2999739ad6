"""What the output would hold of an estimate: weighed by confidence, held, gone back, moved by probes."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.family import model_from_json
from models.thermal.features import lag_table
from models.thermal.training.inputs import build_inputs
from models.thermal.training.online import Followed, compensated_um, follow, following_share
from models.thermal.training.train_family import train_family
from models.thermal.training.trial import since_first_known

MINUTES = np.arange(60.0)


def followed(confidence: float | np.ndarray, in_domain: bool | np.ndarray = True) -> Followed:
    return Followed(
        estimate_um=np.outer(MINUTES, [1.0, -2.0]),
        band_um=np.ones((60, 2)),
        confidence=np.broadcast_to(confidence, 60).astype(float),
        in_domain=np.broadcast_to(in_domain, 60).astype(bool),
        unsure=np.zeros(60, dtype=bool),
        speed_unread=np.zeros(60, dtype=bool),
    )


@pytest.mark.parametrize(("confidence", "weight"), [(1.0, 1.0), (0.9, 1.0), (0.8, 0.5), (0.7, 0.0)])
def test_the_estimate_counts_by_its_confidence(confidence: float, weight: float) -> None:
    held = compensated_um(followed(confidence), MINUTES, np.zeros((60, 2)))
    np.testing.assert_allclose(held, weight * np.outer(MINUTES, [1.0, -2.0]), atol=1e-9)


def test_what_must_not_be_followed_is_held_for_ten_minutes_and_then_taken_back() -> None:
    there = (MINUTES < 20.0) | (MINUTES >= 40.0)
    for part in (followed(np.where(there, 1.0, 0.5)), followed(1.0, there)):
        held = compensated_um(part, MINUTES, np.zeros((60, 2)))[:, 0]
        assert held[19:30].tolist() == [19.0] * 11
        assert held[30:40].tolist() == [0.0] * 10 and held[40] == 40.0
        assert following_share([part]) == pytest.approx(2.0 / 3.0)


def test_a_probe_moves_the_output_to_what_it_measured() -> None:
    measured = np.outer(MINUTES, [1.5, -2.0])
    held = compensated_um(followed(1.0), MINUTES, measured, 20.0)
    left = measured - held
    np.testing.assert_allclose(left[[20, 40]], 0.0, atol=1e-9)
    np.testing.assert_allclose(left[:, 1], 0.0, atol=1e-9)
    assert np.abs(left[20:, 0]).max() <= 0.5 * 20.0


def test_a_model_of_sparse_rows_is_not_late_by_half_of_their_distance_and_one_of_long_means_is_seen_to_be() -> None:
    """Rows 5 min apart, which nobody averaged, asked for means over 5 min on line, which lie 2.5 min back; evaluation
    compared both with what was measured in the same rows, and showed neither."""
    time_s, dense = np.arange(0.0, 4.0 * 3600.0, 15.0), []
    for number in range(3):
        rng = np.random.default_rng(number)
        heat = np.repeat(rng.choice([0.0, 4.0, 8.0], 24), 40)
        (fast,), (slow,) = (lag_table(time_s / 60.0, np.outer(heat, [1.0, 0.6]), (tau,)) for tau in (10.0, 40.0))
        dense.append(
            Recording(
                name=f"run{number}",
                time_s=time_s,
                speed_rpm=None,
                temperature_names=("T1", "T2"),
                temperatures_degc=20.0 + np.column_stack([fast[:, 0], slow[:, 1]]) + rng.normal(0.0, 0.01, fast.shape),
                displacement_names=("c1",),
                displacements_um=10.0 * slow[:, :1],
            )
        )
    at = slice(0, None, 20)
    parts = [
        replace(
            each,
            time_s=each.time_s[at],
            temperatures_degc=each.temperatures_degc[at],
            displacements_um=each.displacements_um[at],
        )
        for each in dense
    ]
    late_um = {}
    for name, recordings, sample_s, mean_s in (("rows", parts, 60.0, 60.0), ("means", dense, 300.0, 300.0)):
        model = train_family(recordings, "lags", sample_s=sample_s, created="2026-01-01T00:00:00Z").model
        assert (model.period_s, model_from_json(model.to_json(), "model.json").period_s) == (mean_s, mean_s)
        inputs = build_inputs(recordings[2:], sample_s=sample_s, lags_min=(), speed_lags_min=())
        got = follow(model, inputs, np.arange(inputs.rows))
        measured_um = since_first_known(inputs.measured_um)
        left_um = measured_um - compensated_um(got, inputs.time_min, measured_um)
        late_um[name] = float(np.sqrt(np.mean(np.square(left_um))))
    steps_um = np.diff(dense[2].displacements_um[::10], axis=0)  # over half a mean of 5 min
    assert late_um["means"] == pytest.approx(float(np.sqrt(np.mean(np.square(steps_um)))), rel=0.3)
    assert late_um["rows"] < 0.4 * late_um["means"]
