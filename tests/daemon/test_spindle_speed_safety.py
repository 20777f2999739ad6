"""What must never happen to the spindle speed, each by the history that would bring it about."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from control_rig import running
from memory_cnc import MemoryCnc
from speed_machine import MACROS
from speed_rig import CUT, SAFE, SpeedRig, acknowledge, turned

from daemon.history.reader import HistoryReader
from drivers.contract import FatalDriverError
from drivers.guard.speed_text import SpeedStatus

bench = turned

PROGRAMMED = (9000.0, 1800.0)
APPLIED = SpeedStatus.APPLIED


async def events(bench: SpeedRig, *kinds: str) -> list[str]:
    await bench.rig.history.flushed()
    with HistoryReader(bench.rig.configuration.history.path) as reader:
        return [event.text for event in reader.events(0.0, 1e12) if event.kind in kinds]


# --- a pair belongs to its operation -------------------------------------------------------


@pytest.mark.parametrize("other", [{"D": 8.0, "E": 9.0}, {"D": 1.0}, {"F": 1500.0}, {"K": 2.0}])
async def test_a_deeper_or_otherwise_other_cut_does_not_take_the_pair(bench: SpeedRig, other: dict) -> None:
    assert (await bench.operation())[2] is APPLIED
    assert bench.call(**other)[0] == 9000.0
    assert bench.call(**other)[2] is SpeedStatus.ANOTHER
    assert bench.call()[2] is APPLIED


async def test_another_tool_with_the_same_numbers_does_not_take_the_pair(bench: SpeedRig) -> None:
    assert (await bench.operation())[2] is APPLIED
    bench.nc.tool_number = 2
    assert bench.call() == (*PROGRAMMED, SpeedStatus.ANOTHER)
    await bench.pass_by(3.0, SAFE)
    assert bench.call() == (*PROGRAMMED, SpeedStatus.DISABLED)
    assert bench.picture()["state"] == "OFF"


async def test_a_call_is_not_joined_with_the_tool_of_an_older_poll(bench: SpeedRig) -> None:
    """The tool is changed and the call made between two polls; the daemon looks before it polls again."""
    await bench.operation()
    bench.nc.tool_number = 2
    bench.call(D=3.0)
    bench.clock.monotonic_s += 1.0
    await bench.rig.serve()
    assert bench.picture()["operation"] == "T1 S9000 F1800 D2"
    await bench.pass_by(2.0, SAFE)
    assert bench.picture()["operation"] == "T2 S9000 F1800 D3"
    assert bench.picture()["alarm"] == ""


async def test_a_call_that_names_another_tool_than_the_cnc_is_not_tuned(bench: SpeedRig) -> None:
    bench.nc.sequence_number = SAFE
    bench.call()
    bench.nc.macros.set(MACROS.called_tool, 7.0)
    await bench.pass_by(5.0, SAFE)
    assert "the call says tool 7 (#4120), the CNC says 1" in bench.picture()["alarm"]
    assert bench.picture()["state"] == "OFF"
    assert not any(bench.written())


async def test_a_control_with_another_text_is_not_tuned(bench: SpeedRig) -> None:
    bench.nc.sequence_number = SAFE
    bench.call()
    bench.nc.macros.set(MACROS.called_text, 1.0)
    await bench.pass_by(5.0, SAFE)
    assert "print it (`toolpoint guard --speed`) and load it" in bench.picture()["alarm"]
    assert not any(bench.written())


async def test_the_tool_s_own_limit_holds(tmp_path: Path) -> None:
    free = SpeedRig(tmp_path)
    async with running(free.rig):
        await free.rig.turn()
        target_rpm = (await free.operation())[0]
    assert target_rpm > 9100.0
    folder = tmp_path / "limited"
    folder.mkdir()
    assert free.configuration.spindle_speed is not None
    operation = free.configuration.spindle_speed.operations[0].model_copy(update={"highest_rpm": 9100.0})
    bench = SpeedRig(folder, operations=[operation])
    async with running(bench.rig):
        await bench.rig.turn()
        assert (await bench.operation())[0] <= 9100.0
        assert bench.rig.control.journal.fault is None


# --- an operation lasts from call to call --------------------------------------------------


@pytest.mark.parametrize("program", [9020, 9010, 9013, 4711])
async def test_a_poll_within_another_program_changes_nothing_in_the_cut(bench: SpeedRig, program: int) -> None:
    """The guard's programs, the speed program and a subprogram."""
    speed_rpm, *_ = await bench.operation()
    await bench.pass_by(3.0, CUT)
    count = len(bench.nc.written)
    bench.nc.program = program
    await bench.pass_by(14.0, CUT)
    bench.nc.program = 1000
    await bench.pass_by(14.0, CUT)
    assert {value for number, value in bench.nc.written[count:] if number == MACROS.enable} == {1.0}
    assert {value for number, value in bench.nc.written[count:] if number == MACROS.speed} == {speed_rpm}
    assert bench.call()[0] == speed_rpm
    await bench.pass_by(3.0, SAFE)
    assert bench.call()[0] == speed_rpm


async def test_a_call_that_is_being_told_is_not_taken(bench: SpeedRig) -> None:
    speed_rpm, *_ = await bench.operation()
    await bench.pass_by(2.0, CUT)
    count = len(bench.nc.written)
    calls = bench.nc.macros.get(MACROS.calls)
    assert calls is not None
    bench.nc.macros.set(MACROS.calls, -calls - 1.0)
    bench.nc.macros.set(MACROS.called_depth, 0.0)
    await bench.pass_by(12.0, CUT)
    bench.nc.macros.set(MACROS.called_depth, 2.0)
    bench.nc.macros.set(MACROS.calls, calls + 1.0)
    await bench.pass_by(12.0, CUT)
    assert {value for number, value in bench.nc.written[count:] if number == MACROS.speed} == {speed_rpm}
    assert bench.call()[0] == speed_rpm


async def test_an_operation_that_comes_again_goes_on_in_steps(bench: SpeedRig) -> None:
    """Two operations in turn while the spindle warms: each moves by a step at most, or jumps to another pocket."""
    taken: dict[float, list[float]] = {2.0: [], 1.5: []}
    for number in range(24):
        depth_mm = (2.0, 1.5)[number % 2]
        speed_rpm, _, status = await bench.operation(D=depth_mm)
        assert status is APPLIED
        taken[depth_mm].append(speed_rpm)
        bench.degc += 0.5
        await bench.pass_by(25.0, CUT)
    for speeds in taken.values():
        steps = [abs(b - a) for a, b in itertools.pairwise(speeds)]
        assert max(steps) > 0.0
        assert max(steps) <= 200.5


# --- faults, prohibitions, a lost link -----------------------------------------------------


async def test_in_fault_nothing_is_decided_and_afterwards_nothing_leaps(bench: SpeedRig) -> None:
    first, *_ = await bench.operation()
    await bench.pass_by(2.0, CUT)
    said = await events(bench, "speed")
    bench.rig.control.journal.raise_fault("compensation: read-back differs")
    count = len(bench.nc.written)
    for _ in range(4):
        bench.degc += 3.0
        await bench.pass_by(35.0, SAFE)
        await bench.pass_by(2.0, CUT)
    picture = bench.picture()
    assert picture["state"] == "HOLD"
    assert "FAULT: compensation: read-back differs" in picture["alarm"]
    assert picture["commanded_rpm"] is picture["commanded_feed_mm_min"] is None
    assert bench.call() == (*PROGRAMMED, SpeedStatus.EXPIRED)
    assert len(bench.nc.written) == count
    assert await events(bench, "speed") == said
    await acknowledge(bench)
    await bench.pass_by(30.0, CUT)
    assert set(bench.written()[-2:]) == {first}
    assert bench.call()[:1] == (first,)
    await bench.pass_by(30.0, CUT)
    await bench.pass_by(30.0, SAFE)
    assert 0.0 < abs(bench.call()[0] - first) <= 200.5


async def test_where_nothing_may_be_written_it_says_so_and_decides_nothing(bench: SpeedRig) -> None:
    bench.rig.interlocks._commissioning = None
    bench.rig.interlocks._not_proved.cache_clear()  # the record is read at the start, and judged once
    assert (await bench.operation())[:2] == PROGRAMMED
    await bench.pass_by(60.0, SAFE)
    picture = bench.picture()
    assert picture["state"] == "HOLD"
    assert "commission" in picture["alarm"]
    assert picture["commanded_rpm"] is None
    assert not bench.written()
    assert not [text for text in await events(bench, "speed") if "begins" not in text]
    assert len([text for text in await events(bench, "alarm") if text.startswith("spindle speed")]) == 1


@pytest.mark.parametrize("taken_groups", [0, 1, 2])
async def test_a_link_lost_twice_in_a_cut_changes_nothing_in_it(bench: SpeedRig, taken_groups: int) -> None:
    speed_rpm, *_ = await bench.operation()
    bench.degc = 36.0
    await bench.pass_by(3.0, CUT)
    count = len(bench.nc.written)
    for _ in range(2):
        bench.nc.reachable = False
        await bench.pass_by(2.0, CUT)
        assert bench.picture()["commanded_rpm"] is None
        bench.nc.reachable, bench.nc.groups_until_lost = True, taken_groups
        written = len(bench.written())
        await bench.rig.connected()
        await bench.pass_by(3.0, CUT)
        assert len(bench.written()) > written, "what may be torn is written again at once"
    await bench.rig.connected()
    await bench.pass_by(20.0, CUT)
    assert {value for number, value in bench.nc.written[count:] if number == MACROS.speed} == {speed_rpm}
    assert {value for number, value in bench.nc.written[count:] if number == MACROS.enable} == {1.0}
    assert bench.call()[::2] == (speed_rpm, APPLIED)
    assert bench.rig.control.journal.fault is None
    await bench.pass_by(20.0, CUT)
    await bench.pass_by(20.0, SAFE)
    assert 0.0 < abs(bench.call()[0] - speed_rpm) <= 200.5


@pytest.mark.parametrize("refusal", ["refuses", "forgets"])
async def test_a_refused_step_is_taken_back(bench: SpeedRig, refusal: str) -> None:
    speed_rpm, *_ = await bench.operation()
    bench.degc += 14.0
    await bench.pass_by(60.0, CUT)
    setattr(bench.nc, refusal, MACROS.speed)
    await bench.pass_by(3.0, SAFE)
    assert "spindle speed" in str(bench.rig.control.journal.fault)
    setattr(bench.nc, refusal, None)
    await acknowledge(bench)
    assert bench.rig.control.journal.fault is None
    await bench.pass_by(20.0, CUT)
    assert bench.call()[0] == speed_rpm
    assert not [text for text in await events(bench, "speed") if text.startswith("moves")]


async def test_macros_that_cannot_be_read_cost_the_compensation_nothing(
    bench: SpeedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_macros = MemoryCnc.read_macros

    async def refusing(self: MemoryCnc, macros: Any) -> dict[int, float | None]:
        if MACROS.echo_status in macros:
            raise FatalDriverError("the CNC's OPC UA server has no macro variable #560")
        return await read_macros(self, macros)

    monkeypatch.setattr(MemoryCnc, "read_macros", refusing)
    await bench.rig.active()
    session = bench.rig.link.session
    await bench.pass_by(60.0, SAFE)
    await bench.rig.follow(5.0, 0.0, 4)
    assert bench.rig.link.session is session
    assert bench.rig.state == "ACTIVE"
    assert "has no macro variable #560" in bench.picture()["alarm"]
    monkeypatch.undo()
    bench.nc.reachable = False
    await bench.pass_by(2.0, SAFE)
    bench.nc.reachable = True
    await bench.rig.connected()
    assert (await bench.operation())[2] is APPLIED
