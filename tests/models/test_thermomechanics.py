"""Bearings from temperatures, the history they need, the fit, the file, and the resonance that is followed."""

from dataclasses import replace

import numpy as np
import pytest

from config.machine.published_bearings import SIGNALS, load_bounds, published_model
from config.machine.spindle import spindle_folder
from config.machine.spindle_chain import read_spindle
from models.dynamics.assembly import CondensedAssembly
from models.dynamics.bearings import CondensedShaft, properties_from_parameters
from models.dynamics.identification import FIXED, IdentificationError
from models.model_file import ModelError
from models.quality import Quality
from models.records import FloatArray, Instant, MachineTemperatures, Trace
from models.thermomechanics.artifact import model_from_json, model_to_json
from models.thermomechanics.fitting import INTERVALS_MIN, MinuteSeries, fit_axis, minute_series
from models.thermomechanics.history import TemperatureHistory
from models.thermomechanics.regression import AxisRegression, Bounds, FittedRange, PropertyRegression
from models.thermomechanics.resonance import peaks
from models.thermomechanics.selection import select_signals
from models.thermomechanics.series import identify_series
from models.thermomechanics.tool_point import AxisTracker, ToolPointTracker

NAMES = ("ct_12", "kr_12", "kt_34", "kt_5", "ct_5")
TYPICAL = {"ct_12": 300.0, "kr_12": 3e6, "kt_34": 1e8, "kt_5": 5e7, "ct_5": 800.0}
FREQUENCY_HZ = 300.0 + 1.5625 * np.arange(640)
LABELS = {"IR": (0,), "A": (1, 2), "F": (3,), "Room": (4,)}


def linear_axis(slope: float = 0.02, *, interval_min: float = 10.0) -> AxisRegression:
    """Return a regression in which every property grows with IR, and nothing else counts."""
    properties = []
    for name, value in TYPICAL.items():
        coefficients = np.zeros(13)
        coefficients[0], coefficients[1] = value * (1.0 - 25.0 * slope), value * slope
        properties.append(
            PropertyRegression(
                name=name, interval_min=interval_min, coefficients=coefficients, bounds=load_bounds()[name]
            )
        )
    seen = FittedRange(lowest_degc=np.full(4, 20.0), highest_degc=np.full(4, 30.0))
    return AxisRegression(axis="y", signals=SIGNALS, properties=tuple(properties), fixed=FIXED[5], fitted_range=seen)


def cycle(time_s: float, degc: FloatArray) -> MachineTemperatures:
    at = Instant(monotonic_s=time_s, utc_s=time_s, real_s=time_s)
    codes = np.full(len(degc), int(Quality.GOOD), dtype=np.uint8)
    return MachineTemperatures(
        line="spindle", measured_degc=degc.copy(), degc=degc.copy(), quality=codes, reason=codes.copy(),
        age_s=np.zeros(len(degc)), trace=Trace(first_byte=at, last_byte=at, cleansed=at),
    )  # fmt: skip


# Regression


def test_a_regression_needs_every_parameter_once_and_the_right_number_of_coefficients() -> None:
    axis = linear_axis()
    with pytest.raises(ModelError, match="must stand once"):
        AxisRegression(axis="y", signals=SIGNALS, properties=axis.properties[1:], fixed=FIXED[5])
    with pytest.raises(ModelError, match="3 signals need 10 coefficients"):
        AxisRegression(axis="y", signals=SIGNALS[:3], properties=axis.properties, fixed=FIXED[5])
    with pytest.raises(ModelError, match="no bearing property"):
        PropertyRegression(name="kx", interval_min=0.0, coefficients=np.zeros(5), bounds=Bounds(lowest=0, highest=1))
    with pytest.raises(ModelError, match="bounds"):
        Bounds(lowest=2.0, highest=1.0)


def test_confidence_falls_outside_the_fitted_temperatures() -> None:
    axis = linear_axis(0.001)
    found = {
        degc: axis.estimate(np.array([degc, 25.0, 25.0, 25.0]), {10.0: np.zeros(4)})[0].confidence
        for degc in (25.0, 35.0, 45.0)
    }
    assert found == {25.0: 1.0, 35.0: 0.5, 45.0: 0.0}


# File


def test_the_file_gives_the_same_model_back() -> None:
    model = published_model()
    text = model_to_json(model)
    again = model_from_json(text, "model.json")
    assert model_to_json(again) == text
    degc, change = np.array([24.0, 23.0, 22.0, 21.0]), {4.0: np.full(4, 0.2), 10.0: np.full(4, 0.5)}
    assert again.axes["x"].estimate(degc, change) == model.axes["x"].estimate(degc, change)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("2910.0", "2911.0", "does not fit the content"),
        ('"toolpoint-thermomechanics"', '"thermal"', "another kind of file"),
        ('"format_version": 1', '"format_version": 2', "is unknown"),
    ],
)
def test_a_changed_file_is_refused_by_name_and_key(old: str, new: str, complaint: str) -> None:
    text = model_to_json(published_model())
    assert old in text
    with pytest.raises(ModelError, match=f"model.json: .*{complaint}"):
        model_from_json(text.replace(old, new, 1), "model.json")


# History


def test_means_now_and_ten_minutes_ago() -> None:
    history = TemperatureHistory((10.0,))
    for k in range(100):
        history.add(10.0 * k, np.array([k * 10.0 / 60.0, np.nan]))
    now, then = history.mean_degc(), history.mean_degc(10.0)
    assert now is not None
    assert then is not None
    assert now[0] - then[0] == pytest.approx(10.0)
    assert np.isnan(now[1])
    assert history.mean_degc(15.0) is None


@pytest.mark.parametrize("period_s", [60.0, 300.0])
def test_what_was_read_ten_minutes_ago_is_known_though_no_reading_comes_to_the_moment(period_s: float) -> None:
    history, rng = TemperatureHistory((10.0,)), np.random.default_rng(0)
    for k in range(60):
        history.add(period_s * k + rng.uniform(0.0, 0.5), np.array([k * period_s / 60.0]))
        if k * period_s > 900.0:
            now, then = history.mean_degc(), history.mean_degc(10.0)
            assert now is not None and then is not None, k
            assert now[0] - then[0] == pytest.approx(10.0, abs=1.0)


# Fit


def made_up(minutes: int, seed: int) -> MinuteSeries:
    """Return temperatures that wander, and properties that follow 5-1 exactly with an interval of 6 min."""
    rng = np.random.default_rng(seed)
    whole = 25.0 + np.cumsum(rng.normal(0.0, 0.3, (minutes + 12, 4)), axis=0)
    past = {each: whole[12 - int(each) : len(whole) - int(each)] for each in INTERVALS_MIN if each}
    now = whole[12:]
    change = now - past[6.0]
    values = np.stack(
        [TYPICAL[name] * (1.0 + 0.02 * now[:, 0] - 0.01 * now[:, 3] + 0.05 * change[:, 0] + 0.01 * change[:, 1] ** 2)
         for name in NAMES], axis=1,
    )  # fmt: skip
    return MinuteSeries(time_min=np.arange(minutes, dtype=float), degc=now, past_degc=past, values=values)


def test_least_squares_finds_the_interval_and_the_coefficients() -> None:
    axis, fitted = fit_axis(
        "y", SIGNALS, NAMES, [made_up(200, 1), made_up(150, 2)], load_bounds(), FIXED[5], least_squares=True
    )
    for name in NAMES:
        regression = fitted[name].regression
        assert regression.interval_min == 6.0
        expected = TYPICAL[name] * np.array([1, 0.02, 0, 0, -0.01, 0.05, 0, 0, 0, 0, 0.01, 0, 0])
        assert regression.coefficients == pytest.approx(expected, abs=1e-8 * TYPICAL[name])
        assert fitted[name].adjusted_r2[6.0] == pytest.approx(1.0, abs=1e-9)
        assert fitted[name].adjusted_r2_without_squares[6.0] < fitted[name].adjusted_r2[6.0]
    assert axis.fitted_range is not None


# Signals


def test_of_signals_that_are_alike_the_one_that_tells_most_of_the_properties_is_used() -> None:
    rng = np.random.default_rng(7)
    first, second = rng.normal(0.0, 1.0, (2, 500))
    degc = np.stack([first + 0.3 * rng.normal(0.0, 1.0, 500), second, first, -first], axis=1)
    found = select_signals(
        ("near", "other", "best", "turned"), degc, ("kt_5 x",), (2.0 * first + 0.2 * second)[:, None]
    )
    assert found.chosen == ("other", "best")
    assert found.groups == (("other",), ("best", "turned", "near"))
    assert found.autocorrelation == pytest.approx(np.corrcoef(degc.T))
    assert found.crosscorrelation[2, 0] == pytest.approx(np.corrcoef(first, 2.0 * first + 0.2 * second)[0, 1])
    given = select_signals(("a", "b"), degc[:, [2, 3]], ("kt_5 x",), None, np.array([[0.1], [0.2]]))
    assert given.chosen == ("b",)


# Series


def test_properties_are_interpolated_to_minutes_but_not_over_a_gap_of_more_than_20() -> None:
    response_min = np.array([0.0, 10.5, 30.5, 51.0, 53.0])
    recorded_min = np.arange(-15.0 * 6, 60.0 * 6) / 6.0
    series = minute_series(response_min, 2.0 * response_min[:, None], recorded_min, recorded_min[:, None])
    assert series.time_min.tolist() == [*range(31), 31, 50, 51, 52, 53], "in the gap beside a response alone"
    assert series.values[:, 0] == pytest.approx(2.0 * series.time_min)
    assert series.degc[:, 0] == pytest.approx(series.time_min - 5.0 / 12.0), "the mean of the minute that ends there"
    assert series.past_degc[10.0] == pytest.approx(series.degc - 10.0)
    with pytest.raises(IdentificationError, match="no minute of the responses"):
        minute_series(response_min, response_min[:, None], recorded_min + 100.0, recorded_min[:, None])


def test_a_series_is_exact_on_responses_of_known_bearings() -> None:
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    shaft = CondensedShaft(spindle.shaft, FREQUENCY_HZ)
    factors = (1.0, 1.2, 1.5)
    true = [{name: value * factor for name, value in TYPICAL.items()} for factor in factors]
    responses = [shaft.nose_receptance(properties_from_parameters({**FIXED[5], **each})) for each in true]
    five = identify_series(shaft, responses, np.arange(3.0), FIXED[5])
    assert five.values == pytest.approx(np.array([[each[name] for name in five.names] for each in true]), rel=1e-3)
    seven = identify_series(shaft, responses, np.arange(3.0), FIXED[7], five)
    assert seven.log_error.max() < 0.05


# Tool point


@pytest.fixture(scope="module")
def tracker() -> ToolPointTracker:
    return new_tracker()


def new_tracker() -> ToolPointTracker:
    model = published_model()
    object.__setattr__(model, "axes", {"y": linear_axis()})
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    return ToolPointTracker(model, {"y": spindle.assembly("tool")}, LABELS, frequency_hz=FREQUENCY_HZ)


def test_the_response_is_that_of_the_properties(tracker: ToolPointTracker) -> None:
    found = tracker.renew(cycle(0.0, np.array([25.0, 24.0, 26.0, 25.0, 25.0])))
    assert found is not None
    parameters = {**FIXED[5], **{each.name: each.value for each in found.axes["y"].properties}}
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    direct = CondensedAssembly(spindle.assembly("tool"), FREQUENCY_HZ).receptance(
        properties_from_parameters(parameters)
    )
    assert found.axes["y"].receptance_m_per_n == pytest.approx(direct, rel=1e-12)
    nearest = min(abs(peak.frequency_hz - found.resonance_hz["y"]) for peak in peaks(FREQUENCY_HZ, direct))
    assert nearest < 1e-6
    assert found.degc.tolist() == [25.0, 25.0, 25.0, 25.0]


def test_doubt_until_the_changes_are_known_and_when_a_signal_is_silent() -> None:
    tracker = new_tracker()
    warm = np.full(5, 25.0)
    silent = np.array([np.nan, 25.0, 25.0, 25.0, 25.0])
    assert tracker.renew(cycle(0.0, silent)) is None
    reasons = []
    for k in range(1, 75):
        found = tracker.renew(cycle(10.0 * k, warm))
        assert found is not None
        reasons.append(found.inhibit)
    assert "need those of 10 min ago, which are missing" in reasons[0]
    assert reasons[-1] == ""
    for k in range(75, 90):
        found = tracker.renew(cycle(10.0 * k, silent))
    assert found is not None
    assert "no temperature of IR for a minute" in found.inhibit
    assert found.degc.tolist() == [25.0, 25.0, 25.0, 25.0]


def test_a_flagged_property_is_taken_to_both_ends_of_its_range() -> None:
    axis = linear_axis()
    tight = [each for each in axis.properties if each.name != "kt_5"]
    bounds = Bounds(lowest=4.3e7, highest=4.9e7)
    (wide,) = (each for each in axis.properties if each.name == "kt_5")
    tight.append(
        PropertyRegression(name="kt_5", interval_min=10.0, coefficients=wide.coefficients.copy(), bounds=bounds)
    )
    axis = AxisRegression(axis="y", signals=SIGNALS, properties=tuple(tight), fixed=FIXED[5])
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    tracker = AxisTracker(axis, spindle.assembly("tool"), FREQUENCY_HZ)
    inside = tracker.renew(np.full(4, 23.0), {10.0: np.zeros(4)})
    assert (inside.flagged, inside.range_ends) == ((), ())
    found = tracker.renew(np.full(4, 26.0), {10.0: np.zeros(4)})
    assert found.flagged == ("kt_5",)
    (ends,) = found.range_ends
    assert ends.at_highest_hz == found.resonance_hz
    assert ends.at_lowest_hz is not None
    assert ends.at_lowest_hz < found.resonance_hz - 1.0
    assert found.confidence == 0.0
    values = {each.name: each.value for each in found.properties}
    at_low = tracker.receptance({**FIXED[5], **values, "kt_5": bounds.lowest})
    assert min(abs(peak.frequency_hz - ends.at_lowest_hz) for peak in peaks(FREQUENCY_HZ, at_low)) < 1.0
    tracker._follower._resonance = replace(found.resonance, continuous=False)
    tracker._ends = (np.inf, ())
    assert tracker._range_ends([found.properties[-1]], values)[0].at_lowest_hz is None, "of a lost mode none is known"
    again = tracker.renew(np.full(4, 26.0), {10.0: np.zeros(4)})
    assert again.resonance.continuous and again.range_ends == found.range_ends


@pytest.mark.parametrize(
    ("low_hz", "high_hz", "beside_hz"),
    [(10.0, 11_000.0, None), (10.0, 1300.0, 3411.0), (900.0, 2500.0, 658.0), (300.0, 2500.0, 3411.0)],
)
def test_the_largest_resonance_is_looked_for_beside_any_band(
    low_hz: float, high_hz: float, beside_hz: float | None
) -> None:
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    tracker = AxisTracker(linear_axis(), spindle.assembly("tool"), np.arange(low_hz, high_hz, 1.5625))
    assert tracker.beside_the_band() == (None if beside_hz is None else pytest.approx(beside_hz, abs=5.0))


def test_a_property_whose_range_loses_the_mode_may_move_it_by_anything() -> None:
    axis = linear_axis()
    bounds = Bounds(lowest=3e7, highest=4.9e7)
    properties = tuple(
        each
        if each.name != "kt_5"
        else PropertyRegression(name="kt_5", interval_min=10.0, coefficients=each.coefficients.copy(), bounds=bounds)
        for each in axis.properties
    )
    seen = axis.fitted_range
    axis = AxisRegression(axis="y", signals=SIGNALS, properties=properties, fixed=FIXED[5], fitted_range=seen)
    spindle = read_spindle(spindle_folder() / "simulated_machine.yaml")
    found = AxisTracker(axis, spindle.assembly("tool"), FREQUENCY_HZ, near_hz=600.0).renew(
        np.full(4, 26.0), {10.0: np.zeros(4)}
    )
    assert found.range_ends[0].at_lowest_hz is None
