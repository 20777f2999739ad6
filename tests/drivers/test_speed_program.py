"""The speed program as `toolpoint guard --speed` prints it, run by the simulated NC."""

import sys
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from speed_machine import MACROS, speed_machine

from config.guard.speed_text import SpeedStatus, speed_program
from config.machines import shipped_file
from daemon.cli import main
from daemon.output.speed_block import DISABLED, SpeedBlock, SpeedPair
from drivers.sim.custom_macro import Interpreter, MacroControl, compile_programs
from drivers.sim.nc import MacroTable

CLOCK_S = 1000.0


class SpeedBench:
    def __init__(self, folder: Path, **changes: object) -> None:
        self.configuration = speed_machine(folder, **changes)
        self.macros = MacroTable()
        self.control = MacroControl(self.macros, addresses=["X", "Y", "Z"], increment_mm=0.001)
        self.control.clock_s = CLOCK_S
        self.interpreter = Interpreter(compile_programs(speed_program(self.configuration)), self.control)
        self.block = SpeedBlock(MACROS)

    def write(self, pair: SpeedPair, *, valid_until_s: float = CLOCK_S + 20.0) -> None:
        for group in self.block.encode(pair, after=5, valid_until_s=valid_until_s):
            for number, value in group:
                self.macros.set(number, value)

    def call(self, **arguments: float) -> tuple[float, float, SpeedStatus]:
        self.interpreter.run(9020, **({"S": 9000.0, "F": 1800.0} | arguments))
        assert (self.macros.get(MACROS.echo_speed), self.macros.get(MACROS.echo_feed)) == (
            self.control.spindle_rpm,
            self.control.feed_mm_min,
        )
        status = SpeedStatus(round(self.macros.get(MACROS.echo_status) or 0.0))
        return self.control.spindle_rpm, self.control.feed_mm_min, status


PAIR = SpeedPair(for_rpm=9000.0, speed_rpm=9400.0, feed_mm_min=1880.0, enable=True)
PROGRAMMED = (9000.0, 1800.0)


@pytest.fixture
def bench(tmp_path: Path) -> SpeedBench:
    return SpeedBench(tmp_path)


def test_the_pair_is_taken_and_the_call_is_told(bench: SpeedBench) -> None:
    bench.write(PAIR)
    assert bench.call(D=4.5, E=5.0) == (9400.0, 1880.0, SpeedStatus.APPLIED)
    told = [bench.macros.get(number) for number in (MACROS.called_speed, MACROS.called_feed, MACROS.called_depth)]
    assert told == [9000.0, 1800.0, 4.5]
    assert bench.macros.get(MACROS.called_radial) == 5.0
    assert (bench.macros.get(MACROS.calls), bench.macros.get(MACROS.wanted)) == (1.0, 1.0)
    assert bench.call()[2] is SpeedStatus.APPLIED
    assert (bench.macros.get(MACROS.calls), bench.macros.get(MACROS.called_depth)) == (2.0, 0.0)


def test_a_call_without_tuning_takes_the_programmed_pair(bench: SpeedBench) -> None:
    bench.write(PAIR)
    assert bench.call(K=0.0) == (*PROGRAMMED, SpeedStatus.NOT_WANTED)
    assert bench.macros.get(MACROS.wanted) == 0.0


@pytest.mark.parametrize(
    "pair,changes,status",
    [
        (DISABLED, {}, SpeedStatus.DISABLED),
        (PAIR, {"valid_until_s": CLOCK_S - 1.0}, SpeedStatus.EXPIRED),
        (PAIR, {"valid_until_s": CLOCK_S + 1e4}, SpeedStatus.EXPIRED),
        (SpeedPair(for_rpm=8000.0, speed_rpm=8300.0, feed_mm_min=1660.0, enable=True), {}, SpeedStatus.ANOTHER),
        (SpeedPair(for_rpm=9000.0, speed_rpm=10900.0, feed_mm_min=2180.0, enable=True), {}, SpeedStatus.OUT_OF_BOUNDS),
        (SpeedPair(for_rpm=9000.0, speed_rpm=9400.0, feed_mm_min=2500.0, enable=True), {}, SpeedStatus.OUT_OF_BOUNDS),
        (SpeedPair(for_rpm=9000.0, speed_rpm=9400.0, feed_mm_min=0.0, enable=True), {}, SpeedStatus.OUT_OF_BOUNDS),
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
    bench.macros.power_off()
    assert bench.call() == (*PROGRAMMED, SpeedStatus.EXPIRED)
    for number in (MACROS.for_speed, MACROS.speed, MACROS.feed, MACROS.enable):
        bench.write(PAIR)
        bench.macros.set(number, None)
        assert bench.call()[:2] == PROGRAMMED


def test_a_plain_feed_must_be_the_programmed_one(tmp_path: Path) -> None:
    bench = SpeedBench(tmp_path, keep_feed_per_tooth=False)
    bench.write(PAIR)
    assert bench.call() == (*PROGRAMMED, SpeedStatus.OUT_OF_BOUNDS)
    bench.write(SpeedPair(for_rpm=9000.0, speed_rpm=9400.0, feed_mm_min=1800.0, enable=True))
    assert bench.call() == (9400.0, 1800.0, SpeedStatus.APPLIED)


@pytest.mark.parametrize("arguments", [{"S": 0.0}, {"F": 0.0}])
def test_a_call_without_speed_or_feed_is_an_alarm(bench: SpeedBench, arguments: dict) -> None:
    bench.interpreter.run(9020, **({"S": 9000.0, "F": 1800.0} | arguments))
    assert bench.control.alarm is not None
    assert bench.control.alarm[0] == 130


def test_inch_mode_is_an_alarm_and_modals_are_restored(bench: SpeedBench) -> None:
    bench.control.set_modal(91)
    bench.call()
    assert bench.control.modal[3] == 91
    bench.control.set_modal(20)
    bench.interpreter.run(9020, S=9000.0, F=1800.0)
    assert bench.control.alarm is not None
    assert bench.control.alarm[0] == 131


def test_the_command_prints_the_program_of_the_machine(tmp_path: Path) -> None:
    configuration = speed_machine(tmp_path)
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump(configuration.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    result = CliRunner().invoke(main, ["guard", "--config", str(path), "--speed"])
    assert result.exit_code == 0, result.stderr
    assert result.stdout == speed_program(configuration)
    refused = CliRunner().invoke(main, ["guard", "--config", str(path), "--speed", "--policy", "zero"])
    assert refused.exit_code == 2
    assert "leave the others out" in refused.stderr


def test_the_command_refuses_a_machine_without_tuning() -> None:
    result = CliRunner().invoke(main, ["guard", "--config", str(shipped_file("cfrpmt.yaml")), "--speed"])
    assert result.exit_code == 2
    assert "no section spindle_speed" in result.stderr
