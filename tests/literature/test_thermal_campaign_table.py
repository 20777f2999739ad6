"""The shipped measurement programme against the dissertation's Table 3-1 (exact: words and numbers, no tolerance)."""

import csv
import os
from pathlib import Path

import pytest

from config.recordings.thermal_campaign import Operation, load_thermal_campaign

SHARED = Path(os.environ.get("TOOLPOINT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
TABLE = SHARED / "reference" / "datasets_table_3_1.csv"


def published() -> dict[int, dict[str, str]]:
    if not TABLE.is_file():
        pytest.skip(f"the reference table {TABLE} is not here; set TOOLPOINT_SHARED")
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {int(row["index"]): row for row in csv.DictReader(file)}


def said(operation: Operation) -> str:
    """The operation in the words in which the table says what went before."""
    speeds = operation.speeds_rpm
    if operation.switching is not None:
        return "switching 0 / 12000"
    if len(speeds) == 1:
        return f"{speeds[0]:.0f}"
    repeats = speeds.count(speeds[0])
    once = speeds[: len(speeds) // repeats]
    times = f" x{repeats}" if repeats > 1 else ""
    return f"{once[0]:.0f}..{once[-1]:.0f} step {once[1] - once[0]:.0f}{times}"


def test_the_programme_is_the_published_table() -> None:
    rows = published()
    datasets = load_thermal_campaign().datasets
    assert list(datasets) == list(rows) == list(range(1, 21))
    for number, row in rows.items():
        operation = datasets[number]
        each = f" ({operation.minutes_each} min each)" if len(operation.speeds_rpm) > 1 else ""
        assert said(operation) + each == row["spindle_speed_rpm"]
        assert operation.previous == row["previous_speed_rpm"]
        assert operation.cooling == row["cooling_operation"]
        assert operation.usage == row["usage"]


def test_every_data_set_follows_the_operation_that_the_table_asks_for() -> None:
    for series in load_thermal_campaign().series:
        before = ""
        after_idle_reduction = False
        for place, operation in enumerate(series.operations):
            if operation.dataset is not None:
                assert operation.previous == before, operation.dataset
                assert (operation.cooling == "cold start") == (place == 0)
                assert ("after idle reduction" in operation.cooling) == (
                    after_idle_reduction and operation.switching is None
                )
            before, after_idle_reduction = said(operation), operation.idle_reduction


def test_every_operation_has_300_minutes_and_three_begin_cold() -> None:
    campaign = load_thermal_campaign()
    assert len(campaign.series) == 3
    assert campaign.minutes == 300
    phases = campaign.datasets[20].phases(campaign.minutes)
    turning = [phase.minutes for phase in phases if phase.speed_rpm > 0.0]
    resting = [phase.minutes for phase in phases if phase.speed_rpm == 0.0]
    assert turning[:8] == [5, 10, 15, 20] * 2
    assert resting[:6] == [5, 10, 15] * 2
    assert not any(phase.chiller for phase in phases if phase.speed_rpm == 0.0)
    assert [phase.minutes for phase in campaign.datasets[1].phases(300)] == [120, 180]
