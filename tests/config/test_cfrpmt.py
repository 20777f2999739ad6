"""The published machine's description against its sensor list."""

import csv
import os
from collections import Counter
from pathlib import Path

import pytest

from config.loader import load_configuration
from config.machines import shipped_file
from config.schema import Configuration

SHARED = Path(os.environ.get("TOOLPOINT_SHARED", Path(__file__).parents[3] / "shared"))
NOT_CLEARLY_PUBLISHED = {178, 210, 211}
"""Left out of the published list, or in it twice; the description says so in its own words."""


@pytest.fixture(scope="module")
def machine() -> Configuration:
    return load_configuration(shipped_file("cfrpmt.yaml"))


def test_302_sensors_with_the_published_counts_by_component(machine: Configuration) -> None:
    assert machine.temperatures.sensor_ids == tuple(range(1, 303))
    assert Counter(machine.temperatures.components) == {
        "Ambient": 20,
        "Spindle unit": 65 + 2,  # and the two infrared sensors, which the published table does not count
        "X-axis slider": 39,
        "Saddle": 95,
        "Bed": 16,
        "Trunnion table": 9,
        "Column": 54,
        "Cooling circuit of chiller": 2,
    }


def test_labels_are_the_published_means(machine: Configuration) -> None:
    ids = machine.temperatures.sensor_ids
    labelled = {label: {ids[i] for i in where} for label, where in machine.temperatures.labels.items()}
    assert labelled == {
        "A": {56, 66},
        "B": {55, 67},
        "C": {87, 74},
        "D": {88, 73},
        "E": {89, 72},
        "F": {93, 99},
        "IR": {301, 302},
        "Room": {*range(1, 6), *range(110, 125)},
    }


def test_three_lines_and_their_chains(machine: Configuration) -> None:
    chains = {line.name: line.sensor_ids for line in machine.temperatures.lines}
    assert chains == {
        "spindle": (*range(1, 125), 301, 302),
        "saddle": tuple(range(125, 220)),
        "fixed": tuple(range(220, 301)),
    }
    infrared = {sensor.id for sensor in machine.temperatures.sensors if sensor.device == "MLX90615"}
    assert infrared == {301, 302}


def test_displacements_macros_and_axes(machine: Configuration) -> None:
    assert machine.displacements is not None
    assert [channel.name for channel in machine.displacements.channels] == ["Y1", "Y2", "Z1", "Z2", "Z3"]
    macros = machine.cnc.macros
    assert macros.allowed == {120, *range(500, 550)}
    ours, echo = (500, 501, 502, 503, 120, 504, 506, 505), (511, 512, 513, 514, 515, 516)
    request = (520, 521, 522, 523, 524)
    assert macros.block == (*ours, *echo, *request)
    axes = machine.compensation.axes
    assert {name: axis.estimate for name, axis in axes.items()} == {"x": None, "y": "Y1", "z": "Z1"}
    assert axes["z"].tool_term is not None
    assert machine.compensation.model_file is None, "a model comes from a person, not with the description"
    assert machine.compensation.commissioning_file is None
    assert machine.cnc.driver == "opcua" and machine.cnc.connection.encrypted
    assert not machine.cnc.allow_insecure_writes


def test_sensors_equal_the_reference_table(machine: Configuration) -> None:
    table = SHARED / "reference" / "latsis_sensors.csv"
    if not table.is_file():
        pytest.skip(f"the reference table {table.name} is not beside the project")
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    lines = {i: number for number, line in enumerate(machine.temperatures.lines, 1) for i in line.sensor_ids}
    described = [
        (s.id, lines[s.id], s.device, s.component, s.label or "", s.part if s.id not in NOT_CLEARLY_PUBLISHED else None)
        for s in machine.temperatures.sensors
    ]
    published = [
        (
            int(row["sensor_id"]),
            int(row["line"]),
            row["device"],
            row["component"],
            row["label"],
            row["part"] if int(row["sensor_id"]) not in NOT_CLEARLY_PUBLISHED else None,
        )
        for row in rows
    ]
    assert described == published
