"""Recordings of simulated days."""

import numpy as np
import pytest

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.machine.recording import record
from drivers.sim.machine.sensors import RotationJump
from drivers.sim.nc.program import (
    PartProgram,
    rotation_program,
)

SENSORS = [
    SensorConfig(id=2, component="Ambient", label="Room"),
    SensorConfig(id=67, component="Spindle unit", part="Housing", label="B"),
    SensorConfig(id=302, device="MLX90615", component="Spindle unit", part="Spindle nose", label="IR"),
]
HEADER = ("t", "rpm", "X", "Y1", "Y2", "Z1", "Z2", "Z3", "T2", "T67", "T302")


def test_columns_rows_and_units() -> None:
    header, rows = record(Day.nominal(), rotation_program(hours=0.5, idle_hours=0.5), SENSORS, hours=1, sample_s=60)
    assert header == HEADER
    assert rows[:, 0] == pytest.approx(np.arange(61) * 60.0)
    assert rows[1:30, 1] == pytest.approx(12000.0)
    assert rows[31:60, 1] == pytest.approx(0.0)
    assert rows[0, 2:8] == pytest.approx(0.0, abs=0.6)
    assert rows[29, 6] < -8.0
    assert rows[0, 8:] == pytest.approx(20.0, abs=0.7)
    assert rows[29, 10] - rows[0, 10] > 5.0


def test_rotation_jump_shows_at_on_and_off_only_in_its_channel() -> None:
    program = PartProgram(number=1, blocks=rotation_program(hours=0.05, idle_hours=0.05).blocks)
    still = record(Day.nominal(), program, SENSORS, hours=0.1, sample_s=10)[1]
    jumping = record(
        Day.nominal(), program, SENSORS, hours=0.1, sample_s=10, rotation_jump=RotationJump(um={"Z2": 4.0})
    )[1]
    difference = jumping[:, 2:] - still[:, 2:]
    assert difference[1:18, 4] == pytest.approx(4.0, abs=0.11)
    assert difference[20:35, 4] == pytest.approx(0.0, abs=1e-9)
    assert np.delete(difference, 4, axis=1) == pytest.approx(0.0, abs=1e-9)
