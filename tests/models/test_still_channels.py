"""A channel that never leaves its noise has no say in penalty, family and gate; what moves is all that is learned."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.training.evaluation import moving
from models.thermal.training.left_out_errors import LeftOutErrors, advantage, relative
from models.thermal.training.mixing import mean_weights
from models.thermal.training.train_family import train_family

ROWS = 120


def still_um(seed: int, rows: int = ROWS) -> FloatArray:
    return np.random.default_rng(seed).normal(0.0, 0.3, (rows, 1))


def run(seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    time_s = 60.0 * np.arange(ROWS)
    heat = rng.uniform(4.0, 8.0) * -np.expm1(-time_s / 3000.0) + 2.0 * np.sin(time_s / 1500.0 + seed)
    unseen = rng.uniform(-1.0, 1.0) * -np.expm1(-time_s / 1000.0)
    shares = rng.uniform(0.3, 1.0, 8)
    return Recording(
        name=f"run {seed}",
        time_s=time_s,
        speed_rpm=None,
        temperature_names=tuple(f"T{index + 1}" for index in range(8)),
        temperatures_degc=20.0 + heat[:, None] * shares + rng.normal(0.0, 0.1, (ROWS, 8)),
        displacement_names=("Z",),
        displacements_um=(6.0 * heat + 4.0 * unseen)[:, None] + rng.normal(0.0, 0.3, (ROWS, 1)),
    )


def with_still_channel(recording: Recording, seed: int) -> Recording:
    both = np.hstack([recording.displacements_um, still_um(seed)])
    return replace(recording, displacement_names=("Z", "X"), displacements_um=both)


def errors(left: FloatArray) -> LeftOutErrors:
    """What a family leaves of a channel that moves and of one that does not, as multiples of two units."""
    measured = [np.hstack([np.linspace(0.0, 20.0, ROWS)[:, None], still_um(run)]) for run in range(4)]
    noise = [np.random.default_rng(10 + run).normal(0.0, 1.0, (ROWS, 2)) for run in range(4)]
    return LeftOutErrors(
        folds=np.arange(4),
        measured_um=tuple(one - one[0] for one in measured),
        residual_um=tuple(one * left for one in noise),
        period_min=1.0,
        probe_min=None,
    )


def test_what_moves_is_what_has_a_say() -> None:
    ramp = np.linspace(0.0, 20.0, ROWS)[:, None]
    assert moving([np.hstack([ramp, still_um(1)]), np.hstack([-ramp, still_um(2)])]).tolist() == [True, False]
    assert moving([np.hstack([ramp * 0.0, still_um(1)]), np.hstack([ramp, still_um(2)])]).tolist() == [True, False]
    assert moving([still_um(1), still_um(2)]).tolist() == [True], "where nothing moves, all there is must count"


def test_the_better_family_is_the_one_that_leaves_less_of_what_moves() -> None:
    good, bad = errors(np.array([1.0, 0.6])), errors(np.array([1.4, 0.1]))
    assert relative(good) == pytest.approx(relative(bad) / 1.4)
    gained, _ = advantage(good, bad)
    assert gained > 0.0
    assert mean_weights([good, bad], mixed=False)[0] == {0: 1.0}


@pytest.mark.parametrize("family", ["ridge", "pls"])
def test_the_same_is_chosen_as_without_the_still_channel(family: str) -> None:
    alone = [run(seed) for seed in range(4)]
    both = [with_still_channel(one, 30 + seed) for seed, one in enumerate(alone)]
    expected, found = (
        train_family(each, family, sample_s=60.0, created="2026-01-01T00:00:00+00:00") for each in (alone, both)
    )
    assert found.trust.held_out_relative_rmse == pytest.approx(expected.trust.held_out_relative_rmse, rel=0.02)
    assert found.trust.forward_skill == pytest.approx(expected.trust.forward_skill, rel=0.05)
    chosen = [each.model.hyper_parameters.get("penalties") for each in (expected, found)]
    assert chosen[0] == chosen[1]
