"""The simulated machine as a whole: programme, truth, NC and power."""

import numpy as np
import pytest

from config.schema.cnc import MacroMapConfig
from config.schema.compensation import AxisConfig
from config.schema.temperatures import SensorConfig
from drivers.guard.check import block_check
from drivers.sim.contract import SimulatedMachine
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.nc import ModeCode, RunCode
from drivers.sim.nc.program import SAFE, Block, PartProgram, demo_program
from drivers.sim.nc.safe_point import SafePointApplication

MAP = MacroMapConfig(
    writable=["100-149", "500-549"],
    sequence_a=510,
    sequence_b=511,
    check=513,
    valid_until=100,
    enable=512,
    values={"y": 502, "z": 503},
    echo_applied={"y": 522, "z": 523},
    echo_time=524,
    echo_status=525,
    echo_guard_version=526,
)
AXES = {axis: AxisConfig(absolute_bound_um=60.0, slew_um_per_min=5.0, step_um=20.0) for axis in ("y", "z")}
SENSORS = [
    SensorConfig(id=1, component="Ambient", label="Room"),
    SensorConfig(id=55, component="Spindle unit", part="Housing", label="B"),
    SensorConfig(id=301, device="MLX90615", component="Spindle unit", part="Spindle nose", label="IR"),
]
IDS = [sensor.id for sensor in SENSORS]

SHORT = PartProgram(
    number=77,
    blocks=(
        Block(sequence_number=10, kind="idle", duration_s=7.5),
        Block(sequence_number=100, kind="positioning", duration_s=12.5),
        Block(sequence_number=200, kind="cut", duration_s=30.0, spindle_speed_rpm=12000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=3.5, spindle_speed_rpm=12000.0),
        Block(sequence_number=210, kind="cut", duration_s=30.0, spindle_speed_rpm=12000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=3.5, spindle_speed_rpm=12000.0),
    ),
    repeat_from=1,
)


def machine(program: PartProgram | None = None, day: Day | None = None) -> CfrpMachine:
    application = SafePointApplication(MAP, AXES)
    return CfrpMachine(day or Day.draw(5, start="cold"), program or demo_program(), SENSORS, application)


def ask(simulated: SimulatedMachine, **um: float) -> None:
    """Write a whole, valid block as the daemon does."""
    macros = simulated.nc.macros
    sequence = (macros.get(MAP.sequence_b) or 0.0) + 1.0
    macros.set(MAP.sequence_a, sequence)
    for axis, value_um in um.items():
        macros.set(MAP.values[axis], value_um / 1000.0)
    macros.set(MAP.valid_until, simulated.nc.clock_s + 100.0)
    macros.set(MAP.enable, 3.0)
    macros.set(MAP.sequence_b, sequence)
    held = {number: macros.get(number) for number in MAP.block}
    macros.set(MAP.check, block_check(MAP, AXES, held))


def snapshot(simulated: CfrpMachine) -> tuple[object, ...]:
    truth = {axis: (at.uncompensated_um, at.compensated_um) for axis, at in simulated.truth().items()}
    return (simulated.register_codes(IDS), simulated.displacement_um(), truth, simulated.nc.clock_s)


def test_same_seed_is_bit_identical_however_it_is_looked_at() -> None:
    often, seldom = machine(), machine()
    for time_s in np.arange(0.7, 1500.0, 0.7):
        often.advance(float(time_s))
        often.register_codes(IDS)
    often.advance(1500.0)
    seldom.advance(1500.0)
    assert snapshot(often) == snapshot(seldom)
    other = machine(day=Day.draw(6, start="cold"))
    other.advance(1500.0)
    assert snapshot(other) != snapshot(seldom)


def test_sequence_numbers_run_states_and_spindle() -> None:
    simulated = machine(SHORT)
    expected = [
        (0.0, 10, RunCode.RESET, 0.0),
        (7.4, 10, RunCode.RESET, 0.0),
        (7.5, 100, RunCode.START, 0.0),
        (20.0, 200, RunCode.START, 0.0),
        (21.0, 200, RunCode.START, 6000.0),
        (22.0, 200, RunCode.START, 12000.0),
        (50.0, SAFE, RunCode.START, 12000.0),
        (53.5, 210, RunCode.START, 12000.0),
        (87.0, 100, RunCode.START, 12000.0),
        (90.0, 100, RunCode.START, 0.0),
    ]
    for time_s, sequence_number, run, speed_rpm in expected:
        simulated.advance(time_s)
        nc = simulated.nc
        assert (simulated.time_s, nc.sequence_number, nc.run) == (time_s, sequence_number, run)
        assert nc.spindle_speed_rpm == pytest.approx(speed_rpm)
        assert (nc.mode, nc.alarm, nc.program, nc.work_offset) == (ModeCode.MEM, 0, 77, 54)
        assert nc.motor_temperature_degc == round(nc.motor_temperature_degc)
    simulated.advance(10.0)
    assert simulated.time_s == 90.0


def test_truth_is_empty_before_positioning_and_zero_at_it() -> None:
    simulated = machine(SHORT)
    simulated.advance(7.0)
    assert simulated.truth() == {}
    simulated.advance(7.5)
    assert set(simulated.truth()) == {"x", "y", "z"}
    assert all(at.uncompensated_um == at.compensated_um == 0.0 for at in simulated.truth().values())
    assert not simulated.truth()["z"].cutting
    simulated.advance(40.0)
    assert simulated.truth()["z"].cutting
    simulated.advance(51.0)
    assert not simulated.truth()["z"].cutting


def test_plus_ten_written_to_z_moves_the_truth_by_plus_ten() -> None:
    plain, compensated = machine(SHORT), machine(SHORT)
    for simulated in (plain, compensated):
        simulated.advance(45.0)
    ask(compensated, y=0.0, z=10.0)
    compensated.advance(49.9)
    assert compensated.truth()["z"].compensated_um == compensated.truth()["z"].uncompensated_um
    for simulated in (plain, compensated):
        simulated.advance(60.0)
    before, after = plain.truth()["z"], compensated.truth()["z"]
    assert after.uncompensated_um == before.uncompensated_um == before.compensated_um
    assert after.compensated_um - before.compensated_um == pytest.approx(10.0)
    assert compensated.truth()["y"] == plain.truth()["y"]
    assert compensated.nc.macros.get(MAP.echo_applied["z"]) == pytest.approx(0.01)


def test_what_is_applied_at_positioning_belongs_to_the_work() -> None:
    simulated = machine(SHORT)
    simulated.advance(45.0)
    ask(simulated, y=0.0, z=10.0)
    simulated.advance(87.0)
    at = simulated.truth()["z"]
    assert simulated.guard.applied_um["z"] == pytest.approx(10.0)
    assert at.uncompensated_um == at.compensated_um == 0.0
    ask(simulated, y=0.0, z=12.0)
    simulated.advance(140.0)
    at = simulated.truth()["z"]
    assert at.compensated_um - at.uncompensated_um == pytest.approx(2.0)


def test_power_cycle() -> None:
    simulated = machine(SHORT)
    simulated.advance(45.0)
    ask(simulated, y=0.0, z=4.0)
    simulated.advance(55.0)
    count, codes = simulated.nc.power_on_count, simulated.register_codes(IDS)
    simulated.power_cycle()
    nc = simulated.nc
    assert nc.power_on_count == count + 1
    assert (nc.clock_s, nc.run, nc.sequence_number) == (0.0, RunCode.RESET, 10)
    assert nc.macros.get(MAP.valid_until) is None
    assert nc.macros.get(MAP.values["z"]) == pytest.approx(0.004)
    assert simulated.guard.applied_um["z"] == pytest.approx(4.0)
    assert simulated.register_codes(IDS) == codes
    simulated.advance(62.5)
    assert nc.sequence_number == 100
    assert nc.clock_s == pytest.approx(7.5, abs=0.001)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"duration_s": 0.0}, "duration_s"), ({"duration_s": 1.0, "spindle_speed_rpm": 12001.0}, "outside")],
)
def test_impossible_blocks_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=f"N5: .*{message}"):
        Block(sequence_number=5, kind="cut", **change)
    with pytest.raises(ValueError, match="repeat_from"):
        PartProgram(number=1, blocks=SHORT.blocks, repeat_from=6)
