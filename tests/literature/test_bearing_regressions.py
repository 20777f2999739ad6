"""Tables D-1 and D-2: bearing properties at known temperatures.

At equal temperatures and no change the regression is the intercept plus the sum of the four coefficients of T times
the temperature: a sum of printed numbers, so it is exact to rounding (1e-9). The figures for X at 20 degC and the
negative damping at 25 degC were computed from the printed tables independently of this code.
"""

import csv
import os
from pathlib import Path

import numpy as np
import pytest

from config.machine.published_bearings import SIGNALS, TABLES, data_folder, published_model

SHARED = Path(os.environ.get("TOOLPOINT_SHARED", Path(__file__).parents[3] / "shared"))
X_AT_20_DEGC = {"ct_12": 68.0, "kr_12": 4.129e6, "kt_34": 1.102e8, "kt_5": 3.66e7, "ct_5": 2300.0}
NOTHING = {4.0: np.zeros(4), 10.0: np.zeros(4)}


def uniform(axis: str, degc: float) -> dict[str, float]:
    return {each.name: each.raw for each in published_model().axes[axis].estimate(np.full(4, degc), NOTHING)}


def test_x_at_20_degc() -> None:
    assert uniform("x", 20.0) == pytest.approx(X_AT_20_DEGC, rel=1e-9)


def test_damping_at_25_degc_is_negative_flagged_and_clamped_at_its_physical_bound() -> None:
    found = {each.name: each for each in published_model().axes["x"].estimate(np.full(4, 25.0), NOTHING)}
    assert found["ct_12"].raw == pytest.approx(-642.5, rel=1e-9)
    assert (found["ct_12"].value, found["ct_12"].flagged, found["ct_12"].confidence) == (0.0, True, 0.0)
    assert not found["kt_5"].flagged
    assert found["kt_5"].value == found["kt_5"].raw


def test_y_rear_damping_is_negative_above_14_5_degc() -> None:
    assert uniform("y", 14.4)["ct_5"] > 0.0 > uniform("y", 14.6)["ct_5"]


def test_intervals_are_10_min_but_4_min_for_two_properties_in_x() -> None:
    model = published_model()
    four = {(axis, each.name) for axis, told in model.axes.items() for each in told.properties
            if each.interval_min == 4.0}  # fmt: skip
    assert four == {("x", "kt_34"), ("x", "kt_5")}
    assert model.intervals_min == (4.0, 10.0)
    assert model.signals == SIGNALS


def test_each_change_counts_over_the_interval_of_its_property() -> None:
    axis = published_model().axes["x"]
    still = {each.name: each.raw for each in axis.estimate(np.full(4, 20.0), NOTHING)}
    moved = {4.0: np.array([1.0, 0.0, 0.0, 0.0]), 10.0: np.zeros(4)}
    after = {each.name: each.raw for each in axis.estimate(np.full(4, 20.0), moved)}
    assert {name for name in still if after[name] != still[name]} == {"kt_34", "kt_5"}
    assert after["kt_34"] - still["kt_34"] == pytest.approx(-2.05e6 + 7.74e5, rel=1e-6)


@pytest.mark.skipif(not (SHARED / "reference").is_dir(), reason="the published tables are not beside the repository")
@pytest.mark.parametrize("axis", TABLES)
def test_the_shipped_tables_are_the_published_ones(axis: str) -> None:
    names = {"x": "bearing_regression_table_d1_x.csv", "y": "bearing_regression_table_d2_y.csv"}
    with (data_folder() / TABLES[axis]).open() as ours, (SHARED / "reference" / names[axis]).open() as theirs:
        assert list(csv.reader(ours)) == list(csv.reader(theirs))
