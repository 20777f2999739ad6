"""The Haas driver at a control: what it reads, what it refuses, and answers to somebody else."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio
from scripted_machine import GROUPS, ScriptedNc, cnc_config

from drivers.clock import SystemClock
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError, NotSentError
from drivers.haas.cnc import HaasCnc
from drivers.haas.codec import encode_fields
from drivers.sim.wires.haas_server import UNKNOWN, SimulatedHaasServer
from models.records import CncMode, CncRun

pytestmark = pytest.mark.wires


class Control:
    """A simulated control and connections to it."""

    def __init__(self) -> None:
        self.nc = ScriptedNc()
        self.server = SimulatedHaasServer(self.nc, self.config(), port=0)
        self.responder = self.server.responder

    def config(self, port: int = 5051, **changes: Any) -> Any:
        return cnc_config(haas={"host": "127.0.0.1", "port": port} | changes.pop("haas", {}), **changes)

    async def connected(self, **changes: Any) -> HaasCnc:
        cnc = HaasCnc(self.config(self.server.port, **changes), SystemClock())
        await cnc.connect()
        return cnc


@pytest_asyncio.fixture
async def control() -> AsyncIterator[Control]:
    served = Control()
    await served.server.start()
    yield served
    await served.server.stop()


async def test_a_poll_gives_what_the_control_shows(control: Control) -> None:
    cnc = await control.connected()
    control.nc.macros.set(503, -0.0125)
    sample = await cnc.read([503, 501])
    assert (sample.mode, sample.run, sample.alarm) == (CncMode.MEMORY, CncRun.START, False)
    assert (sample.program, sample.sequence_number, sample.work_offset, sample.tool_number) == (1000, 20, 54, 3)
    assert sample.spindle_speed_rpm == 5000.0 and sample.motor_temperature_degc != sample.motor_temperature_degc
    assert sample.macros == {503: -0.0125, 501: None}
    assert (cnc.identity, cnc.security, set(cnc.cannot)) == (SIMULATED_CNC_IDENTITY, "insecure", {"motor_temperature"})
    control.nc.alarm, control.nc.mode = 100, 10
    later = await cnc.read([])
    assert later.alarm and later.run is CncRun.STOP and later.mode is CncMode.UNKNOWN
    assert later.clock_s > sample.clock_s and later.power_on_count == sample.power_on_count
    await cnc.close()


async def test_what_the_other_connection_is_answered_never_counts(control: Control) -> None:
    cnc = await control.connected()
    reader, writer = await asyncio.open_connection("127.0.0.1", control.server.port)
    writer.writelines([b"?Q600 501\r\n", b"?Q600 503\r\n", b"?Q600 3001\r\n", b"?Q999\r\n"] * 200)
    for count in range(20):
        control.nc.macros.values[503], control.nc.macros.values[501] = float(count), -float(count)
        assert await cnc.read_macros([503, 501]) == {503: float(count), 501: -float(count)}
        await cnc.write_macros([[(502, float(count))]])
    assert (await reader.readuntil(b"UNKNOWN")).startswith(b"\x02")
    writer.close()
    await cnc.close()


async def test_without_numbers_another_client_ends_the_link_and_the_sentence_says_so(control: Control) -> None:
    control.responder.numbered = False
    cnc = await control.connected()
    assert await cnc.read_macros([503, 3027]) == {503: None, 3027: 5000.0}
    _, writer = await asyncio.open_connection("127.0.0.1", control.server.port)
    with pytest.raises(LinkError):
        while True:
            writer.write(b"?Q600 501\r\n")
            await cnc.read_macros([503])
    with pytest.raises(LinkError, match=r"names no macro variable in its answers.*end the other client|does not fit"):
        await cnc.read_macros([503])
    writer.close()
    await cnc.close()


async def test_an_answer_that_comes_late_is_not_taken_for_the_present_value(control: Control) -> None:
    cnc = await control.connected()
    control.nc.macros.set(503, 1.0)
    old = control.responder.answer("?Q600 503")
    control.nc.macros.set(503, 2.0)
    answer, late = control.responder.answer, [old]
    control.responder.answer = lambda line: late.pop() + answer(line) if late else answer(line)  # type: ignore[method-assign]
    assert await cnc.read_macros([503, 501]) == {503: 2.0, 501: None}
    await cnc.close()


async def test_state_and_macros_of_one_poll_belong_together(control: Control) -> None:
    cnc = await control.connected(haas={})
    answer = control.responder.answer

    def position(line: str) -> bytes:
        if line == "?Q600 513" and control.nc.sequence_number == 20:
            control.nc.sequence_number = 100
            control.nc.macros.set(513, 77.0)
        return answer(line)

    control.responder.answer = position  # type: ignore[method-assign]
    sample = await cnc.read([500, 513])
    assert (sample.sequence_number, sample.macros[513]) == (100, 77.0)
    await cnc.close()


@pytest.mark.parametrize(("spaced", "newer"), [(True, False), (True, True), (False, False), (False, True)])
async def test_both_forms_of_writing_are_tried_and_the_right_one_kept(
    control: Control, spaced: bool, newer: bool
) -> None:
    answer, asked = control.responder.answer, list[str]()
    control.responder.numbered = not newer

    def strict(line: str) -> bytes:
        asked.append(line)
        unknown = encode_fields(f"?, {line}") if newer else UNKNOWN
        return unknown if line.startswith("?E") and line.startswith("?E ") != spaced else answer(line)

    control.responder.answer = strict  # type: ignore[method-assign]
    cnc = await control.connected()
    await cnc.write_macros(GROUPS)
    await cnc.write_macros(GROUPS)
    written = [line for line in asked if line.startswith("?E")]
    assert len(written) == 2 * sum(len(group) for group in GROUPS) + spaced
    assert [number for number, _ in control.nc.macros.written] == 2 * [500, 501, 502, 503, 100, 504, 506, 505]
    assert await cnc.read_macros([503, 506]) == {503: 0.0105, 506: 29_813.0}
    await cnc.close()


async def test_a_refused_write_names_the_macro_and_what_it_holds_and_nothing_follows(control: Control) -> None:
    control.responder.refused_macros.add(501)
    cnc = await control.connected()
    with pytest.raises(FatalDriverError, match=r"#501 = 0\.001: it holds None afterwards") as refused:
        await cnc.write_macros(GROUPS)
    assert not isinstance(refused.value, NotSentError)
    assert [number for number, _ in control.nc.macros.written] == [500]
    with pytest.raises(NotSentError, match=r"#502: 10000000000000.0 has more digits"):
        await cnc.write_macros([[(500, 2.0)], [(502, 1e13)]])
    assert await cnc.read_macros([500]) == {500: 1.0}
    await cnc.close()


async def test_what_a_control_leaves_vacant_is_said_with_its_reason(control: Control) -> None:
    numbers = {"sequence_number_macro": 550, "spindle_speed_macro": 551, "program_macro": 552}
    cnc = HaasCnc(control.config(control.server.port, haas=numbers), SystemClock())
    await cnc.connect()
    assert cnc.cannot["sequence_number"] == "system variable #550 is vacant"
    assert {"sequence_number", "spindle_speed", "program", "motor_temperature"} == set(cnc.cannot)
    sample = await cnc.read([])
    assert sample.spindle_speed_rpm != sample.spindle_speed_rpm and sample.sequence_number == 0
    await cnc.close()
    with pytest.raises(LinkError, match="#553 is vacant, and the machine's state needs it"):
        await control.connected(haas={"tool_macro": 553})
    control.nc.macros.set(554, 2.5)
    for name in ("tool_macro", "program_macro", "sequence_number_macro"):
        with pytest.raises(LinkError, match=r"#554 holds 2\.5, which is no whole number"):
            await (await control.connected(haas={name: 554})).read([])
    with pytest.raises(LinkError, match=r"it does not understand \?Q600 99: check cnc\.macros"):
        await control.connected(haas={"tool_macro": 99}, timeout_s=0.3)


async def test_a_work_offset_whose_number_no_variable_tells_is_none(control: Control) -> None:
    cnc = await control.connected()
    for code, told in {59: 59, 110: 110, 129: 129, 154: 0, 154.5: 0}.items():
        control.nc.work_offset = code  # type: ignore[assignment]
        assert (await cnc.read([])).work_offset == told, "#4116 holds the P of G154, and of the G04 or G65 after it"
    await cnc.close()


async def test_a_power_on_ends_the_link_and_a_clock_that_goes_back_too(control: Control) -> None:
    cnc = await control.connected()
    before = await cnc.read([])
    control.nc._clock_s = 1.0
    with pytest.raises(LinkError, match="late answer, or a program has set #3001"):
        await cnc.read([])
    await cnc.close()
    control.nc._clock_s = 100.0
    cnc = await control.connected()
    control.nc.power_on_count += 1
    with pytest.raises(LinkError, match="ended the connection"):
        await cnc.read([])
    await cnc.close()
    cnc = await control.connected()
    assert (await cnc.read([])).power_on_count > before.power_on_count
    await cnc.close()
