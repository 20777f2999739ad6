"""Recordings: their parts, and what is said about bad ones."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import DatasetError, Recording
from models.recordings.findings import recording_findings, require_usable, usable_recordings


def recording(rows: int = 60, sensors: int = 3, period_s: float = 60.0) -> Recording:
    rng = np.random.default_rng(5)
    return Recording(
        name="day.csv",
        time_s=np.arange(rows) * period_s,
        speed_rpm=np.where(np.arange(rows) % 20 < 10, 0.0, 5000.0),
        temperature_names=tuple(f"t{i + 1}" for i in range(sensors)),
        temperatures_degc=20.0 + np.cumsum(rng.normal(0.2, 0.1, (rows, sensors)), axis=0),
        displacement_names=("c1", "c2"),
        displacements_um=np.cumsum(rng.normal(0.3, 0.2, (rows, 2)), axis=0),
    )


def sentences(one: Recording) -> str:
    return "\n".join(str(finding) for finding in recording_findings(one))


def spoilt(table: str, column: int | slice, rows: slice | int, value: float) -> Recording:
    good = recording()
    values = getattr(good, table).copy()
    values[rows, column] = value
    return replace(good, **{table: values})


def test_a_good_recording_has_no_findings() -> None:
    assert require_usable(recording()) == ()


def test_tables_and_names_must_fit() -> None:
    with pytest.raises(DatasetError, match="2 temperature names"):
        replace(recording(), temperature_names=("t1", "t2"))
    with pytest.raises(DatasetError, match="c1 appear twice"):
        replace(recording(), displacement_names=("c1", "c1"))
    with pytest.raises(DatasetError, match="as many speeds"):
        replace(recording(), speed_rpm=np.zeros(3))


def test_time_must_increase_and_the_row_is_named() -> None:
    times = recording().time_s.copy()
    times[7] = times[6]
    with pytest.raises(DatasetError, match=r"column time, row 8: 360 s does not come after 360 s"):
        replace(recording(), time_s=times)
    times[7] = np.nan
    with pytest.raises(DatasetError, match="column time, row 8: not a time"):
        replace(recording(), time_s=times)


def test_an_impossible_temperature_is_told_as_the_file_has_it() -> None:
    bad = spoilt("temperatures_degc", 1, slice(4, 6), (-9999.0 - 32.0) / 1.8)
    assert "column t2, row 5: -5572.78 degC (-9999 degF) cannot be (2 such values" in sentences(bad)
    assert "-999 degC cannot be" in sentences(spoilt("temperatures_degc", 1, 4, -999.0))


def test_zeros_that_a_displacement_never_comes_near_count_as_missing_and_those_it_passes_through_do_not() -> None:
    """A reader that wrote 0.00 in one row of fifty, where the channel stood at 100 um, was taken for the machine."""
    good = recording()
    um = good.displacements_um.copy()
    um[:, 0] += 100.0
    um[[3, 30], 0] = 0.0
    bad = replace(good, displacements_um=um)
    assert "column c1, row 4: 0 um cannot be (2 such values, the first here)" in sentences(bad)
    assert np.flatnonzero(np.isnan(bad.without_impossible().displacements_um[:, 0])).tolist() == [3, 30]
    set_to_zero = um - um[0]
    set_to_zero[:2] = 0.0
    for healthy in (good.displacements_um - good.displacements_um[30], um + 20.0, set_to_zero):
        assert replace(good, displacements_um=healthy).without_impossible().displacements_um is healthy


@pytest.mark.parametrize("count", [2, 3, 5])
def test_a_temperature_that_goes_away_for_a_few_rows_counts_as_missing(count: int) -> None:
    bad = spoilt("temperatures_degc", 1, slice(20, 20 + count), 0.0)
    found = np.argwhere(np.isnan(bad.without_impossible().temperatures_degc))
    assert found.tolist() == [[row, 1] for row in range(20, 20 + count)]


def test_missing_values_are_a_warning_that_names_column_and_row() -> None:
    assert "column t2, row 5: 3 values are missing" in sentences(spoilt("temperatures_degc", 1, slice(4, 7), np.nan))
    good = recording()
    rpm = np.where(np.arange(good.rows) < 40, good.speed_rpm, np.nan)
    assert "column spindle speed, row 41: 20 values are missing" in sentences(replace(good, speed_rpm=rpm))


def test_displacements_apart_from_all_others_count_as_missing_and_what_passes_through_does_not() -> None:
    """What a logger writes for no value, such as -999, left nothing of a channel's model, without a word."""
    good = recording()
    um = good.displacements_um.copy()
    um[[3, 9], 0] = -999.0
    bad = replace(good, displacements_um=um)
    assert "column c1, row 4: -999 um cannot be (2 such values, the first here)" in sentences(bad)
    assert np.flatnonzero(np.isnan(bad.without_impossible().displacements_um[:, 0])).tolist() == [3, 9]
    um = good.displacements_um + np.linspace(0.0, 900.0, good.rows)[:, None]
    assert replace(good, displacements_um=um).without_impossible().displacements_um is um, "a portal that grows"


def test_a_temperature_that_goes_away_for_one_row_counts_as_missing_and_one_that_stays_away_does_not() -> None:
    """A logger that wrote zeros for one row in a hundred made the model leave three times as much, without a word."""
    degc = recording().temperatures_degc.copy()
    degc[4] = 0.0
    bad = replace(recording(), temperatures_degc=degc)
    assert np.isnan(bad.without_impossible().temperatures_degc).sum(axis=1).nonzero()[0].tolist() == [4]
    assert "row 5: 0 degC cannot be and counts as missing" in sentences(bad)
    degc = recording().temperatures_degc.copy()
    degc[10:] += 20.0
    assert replace(recording(), temperatures_degc=degc).without_impossible().temperatures_degc is degc, "coolant"


def test_missing_values_of_many_columns_are_one_sentence_with_their_number() -> None:
    gappy = []
    for number in range(3):
        values = recording().temperatures_degc.copy()
        values[5:7, 0] = values[10 : 14 + number, 2] = np.nan
        gappy.append(replace(recording(), name=f"{number}.csv", temperatures_degc=values))
    (said,) = (sentence for sentence in usable_recordings(gappy)[1] if "missing" in sentence)
    assert said.startswith(
        "0.csv, 1.csv, 2.csv: 21 values are missing, most in column t3 of 2.csv (6, the first in row"
    )
    (of_few,) = (sentence for sentence in usable_recordings(gappy[:1])[1] if "t1" in sentence)
    assert "row 6: 2 values are missing" in of_few
    assert "row 5: 1 value is missing, here; the row" in sentences(spoilt("temperatures_degc", 1, slice(4, 5), np.nan))
    require_usable(spoilt("temperatures_degc", 1, slice(4, 7), np.nan))


def test_a_row_that_is_missing_in_every_column_is_told_once() -> None:
    """A warning for each of 302 sensors left no room for what else was wrong."""
    names = recording().temperature_names
    (found,) = (one for one in recording_findings(spoilt("temperatures_degc", slice(None), 4, np.nan)) if one.row == 5)
    assert found.columns == len(names) and str(found).startswith(f"columns {', '.join(names)}, row 5: 1 value is")


def test_a_temperature_and_a_displacement_that_are_exchanged_are_named() -> None:
    time_s = 60.0 * np.arange(240.0)
    warm = 1.0 - np.exp(-time_s / 3600.0)
    degc = 21.0 + warm[:, None] * np.array([6.0, 9.0, 4.0, 7.0])
    um = (40.0 + 90.0 * warm)[:, None]
    right = Recording(
        name="day.csv",
        time_s=time_s,
        speed_rpm=None,
        temperature_names=("t1", "t2", "t3", "t4"),
        temperatures_degc=degc,
        displacement_names=("Z1",),
        displacements_um=um,
    )
    assert recording_findings(right) == ()
    exchanged = replace(
        right, temperatures_degc=np.hstack([degc[:, :1], um, degc[:, 2:]]), displacements_um=degc[:, 1:2]
    )
    (found,) = recording_findings(exchanged)
    assert (
        found.column == "Z1"
        and "temperature t2 does not" in found.sentence
        and "are the two columns exchanged?" in found.sentence
    )


def test_a_time_that_is_not_in_seconds_is_told_by_how_short_the_recording_is() -> None:
    whole = recording()
    warm = whole.temperatures_degc + np.linspace(0.0, 5.0, whole.rows)[:, None]
    assert "time_unit" not in sentences(replace(whole, temperatures_degc=warm))
    hours = replace(whole, temperatures_degc=warm, time_s=whole.time_s / 3600.0)
    assert "say so in the map: time_unit: min, h or d" in sentences(hours)
    long = recording(4000, period_s=15.0)
    assert "time_unit" not in sentences(long)
    minutes = replace(long, time_s=long.time_s / 60.0)
    assert "4000 rows in 1e+03 s" in sentences(minutes) and "time_unit: min, h or d" in sentences(minutes)


@pytest.mark.parametrize("clock", [1.0, 60.0])
def test_minutes_that_are_counted_as_seconds_are_told_by_how_soon_most_temperatures_move(clock: float) -> None:
    long = recording(1200, sensors=5)
    warm_k = np.tile(np.repeat([12.0, 0.0], 120), 5)
    followed = np.zeros((1200, 3))
    for row in range(1, 1200):
        followed[row] = followed[row - 1] + (warm_k[row] - followed[row - 1]) / np.array([10.0, 30.0, 90.0])
    degc = np.round((20.0 + followed @ np.array([[1, 0.5, 0, 0, 0], [0, 0.5, 1, 0.3, 0], [0, 0, 0, 0.7, 1]])) * 2) / 2
    counted = replace(long, temperatures_degc=degc, time_s=long.time_s * clock / 60.0)
    told = "most temperatures change by half of all that they do within 60 s" in sentences(counted)
    assert told == (clock == 1.0), "half a kelvin in one step is no haste"
    coolant = np.where(np.arange(1200)[:, None] // 100 % 2 == 0, [8.0, 6.0, 0.0, 0.0, 0.0], 0.0)
    nozzle = replace(long, temperatures_degc=degc + coolant, time_s=long.time_s / 4.0)
    assert "time_unit" not in sentences(nozzle), "two sensors in the jet are not the machine"


def test_a_gap_is_a_warning_that_names_the_row_after_it() -> None:
    times = recording().time_s.copy()
    times[30:] += 3600.0
    said = sentences(replace(recording(), time_s=times))
    assert "column time, row 31: a gap of 3660 s" in said and "summer time there, say time_zone" in said
    later = times + np.where(np.arange(len(times)) < 30, 0.0, 60.0)
    assert "summer time" not in sentences(replace(recording(), time_s=later))


def test_kelvin_millimetres_and_raw_counts_are_recognised() -> None:
    good = recording()
    with pytest.raises(DatasetError, match=r"column t1: a median of .* looks like kelvin: say temp.*{'t1': K}"):
        require_usable(replace(good, temperatures_degc=good.temperatures_degc + 273.15))
    with pytest.raises(DatasetError, match="looks like tenths of a degree"):
        require_usable(replace(good, temperatures_degc=good.temperatures_degc * 10.0))
    tenths = np.linspace(190.0, 400.0, good.rows)[:, None] * np.ones(3)
    with pytest.raises(DatasetError, match="a median of 295 cannot be degC; it looks like tenths"):
        require_usable(replace(good, temperatures_degc=tenths))
    with pytest.raises(DatasetError, match=r"it looks like degF: say temperature_units: \{'\*': degF\} in the map"):
        require_usable(replace(good, temperatures_degc=good.temperatures_degc * 1.8 + 32.0))
    with pytest.raises(DatasetError, match="spindle speed: never above 12, which warms no spindle"):
        require_usable(replace(good, speed_rpm=np.linspace(0.0, 12.0, good.rows)))
    with pytest.raises(DatasetError, match="raw counts or an open wire"):
        require_usable(replace(good, temperatures_degc=good.temperatures_degc * 16.0 + 2000.0))
    open_wire = good.temperatures_degc.copy()
    open_wire[good.rows // 3 :, 0] = 3276.7
    with pytest.raises(DatasetError, match=r"column t1: 6\d% of its values cannot be degC, such as 3277: where its"):
        require_usable(replace(good, temperatures_degc=open_wire))
    with pytest.raises(DatasetError, match="looks like millimetres or inches"):
        require_usable(replace(good, displacements_um=good.displacements_um / 1000.0))
    one_in_mm = replace(good, displacements_um=good.displacements_um * np.array([1.0, 0.001]))
    assert "column c2: moves by no more than" in sentences(one_in_mm)
    assert "displacement_units: {'c2': mm}" in sentences(one_in_mm)
    with pytest.raises(DatasetError, match=r"column c1: moves by .* too far for micrometres"):
        require_usable(replace(good, displacements_um=good.displacements_um * 1000.0))


def test_rises_since_the_start_are_told_and_named_where_only_some_recordings_hold_them() -> None:
    rises = replace(recording(), temperatures_degc=recording().temperatures_degc - recording().temperatures_degc[0])
    other = replace(rises, name="b.csv", displacements_um=rises.displacements_um + 1.0)
    (of_all,) = usable_recordings([rises, other])[1]
    assert of_all.startswith("day.csv, b.csv: all temperatures begin at 0") and "changes since a reference" in of_all
    (of_one,) = usable_recordings([rises, replace(recording(), name="b.csv")])[1]
    assert of_one.startswith("day.csv: all") and "in these recordings alone; add what each sensor read" in of_one


def test_rows_that_two_recordings_share_count_once_and_a_recording_within_another_is_refused() -> None:
    whole = recording()
    early, late = replace(whole.part(0, 40), name="a.csv"), replace(whole.part(25, whole.rows), name="b.csv")
    for given in ([early, late], [late, early]):
        used, (said,) = usable_recordings(given)
        assert said == "b.csv: its first 15 rows are the last ones of a.csv, and count once: the two recordings overlap"
        assert sum(one.rows for one in used) == whole.rows and used[given.index(late)].time_s[0] == whole.time_s[40]
    with pytest.raises(DatasetError, match=r"b.csv: all its rows are in day.csv too; give each run once"):
        usable_recordings([whole, late])
    still = replace(whole, temperatures_degc=np.full_like(whole.temperatures_degc, 21.0))
    still = replace(still, displacements_um=np.zeros_like(still.displacements_um))
    assert len(usable_recordings([still.part(0, 40), still.part(25, still.rows)])[0][1].time_s) == still.rows - 25


@pytest.mark.parametrize("value", [850.0, -200.0, 1e9])
def test_a_single_impossible_temperature_is_named_and_counts_as_missing(value: float) -> None:
    bad = spoilt("temperatures_degc", 1, 4, value)
    assert f"column t2, row 5: {value:.6g} degC cannot be and counts as missing" in sentences(bad)
    assert np.isnan(bad.without_impossible().temperatures_degc[4, 1])
    assert np.isfinite(bad.without_impossible().temperatures_degc).sum() == bad.temperatures_degc.size - 1
    several = spoilt("temperatures_degc", 1, slice(10, 30), value)
    assert f"row 11: {value:.6g} degC cannot be (20 such values, the first here)" in sentences(several)
    assert len(recording_findings(several)) == 1, "it is said once"


def test_parts_keep_the_clock_of_the_whole() -> None:
    part = recording().between_hours(0.25, 0.5)
    np.testing.assert_array_equal(part.time_s[[0, -1]], [900.0, 1740.0])
    assert part.between_hours(0.4, 0.5).time_s[0] == 1440.0
    with pytest.raises(DatasetError, match=r"no row in hours 3 to 4; the recording covers hours 0.00 to 0.98"):
        recording().between_hours(3.0, 4.0)
    with pytest.raises(DatasetError, match="run backwards"):
        recording().between_hours(2.0, 1.0)


def test_down_sampling_averages_every_column_and_never_adds_rows() -> None:
    fine = recording(rows=240, period_s=15.0)
    minutes = fine.downsampled(60.0)
    assert minutes.rows == 60
    np.testing.assert_allclose(minutes.temperatures_degc[3], fine.temperatures_degc[12:16].mean(axis=0))
    np.testing.assert_allclose(minutes.displacements_um[3], fine.displacements_um[12:16].mean(axis=0))
    assert minutes.speed_rpm is not None and fine.speed_rpm is not None
    np.testing.assert_allclose(minutes.speed_rpm[3], fine.speed_rpm[12:16].mean())
    assert minutes.downsampled(10.0) is minutes


def test_a_speed_column_without_any_value_is_refused_and_not_taken_for_standstill() -> None:
    with pytest.raises(DatasetError, match="spindle speed: no value at all"):
        require_usable(replace(recording(), speed_rpm=np.full(60, np.nan)))
