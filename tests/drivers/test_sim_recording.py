"""Recordings of simulated days."""

import numpy as np
import pytest

from config.schema.temperatures import SensorConfig
from drivers.sim.machine.day import Day
from drivers.sim.machine.recording import record
from drivers.sim.machine.sensors import RotationJump
from drivers.sim.nc.program import (
    PartProgram,
    alternating_program,
    demo_program,
    rotation_program,
    stepwise_program,
    switching_program,
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


def test_sampling_does_not_change_the_day() -> None:
    day, program = Day.draw(4, start="warm"), demo_program()
    _, every_10_s = record(day, program, SENSORS, hours=0.5, sample_s=10)
    _, every_minute = record(day, program, SENSORS, hours=0.5, sample_s=60)
    assert (every_10_s[::6] == every_minute).all()


def test_another_day_of_the_same_machine_differs() -> None:
    first, second = (record(Day.draw(seed), demo_program(), SENSORS, hours=1, sample_s=60)[1] for seed in (1, 2))
    assert (first[:, 2:] != second[:, 2:]).any(axis=0).all()
    assert (first[:, 1] == second[:, 1]).all()


def test_warm_days_move_less_than_cold_ones() -> None:
    cold, warm = (
        record(Day.draw(9, start=start), rotation_program(), SENSORS, hours=2, sample_s=600)[1]
        for start in ("cold", "warm")
    )
    assert abs(warm[-2, 6]) < abs(cold[-2, 6])


def test_too_fast_sampling_is_refused() -> None:
    with pytest.raises(ValueError, match="sample_s"):
        record(Day.nominal(), demo_program(), SENSORS, hours=1, sample_s=5)


def test_progress_is_reported() -> None:
    seen: list[float] = []
    record(Day.nominal(), demo_program(), SENSORS, hours=2, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[0] == 0.0 and 0.3 < seen[-1] < 1.0


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


def test_programs_for_training_days() -> None:
    steps = stepwise_program(range(2000, 12001, 2000), minutes_each=20)
    assert [block.spindle_speed_rpm for block in steps.blocks] == [2000, 4000, 6000, 8000, 10000, 12000, 0]
    assert sum(block.duration_s for block in steps.blocks) == 5 * 3600
    mixed = alternating_program((12000, 8000, 12000), idle_reduction=(False, True))
    assert [block.chiller for block in mixed.blocks if block.kind == "idle"] == [True, False, True]
    switching = switching_program()
    assert not any(block.chiller for block in switching.blocks if block.kind == "idle")
    assert {block.duration_s / 60 for block in switching.blocks} == {5, 10, 15, 20}
    assert [block.duration_s for block in rotation_program().blocks] == [7200.0, 10800.0]
    assert not rotation_program(idle_reduction=True).blocks[-1].chiller
