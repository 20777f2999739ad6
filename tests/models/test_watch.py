"""The watch of the temperature sensors: what is found, when, and what is not."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.records import FloatArray
from models.thermal.features import lag_table
from models.thermal.sensor_watch import SensorWatch, departure_maps, without_columns
from models.thermal.training.folds import inner_folds
from models.thermal.training.inputs import build_inputs
from models.thermal.training.making import fit_start
from models.thermal.training.watch_fit import fit_watch
from models.thermal.watch import Watcher, WatchState, usual_step_k

SENSORS = 6


def recording(hours: int = 16) -> Recording:
    rng = np.random.default_rng(5)
    time_min = np.arange(60.0 * hours)
    rpm = np.where((time_min // 60) % 2 == 0, 2000.0 + 1000.0 * ((time_min // 120) % 3), 0.0)
    heat = ((rpm / 4000.0) ** 2)[:, None]
    parts = lag_table(time_min, np.hstack([heat, heat]), (10.0, 40.0))
    body = np.column_stack([parts[0][:, 0], parts[1][:, 0]])
    degc = 22.0 + 9.0 * body @ rng.uniform(0.3, 1.0, (2, SENSORS)) + rng.normal(0.0, 0.02, (len(rpm), SENSORS))
    return Recording(
        name="watched",
        time_s=60.0 * time_min,
        speed_rpm=rpm,
        temperature_names=tuple(f"T{i + 1}" for i in range(SENSORS)),
        temperatures_degc=degc,
        displacement_names=("c1",),
        displacements_um=20.0 * body[:, :1],
    )


@pytest.fixture(scope="module")
def whole() -> Recording:
    return recording()


@pytest.fixture(scope="module")
def watch(whole: Recording) -> SensorWatch:
    inputs = build_inputs([whole], sample_s=60.0)
    rows = inputs.rows_between(0.0, 12.0)
    return fit_watch([whole], 60.0, rows, inner_folds(inputs, rows)[0])


def follow(
    watch: SensorWatch, whole: Recording, degc: FloatArray, first: int = 600, steps_k: tuple[float, ...] = ()
) -> WatchState:
    assert whole.speed_rpm is not None
    watcher = Watcher(watch, steps_k)
    state = watcher.begin(0.0, degc[0], float(whole.speed_rpm[0]))
    for row in range(1, whole.rows):
        speed_rpm = float(whole.speed_rpm[row])
        state = watcher.step(state, float(row), degc[row], speed_rpm, find_faults=row >= first)
    return state


def test_a_healthy_machine_blames_nobody(watch: SensorWatch, whole: Recording) -> None:
    assert follow(watch, whole, whole.temperatures_degc).faults == ()


@pytest.mark.parametrize("sensor", [0, 3])
@pytest.mark.parametrize(
    ("fault", "sign", "within_min"),
    [
        (lambda t: np.where(t >= 0, 5.0, 0.0), "slew", 0.0),
        (lambda t: np.where(t >= 0, 800.0, 0.0), "slew", 0.0),
        (lambda t: np.where(t == 0, 4.0, 0.0), "slew", 0.0),
        (lambda t: np.where(t >= 0, t / 30.0, 0.0), "departure", 60.0),
    ],
    ids=["step", "open", "spike", "drift"],
)
def test_a_fault_is_blamed_on_the_sensor_that_has_it(
    watch: SensorWatch, whole: Recording, sensor: int, fault: object, sign: str, within_min: float
) -> None:
    assert callable(fault)
    degc = whole.temperatures_degc.copy()
    degc[:, sensor] += fault(np.arange(whole.rows) - 760.0)
    (fault,) = follow(watch, whole, degc).faults
    assert (fault.sensor, fault.sign) == (sensor, sign)
    assert 0.0 <= fault.time_min - 760.0 <= within_min


def test_a_stuck_sensor_is_blamed_after_the_time_that_training_allows(watch: SensorWatch, whole: Recording) -> None:
    degc = whole.temperatures_degc.copy()
    degc[760:, 2] = degc[760, 2]
    (fault,) = follow(watch, whole, degc).faults
    assert (fault.sensor, fault.sign, fault.time_min) == (2, "flat", 760.0 + watch.flat_min[2])


def test_a_missing_sensor_is_excluded_after_what_is_bridged(watch: SensorWatch, whole: Recording) -> None:
    degc = whole.temperatures_degc.copy()
    degc[700:705, 1] = np.nan
    degc[760:, 4] = np.nan
    (fault,) = follow(watch, whole, degc).faults
    assert (fault.sensor, fault.sign, fault.time_min) == (4, "missing", 770.0)


def test_a_line_that_is_heard_later_than_another_has_not_slewed(watch: SensorWatch, whole: Recording) -> None:
    """After a restart one line only is there; sensors that nobody heard stand at their mean of training, not of now."""
    watcher, first, degc = Watcher(watch), 600, whole.temperatures_degc + 15.0
    there = np.arange(degc.shape[1]) < 2
    state = watcher.begin(float(first), np.where(there, degc[first], np.nan), float(whole.speed_rpm[first]))
    for row in range(first + 1, first + 120):
        heard = degc[row] if row >= first + 3 else np.where(there, degc[row], np.nan)
        state = watcher.step(state, float(row), heard, float(whole.speed_rpm[row]))
        assert state.excluded == ()
    spoilt = degc[first + 120] + 8.0 * ~there * (np.arange(len(there)) == 3)
    assert watcher.step(state, float(first + 120), spoilt, 0.0).excluded == (3,), "what it does from now on counts"


def test_two_faults_at_once_are_both_found(watch: SensorWatch, whole: Recording) -> None:
    degc = whole.temperatures_degc.copy()
    drift = np.arange(200.0) / 20.0
    degc[760:, [1, 4]] += drift[:, None] * [1.0, -1.0]
    assert {fault.sensor for fault in follow(watch, whole, degc).faults} == {1, 4}


@pytest.mark.parametrize("amount_k", [0.6, 3.0])
def test_what_no_sensor_explains_is_blamed_on_nobody(watch: SensorWatch, whole: Recording, amount_k: float) -> None:
    """Three sensors, half of all, see a draught that the others do not: the machine is unusual, no sensor is broken."""
    degc = whole.temperatures_degc.copy()
    draught = amount_k * np.clip((np.arange(float(whole.rows)) - 760.0) / 30.0, 0.0, 1.0)
    degc[:, :3] += draught[:, None]
    state = follow(watch, whole, degc)
    assert Watcher(watch).relative_departures(state, ()).max() > 2.0
    assert state.faults == ()


def test_two_faults_one_after_the_other_are_both_found(watch: SensorWatch, whole: Recording) -> None:
    degc = whole.temperatures_degc.copy()
    degc[700:, 1] += 6.0
    degc[:, 5] += np.maximum(np.arange(whole.rows) - 760.0, 0.0) / 30.0
    assert follow(watch, whole, degc).excluded == (1, 5)


def test_leaving_columns_out_of_a_precision_is_inverting_without_them() -> None:
    rng = np.random.default_rng(2)
    samples = rng.normal(size=(50, 6))
    covariance = samples.T @ samples / 50.0 + 0.1 * np.eye(6)
    kept = np.array([0, 2, 3, 5])
    found = without_columns(np.linalg.inv(covariance), [1, 4])(kept)
    np.testing.assert_allclose(found[:, kept], np.linalg.inv(covariance[np.ix_(kept, kept)]), rtol=1e-9)
    assert np.all(found[:, [1, 4]] == 0.0)


def test_a_departure_is_the_residual_of_a_ridge_regression_on_the_other_sensors(
    watch: SensorWatch, whole: Recording
) -> None:
    layout = watch.layout
    covariance = np.linalg.inv(watch.precision)
    own = layout.of_sensors([2])
    others = np.setdiff1d(np.arange(layout.columns), own)
    weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, own[0]])
    columns = np.random.default_rng(1).normal(size=layout.columns)
    maps, _ = departure_maps(layout, watch.precision, watch.gain)
    by_regression = (columns[own[0]] - columns[others] @ weights) / watch.gain[own[0]]
    assert maps[2] @ columns == pytest.approx(by_regression, rel=1e-6)


def test_a_constant_sensor_neither_counts_nor_disturbs(whole: Recording) -> None:
    degc = whole.temperatures_degc.copy()
    degc[:, 3] = 25.0
    flat = replace(whole, temperatures_degc=degc)
    inputs = build_inputs([flat], sample_s=60.0)
    rows = inputs.trainable()
    fitted = fit_watch([flat], 60.0, rows, inner_folds(inputs, rows)[0])
    assert np.isfinite(fitted.precision).all()
    assert follow(fitted, flat, degc).faults == ()


def in_steps(recorded: Recording, step_k: float = 0.25) -> Recording:
    """The recording of sensors that count in steps, as many loggers do."""
    return replace(recorded, temperatures_degc=np.round(recorded.temperatures_degc / step_k) * step_k)


def test_a_sensor_that_counts_in_steps_may_stand_still_with_the_machine_and_not_against_it(whole: Recording) -> None:
    stepped = in_steps(whole)
    inputs = build_inputs([stepped], sample_s=60.0)
    rows = inputs.rows_between(0.0, 12.0)
    stepped_watch = fit_watch([stepped], 60.0, rows, inner_folds(inputs, rows)[0])
    assert stepped.speed_rpm is not None
    rest = np.repeat(stepped.temperatures_degc[:1], 400, axis=0)
    resting = replace(
        stepped,
        time_s=60.0 * np.arange(float(stepped.rows + 400)),
        speed_rpm=np.concatenate([np.repeat(stepped.speed_rpm[:1], 400), stepped.speed_rpm]),
        temperatures_degc=np.vstack([rest, stepped.temperatures_degc]),
        displacements_um=np.zeros((stepped.rows + 400, 1)),
    )
    assert (stepped_watch.flat_min < 400.0).all()
    assert follow(stepped_watch, resting, resting.temperatures_degc, first=10).faults == (), (
        "the whole machine stands still"
    )
    stuck = stepped.temperatures_degc.copy()
    stuck[700:, 2] = stuck[700, 2]
    found = [fault.sensor for fault in follow(stepped_watch, stepped, stuck).faults]
    assert found == [2]


@pytest.mark.parametrize("step_k", [0.0625, 0.1])
def test_a_machine_that_counts_in_coarser_steps_than_training_may_stand_still_and_a_stuck_sensor_may_not(
    watch: SensorWatch, whole: Recording, step_k: float
) -> None:
    stepped, steps_k = in_steps(whole, step_k), (step_k,) * SENSORS
    assert stepped.speed_rpm is not None
    creep = whole.temperatures_degc[0] + np.linspace(0.0, 2.0 * step_k, 600)[:, None]
    resting = replace(
        stepped,
        time_s=60.0 * np.arange(float(stepped.rows + 600)),
        speed_rpm=np.concatenate([np.repeat(stepped.speed_rpm[:1], 600), stepped.speed_rpm]),
        temperatures_degc=np.vstack([np.round(creep / step_k) * step_k, stepped.temperatures_degc]),
        displacements_um=np.zeros((stepped.rows + 600, 1)),
    )
    assert (watch.flat_min < 15.0).all(), "no sensor of the training had a value twice"
    assert follow(watch, resting, resting.temperatures_degc, 10, steps_k).faults == ()
    stuck = stepped.temperatures_degc.copy()
    stuck[700:, 2] = stuck[700, 2]
    found = [fault.sensor for fault in follow(watch, stepped, stuck, steps_k=steps_k).faults]
    assert found == [2]


@pytest.mark.parametrize(("readings", "single"), [(1, False), (6, True)])
def test_a_machine_whose_values_turn_out_to_be_rounded_may_stand_still_and_a_stuck_sensor_may_not(
    watch: SensorWatch, whole: Recording, readings: int, single: bool
) -> None:
    assert whole.speed_rpm is not None
    rng = np.random.default_rng(3)

    def read(degc: FloatArray) -> FloatArray:
        noisy = degc + rng.normal(0.0, 0.02 if readings > 1 else 0.0, (readings, *degc.shape))
        shown = np.round(noisy / 0.1) * 0.1
        return np.asarray((shown.astype(np.float32) if single else shown).mean(axis=0, dtype=np.float64))

    creep = whole.temperatures_degc[0] + 0.25 * np.sin(np.linspace(0.0, np.pi, 600))[:, None]
    degc = np.vstack([read(creep), read(whole.temperatures_degc)])
    resting = replace(
        whole,
        time_s=60.0 * np.arange(float(len(degc))),
        speed_rpm=np.concatenate([np.repeat(whole.speed_rpm[:1], 600), whole.speed_rpm]),
        temperatures_degc=degc,
        displacements_um=np.zeros((len(degc), 1)),
    )
    assert follow(watch, resting, degc, 10).faults == (), "no step is known of these sensors"
    stuck = degc.copy()
    stuck[1300:, 2] = np.round(degc[1300, 2], 1)
    assert [fault.sensor for fault in follow(watch, resting, stuck, 10).faults] == [2]
    fine = np.vstack([creep + rng.normal(0.0, 0.02, creep.shape), whole.temperatures_degc])
    fine[100:, 2] = fine[100, 2]
    (fault,) = follow(watch, resting, fine, 10).faults
    assert (fault.sensor, fault.sign) == (2, "flat") and fault.time_min < 107.0, "a value that is on no step, at once"


@pytest.mark.parametrize("step_k", [0.5, 1.0])
def test_a_sensor_whose_coarse_step_is_known_departs_and_jumps_by_its_step(
    watch: SensorWatch, whole: Recording, step_k: float
) -> None:
    stepped, steps_k = in_steps(whole, step_k), (step_k,) * SENSORS
    assert follow(watch, stepped, stepped.temperatures_degc, 10, steps_k).faults == ()
    broken = stepped.temperatures_degc.copy()
    broken[700:, 2] = 850.0
    assert [fault.sensor for fault in follow(watch, stepped, broken, 10, steps_k).faults] == [2]


@pytest.mark.parametrize(("step_k", "readings"), [(0.5, 1), (1.0 / 1.8, 1), (1.0, 6)])
def test_sensors_that_turn_out_to_count_coarsely_depart_and_jump_by_their_step(
    watch: SensorWatch, whole: Recording, step_k: float, readings: int
) -> None:
    """Their values tell the step: of six sensors two to five were excluded. A mean over a change lies between two."""
    zero = 32.0 / 1.8 if step_k not in (0.5, 1.0) else 0.0
    times = np.arange(whole.rows * readings) / readings
    fine = np.column_stack([np.interp(times, np.arange(whole.rows), degc) for degc in whole.temperatures_degc.T])
    degc = np.round((fine + zero) / step_k).reshape(whole.rows, readings, SENSORS).mean(axis=1) * step_k - zero
    assert follow(watch, whole, degc, 10).faults == ()
    broken, drifting = degc.copy(), whole.temperatures_degc.copy()
    broken[700:, 2] = 850.0
    assert [fault.sensor for fault in follow(watch, whole, broken, 10).faults] == [2]
    drifting[:, 2] += np.linspace(0.0, 10.0, whole.rows)
    drifting = np.round((drifting + zero) / step_k) * step_k - zero
    assert 2 in follow(watch, whole, drifting, 10).excluded


def test_a_sensor_that_begins_on_a_coarse_step_and_shows_finer_values_has_the_limits_of_training(
    watch: SensorWatch, whole: Recording
) -> None:
    assert whole.speed_rpm is not None
    begins = whole.temperatures_degc + (np.round(whole.temperatures_degc[0]) - whole.temperatures_degc[0])
    watcher = Watcher(watch)
    state = watcher.begin(0.0, begins[0], 0.0)
    assert (state.steps.limit_k == 1.0).all()
    for row in range(1, 60):
        state = watcher.step(state, float(row), begins[row], 0.0)
    assert (state.steps.limit_k == 0.0).all()


@pytest.mark.parametrize(
    ("known_k", "begins_degc", "step_k"), [(0.5, 21.3, 0.5), (0.0, 21.0, 1.0), (0.0625, 21.0, 0.0625), (0.0, 21.3, 0.0)]
)
def test_a_sensor_may_jump_by_its_step_more_than_in_training_and_by_no_more(
    watch: SensorWatch, known_k: float, begins_degc: float, step_k: float
) -> None:
    """The step that is known counts, whatever the values look like; else the one that they tell."""
    watcher, degc = Watcher(watch, (known_k,) * SENSORS), np.full(SENSORS, begins_degc)
    begun = watcher.begin(0.0, degc, 0.0)
    for beyond_k, faulty in ((-0.01, False), (0.01, True)):
        jumped = degc + (np.arange(SENSORS) == 2) * (watch.slew_k_per_min + step_k + beyond_k)
        signs = [(fault.sensor, fault.sign) for fault in watcher.step(begun, 1.0, jumped, 0.0).faults]
        assert ((2, "slew") in signs) == faulty


@pytest.mark.parametrize(
    ("degc", "step_k"),
    [
        (23.0, 1.0),
        (23.5, 0.5),
        (23.1, 0.1),
        (float(np.float32(23.1)), 0.1),
        (23.0625, 0.0625),
        (21.35, 0.05),
        ((71.3 - 32.0) / 1.8, 0.1 / 1.8),
        (296.4 - 273.15, 0.25),
        (23.1234, 0.0),
    ],
)
def test_a_value_tells_the_usual_step_that_it_is_a_multiple_of(degc: float, step_k: float) -> None:
    assert usual_step_k(np.array([degc])) == pytest.approx([step_k])


@pytest.mark.parametrize("before_min", [0, 240])
def test_a_part_that_begins_off_its_surroundings_is_no_fault(
    watch: SensorWatch, whole: Recording, before_min: int
) -> None:
    """A door stood open: for hours its first minutes counted as where it stands, so too after a gap."""
    assert whole.speed_rpm is not None
    watcher, rng, speed_rpm = Watcher(watch), np.random.default_rng(6), float(whole.speed_rpm[0])
    at_rest, off_k = whole.temperatures_degc[0], 1.5 * watch.threshold_k[2] * np.eye(SENSORS)[2]
    state = watcher.begin(0.0, at_rest + (off_k if before_min == 0 else 0.0), speed_rpm)
    for minute in range(1, before_min + 240):
        after_gap = minute >= before_min > 0
        share = np.exp(-(minute - before_min) / 8.0) if minute >= before_min else 0.0
        degc = at_rest + share * off_k + rng.normal(0.0, 0.01, SENSORS)
        state = watcher.step(state, minute + 600.0 * after_gap, degc, speed_rpm)
    assert state.faults == (), "by now it is as training knows it"


def shift(seed: int, hours: int = 8) -> Recording:
    """A shift of one machine from a cold start on: four sensors between bodies that follow the spindle's heat."""
    places, rng, time_min = np.random.default_rng(2), np.random.default_rng(seed), np.arange(60.0 * hours)
    rpm = np.where((time_min // 30) % 2 == 0, np.repeat(rng.uniform(1000.0, 4000.0, 2 * hours), 30), 0.0)
    quick = lag_table(time_min, ((rpm / 4000.0) ** 2)[:, None], (6.0,))[0]
    body = np.hstack([quick, *lag_table(time_min, quick, (30.0, 200.0))])
    shares = np.square(places.uniform(0.0, 1.0, (3, 4)))
    degc = 22.0 + 20.0 * body @ (shares / shares.sum(axis=0)) + rng.normal(0.0, 0.02, (len(rpm), 4))
    return Recording(
        name=f"shift{seed}",
        time_s=60.0 * time_min,
        speed_rpm=rpm,
        temperature_names=("T1", "T2", "T3", "T4"),
        temperatures_degc=degc,
        displacement_names=("c1",),
        displacements_um=20.0 * body[:, :1],
    )


@pytest.mark.parametrize("drift_k_per_h", [0.0, 2.0])
def test_a_machine_that_starts_warm_loses_no_healthy_sensor_and_still_finds_a_wrong_one(drift_k_per_h: float) -> None:
    """Every run of training began cold, and this one after a break: its lags begin where they are not."""
    cold = [shift(seed) for seed in range(4)]
    inputs = build_inputs(cold, sample_s=60.0)
    rows = np.ones(inputs.rows, dtype=np.bool_)
    watcher = Watcher(fit_watch(cold, 60.0, rows, inner_folds(inputs, rows)[0]))
    start = fit_start(inputs, rows, np.zeros((inputs.layout.columns, 1)))
    for today in map(shift, range(20, 24)):
        assert today.speed_rpm is not None
        degc, rpm = today.temperatures_degc[270:].copy(), today.speed_rpm[270:]
        degc[:, 2] += drift_k_per_h / 60.0 * np.maximum(np.arange(len(degc)) - 60.0, 0.0)
        state = watcher.begin(0.0, degc[0], float(rpm[0]), start.unknown_at_start(degc[0]))
        for row in range(1, len(degc)):
            state = watcher.step(state, float(row), degc[row], float(rpm[row]))
        assert [fault.sensor for fault in state.faults][:1] == ([2] if drift_k_per_h else [])
