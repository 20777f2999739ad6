"""The speed program as `toolpoint guard --speed` prints it, run by the simulated NC, in both languages."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from speed_machine import MACROS, in_dialect, speed_machine

from daemon.cli import main
from daemon.spindle_speed.macro_block import (
    DISABLED,
    NOTHING,
    OperationKey,
    SpeedBlock,
    SpeedCall,
    SpeedPair,
    speed_check,
)
from drivers.guard.programs import guard_program
from drivers.guard.speed_text import SpeedStatus, speed_program, speed_text_number
from drivers.guard.text import GuardTextError
from drivers.sim.nc.custom_macro import Interpreter, MacroControl, compile_programs
from drivers.sim.nc.nc import MacroTable
from drivers.sim.nc.sinumerik import SinumerikControl, SinumerikInterpreter, compile_archive

CLOCK_S = 1000.0


class SpeedBench:
    """A FANUC with the speed program."""

    dialect = "fanuc"
    edge = (130, 131, 132, 133)
    """Alarms: a wrong call, inch, no feed per minute, S in m/min."""

    def __init__(self, folder: Path, **changes: object) -> None:
        self.configuration = in_dialect(speed_machine(folder, **changes), self.dialect)
        self.macros = MacroTable()
        self.control, self.interpreter = self.made()
        self.control.clock_s = CLOCK_S
        self.control.tool_number = 1
        self.block = SpeedBlock(MACROS)

    def made(self) -> tuple[Any, Any]:
        control = MacroControl(self.macros, addresses=["X", "Y", "Z"], increment_mm=0.001)
        return control, Interpreter(compile_programs(speed_program(self.configuration)), control)

    def feed_otherwise(self, code: int) -> None:
        """Set the group of G93, G94 and G95, or G96."""
        self.control.set_modal(97 if code == 94 else 94)
        self.control.set_modal(code)

    def inch(self) -> None:
        self.control.set_modal(20)

    def write(self, pair: SpeedPair, *, valid_until_s: float = CLOCK_S + 20.0) -> None:
        for group in self.block.encode(pair, after=5, valid_until_s=valid_until_s):
            for number, value in group:
                self.macros.set(number, value)

    def told(self) -> SpeedCall | None:
        """What the daemon would read now."""
        return self.block.call({number: self.macros.get(number) for number in MACROS.numbers})

    def call(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        self.interpreter.run(9020, **(CALL | arguments))
        assert (self.macros.get(MACROS.echo_speed), self.macros.get(MACROS.echo_feed)) == (
            self.control.spindle_rpm,
            self.control.feed_mm_min,
        )
        status = SpeedStatus(round(self.macros.get(MACROS.echo_status) or 0.0))
        return self.control.spindle_rpm, self.control.feed_mm_min, status


class SinumerikSpeedBench(SpeedBench):
    """A SINUMERIK with the guard's programs beside it, one of which starts the clock."""

    dialect = "sinumerik"
    edge = (140, 141, 142, 142)

    def made(self) -> tuple[Any, Any]:
        control = SinumerikControl(self.macros, addresses=["X", "Y", "Z"], increment_mm=0.001)
        self.text = guard_program(self.configuration)
        interpreter = SinumerikInterpreter(compile_archive(self.text + speed_program(self.configuration)), control)
        for number in {*MACROS.numbers, 580, 581}:  # every R parameter is a number
            self.macros.set(number, None)
        interpreter.run(START)
        return control, interpreter

    def feed_otherwise(self, code: int) -> None:
        self.control.groups[15] = {93: 1, 94: 2, 95: 3, 96: 4}[code]

    def inch(self) -> None:
        self.control.groups[13] = 1


START = 9015


BENCHES = (SpeedBench, SinumerikSpeedBench)
OPERATION = OperationKey(tool_number=1.0, speed_rpm=9000.0, feed_mm_min=1800.0, depth_mm=4.5, radial_mm=5.0, kind=1.0)
CALL = {"S": 9000.0, "F": 1800.0, "D": 4.5, "E": 5.0}
PAIR = SpeedPair(made_for=OPERATION, speed_rpm=9400.0, feed_mm_min=1880.0, enable=True)
PROGRAMMED = (9000.0, 1800.0)


@pytest.fixture(params=BENCHES, ids=lambda bench: bench.dialect)
def kind(request: pytest.FixtureRequest) -> type[SpeedBench]:
    return request.param


@pytest.fixture
def bench(kind: type[SpeedBench], tmp_path: Path) -> SpeedBench:
    return kind(tmp_path)


def test_the_pair_is_taken_and_the_call_is_told(bench: SpeedBench) -> None:
    bench.write(PAIR)
    assert bench.call() == (9400.0, 1880.0, SpeedStatus.APPLIED)
    assert bench.told() == SpeedCall(count=1, operation=OPERATION, text=speed_text_number(bench.configuration))
    assert bench.call() == (9400.0, 1880.0, SpeedStatus.APPLIED)
    bench.interpreter.run(9020, S=9000.0, F=1800.0)
    told = bench.told()
    assert told is not None
    assert (told.count, told.operation) == (3, replace(OPERATION, depth_mm=0.0, radial_mm=0.0))


def test_a_call_without_tuning_takes_the_programmed_pair(bench: SpeedBench) -> None:
    bench.write(PAIR)
    assert bench.call(K=0.0) == (*PROGRAMMED, SpeedStatus.NOT_WANTED)
    assert bench.macros.get(MACROS.called_kind) == 0.0


@pytest.mark.parametrize(
    "other",
    [{"D": 8.0}, {"D": 4.6}, {"E": 9.0}, {"F": 1700.0}, {"S": 9001.0}, {"K": 2.0}, {"tool": 2.0}, {"tool": 0.0}],
)
def test_a_pair_for_another_operation_is_left_alone(bench: SpeedBench, other: dict[str, float]) -> None:
    bench.write(PAIR)
    arguments = dict(other)
    bench.control.tool_number = round(arguments.pop("tool", 1.0))
    programmed = (arguments.get("S", 9000.0), arguments.get("F", 1800.0))
    assert bench.call(**arguments) == (*programmed, SpeedStatus.ANOTHER)
    told = bench.told()
    assert told is not None
    assert told.operation.tool_number == bench.control.tool_number
    bench.control.tool_number = 1
    assert bench.call()[2] is SpeedStatus.APPLIED


def test_no_look_in_between_takes_a_call_half_told(bench: SpeedBench) -> None:
    """After every single block of the program the daemon would read a whole call, old or new, or none."""
    bench.call()
    old = bench.told()
    bench.interpreter.start(9020, **(CALL | {"S": 7000.0, "D": 2.0, "K": 2.0}))
    seen = []
    while bench.interpreter.running:
        bench.interpreter.step()
        seen.append(bench.told())
    new = bench.told()
    assert old is not None and new is not None
    assert (new.count, new.operation.speed_rpm, new.operation.kind) == (old.count + 1, 7000.0, 2.0)
    order = [old, None, new]
    assert set(seen) == set(order)
    assert [order.index(each) for each in seen] == sorted(order.index(each) for each in seen)


def test_a_call_that_a_reset_broke_off_is_never_taken_and_the_next_one_counts_on(bench: SpeedBench) -> None:
    bench.call()
    bench.interpreter.start(9020, **CALL)
    while bench.told() is not None:
        bench.interpreter.step()
    bench.interpreter.reset()
    assert bench.macros.get(MACROS.calls) == -2.0
    bench.call()
    told = bench.told()
    assert told is not None
    assert told.count == 3


def test_the_tool_s_own_limit_stands_in_the_text(kind: type[SpeedBench], tmp_path: Path) -> None:
    operation = speed_machine(tmp_path).spindle_speed.operations[0]
    low = operation.model_copy(update={"highest_rpm": 9300.0})
    lower = operation.model_copy(update={"program": 7, "highest_rpm": 9200.0})
    other = operation.model_copy(update={"tool_number": 2, "highest_rpm": 9500.0})
    bench = kind(tmp_path, operations=[low, lower, other])
    bench.write(PAIR)
    assert bench.call() == (*PROGRAMMED, SpeedStatus.OUT_OF_BOUNDS)
    bench.write(replace(PAIR, speed_rpm=9200.0, feed_mm_min=1840.0))
    assert bench.call() == (9200.0, 1840.0, SpeedStatus.APPLIED)
    bench.write(replace(PAIR, speed_rpm=9201.0, feed_mm_min=1840.2))
    assert bench.call()[2] is SpeedStatus.OUT_OF_BOUNDS
    bench.control.tool_number = 2
    bench.write(replace(PAIR, made_for=replace(OPERATION, tool_number=2.0)))
    assert bench.call() == (9400.0, 1880.0, SpeedStatus.APPLIED)


@pytest.mark.parametrize(
    "pair,changes,status",
    [
        (DISABLED, {}, SpeedStatus.DISABLED),
        (PAIR, {"valid_until_s": CLOCK_S - 1.0}, SpeedStatus.EXPIRED),
        (PAIR, {"valid_until_s": CLOCK_S + 1e4}, SpeedStatus.EXPIRED),
        (replace(PAIR, made_for=NOTHING), {}, SpeedStatus.ANOTHER),
        (replace(PAIR, speed_rpm=10900.0, feed_mm_min=2180.0), {}, SpeedStatus.OUT_OF_BOUNDS),
        (replace(PAIR, feed_mm_min=2500.0), {}, SpeedStatus.OUT_OF_BOUNDS),
        (replace(PAIR, feed_mm_min=0.0), {}, SpeedStatus.OUT_OF_BOUNDS),
    ],
)
def test_everything_else_is_the_programmed_pair(
    bench: SpeedBench, pair: SpeedPair, changes: dict, status: SpeedStatus
) -> None:
    bench.write(pair, **changes)
    assert bench.call() == (*PROGRAMMED, status)


def test_vacant_torn_and_cleared_macros_are_the_programmed_pair(bench: SpeedBench) -> None:
    assert bench.call() == (*PROGRAMMED, SpeedStatus.TORN)
    bench.write(PAIR)
    bench.macros.set(MACROS.sequence_a, 77.0)
    assert bench.call() == (*PROGRAMMED, SpeedStatus.TORN)
    bench.write(PAIR)
    bench.macros.set(MACROS.valid_until, None)
    assert bench.call() == (*PROGRAMMED, SpeedStatus.EXPIRED)
    for number in set(MACROS.ours) - {MACROS.valid_until}:
        bench.write(PAIR)
        bench.macros.set(number, None)
        assert bench.call()[:2] == PROGRAMMED


ONE_FOREIGN = [
    ("speed", 9410.0, {}),
    ("speed", 9399.0, {}),
    ("feed", 1885.0, {}),
    ("valid_until", CLOCK_S + 100.0, {}),
    ("for_tool", 2.0, {"tool": 2.0}),
    ("for_speed", 9001.0, {"S": 9001.0}),
    ("for_feed", 1810.0, {"F": 1810.0}),
    ("for_depth", 8.0, {"D": 8.0}),
    ("for_radial", 9.0, {"E": 9.0}),
    ("for_kind", 2.0, {"K": 2.0}),
    ("check", 1.0, {}),
    ("check", None, {}),
]


@pytest.mark.parametrize("name,value,call", ONE_FOREIGN, ids=[f"{name} {value}" for name, value, _ in ONE_FOREIGN])
def test_one_foreign_value_anywhere_in_the_speed_s_block_and_the_programmed_pair_is_taken(
    bench: SpeedBench, name: str, value: float | None, call: dict[str, float]
) -> None:
    bench.write(PAIR)
    bench.macros.set(getattr(MACROS, name), value)
    arguments = dict(call)
    bench.control.tool_number = round(arguments.pop("tool", 1.0))
    programmed = (arguments.get("S", 9000.0), arguments.get("F", 1800.0))
    assert bench.call(**arguments) == (*programmed, SpeedStatus.CHECK)
    bench.write(PAIR)
    bench.control.tool_number = 1
    assert bench.call() == (9400.0, 1880.0, SpeedStatus.APPLIED)


@pytest.mark.parametrize("disabled", [DISABLED, replace(PAIR, enable=False)])
def test_a_foreign_enable_bit_switches_no_pair_on(bench: SpeedBench, disabled: SpeedPair) -> None:
    bench.write(disabled)
    bench.macros.set(MACROS.enable, 1.0)
    assert bench.call()[:2] == PROGRAMMED


def test_two_exchanged_values_of_the_speed_s_block_do_not_fit_the_check() -> None:
    block = SpeedBlock(MACROS)
    held = dict(each for group in block.encode(PAIR, after=5, valid_until_s=CLOCK_S) for each in group)
    numbers = [number for number in MACROS.ours if number not in (MACROS.check, MACROS.sequence_a, MACROS.sequence_b)]
    pairs = [(a, b) for a in numbers for b in numbers if a < b and held[a] != held[b]]
    assert len(pairs) > 40
    for a, b in pairs:
        assert speed_check(MACROS, held | {a: held[b], b: held[a]}) != held[MACROS.check]


def test_the_check_of_the_largest_block_fits_into_eight_digits() -> None:
    largest = replace(OPERATION, tool_number=99_999.0, speed_rpm=1e5, feed_mm_min=1e5, depth_mm=1e3, radial_mm=1e3)
    pair = SpeedPair(made_for=replace(largest, kind=1e3), speed_rpm=1e5, feed_mm_min=1e5, enable=True)
    groups = SpeedBlock(MACROS).encode(pair, after=999_998, valid_until_s=2**31 / 1000.0)
    assert dict(each for group in groups for each in group)[MACROS.check] < 1e8


def test_without_a_variable_for_the_check_there_is_no_text(kind: type[SpeedBench], tmp_path: Path) -> None:
    unchecked = MACROS.model_copy(update={"check": None})
    with pytest.raises(GuardTextError, match=r"spindle_speed\.macros\.check names no variable"):
        speed_program(in_dialect(speed_machine(tmp_path, macros=unchecked), kind.dialect))


@pytest.mark.parametrize("code", [93, 95, 96])
def test_a_feed_or_speed_that_is_not_per_minute_is_an_alarm(bench: SpeedBench, code: int) -> None:
    bench.write(PAIR)
    bench.feed_otherwise(code)
    bench.interpreter.run(9020, **CALL)
    assert bench.control.alarm is not None
    assert bench.control.alarm[0] == bench.edge[3 if code == 96 else 2]
    assert (bench.control.spindle_rpm, bench.macros.get(MACROS.calls)) == (0.0, None)
    bench.control.alarm = None
    bench.feed_otherwise(94)
    assert bench.call()[2] is SpeedStatus.APPLIED


@pytest.mark.parametrize("arguments", [{"S": 0.0}, {"F": 0.0}, {"D": -1.0}, {"E": -1.0}, {"K": -1.0}])
def test_a_call_that_makes_no_sense_is_an_alarm(bench: SpeedBench, arguments: dict) -> None:
    bench.interpreter.run(9020, **({"S": 9000.0, "F": 1800.0} | arguments))
    assert bench.control.alarm is not None
    assert bench.control.alarm[0] == bench.edge[0]
    assert bench.macros.get(MACROS.calls) is None


def test_inch_mode_is_an_alarm(bench: SpeedBench) -> None:
    bench.inch()
    bench.interpreter.run(9020, S=9000.0, F=1800.0)
    assert bench.control.alarm is not None
    assert bench.control.alarm[0] == bench.edge[1]
    assert bench.told() is None


def test_modals_are_restored(tmp_path: Path) -> None:
    bench = SpeedBench(tmp_path)
    bench.control.set_modal(91)
    bench.call()
    assert bench.control.modal[3] == 91


def test_a_pair_does_not_outlive_power_off_though_r_parameters_do(tmp_path: Path) -> None:
    """Switched on for as long as the last time, the clock would make a pair of then valid again."""
    bench = SinumerikSpeedBench(tmp_path)
    bench.write(PAIR, valid_until_s=20.0)
    bench.control.power_on()
    bench.interpreter.run(START)
    bench.control.clock_s += 5.0
    assert bench.macros.get(MACROS.valid_until) is None
    assert bench.call() == (*PROGRAMMED, SpeedStatus.EXPIRED)
    bench.write(PAIR, valid_until_s=20.0)
    assert bench.call()[2] is SpeedStatus.APPLIED
    bench.control.power_on()  # and where no guard has been called since, the speed program has the clock started
    assert bench.call() == (*PROGRAMMED, SpeedStatus.EXPIRED)


def test_the_command_prints_the_program_of_the_machine(kind: type[SpeedBench], tmp_path: Path) -> None:
    configuration = in_dialect(speed_machine(tmp_path), kind.dialect)
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(configuration.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    result = CliRunner().invoke(main, ["guard", "--config", str(path), "--speed"])
    assert result.exit_code == 0, result.stderr
    assert result.stdout == speed_program(configuration)
    refused = CliRunner().invoke(main, ["guard", "--config", str(path), "--speed", "--policy", "zero"])
    assert refused.exit_code == 2
    assert "leave the others out" in refused.stderr
