"""When the simulated machine runs its NC programs: handshake, safe flag, alarms, operator messages."""

import re
from importlib.resources import files
from typing import Any

import pytest
from guard_bench import AXES, MAP

from config.schema.cnc import MacroMapConfig, RequestMacrosConfig
from config.schema.guard import GuardConfig
from config.schema.temperatures import SensorConfig
from drivers.guard.programs import guard_text
from drivers.sim.machine.day import Day
from drivers.sim.machine.machine import CfrpMachine
from drivers.sim.nc.custom_macro.control import DEFAULT_MODALS
from drivers.sim.nc.nc_programs import MACRO_ALARM
from drivers.sim.nc.program import SAFE, Block, PartProgram
from drivers.sim.nc.safe_point import SafePointApplication

REQUEST = RequestMacrosConfig(counter=520, kind=521, axis=522, value_mm=523, acknowledge=524)
FLAG = 525
SENSORS = [SensorConfig(id=1, component="Ambient", label="Room")]
PROGRAM = PartProgram(
    number=77,
    blocks=(
        Block(sequence_number=10, kind="idle", duration_s=5.0),
        Block(sequence_number=100, kind="positioning", duration_s=20.0),
        Block(sequence_number=200, kind="cut", duration_s=30.0, spindle_speed_rpm=12000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=4.0, tool_number=7),
        Block(sequence_number=210, kind="cut", duration_s=30.0, spindle_speed_rpm=12000.0),
        Block(sequence_number=SAFE, kind="safe", duration_s=4.0, probe="z"),
    ),
    repeat_from=1,
)


def machine(*, flag: bool = False, **guard: Any) -> CfrpMachine:
    settings = {"increment_mm": 0.0001, "on_timeout": "continue"} | guard
    maps = MAP.model_dump() | {"request": REQUEST.model_dump(), "safe_flag": FLAG if flag else None}
    return CfrpMachine(
        Day.draw(5, start="cold"),
        PROGRAM,
        SENSORS,
        SafePointApplication(MacroMapConfig.model_validate(maps), AXES, GuardConfig(**settings)),
    )


def request_of(simulated: CfrpMachine) -> tuple[float | None, ...]:
    return tuple(simulated.nc.macros.get(number) for number in (520, 521, 522, 523))


def test_requests_are_made_where_the_program_asks() -> None:
    simulated = machine()
    simulated.advance(4.9)
    assert request_of(simulated) == (0.0, 0.0, 0.0, 0.0)
    simulated.advance(5.5)
    assert request_of(simulated) == (1.0, 1.0, 0.0, 0.0)
    simulated.nc.macros.set(524, 1.0)
    simulated.advance(55.5)
    assert request_of(simulated) == (2.0, 3.0, 0.0, 7.0)
    assert simulated.nc.tool_number == 7
    simulated.nc.macros.set(524, 2.0)
    simulated.advance(91.0)
    measured = simulated.truth()["z"].compensated_um
    counter, kind, axis, value = request_of(simulated)
    assert (counter, kind, axis) == (3.0, 2.0, 3.0)
    assert value * 1000.0 == pytest.approx(measured, abs=0.5)


@pytest.mark.parametrize("timeout_s,ends_s", [(10.0, 25.0), (40.0, 45.1)])
def test_a_request_without_an_answer_holds_its_block_until_the_time_is_over(timeout_s: float, ends_s: float) -> None:
    simulated = machine(request_timeout_s=timeout_s)
    simulated.advance(ends_s - 0.2)
    assert simulated.nc.sequence_number == 100
    simulated.advance(ends_s + 0.2)
    assert simulated.nc.sequence_number == 200
    assert request_of(simulated)[1] == 0.0
    assert not simulated.guard.control.messages


@pytest.mark.parametrize("stop", ["message", "stop"])
@pytest.mark.parametrize("code", [90, 91])
def test_the_programs_leave_the_modes_as_they_were(code: int, stop: str) -> None:
    """Also where nobody answers and an alarm ends the program: a RESET does not bring them back on every control."""
    simulated = machine(flag=True, alarm=stop, on_timeout=stop)
    guard, macros = simulated.guard, simulated.nc.macros
    guard.control.modal[3] = code
    for number in (guard.programs.enter, guard.programs.leave, guard.programs.guard):
        assert number is not None
        guard.at(macros, 10.0).run(number)
        assert guard.control.modal == DEFAULT_MODALS | {3: code}
    assert guard.programs.request is not None
    guard.at(macros, 10.0).start(guard.programs.request, K=1.0)
    guard.at(macros, 10.0).wait()
    while guard.at(macros, 30.0).wait() is not None:
        continue
    assert guard.control.modal == DEFAULT_MODALS | {3: code}


@pytest.mark.parametrize("alarm,expected", [("message", 0), ("stop", MACRO_ALARM + 123)])
def test_a_refusal_is_told_to_the_operator(alarm: str, expected: int) -> None:
    simulated = machine(alarm=alarm)
    simulated.advance(5.5)
    simulated.nc.macros.set(524, -1.0)
    simulated.advance(6.0)
    assert simulated.nc.alarm == expected
    text = "TOOLPOINT REFUSES REQUEST"
    control = simulated.guard.control
    assert list(control.messages) == ([text] if alarm == "message" else [])
    assert control.alarm == (None if alarm == "message" else (123, text))
    simulated.advance(26.0)
    assert (simulated.nc.alarm, simulated.nc.sequence_number) == (0, 200)


def test_an_old_answer_does_not_count() -> None:
    simulated = machine()
    simulated.advance(5.5)
    simulated.nc.macros.set(524, 1.0)
    simulated.advance(55.1)
    assert request_of(simulated)[0] == 2.0
    assert simulated.guard.interpreter.running


@pytest.mark.parametrize("counter,following", [(None, 1.0), (-3.0, 1.0), (999_999.0, 1.0), (41.0, 42.0), (4.5, 5.0)])
def test_the_counter_goes_on_from_whatever_it_is(counter: float | None, following: float) -> None:
    simulated = machine()
    simulated.nc.macros.set(520, counter)
    simulated.advance(5.5)
    assert request_of(simulated)[0] == following


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        *({"K": kind} for kind in (4.0, 0.0, 1.5, 2.5, 1e-9, -1.0, 1e300)),
        *({"K": 1.0, "A": axis} for axis in (4.0, -1.0, 2.4, 1e-9, 1e300)),
        {"K": 2.0},
        {"K": 2.0, "A": 3.0},
        *({"K": 2.0, "A": axis, "V": 0.01} for axis in (0.0, 3.4, 4.0, 1e-9)),
        {"K": 2.0, "V": 0.01},
        {"K": 3.0},
        {"K": 3.0, "A": 1.0},
        *({"K": 3.0, "V": tool} for tool in (2.5, -1.0, 1e-9, 1e8, 1e300)),
    ],
)
def test_a_wrong_call_is_refused_before_anything_is_asked(arguments: dict[str, float]) -> None:
    simulated = machine()
    guard = simulated.guard
    assert guard.programs.request is not None
    guard.at(simulated.nc.macros, 1.0).run(guard.programs.request, **arguments)
    assert guard.control.alarm == (120, "TOOLPOINT REQUEST WRONG")
    assert request_of(simulated) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("counter,acknowledge,following", [(None, 1.0, 2.0), (None, -1.0, 2.0), (6.0, 7.0, 8.0)])
def test_an_answer_that_stands_there_from_before_answers_no_request(
    counter: float | None, acknowledge: float, following: float
) -> None:
    simulated = machine()
    simulated.nc.macros.set(520, counter)
    simulated.nc.macros.set(524, acknowledge)
    simulated.advance(5.5)
    assert request_of(simulated)[0] == following
    assert simulated.guard.interpreter.running, "it waits"


def test_a_request_in_inches_is_refused() -> None:
    simulated = machine()
    guard = simulated.guard
    guard.control.modal[6] = 20
    assert guard.programs.request is not None
    guard.at(simulated.nc.macros, 1.0).run(guard.programs.request, K=1.0)
    assert guard.control.alarm == (121, "TOOLPOINT REQUEST IN INCH")


def test_a_timer_that_wraps_while_waiting_does_not_end_the_wait() -> None:
    simulated = machine()
    guard, macros = simulated.guard, simulated.nc.macros
    assert guard.programs.request is not None
    start_s = 2_147_483.648 - 1.0
    guard.at(macros, start_s).start(guard.programs.request, K=1.0)
    waited_s = 0.0
    while (dwell_s := guard.at(macros, start_s + waited_s).wait()) is not None:
        waited_s += dwell_s
        assert waited_s < 20.0
    assert waited_s == pytest.approx(10.0, abs=0.2)


def test_the_safe_flag_is_set_in_safe_blocks_only() -> None:
    simulated = machine(flag=True, request_timeout_s=0.5)
    flags = {}
    for tenths in range(1, 1300):
        simulated.advance(tenths / 10.0)
        flags.setdefault(simulated.nc.sequence_number, set()).add(simulated.nc.macros.get(FLAG))
    assert flags[200] == {0.0} and flags[100] == {0.0} and flags[210] == {0.0}
    assert 1.0 in flags[SAFE]


def test_the_number_of_an_alarm_is_the_number_of_one_message() -> None:
    maps = MAP.model_dump() | {"request": REQUEST.model_dump(), "safe_flag": FLAG}
    guard = guard_text(MacroMapConfig.model_validate(maps), AXES, GuardConfig(alarm="stop", on_timeout="stop"))
    texts = guard + files("drivers.guard").joinpath("speed.nc").read_text("ascii")
    words: dict[str, set[str]] = {}
    for number, message in re.findall(r"#3000=(\d+)\((TOOLPOINT [^)]+)\)", texts):
        words.setdefault(number, set()).add(message)
    assert {"103", "112", "123", "130"} <= set(words)
    assert {number: messages for number, messages in words.items() if len(messages) > 1} == {}
