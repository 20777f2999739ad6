"""Families of models on a public recording of a spindle (CAIVIAC/FL_THERMAL, MIT licence, 46 h).

Split A trains on hours 0-32 (four on/off cycles) and tests all that follows as one run with one
reference; split C leaves each of the six cycles out. A published study of the same data found, with
a mean of two ridges on temperatures, their lags and lagged spindle speed, 80 % (A) and 80 % (C) of
the RMSE removed, and 93 % / 92 % with an hourly probe (on every cycle:
`tests/benchmarks/bench_thermal_models.py --only probes`). The bounds below are what this project
asks of itself; they leave room for other linear algebra libraries, not for another method.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from searched_once import searched_once

from daemon.cli.thermal.evaluate import parse_fault
from daemon.workbench.thermal.evaluation import Protocol, evaluate
from drivers.files.recording_csv import read_recording
from models.recordings.dataset import Recording

SHARED = Path(os.environ.get("TOOLPOINT_SHARED", Path(__file__).parents[3] / "shared"))
PATH = SHARED / "data" / "fl_thermal" / "fl_thermal_46h_15s.csv"
pytestmark = pytest.mark.skipif(not PATH.is_file(), reason=f"the recording is not there ({PATH}); set TOOLPOINT_SHARED")
SPLIT_A: dict[str, Any] = {"train_hours": (0.0, 32.0), "test_hours": (32.0, 46.3)}


@pytest.fixture(autouse=True, scope="module")
def searches_once() -> Iterator[None]:
    """With and without probes it is trained on the same hours, or on the same cycles."""
    with searched_once():
        yield


@pytest.fixture(scope="module")
def minutes() -> Recording:
    return read_recording(PATH).downsampled(60.0)


def figures(rows: Recording, model: str = "default", *, sample_s: float = 60.0, **protocol: Any) -> dict[str, Any]:
    return evaluate([rows], sample_s, model, Protocol(**protocol), lambda what, done, total: None)


@pytest.fixture(scope="module")
def split_a(minutes: Recording) -> dict[str, Any]:
    """Trained once, and tested as it was recorded and with every sensor failing in every way."""
    texts = ("stuck:each@36h", "step:each:5degC@36h", "open:each@36h", "drift:each:1degC/h@36h")
    return figures(minutes, **SPLIT_A, faults=tuple(parse_fault(text) for text in texts))


def test_split_a(split_a: dict[str, Any]) -> None:
    found = split_a
    assert found["mean"]["reduction_rmse"] >= 0.80
    assert found["mean"]["reduction_max"] >= 0.78
    assert all(channel["band_coverage"] >= 0.85 for channel in found["channels"].values())
    assert (found["false_alarms"], found["refused"]) == (0, None)
    assert "gaussian" in found["hyper_parameters"]["family"]


@pytest.mark.slow
def test_split_c() -> None:
    """On a row every 3 min, which trains six times in less than half of the processor time of one a minute."""
    found = figures(read_recording(PATH).downsampled(180.0), sample_s=180.0, leave_out="cycles")
    assert [test["name"] for test in found["tests"]] == [f"cycle {number}" for number in range(1, 7)]
    assert found["mean"]["reduction_rmse"] >= 0.80
    assert sum(test["reduction_rmse"] for test in found["tests"]) / 6 >= 0.76
    assert all(channel["band_coverage"] >= 0.85 for channel in found["channels"].values())


def test_an_hourly_probe(minutes: Recording, split_a: dict[str, Any]) -> None:
    without = split_a["mean"]
    with_probe = figures(minutes, **SPLIT_A, probe_min=60.0)["mean"]
    assert with_probe["reduction_rmse"] >= 0.915
    assert with_probe["rmse_um"] <= 0.5 * without["rmse_um"]


def test_any_single_sensor_may_fail(split_a: dict[str, Any]) -> None:
    of_kind = {kind: [f for f in split_a["faults"] if f["kind"] == kind] for kind in ("stuck", "step", "open", "drift")}
    assert {kind: len(faults) for kind, faults in of_kind.items()} == dict.fromkeys(of_kind, 16)
    for kind in ("stuck", "step", "open"):
        assert max(fault["max_ratio"] for fault in of_kind[kind]) <= 1.5
        assert all(fault["found_after_min"] is not None for fault in of_kind[kind])
    assert max(fault["max_ratio"] for fault in of_kind["drift"]) <= 2.0
    minutes_to_find = sorted(fault["found_after_min"] or 1e9 for fault in of_kind["drift"])
    assert minutes_to_find[8] <= 90.0


@pytest.mark.parametrize(
    ("model", "least", "most"),
    [
        ("ridge", 0.62, 0.75),
        ("pls", 0.62, 0.78),
        ("lasso", 0.60, 0.75),
        ("increments", 0.35, 0.50),
        ("increments-b0", 0.15, 0.32),
    ],
)
def test_the_other_families_come_near_what_is_known_of_them(
    minutes: Recording, model: str, least: float, most: float
) -> None:
    """The study found 67 % for ridge and PLS on temperatures alone, 36 % for increments over 1 min, 20 % with b_0."""
    assert least <= figures(minutes, model, **SPLIT_A)["mean"]["reduction_rmse"] <= most


def test_without_spindle_speed_it_works_less_well(minutes: Recording, split_a: dict[str, Any]) -> None:
    found = figures(replace(minutes, speed_rpm=None), **SPLIT_A)
    assert found["hyper_parameters"]["speed_lags_min"] == []
    assert 0.65 <= found["mean"]["reduction_rmse"] < split_a["mean"]["reduction_rmse"]
