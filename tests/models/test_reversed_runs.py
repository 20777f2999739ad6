"""A run in which a channel was measured the wrong way round is found, named and left out; another regime is not."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.features import lag_table
from models.thermal.training.inputs import build_inputs
from models.thermal.training.reversed_runs import reversed_runs, reversed_sentences
from models.thermal.training.train_family import train_family

RUNS, MINUTES = 6, 150


def run(number: int, *, turned: bool = False, gain: float = 1.0) -> Recording:
    rng = np.random.default_rng(number)
    time_min = np.arange(float(MINUTES))
    heat = np.repeat(rng.uniform(0.2, 1.0, 3), MINUTES // 3)[:, None]
    heat[0] = 0.0
    body = np.hstack(list(lag_table(time_min, heat, (8.0, 30.0))))
    degc = 21.0 + 9.0 * body @ np.array([[1.0, 0.4, 0.1], [0.1, 0.5, 1.0]]) + rng.normal(0.0, 0.03, (MINUTES, 3))
    um = gain * body @ np.array([[20.0, 6.0], [5.0, -15.0]]) + rng.normal(0.0, 0.1, (MINUTES, 2))
    return Recording(
        name=f"run {number}",
        time_s=60.0 * time_min,
        speed_rpm=None,
        temperature_names=("T1", "T2", "T3"),
        temperatures_degc=np.round(degc, 1),
        displacement_names=("y", "z"),
        displacements_um=um * np.array([1.0, -1.0 if turned else 1.0]),
    )


def found(recordings: list[Recording]) -> dict[int, tuple[str, ...]]:
    inputs = build_inputs(recordings, sample_s=60.0, lags_min=(), speed_lags_min=())
    return reversed_runs(inputs, inputs.trainable())


@pytest.mark.parametrize("which", range(RUNS))
def test_the_run_that_reads_the_wrong_way_round_is_found(which: int) -> None:
    assert found([run(number, turned=number == which) for number in range(RUNS)]) == {which: ("z",)}


def test_what_is_only_different_is_none() -> None:
    assert found([run(number) for number in range(RUNS)]) == {}
    assert found([run(number, gain=2.0 if number > 2 else 1.0) for number in range(RUNS)]) == {}
    half = [run(number, turned=number > 2) for number in range(RUNS)]
    assert found(half) == {}, "nobody knows which half is right"
    assert found([run(0), run(1), run(2, turned=True)]) == {}, "too few to say"


def test_training_leaves_it_out_and_says_so() -> None:
    recordings = [run(number, turned=number == 1) for number in range(RUNS)]
    made = train_family(recordings, "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert made.choice is not None
    assert "run 1: z reads the wrong way round" in made.advice[0], "who trains is told what was left out"
    assert [used.name for used in made.model.training] == [f"run {number}" for number in (0, 2, 3, 4, 5)]
    straight = train_family([run(n) for n in (0, 2, 3, 4, 5)], "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert made.trust.held_out_relative_rmse == pytest.approx(straight.trust.held_out_relative_rmse, abs=1e-9)
    assert made.trust.refused is None


def test_of_a_part_of_a_recording_the_hours_are_told() -> None:
    whole, part = run(0), run(1)
    joined = replace(
        whole,
        time_s=np.concatenate([whole.time_s, part.time_s + 5 * 3600.0]),
        temperatures_degc=np.vstack([whole.temperatures_degc, part.temperatures_degc]),
        displacements_um=np.vstack([whole.displacements_um, part.displacements_um]),
    )
    inputs = build_inputs([joined], sample_s=60.0, lags_min=(), speed_lags_min=())
    (sentence,) = reversed_sentences(inputs, {1: ("y",)})
    assert sentence.startswith("run 0, hours 5.0 to 7.5: y reads")
