"""Sensors that contradict the others are named, and no others."""

from dataclasses import replace

import numpy as np
import pytest

from models.recordings.dataset import Recording
from models.recordings.findings import usable_recordings
from models.recordings.sensor_agreement import disagreements
from models.records import FloatArray


def run(seed: int, hours: float = 3.0) -> Recording:
    """Six sensors that see two heats in different shares, with offsets of their own and 0.1 K resolution."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, hours * 3600.0, 60.0)
    quick = rng.uniform(6.0, 14.0) * -np.expm1(-time_s / 1800.0)
    slow = rng.uniform(4.0, 8.0) * -np.expm1(-time_s / 9000.0) + np.sin(time_s / 4000.0 + seed)
    shares = np.array([[1.0, 0.2], [0.8, 0.5], [0.3, 1.0], [0.5, 0.6], [0.1, 0.9], [0.9, 0.1]])
    degc = 20.0 + rng.normal(0.0, 0.5, 6) + np.column_stack([quick, slow]) @ shares.T
    return Recording(
        name=f"run{seed}.csv",
        time_s=time_s,
        speed_rpm=None,
        temperature_names=tuple(f"T{i}" for i in range(1, 7)),
        temperatures_degc=np.round(degc + rng.normal(0.0, 0.03, degc.shape), 1),
        displacement_names=("Z1",),
        displacements_um=(quick + slow)[:, None],
    )


def changed(recording: Recording, sensor: int, values: FloatArray, first: int = 0) -> Recording:
    degc = recording.temperatures_degc.copy()
    degc[first:, sensor] = values
    return replace(recording, temperatures_degc=degc)


RUNS = [run(seed) for seed in range(5)]


def test_sensors_that_agree_are_not_named() -> None:
    assert disagreements(RUNS) == []
    assert disagreements(RUNS[:1]) == []
    assert disagreements([]) == []


def test_sensors_of_one_kelvin_resolution_do_not_seem_stuck() -> None:
    """Of four such recordings up to four sensors were called stuck, in nine of ten draws."""
    coarse = [replace(one, temperatures_degc=np.round(one.temperatures_degc)) for one in RUNS]
    assert disagreements(coarse) == []
    stuck = changed(coarse[0], 1, coarse[0].temperatures_degc[30, 1], first=30)
    assert [one.sensor for one in disagreements([stuck, *coarse[1:]])] == [1]


@pytest.mark.parametrize("number", [0, 4])
def test_a_stuck_sensor_is_named_with_the_row(number: int) -> None:
    recording = RUNS[number]
    stuck = changed(recording, 1, recording.temperatures_degc[40, 1], first=40)
    (found,) = disagreements([*RUNS[:number], stuck, *RUNS[number + 1 :]])
    assert (found.recording, found.sensor) == (number, 1)
    assert found.row is not None and abs(found.row - 40) <= 5
    assert 1.9 < found.stuck_h < 2.4 and found.by_k > 2.0


def test_a_sensor_that_is_the_wrong_way_round_in_one_recording_is_named_alone() -> None:
    recording = RUNS[2]
    turned = 2.0 * recording.temperatures_degc[0, 3] - recording.temperatures_degc[:, 3]
    (found,) = disagreements([*RUNS[:2], changed(recording, 3, turned), *RUNS[3:]])
    assert (found.recording, found.sensor, found.row) == (2, 3, None)


def test_a_regime_that_all_sensors_see_names_none() -> None:
    hotter = replace(RUNS[2], temperatures_degc=20.0 + 2.5 * (RUNS[2].temperatures_degc - 20.0))
    assert disagreements([*RUNS[:2], hotter, *RUNS[3:]]) == []


def test_the_warning_names_recording_column_and_row() -> None:
    recording = RUNS[1]
    stuck = changed(recording, 4, recording.temperatures_degc[60, 4], first=60)
    _, warnings = usable_recordings([RUNS[0], stuck, *RUNS[2:]])
    assert warnings[0].startswith("run1.csv: column T5, row 6")
    assert "it seems stuck" in warnings[0]
