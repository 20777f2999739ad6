"""Models with lags: features, closed-form exclusion, sample-by-sample use, the file, the state's file."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from signed_models import signed
from sklearn.linear_model import Ridge

from models.model_file import ModelError
from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.estimation import UNSURE_UM
from models.thermal.estimator import LinearEstimator, excluded_sensors, readmitted
from models.thermal.family import model_from_json
from models.thermal.features import Design, lag_table
from models.thermal.known_history import ModelState
from models.thermal.linear import LinearModel
from models.thermal.training.families import Fit
from models.thermal.training.inputs import build_inputs
from models.thermal.training.prepared import prepare
from models.thermal.training.recipes import RECIPES
from models.thermal.training.ridge import RidgeProblem
from models.thermal.training.train_family import train_family

CREATED = "2026-01-01T00:00:00+00:00"
SENSORS = 5


def machine(cycles: int = 4, minutes: int = 120, seed: int = 0, noise_k: float = 0.02) -> Recording:
    """A spindle that heats two parts with different time constants; displacements follow them."""
    rng = np.random.default_rng(seed)
    speeds = rng.permutation(np.linspace(1500.0, 6000.0, cycles))
    rpm = np.concatenate([np.r_[np.full(minutes // 2, s), np.zeros(minutes - minutes // 2)] for s in speeds])
    time_min = np.arange(float(len(rpm)))
    heat = np.column_stack([(rpm / 6000.0) ** 2, rpm / 6000.0])
    parts = lag_table(time_min, heat, (12.0, 45.0))
    ambient = 0.3 * np.sin(time_min / 300.0)
    places = rng.uniform(0.2, 1.0, (4, SENSORS))
    body = np.hstack([parts[0], parts[1]])
    degc = 22.0 + 8.0 * body @ places + ambient[:, None] + rng.normal(0.0, noise_k, (len(rpm), SENSORS))
    um = 40.0 * parts[1][:, :1] + np.outer(parts[0][:, 1], [10.0, -25.0]) + 2.0 * ambient[:, None]
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
def recording() -> Recording:
    return machine()


@pytest.fixture(scope="module")
def model(recording: Recording) -> LinearModel:
    made = train_family([recording], "lags", sample_s=60.0, created=CREATED).model
    assert isinstance(made, LinearModel)
    return made


def default_fit(recording: Recording) -> tuple[Any, Fit]:
    prepared = prepare([recording], 60.0, RECIPES["lags"])
    return prepared.inputs, prepared.problem.fit()


def test_a_lag_is_exact_for_a_ramp_whatever_the_sampling() -> None:
    """For u = t the lag is t - tau (1 - exp(-t / tau))."""
    for steps in (1, 7, 100):
        time_min = np.linspace(0.0, 30.0, steps + 1)
        lagged = lag_table(time_min, time_min[:, None], (12.0,))[0, -1, 0]
        assert lagged == pytest.approx(30.0 - 12.0 * (1.0 - np.exp(-30.0 / 12.0)), rel=1e-12)


def test_the_ridge_is_that_of_scikit_learn(recording: Recording) -> None:
    inputs = build_inputs([recording], sample_s=60.0)
    rows = inputs.trainable()
    design = Design(departures=False)
    problem = RidgeProblem(inputs, rows, np.zeros(inputs.rows, dtype=np.intp), design)
    found = problem.solve(frozenset(), [1e-3])[0].coefficients()
    spread = inputs.features.std(axis=0)
    other = Ridge(alpha=1e-3 * inputs.rows, solver="svd").fit(inputs.features / spread, inputs.cleansed_um)
    np.testing.assert_allclose(found, (other.coef_ / spread).T, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("departures", [False, True])
@pytest.mark.parametrize("without", [(1,), (0, 3)])
def test_leaving_sensors_out_is_a_fit_without_them(
    recording: Recording, departures: bool, without: tuple[int, ...]
) -> None:
    inputs = build_inputs([recording], sample_s=60.0)
    rows, fold = inputs.trainable(), np.zeros(inputs.rows, dtype=np.intp)
    design = Design(departures=departures)
    solution = RidgeProblem(inputs, rows, fold, design).solve(frozenset(), [1e-2])[0]
    kept = [i for i in range(SENSORS) if i not in without]
    names = tuple(recording.temperature_names[i] for i in kept)
    fewer = Recording(
        name="fewer",
        time_s=recording.time_s,
        speed_rpm=recording.speed_rpm,
        temperature_names=names,
        temperatures_degc=recording.temperatures_degc[:, kept],
        displacement_names=recording.displacement_names,
        displacements_um=recording.displacements_um,
    )
    smaller = build_inputs([fewer], sample_s=60.0)
    # The relative penalty refers to the mean variance of the columns, which differs: match the absolute one.
    problem = RidgeProblem(smaller, rows, fold, design)
    whole = solution.remaining
    penalty = _absolute_penalty(RidgeProblem(inputs, rows, fold, design), 1e-2)
    again = problem.solve(frozenset(), [penalty / _absolute_penalty(problem, 1.0)])[0].coefficients()
    found = solution.coefficients(without)
    assert whole.min() >= 0.0
    assert np.all(found[inputs.layout.of_sensors(without)] == 0.0)
    np.testing.assert_allclose(np.delete(found, inputs.layout.of_sensors(without), axis=0), again, rtol=1e-6, atol=1e-8)


def _absolute_penalty(problem: RidgeProblem, relative: float) -> float:
    """From two relative penalties r and s of a direction with eigenvalue w: remaining = p / (w + p)."""
    solution = problem.solve(frozenset(), [relative])[0]
    other = problem.solve(frozenset(), [0.0 + 1e-30])[0]
    scale = np.abs(other.weights.T @ solution.directions)
    shrunk = np.abs(solution.weights.T @ solution.directions)
    strongest = int(np.argmin(solution.remaining))
    ratio = solution.remaining[strongest] / (1.0 - solution.remaining[strongest])
    assert scale[0, strongest] > shrunk[0, strongest] * 0.99
    eigenvalue = _largest_eigenvalue(problem)
    return float(ratio * eigenvalue)


def _largest_eigenvalue(problem: RidgeProblem) -> float:
    from models.thermal.training.ridge import _centred

    return float(np.linalg.eigvalsh(_centred(problem._pieces)[0])[-1])


def history(recording: Recording) -> list[tuple[float, FloatArray, float]]:
    assert recording.speed_rpm is not None
    return list(zip((recording.time_s / 60.0).tolist(), recording.temperatures_degc, recording.speed_rpm, strict=True))


def test_sample_by_sample_gives_what_the_whole_table_gives(recording: Recording, model: LinearModel) -> None:
    inputs, fit = default_fit(recording)
    estimator = LinearEstimator(model)
    samples = history(recording)
    reference = estimator.rebuild(samples[:101])
    assert reference is not None
    state = reference
    for time_min, degc, speed_rpm in samples[101:300]:
        state = estimator.advance(state, time_min, degc, speed_rpm, find_faults=False)
    estimation = estimator.estimate(state, reference)
    assert estimation is not None
    wanted = fit.estimate_um(inputs.features[299], inputs.features[100], 0.0)
    np.testing.assert_allclose(estimation.thermal_error_um, wanted, atol=1e-9)
    assert (estimation.imputed, estimation.outside, estimation.in_domain) == ((), (), True)


def at_random(recording: Recording, row: int) -> FloatArray:
    """Temperatures of a machine that does not stand as it did at the beginning of its recording."""
    degc = recording.temperatures_degc[row]
    assert np.ptp(degc - recording.temperatures_degc[0]) > 1.0
    return degc


def test_the_past_of_a_machine_at_rest_is_known_and_of_a_warm_one_becomes_so(
    recording: Recording, model: LinearModel
) -> None:
    estimator = LinearEstimator(model)
    whole = int(estimator.history_min)
    assert whole == 4.0 * max(model.layout.lags_min)
    rest, warm = recording.temperatures_degc[0], at_random(recording, 150)
    assert estimator.settled(estimator.begin(0.0, rest, 0.0)) > 0.99
    known = []
    for minutes in (0, whole // 8, whole // 2, whole + 1):
        state = estimator.rebuild((float(minute), warm, 0.0) for minute in range(minutes + 1))
        assert state is not None
        known.append(estimator.settled(state))
        np.testing.assert_allclose(state.unknown, np.exp(-minutes / estimator._past.constants_min), rtol=1e-9)
    assert known == sorted(known) and known[0] < 0.99 and known[-1] > 0.999


def test_a_watch_begins_where_a_temperature_was_measured(recording: Recording, model: LinearModel) -> None:
    """In some silent minutes it began at the middle of training: what stands elsewhere seemed to have jumped there."""
    estimator, silent = LinearEstimator(model), np.full(SENSORS, np.nan)
    state = estimator.rebuild([(float(minute), silent, 0.0) for minute in range(-3, 0)])
    assert state is not None
    elsewhere_k = np.array([8.0, 0.0, 0.0, 0.0, 0.0])
    for time_min, degc, rpm in history(recording)[:100]:
        state = estimator.advance(state, time_min, degc + elsewhere_k, rpm)
    assert state.watch is not None and state.watch.faults == ()


def test_a_silence_of_everything_is_the_same_with_rows_and_without(recording: Recording, model: LinearModel) -> None:
    """A recording has no rows where the daemon hears nothing; both must go on after it."""
    estimator = LinearEstimator(model)
    degc, silent = recording.temperatures_degc, np.full(SENSORS, np.nan)
    before = estimator.begin(0.0, degc[0], 0.0)
    for minute in range(1, 100):
        before = estimator.advance(before, float(minute), degc[minute], 0.0)
    with_rows = before
    for minute in range(100, 130):
        with_rows = estimator.advance(with_rows, float(minute), silent, float("nan"), bridged=True)
    after = [estimator.advance(each, 130.0, degc[130], 0.0, bridged=True) for each in (before, with_rows)]
    found = [estimator.estimate(each, before) for each in after]
    assert found[0] is not None and found[1] is not None and found[0].imputed == found[1].imputed == ()
    np.testing.assert_allclose(found[0].thermal_error_um, found[1].thermal_error_um, atol=1e-9)
    assert after[0].unknown.max() > before.unknown.max(), "what it took in of the gap is not known"
    cut = estimator.estimate(estimator.advance(before, 130.0, degc[130], 0.0), before)
    assert cut is None, "without the word that their past explains them nobody counts"


@pytest.fixture(scope="module")
def with_an_axis(recording: Recording) -> LinearModel:
    """A model that has the position of an axis behind the temperatures, hundreds of mm to and fro."""
    z_mm = 250.0 + 240.0 * np.sin(np.arange(recording.rows) / 7.0)
    moving = replace(
        recording,
        temperature_names=(*recording.temperature_names, "Z_mm"),
        temperatures_degc=np.column_stack([recording.temperatures_degc, z_mm]),
        axis_positions=("Z_mm",),
    )
    made = train_family([moving], "lags", sample_s=60.0, created=CREATED).model
    assert isinstance(made, LinearModel) and made.start is not None
    return made


def test_where_an_axis_has_dwelt_is_unknown_at_first_and_after_a_gap_of_its_position(
    recording: Recording, with_an_axis: LinearModel
) -> None:
    """Temperatures that are known, or at rest, tell nothing of it: half an hour elsewhere once passed unseen."""
    estimator, rest = LinearEstimator(with_an_axis), np.append(recording.temperatures_degc[0], 250.0)
    assert estimator.begin(0.0, rest, 0.0).unknown.min() == 1.0
    state = before = estimator.rebuild((float(minute), rest, 0.0) for minute in range(1000))
    assert state is not None and before is not None and before.unknown.max() < 0.1
    for minute in range(1000, 1031):
        row = np.append(rest[:SENSORS], 250.0 if minute == 1030 else np.nan)
        state = estimator.advance(state, float(minute), row, 0.0, bridged=True)
    gone = -np.expm1(-31.0 / estimator._past.constants_min)
    assert (state.unknown >= 0.9 * gone)[~estimator._past.of_speed].all()


def test_a_model_without_lags_knows_from_its_file_how_far_the_past_of_its_watch_is_unknown() -> None:
    made = train_family([machine(cycles=3)], "default", sample_s=60.0, created=CREATED).model
    assert isinstance(made, LinearModel) and made.layout.lags_min == () and made.watch is not None
    read = model_from_json(made.to_json(), "model.json")
    assert isinstance(read, LinearModel) and read.start is not None
    estimator = LinearEstimator(read)
    for off_k, unknown in ((0.0, 0.1), (30.0, 1.0)):
        state = estimator.begin(0.0, 22.0 + read.start.rest_degc + off_k * np.eye(SENSORS)[0], 0.0)
        assert state.watch is not None and state.watch.unknown == unknown


def test_a_temperature_that_hardly_moved_in_training_may_change_as_far_as_others(model: LinearModel) -> None:
    domain = model.domain
    width_k = domain.highest - domain.lowest
    quiet = replace(domain, highest=domain.highest.copy(), lowest=domain.lowest.copy())
    quiet.highest[0] = quiet.lowest[0] + 0.1
    estimator = LinearEstimator(replace(model, domain=quiet))
    usual_k = float(np.median(np.append(width_k[1:], 0.1)))
    degc = 0.5 * (domain.highest + domain.lowest)
    degc[0] = quiet.lowest[0]
    reference = estimator.begin(0.0, degc, 0.0)
    for change_k, inside in ((0.1 + 0.9 * usual_k, True), (0.1 + 1.1 * usual_k, False)):
        changed = degc.copy()
        changed[0] += change_k
        now = estimator.advance(reference, 1.0, changed, 0.0, find_faults=False)
        found = estimator.estimate(now, reference)
        assert found is not None and (not found.outside) is inside


@pytest.mark.parametrize(
    ("hall_k", "fahrenheit", "inside"), [(0.0, False, True), (18.0, False, True), (0.0, True, False)]
)
def test_a_hall_in_another_season_is_no_departure_and_another_unit_is(
    model: LinearModel, hall_k: float, fahrenheit: bool, inside: bool
) -> None:
    """What the estimate holds is the change: judged by level, a warm hall put the output on hold for a whole day."""
    estimator, domain = LinearEstimator(model), model.domain
    assert np.min(domain.highest - domain.lowest) < 18.0, "by their width alone not all ranges reach so far"
    then = domain.highest + hall_k
    rows = [then, then + 1.0]
    if fahrenheit:
        rows = [1.8 * row + 32.0 for row in rows]
    reference = estimator.begin(0.0, rows[0], 0.0)
    found = estimator.estimate(estimator.advance(reference, 1.0, rows[1], 0.0, find_faults=False), reference)
    assert found is not None and (not found.outside) is inside


def test_while_the_past_is_not_known_the_band_is_wider_and_confidence_low(
    recording: Recording, model: LinearModel
) -> None:
    estimator, warm = LinearEstimator(model), at_random(recording, 150)
    factors, confidences = [], []
    for minutes in (0, 240, 961):
        reference = estimator.rebuild((float(minute), warm, 0.0) for minute in range(minutes % 5, minutes + 1, 5))
        assert reference is not None
        state = reference
        for minute in range(minutes + 5, minutes + 200, 5):
            state = estimator.advance(state, float(minute), warm, 0.0, find_faults=False)
        found = estimator.estimate(state, reference)
        assert found is not None
        factors.append(float(np.max(found.band_factor)))
        confidences.append(found.confidence)
    assert factors == sorted(factors, reverse=True) and factors[0] > 1.05 and factors[-1] < 1.01
    assert confidences == sorted(confidences) and confidences[-1] > 0.9999


def test_a_long_gap_in_speed_is_unknown_and_a_short_one_is_not(recording: Recording, model: LinearModel) -> None:
    estimator = LinearEstimator(model)
    degc, of_speed = recording.temperatures_degc[0], estimator._past.of_speed
    state = estimator.rebuild((float(minute), degc, 0.0) for minute in range(961))
    assert state is not None and of_speed.any()

    def gap(begins_min: float, ends_min: float) -> ModelState:
        there = estimator.advance(state, begins_min, degc, find_faults=False)
        return estimator.advance(there, ends_min, degc, 0.0, find_faults=False)

    short, missed = gap(961.0, 962.0), gap(965.0, 969.0)
    assert short.unknown.max() < 0.02
    rare = estimator.rebuild((float(minute), degc, 0.0) for minute in range(0, 961, 5))
    assert rare is not None and estimator.advance(rare, 965.0, degc, 0.0).unknown.max() < 0.02
    np.testing.assert_allclose(
        missed.unknown[of_speed], 1.0 - np.exp(-9.0 / estimator._past.constants_min[of_speed]), atol=0.02
    )
    found = [estimator.estimate(each, state) for each in (short, missed)]
    assert found[0] is not None and found[0].speed_unread_um < 0.01, "the spindle may have begun to turn meanwhile:"
    assert found[1] is not None and found[1].speed_unread_um > UNSURE_UM and found[1].confidence > 0.0
    silent = state
    for minute in range(965, 1021, 5):
        silent = estimator.advance(silent, float(minute), degc)
    assert estimator.settled(silent) < estimator.settled(state)
    back = estimator.advance(silent, 1021.0, degc, 0.0)
    np.testing.assert_allclose(
        back.unknown[of_speed], 1.0 - np.exp(-61.0 / estimator._past.constants_min[of_speed]), atol=0.02
    )
    assert back.unknown[~of_speed].max() < 0.02


def test_a_lost_sensor_is_left_out_until_the_next_reference(recording: Recording, model: LinearModel) -> None:
    estimator = LinearEstimator(model)
    samples = history(recording)
    reference = estimator.rebuild(samples[:50])
    assert reference is not None

    def lost(minute: int) -> FloatArray:
        return np.where(np.arange(SENSORS) == 2, np.nan, samples[minute][1])

    state = estimator.advance(reference, 50.0, lost(50), samples[50][2])
    assert excluded_sensors(state, reference) == (2,)
    back = estimator.advance(state, 55.0, samples[55][1], samples[55][2])
    assert excluded_sensors(back, reference) == ()
    for minute in range(51, 70):
        state = estimator.advance(state, float(minute), lost(minute), samples[minute][2])
    late = estimator.advance(state, 70.0, samples[70][1], samples[70][2])
    assert excluded_sensors(late, reference) == (2,)
    estimation = estimator.estimate(late, reference)
    assert estimation is not None and estimation.imputed == (model.sensor_ids[2],)
    assert excluded_sensors(readmitted(late, (2,)), late) == ()


def test_lags_of_a_sensor_that_was_heard_for_one_row_go_on_from_where_they_were_begun(
    recording: Recording, model: LinearModel
) -> None:
    """Not from the middle of training, where one stands that was never heard."""
    estimator, samples = LinearEstimator(model), history(recording)
    states = []
    for heard in ([], [100, *range(105, 110)]):
        rows = [
            (t, degc if t in heard or not heard else np.where(np.arange(SENSORS) == 2, np.nan, degc), rpm)
            for t, degc, rpm in samples[:110]
        ]
        state = estimator.rebuild(rows, bridged=True)
        assert state is not None
        states.append(state)
    whole, once = states
    np.testing.assert_allclose(once.lagged[:, 2], whole.lagged[:, 2], atol=0.3)


def test_far_from_training_confidence_fades(recording: Recording, model: LinearModel) -> None:
    estimator = LinearEstimator(model)
    degc = recording.temperatures_degc[0]
    reference = estimator.rebuild((float(minute), degc, 0.0) for minute in range(961))
    assert reference is not None
    near = estimator.estimate(reference, reference)
    hot = estimator.advance(reference, 961.0, degc + 200.0, 0.0, find_faults=False)
    far = estimator.estimate(hot, reference)
    assert near is not None and far is not None
    assert near.confidence > 0.9999 and near.in_domain and np.max(near.band_factor) == 1.0
    assert far.confidence == 0.0 and not far.in_domain and far.outside == model.sensor_ids
    assert np.min(far.band_factor) >= 2.0


def test_the_file_gives_the_model_back(model: LinearModel) -> None:
    text = model.to_json()
    again = model_from_json(text, "m.json")
    assert isinstance(again, LinearModel)
    assert again.to_json() == text
    assert again.hyper_parameters == model.hyper_parameters
    np.testing.assert_array_equal(again.coefficients((1,)), model.coefficients((1,)))


def rewritten(model: LinearModel, change: Callable[[dict[str, Any]], None]) -> str:
    """Return the file after a change, with a checksum that fits it again."""
    content = json.loads(model.to_json())["model"]
    change(content)
    return signed(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c.update(sensor_names=c["sensor_names"][1:]), "sensor_names: 4 for 5 sensors in sensor_ids"),
        (lambda c: c.update(centre=[0.0]), "centre: has shape"),
        (
            lambda c: c["solutions"][0]["weights"][0].__setitem__(0, 1e9),
            r"test_vectors\[0\]: channel c1: the model gives",
        ),
        (lambda c: c.update(solutions=[]), "solutions: is empty"),
        (lambda c: c["watch"].update(threshold_k=[0.0] * 5), "watch.threshold_k: a limit is positive"),
        (lambda c: c.update(test_vectors=[]), "test_vectors: is empty"),
        (lambda c: c.update(layout={"sensors": 5, "lags_min": [-1], "speed_lags_min": []}), "layout"),
        (lambda c: c["domain"].update(leverage_limit=0.0), "leverage_limit: 0.0 must be positive"),
        (lambda c: c.pop("watch"), "watch: is missing"),
        (lambda c: c["solutions"][0]["directions"].update(float32="AAAA"), "holds 3 bytes, which is no matrix"),
        (lambda c: c["solutions"][0]["directions"].update(float32="?"), "float32 is not base64"),
        (lambda c: c.update(extra=1), "extra: is not a key of this format"),
    ],
)
def test_a_file_that_cannot_be_right_is_refused(model: LinearModel, change: Any, sentence: str) -> None:
    with pytest.raises(ModelError, match=sentence):
        model_from_json(rewritten(model, change), "m.json")


def test_a_changed_or_foreign_file_is_refused(model: LinearModel) -> None:
    text = model.to_json()
    with pytest.raises(ModelError, match="sha256: does not fit"):
        model_from_json(text.replace('"kind": "lags"', '"kind": "other"'), "m.json")
    with pytest.raises(ModelError, match=r"m\.json: format_version: 7 is unknown"):
        model_from_json(text.replace('"format_version": 3', '"format_version": 7'), "m.json")
    with pytest.raises(ModelError, match="this is not JSON"):
        model_from_json(text[: len(text) // 2], "m.json")
