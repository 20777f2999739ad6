"""Sensors that return to a model with lags: no step, lags that follow, and what was wrong fades."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.estimation import Machine, OnlineReference
from models.thermal.estimator import LinearEstimator
from models.thermal.features import lag_table
from models.thermal.known_history import ModelState
from models.thermal.linear import LinearModel
from models.thermal.rebase import StateReference, estimate_since, rebased, returning, state_reference
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import build_inputs, temperatures_alone
from models.thermal.training.train_family import train_family
from models.thermal.training.watch_fit import fit_watch

SENSORS = 5
MINUTES = 1500
REFERENCE = 1000


def machine(seed: int) -> Recording:
    """A spindle that heats two parts; five sensors see them in other shares."""
    rng = np.random.default_rng(seed)
    rpm = np.resize(np.repeat(rng.permutation([0.0, 6000.0, 2000.0, 4500.0, 3000.0]), 60), MINUTES)
    time_min = np.arange(float(MINUTES))
    heat = np.column_stack([(rpm / 6000.0) ** 2, rpm / 6000.0])
    body = np.hstack(list(lag_table(time_min, heat, (12.0, 60.0))))
    places = np.random.default_rng(0).uniform(0.2, 1.0, (4, SENSORS))
    degc = 22.0 + 8.0 * body @ places + rng.normal(0.0, 0.02, (MINUTES, SENSORS))
    um = body @ np.array([[10.0, -25.0], [5.0, 10.0], [40.0, 3.0], [0.0, 20.0]])
    return Recording(
        name=f"machine{seed}",
        time_s=60.0 * time_min,
        speed_rpm=rpm,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=degc,
        displacement_names=("c1", "c2"),
        displacements_um=um + rng.normal(0.0, 0.05, um.shape),
    )


@pytest.fixture(scope="module")
def model() -> LinearModel:
    made = train_family([machine(0)], "lags", sample_s=60.0, created="2026-01-01T00:00:00+00:00").model
    assert isinstance(made, LinearModel)
    return made


@pytest.fixture(scope="module")
def at_reference(model: LinearModel) -> ModelState:
    return Run(model).state


class Run:
    """A recording played to a model minute by minute, as the daemon does it."""

    of = machine(5)

    def __init__(self, model: LinearModel, at_reference: ModelState | None = None) -> None:
        self.estimator = LinearEstimator(model)
        state = at_reference or self.estimator.rebuild(self._sample(minute) for minute in range(REFERENCE))
        assert state is not None
        self.state: ModelState = state
        self.reference: StateReference = state_reference(self.estimator, state)
        self.minute = REFERENCE
        self.absent: set[int] = set()

    def _sample(self, minute: int) -> tuple[float, FloatArray, float]:
        assert self.of.speed_rpm is not None
        return float(minute), self.of.temperatures_degc[minute].copy(), float(self.of.speed_rpm[minute])

    def run(self, minutes: int, gone: tuple[int, ...] = (), offset_k: FloatArray | float = 0.0) -> FloatArray:
        """Go on; return the thermal error of every minute [um]."""
        errors = []
        for _ in range(minutes):
            time_min, degc, speed = self._sample(self.minute)
            degc += offset_k
            degc[list(gone)] = np.nan
            self.state = self.estimator.advance(self.state, time_min, degc, speed)
            back = returning(self.estimator, self.state, self.reference, sorted(self.absent))
            if back and (found := rebased(self.estimator, self.state, self.reference, back)) is not None:
                self.state, self.reference = found
            self.absent = set(gone)
            estimation = estimate_since(self.estimator, self.state, self.reference)
            if estimation is not None:
                self.latest = estimation
                errors.append(estimation.thermal_error_um)
            self.minute += 1
        return np.array(errors)


def test_what_is_imputed_is_what_the_fit_without_the_sensors_takes_theirs_for(model: LinearModel) -> None:
    rng = np.random.default_rng(1)
    for without in ((0,), (1, 3), (0, 2, 4)):
        change = rng.normal(0.0, 1.0, model.layout.columns)
        for ridge in model.solutions:
            whole = ridge.imputed(change, without) @ ridge.coefficients()
            np.testing.assert_allclose(whole, change @ ridge.coefficients(without), atol=1e-6)
        found = LinearEstimator(model).left_out.imputed(change, without)
        others = np.delete(np.arange(model.layout.columns), model.layout.of_sensors(without))
        np.testing.assert_array_equal(found[others], change[others])


@pytest.mark.parametrize(("away_min", "offset_k"), [(3, 1.5), (40, -8.0), (200, 0.0)])
def test_a_sensor_that_returns_moves_nothing_and_then_counts(
    model: LinearModel, away_min: int, offset_k: float
) -> None:
    run, frame = Run(model), np.where(np.arange(SENSORS) == 1, offset_k, 0.0)
    usual = np.abs(np.diff(run.run(100), axis=0)).max()
    gone = run.run(away_min, gone=(1,))
    assert run.latest.imputed == (model.sensor_ids[1],)
    assert run.latest.confidence > 0.4, "four of five sensors are there, and they have not gone far"
    back = run.run(30, offset_k=frame)
    assert not run.latest.imputed and run.latest.confidence > 0.6
    assert np.abs(back[0] - gone[-1]).max() < 2.0 * usual, "no step"
    assert np.abs(np.diff(back, axis=0)).max() < 2.0 * usual
    estimation = run.latest.thermal_error_um
    assert np.abs(run.run(1, offset_k=frame + np.eye(SENSORS)[1])[-1] - estimation).max() > 0.05, "it counts"


def test_what_a_sensor_was_imputed_with_until_it_was_set_anew_stays_in_doubt(model: LinearModel) -> None:
    """It goes on from there: what that was off is off from then on."""
    before = Run(model)
    blind = replace(before.state, missing=np.arange(SENSORS) == 1)
    run = Run(model, blind)
    run.run(100, gone=(1,))
    unsure_um = run.latest.imputed_um
    assert unsure_um > 0.0
    run.run(1)
    assert (run.latest.imputed, run.latest.imputed_um) == ((), pytest.approx(unsure_um, rel=0.3))
    settled_um = run.latest.imputed_um
    run.run(50)
    assert run.latest.imputed_um == settled_um


def test_a_return_leaves_the_estimate_as_good_as_it_is_without_an_absence(model: LinearModel) -> None:
    undisturbed, disturbed = Run(model), Run(model)
    frame = np.where(np.arange(SENSORS) == 1, 5.0, 0.0)
    undisturbed.run(100)
    disturbed.run(100)
    undisturbed.run(120)
    disturbed.run(120, gone=(1,))
    whole, back = undisturbed.run(150), disturbed.run(150, offset_k=frame)
    assert np.abs(whole).max() > 10.0
    assert np.abs(whole - back).max() < 1.5, "an offset of 5 K is not taken for a movement"


def test_lags_started_from_a_guess_follow_the_sensor(model: LinearModel) -> None:
    """What was guessed about the lags is forgotten with them: a later reference is not biased."""
    run, other = Run(model), Run(model)
    run.run(100)
    run.run(200, gone=(2,))
    run.run(1)
    other.run(301)
    guess = np.abs(run.state.lagged[:, 2] - other.state.lagged[:, 2])
    assert guess.max() < 0.5
    run.run(190)
    other.run(190)
    left = np.abs(run.state.lagged[:, 2] - other.state.lagged[:, 2])
    faded = np.exp(-190.0 / np.array(model.layout.lags_min))
    np.testing.assert_allclose(left, guess * faded, atol=1e-9)


def test_what_the_watch_found_wrong_does_not_return(model: LinearModel) -> None:
    run = Run(model)
    run.run(5)
    run.run(3, offset_k=np.where(np.arange(SENSORS) == 4, 30.0, 0.0))
    run.run(20, gone=(4,))
    run.run(3)
    assert run.latest.imputed == (model.sensor_ids[4],)


@given(
    gone=st.lists(
        st.tuples(st.sets(st.integers(0, SENSORS - 1), max_size=SENSORS - 1), st.integers(1, 25)),
        min_size=1,
        max_size=6,
    ),
    offsets=st.lists(st.floats(-6.0, 6.0), min_size=SENSORS, max_size=SENSORS),
)
@settings(max_examples=25, deadline=None)
def test_whoever_comes_and_goes_a_return_is_never_a_step(
    at_reference: ModelState, model: LinearModel, gone: list[tuple[set[int], int]], offsets: list[float]
) -> None:
    """In the minute of a return the estimate is what it is without those who return."""
    run = Run(model, at_reference)
    for sensors, minutes in gone:
        run.run(minutes, gone=tuple(sensors))
        time_min, degc, speed = run._sample(run.minute)
        state = run.estimator.advance(run.state, time_min, degc + np.array(offsets), speed)
        back = returning(run.estimator, state, run.reference, sorted(run.absent))
        found = rebased(run.estimator, state, run.reference, back) if back else None
        if found is None:
            continue
        hidden = replace(found[0], missing=np.isin(np.arange(SENSORS), back))
        before = estimate_since(run.estimator, hidden, run.reference)
        after = estimate_since(run.estimator, *found)
        assert before is not None and after is not None
        np.testing.assert_allclose(after.thermal_error_um, before.thermal_error_um, atol=1e-6)
        run.run(5, offset_k=np.array(offsets))


@pytest.fixture(scope="module")
def watching(model: LinearModel) -> LinearModel:
    """The model with a watch on its sensors, as the default has one, without the search for the default's families."""
    recorded = temperatures_alone([machine(0)])
    inputs = build_inputs(recorded, sample_s=60.0)
    rows = inputs.trainable()
    return replace(model, watch=fit_watch(recorded, 60.0, rows, inner_folds(inputs, rows)[0]))


def after_a_drift(
    model: LinearModel,
    drift_k_per_h: float,
    *,
    told: bool = False,
    off_k: float = 0.0,
    back_min: float = 0.0,
    shift_k: float = 0.0,
    shifted: int = 2,
) -> tuple[FloatArray, list[int]]:
    """A sensor drifts for an hour and a half, is right again, and ten minutes later the work is positioned.

    Returns the thermal error of every minute since then [um], and who counts no longer in the end.

    `told`: cleansing has told the jump. `off_k`: so far beside training the sensor's place is. `back_min`: it has gone
    back over so long, instead of at once [min]. `shift_k`: what is taken off the sensor `shifted` since
    that came back at another level.
    """
    of, none = machine(5), np.zeros(SENSORS, dtype=bool)
    of = replace(of, temperatures_degc=of.temperatures_degc + off_k * (np.arange(SENSORS) == shifted))
    jumped_k = -drift_k_per_h * 89.0 / 60.0 * (np.arange(SENSORS) == 2) * told
    assert of.speed_rpm is not None
    online = model.runtime(Machine(components={}))
    online.rebuild([(float(i), of.temperatures_degc[i], float(of.speed_rpm[i])) for i in range(REFERENCE)])
    first = OnlineReference(time_min=REFERENCE - 1.0, now_min=REFERENCE - 1.0, degc=of.temperatures_degc[REFERENCE - 1])
    online.set_reference(first)
    errors = []
    for minute in range(160):
        time_min, degc = float(REFERENCE + minute), of.temperatures_degc[REFERENCE + minute].copy()
        degc[2] += (
            drift_k_per_h
            / 60.0
            * min(minute, (90 - minute) * (90.0 / back_min - 1.0) if back_min else 90.0)
            * (minute < 90)
        )
        if minute == 90:
            online.jumped(jumped_k)
        online.on_sample(time_min, degc, float(of.speed_rpm[REFERENCE + minute]))
        if minute == 100:
            shift = shift_k * (np.arange(SENSORS) == shifted)
            again = OnlineReference(time_min=time_min, now_min=time_min, degc=degc, jumped_k=jumped_k, shift_k=shift)
            online.set_reference(again)
        estimation, _ = online.estimate(time_min, degc, none)
        assert estimation is not None
        if minute >= 100:
            errors.append(estimation.thermal_error_um)
    return np.array(errors), list(online.excluded)


@pytest.mark.parametrize("back_min", [0.0, 20.0, 60.0], ids=["at once", "in 20 min", "in an hour"])
def test_a_sensor_that_is_right_again_leaves_nothing_behind_once_the_work_is_positioned(
    watching: LinearModel, back_min: float
) -> None:
    clean, _ = after_a_drift(watching, 0.0)
    after, excluded = after_a_drift(watching, 12.0, back_min=back_min)
    np.testing.assert_allclose(after, clean, atol=0.1)
    assert excluded == []


@pytest.mark.parametrize("off_k", [0.0, 0.7], ids=["as in training", "beside training"])
@pytest.mark.parametrize("watched", [True, False])
def test_nor_does_one_whose_jump_was_taken_for_another_level(
    model: LinearModel, watching: LinearModel, watched: bool, off_k: float
) -> None:
    """At the level of now what it said while it drifted is as wrong as the jump: a campaign found 1.4 um."""
    some = watching if watched else replace(model, watch=None)
    clean, _ = after_a_drift(some, 0.0, off_k=off_k)
    after, excluded = after_a_drift(some, 12.0, told=True, off_k=off_k)
    np.testing.assert_allclose(after, clean, atol=0.3)
    assert excluded == []


@pytest.mark.parametrize(("shifted", "shift_k", "told"), [(2, 6.0, True), (2, 6.0, False), (0, -10.0, False)])
def test_nor_does_one_where_a_sensor_came_back_otherwise_than_was_explained(
    watching: LinearModel, shifted: int, shift_k: float, told: bool
) -> None:
    """With what is taken off for that it is not where the others expect it: two random histories found 1 um."""
    how: dict[str, Any] = {"off_k": -shift_k, "shift_k": shift_k, "shifted": shifted}
    clean, _ = after_a_drift(watching, 0.0, **how)
    after, _ = after_a_drift(watching, 5.0, told=told, **how)
    np.testing.assert_allclose(after, clean, atol=0.1)


def test_a_reference_that_another_one_was_refused_for_is_counted_from_as_before(model: LinearModel) -> None:
    """What lags were moved by when a sensor returned was added once more: a random history found 1.3 um in ACTIVE."""
    of, now, back = machine(5), REFERENCE + 60, REFERENCE + 20
    table, rpm = of.temperatures_degc.copy(), np.zeros(MINUTES) if of.speed_rpm is None else of.speed_rpm
    table[REFERENCE - 30 : back, 2] = np.nan
    table[back:, 2] += 5.0

    def told(until: int) -> Iterator[tuple[float, FloatArray, float]]:
        return ((float(row), table[row], float(rpm[row])) for row in range(until + 1))

    online, away = model.runtime(Machine(components={})), np.zeros(SENSORS, dtype=bool)
    online.rebuild(told(REFERENCE))
    first = OnlineReference(time_min=float(REFERENCE), now_min=float(REFERENCE), degc=table[REFERENCE])
    online.set_reference(first)
    for row in range(REFERENCE + 1, now + 1):
        online.on_sample(float(row), table[row], float(rpm[row]))
        before, _ = online.estimate(float(row), table[row], away)
    kept = online.kept
    assert kept is not None and np.abs(kept["shift_degc"]).max() > 0.5
    online.set_reference(OnlineReference(time_min=float(now), now_min=float(now), degc=table[now]))
    online.set_reference(replace(first, now_min=float(now), history=told(REFERENCE), excluded={}, kept=kept))
    after, _ = online.estimate(float(now), table[now], away)
    assert before is not None and after is not None
    np.testing.assert_allclose(after.thermal_error_um, before.thermal_error_um, atol=1e-6)


def test_a_healthy_sensor_that_was_blamed_goes_on_with_its_own_lags_once_the_work_is_positioned(
    watching: LinearModel,
) -> None:
    """What the others expect of it is off beyond training: a campaign found 1.2 um."""
    of, none = machine(5), np.zeros(SENSORS, dtype=bool)
    assert of.speed_rpm is not None
    table = of.temperatures_degc.copy()
    table[REFERENCE - 10 :, [0, 1, 3, 4]] += 3.0  # coolant that reaches all others
    estimates = []
    for blamed in (False, True):
        online = watching.runtime(Machine(components={}))
        online.rebuild([(float(i), table[i], float(of.speed_rpm[i])) for i in range(REFERENCE)])
        degc, at_min = table[REFERENCE], float(REFERENCE)
        online.on_sample(at_min, degc, float(of.speed_rpm[REFERENCE]))
        positioned = OnlineReference(time_min=at_min, now_min=at_min, degc=degc)
        if blamed:
            online.set_reference(replace(positioned, excluded={watching.sensor_ids[2]: "departure"}))
        assert online.set_reference(positioned) == ((watching.sensor_ids[2],) if blamed else ())
        errors = []
        for row in range(REFERENCE + 1, REFERENCE + 10):
            online.on_sample(float(row), table[row], float(of.speed_rpm[row]))
            found, _ = online.estimate(float(row), table[row], none)
            assert found is not None
            errors.append(found.thermal_error_um)
        estimates.append(np.array(errors))
    np.testing.assert_allclose(estimates[1], estimates[0], atol=1e-9)


def positioned_again(model: LinearModel, table: FloatArray, rpm: FloatArray, after: int) -> tuple[FloatArray, ...]:
    """Position the work, and so many minutes later again.

    Returns the thermal error of every minute of the hour after that [um], whether it is followed, and who was blamed.
    """
    online, none = model.runtime(Machine(components={})), np.zeros(SENSORS, dtype=bool)
    online.rebuild((float(i), table[i], float(rpm[i])) for i in range(REFERENCE - 400, REFERENCE))
    errors, followed, blamed = [], [], 0
    for minute in range(REFERENCE, REFERENCE + after + 60):
        now_min, degc = float(minute), table[minute]
        online.on_sample(now_min, degc, float(rpm[minute]))
        if minute in (REFERENCE, REFERENCE + after):
            blamed = len(online.excluded)
            online.set_reference(OnlineReference(time_min=now_min, now_min=now_min, degc=degc))
        found, _ = online.estimate(now_min, degc, none)
        if minute >= REFERENCE + after:
            errors.append(np.full(2, np.nan) if found is None else found.thermal_error_um)
            followed.append(
                found is not None and found.in_domain and found.confidence >= 0.5 and found.imputed_um < 1.0
            )
    return np.array(errors), np.array(followed), np.array(blamed)


@pytest.mark.parametrize(
    ("splash_k", "ambient_k", "drift_k"),
    [(10.0, 0.0, 0.0), (-10.0, 0.0, 0.0), (0.0, 12.0, 0.0), (0.0, -12.0, 0.0), (0.0, 0.0, 8.0)],
)
def test_sensors_that_were_blamed_end_at_the_truth_or_unsure_once_the_work_is_positioned(
    watching: LinearModel, splash_k: float, ambient_k: float, drift_k: float
) -> None:
    """The truth is what the model says when nobody is ever blamed: up to 1.9 um beside it with full confidence.

    Coolant that reaches all sensors but one, a hall that warms and cools, and a sensor that drifts and is right again.
    """
    nobody, blamed, sure = replace(watching, watch=None), 0, 0
    for seed in (6, 7, 8, 11):
        of, since = machine(seed), np.arange(MINUTES) - REFERENCE
        assert of.speed_rpm is not None
        true = of.temperatures_degc + np.where(since >= 0, ambient_k * (1.0 - np.exp(-since / 30.0)), 0.0)[:, None]
        true[since >= 5] += splash_k * (np.arange(SENSORS) != 2)
        said = true.copy()
        said[:, 1] -= np.where((since >= -25) & (since < 15), 0.25 * np.clip(since + 25, 0, 20), 0.0) * drift_k / 5.0
        for after in (20, 42, 90):
            truth_um, *_ = positioned_again(nobody, true, of.speed_rpm, after)
            found_um, followed, count = positioned_again(watching, said, of.speed_rpm, after)
            assert np.abs(found_um - truth_um)[followed].max(initial=0.0) <= 1.0
            blamed, sure = blamed + int(count), sure + int(followed.sum())
    assert blamed > 0 and sure > 0


def taken_up(
    model: LinearModel, *, gone_at_reference: bool = False, begins: int = 0
) -> tuple[list[FloatArray], list[tuple[int, ...]], float]:
    """Restart five hours after the work was positioned.

    Returns the thermal error of every minute [um], who was set anew, and what is in doubt in the end [um].
    """
    of, none, now = machine(5), np.zeros(SENSORS, dtype=bool), REFERENCE + 300
    assert of.speed_rpm is not None
    table, speed = of.temperatures_degc, of.speed_rpm
    before = [(float(i), table[i].copy(), float(speed[i])) for i in range(REFERENCE + 1)]
    if gone_at_reference:
        before[-1][1][1] = np.nan
    online = model.runtime(Machine(components={}))
    online.rebuild((float(i), table[i], float(speed[i])) for i in range(begins, now))
    then = OnlineReference(
        time_min=float(REFERENCE), now_min=float(now), degc=table[REFERENCE], history=before, excluded={}
    )
    online.set_reference(then)
    errors, anew = [], []
    for minute in range(now, now + 20):
        degc = table[minute]
        online.on_sample(float(minute), degc, float(speed[minute]))
        estimation, found = online.estimate(float(minute), degc, none)
        assert estimation is not None, "every sensor counts"
        assert estimation.imputed == ()
        errors.append(estimation.thermal_error_um)
        anew.append(found)
    return errors, anew, estimation.imputed_um


def test_a_sensor_that_a_reference_holds_is_not_set_anew_when_it_is_taken_up(model: LinearModel) -> None:
    as_held, _, _ = taken_up(model)
    found, anew, unsure_um = taken_up(model, gone_at_reference=True)
    assert not any(anew) and unsure_um == 0.0
    np.testing.assert_allclose(found, as_held, atol=0.02)


@pytest.mark.parametrize(
    ("off_k", "again"), [(0.0, True), (-0.8, False), (-4.0, False)], ids=["itself", "nearly", "not at all"]
)
def test_a_sensor_that_slewed_counts_again_once_it_says_what_the_others_expect(
    model: LinearModel, off_k: float, again: bool
) -> None:
    """In the air of a door that was open for some minutes it was out for the rest of the run."""
    run, online = Run.of, model.runtime(Machine(components={}))
    assert run.speed_rpm is not None
    for minute in range(200, REFERENCE + 70):
        degc = run.temperatures_degc[minute].copy()
        degc[1] += 0.0 if minute < REFERENCE + 20 else -4.0 if minute < REFERENCE + 24 else off_k
        online.on_sample(float(minute), degc, float(run.speed_rpm[minute]))
        if minute == REFERENCE:
            online.set_reference(OnlineReference(time_min=minute, now_min=minute, degc=degc))
        if minute in (REFERENCE + 22, REFERENCE + 45):
            assert online.excluded == {model.sensor_ids[1]: "slew"}
    assert online.excluded == ({} if again else {model.sensor_ids[1]: "slew"})
