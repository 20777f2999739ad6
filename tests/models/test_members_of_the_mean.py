"""Which ridges enter the default model: those that predict what was left out, and no other."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.features import BoolArray, IntArray, lag_table
from models.thermal.linear import LinearModel
from models.thermal.training.choice import ChosenProblem, mean_of
from models.thermal.training.families import MEMBER_FACTOR, MEMBER_SLACK, members
from models.thermal.training.folds import inner_folds
from models.thermal.training.gaussian_member import GaussianMember
from models.thermal.training.inputs import Inputs, build_inputs
from models.thermal.training.lags import part_of, widened
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES
from models.thermal.training.ridge_member import DEPARTURES, LEVELS, RidgeMember
from models.thermal.training.train_family import FamilyTraining, train_family

MINUTES, SENSORS = 73, 8


def warm_up(seed: int) -> Recording:
    """A short run from cold."""
    rng = np.random.default_rng(seed)
    time_min, level = np.arange(float(MINUTES)), rng.uniform(0.5, 1.0)
    heat = np.tile([level, level**2], (MINUTES, 1))
    heat[0] = 0.0
    body = np.hstack(list(lag_table(time_min, heat, (8.0, 35.0))))
    places = np.random.default_rng(0).uniform(0.2, 1.0, (4, SENSORS))
    degc = 22.0 + rng.normal(0.0, 1.0) + 10.0 * body @ places + rng.normal(0.0, 0.03, (MINUTES, SENSORS))
    um = body @ np.random.default_rng(1).normal(0.0, 20.0, (4, 2)) + rng.normal(0.0, 0.05, (MINUTES, 2))
    return Recording(
        name=f"warm-up {seed}",
        time_s=60.0 * time_min,
        speed_rpm=None,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=np.round(degc, 1),
        displacement_names=("y", "z"),
        displacements_um=um,
    )


@pytest.fixture(scope="module")
def runs() -> list[Recording]:
    return [warm_up(seed) for seed in range(5)]


@pytest.fixture(scope="module")
def trained(runs: list[Recording]) -> FamilyTraining:
    return train_family(runs, "lags", sample_s=60.0, created="2026-01-01T00:00:00Z")


def test_the_model_has_the_members_alone(trained: FamilyTraining) -> None:
    penalties = trained.hyper_parameters["penalties"]
    assert isinstance(penalties, list)
    assert len(penalties) == len(str(trained.hyper_parameters["members"]).split(", "))
    assert isinstance(trained.model, LinearModel) and len(trained.model.solutions) == len(penalties)


def test_no_lag_is_longer_than_a_run(trained: FamilyTraining) -> None:
    assert isinstance(trained.model, LinearModel)
    assert max(trained.model.layout.lags_min) <= MINUTES


def test_the_default_says_what_it_tried_and_is_no_worse(runs: list[Recording], trained: FamilyTraining) -> None:
    default = train_family(runs, "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert default.choice is not None
    tried = {one.family for one in default.choice.candidates}
    assert tried >= {"ridge", "increments", "lags"} and not tried & {"pls", "lasso"}
    assert default.choice.family in default.choice.why
    assert default.trust.held_out_relative_rmse <= trained.trust.held_out_relative_rmse + 0.02


@pytest.mark.parametrize("cycle_min", [None, 25, 15, 10])
def test_of_a_single_run_a_ridge_is_taken_that_leaves_less_of_other_days(
    runs: list[Recording], cycle_min: int | None
) -> None:
    """Parts of one run are alike in what differs between days: judged by them, lags look better than they are, however
    many cycles it has."""
    speed = None if cycle_min is None else np.where(np.arange(MINUTES) % cycle_min < cycle_min / 2, 3000.0, 0.0)
    days = []
    for number, run in enumerate(runs):
        rng = np.random.default_rng(50 + number)
        degc = 22.0 + np.cumsum(rng.normal(0.0, 0.15, (MINUTES, SENSORS)), axis=0)
        unseen_um = np.cumsum(np.cumsum(rng.normal(0.0, 0.002, (MINUTES, 2)), axis=0), axis=0)
        um = (degc - degc[0]) @ np.random.default_rng(4).normal(0.0, 2.0, (SENSORS, 2)) + unseen_um
        measured_degc = degc + rng.normal(0.0, 0.02, degc.shape)
        days.append(replace(run, temperatures_degc=measured_degc, displacements_um=um, speed_rpm=speed))
    left = {}
    for family in ("default", "lags"):
        made = train_family(days[:1], family, sample_s=60.0, created="2026-01-01T00:00:00Z")
        assert isinstance(made.model, LinearModel)
        left[family] = 0.0
        for day in days[1:]:
            measured_um = day.displacements_um - day.displacements_um[0]
            estimated_um = made.model.recorded_um(day.time_s / 60.0, day.temperatures_degc, day.speed_rpm, 0)
            left[family] += float(np.square(measured_um - estimated_um).sum() / np.square(measured_um).sum())
        if family == "default":
            assert made.choice is not None and made.choice.family == "ridge"
            assert "may lead astray on another day: ridge is taken" in made.choice.why
    assert left["default"] < 0.2 * left["lags"]


def test_members_are_all_that_are_nearly_as_good_as_the_best() -> None:
    assert members([0.20, 0.19]) == [0, 1]
    assert members([0.40, 0.40 * MEMBER_FACTOR + 1e-9]) == [0]
    assert members([0.01, 0.01 + MEMBER_SLACK]) == [0, 1], "both leave next to nothing"
    assert members([0.01, 0.02 + MEMBER_SLACK]) == [0]
    assert members([1.46, 0.10, float("nan")]) == [1]
    assert members([float("nan"), float("nan")]) == [0, 1], "nothing was left out, so nothing is known"


def test_a_default_that_needs_no_lags_still_watches_its_sensors(runs: list[Recording]) -> None:
    """Sensors that see all heat: a ridge on temperatures is as good as any, and a drifting sensor must be found."""
    seen = []
    for run in runs:
        places = np.random.default_rng(4).normal(0.0, 1.0, (SENSORS, 2))
        um = (run.temperatures_degc - run.temperatures_degc[0]) @ places
        noise = np.random.default_rng(len(seen)).normal(0.0, 0.05, um.shape)
        seen.append(replace(run, displacements_um=um + noise))
    made = train_family(seen, "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
    assert made.choice is not None and made.choice.family == "ridge"
    model = made.model
    assert isinstance(model, LinearModel) and not model.layout.lags_min and model.watch is not None
    online = model.runtime(Machine(components={}))
    of = seen[0]
    online.on_sample(0.0, of.temperatures_degc[0], float("nan"))
    reference = OnlineReference(time_min=0.0, now_min=0.0, degc=of.temperatures_degc[0])
    online.set_reference(reference)
    wanted = model.recorded_um(of.time_s / 60.0, of.temperatures_degc, None, 0)
    for row in range(1, MINUTES):
        online.on_sample(float(row), of.temperatures_degc[row], float("nan"))
        found, _ = online.estimate(float(row), of.temperatures_degc[row], np.zeros(SENSORS, dtype=np.bool_))
        assert found is not None
        if not found.imputed:
            np.testing.assert_allclose(found.thermal_error_um, wanted[row], atol=1e-6)
    assert not online.excluded
    rng = np.random.default_rng(8)
    spoilt = of.temperatures_degc[-1] + 30.0 * np.eye(SENSORS)[3]
    for row in range(MINUTES, MINUTES + 20):
        online.on_sample(float(row), spoilt + rng.normal(0.0, 0.1, SENSORS), float("nan"))
    assert list(online.excluded) == [model.sensor_ids[3]]


def prepared(runs: list[Recording]) -> tuple[Inputs, BoolArray, IntArray]:
    inputs = build_inputs(runs, sample_s=60.0, lags_min=(10.0, 30.0), speed_lags_min=())
    rows = inputs.trainable()
    return inputs, rows, inner_folds(inputs, rows)[0]


def leaving(member: RidgeMember | GaussianMember, share: float, seed: int) -> None:
    """Let a member leave this share of each run, by chance as a seed says."""
    assert member.errors is not None
    measured = member.errors.measured_um
    rng = np.random.default_rng(seed)
    left = tuple(share * um.std() * rng.normal(size=um.shape) for um in measured)
    member.errors = replace(member.errors, residual_um=left)


def test_far_out_the_best_ridge_counts_also_where_another_one_is_a_member(runs: list[Recording]) -> None:
    """A ridge that errs the other way makes the mean better; alone, beyond the domain, it is still a worse one."""
    inputs, rows, fold = prepared(runs)
    process = GaussianMember("process", inputs, rows, fold, None, departures=False)
    worse = RidgeMember("worse", part_of(inputs, (), ()), rows, fold, None, LEVELS)
    better = RidgeMember("better", inputs, rows, fold, None, DEPARTURES)
    leaving(process, 0.2, seed=1)
    leaving(worse, 0.8, seed=1)
    leaving(better, 0.7, seed=1)
    assert worse.errors is not None
    worse.errors = replace(worse.errors, residual_um=tuple(-um for um in worse.errors.residual_um))
    mean = mean_of("gaussian and ridges", [process, worse, better], inputs, rows, [worse, better])
    assert mean.hyper_parameters["members"] == "process, worse"
    fit = mean.fit(frozenset())
    assert fit.mixture is not None
    far = fit.solutions[fit.mixture.outside]
    wanted = widened(better.solution(frozenset()), mean.layout)
    np.testing.assert_allclose(far.coefficients(), wanted.coefficients())


@pytest.mark.parametrize(
    ("shares", "family"),
    [
        ((0.1, 0.25, 0.1, 0.25, 0.1), "gaussian"),
        ((0.1, 0.1, 0.1, 0.1, 0.1), "gaussian and ridges"),
    ],
)
def test_processes_and_ridges_together_must_be_clearly_better_than_one_kind(
    runs: list[Recording], monkeypatch: pytest.MonkeyPatch, shares: tuple[float, ...], family: str
) -> None:
    """What is better on some of few runs and worse on others is better by chance: it is the best of more trials."""
    inputs, rows, fold = prepared(runs)
    found = []
    for number, (name, left) in enumerate((("lags", 0.3), ("gaussian", 0.2), ("gaussian and ridges", 1.0))):
        member = RidgeMember(name, inputs, rows, fold, None, DEPARTURES)
        leaving(member, left, seed=number)
        assert member.errors is not None
        if name == "gaussian and ridges":
            residuals = zip(shares, member.errors.residual_um, strict=True)
            member.errors = replace(member.errors, residual_um=tuple(share * um for share, um in residuals))
        found.append(mean_of(name, [member], inputs, rows))
    assert found[2].score < found[1].score < found[0].score
    monkeypatch.setattr(ChosenProblem, "_mixed", lambda self, speeds: list(found))
    choice = ChosenProblem(("lags", "gaussian"), inputs, rows, fold, None).choice
    assert choice.family == family
    assert "gaussian and ridges leaves" in choice.why


def unlike(seed: int) -> Recording:
    """A run of a machine of which the sensors tell one channel well, by small differences, and next to nothing of z."""
    rng, minutes = np.random.default_rng(seed), 90
    heat = np.repeat(rng.uniform(0.0, 1.0, (minutes // 15, 2)), 15, axis=0)
    body = np.hstack(list(lag_table(np.arange(float(minutes)), heat, (15.0, 60.0))))
    places = 1.0 + np.random.default_rng(0).uniform(-0.05, 0.05, (4, SENSORS))
    exact = 22.0 + 10.0 * body @ places
    y_um = 30.0 * (exact[:, 0] - exact[:, 1]) + 10.0 * (exact[:, 2] - exact[:, 3])
    z_um = 5.0 * np.cumsum(rng.normal(size=minutes))
    return Recording(
        name=f"unlike {seed}",
        time_s=60.0 * np.arange(float(minutes)),
        speed_rpm=None,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=exact + rng.normal(0.0, 0.002, exact.shape),
        displacement_names=("y", "z"),
        displacements_um=np.column_stack([y_um, z_um]),
    )


def test_a_channel_that_the_sensors_tell_well_does_not_pay_for_one_of_which_they_tell_nothing() -> None:
    """One penalty for both damps what is known of y, because little damping makes noise of z."""
    both = [unlike(seed) for seed in range(6)]
    alone = [replace(run, displacement_names=("y",), displacements_um=run.displacements_um[:, :1]) for run in both]
    left_um = []
    for some in (both, alone):
        found = train_family(some, "default", sample_s=60.0, created="2026-01-01T00:00:00Z")
        assert found.choice is not None
        assert ("y, by itself, has" in found.choice.why) == (some[0].displacement_names == ("y", "z"))
        left_um.append(found.trust.band_um[0])
    assert left_um[0] < 1.3 * left_um[1]


def test_what_the_solutions_of_a_model_hold_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The daemon holds them all: where that is too much, the channels that gain most have members of their own."""
    runs = []
    for seed in range(6):
        run = unlike(seed)
        y_um, z_um = run.displacements_um.T
        noise_um = np.random.default_rng(seed).normal(0.0, 0.03, len(y_um))
        um = np.column_stack([y_um + noise_um, y_um, z_um])
        runs.append(replace(run, displacement_names=("noisy", "y", "z"), displacements_um=um))
    recipe = replace(RECIPES["default"], prepare=partial(ChosenProblem, ("ridge", "lags")))
    monkeypatch.setattr("models.thermal.training.choice.MOST_NUMBERS", 2 * SENSORS**2)
    problem = prepare(runs, 60.0, recipe).problem
    assert isinstance(problem, ChosenProblem)
    assert re.findall(r"(\w+), by itself, has", problem.choice.why) == ["y"]  # not the noisy one as well
