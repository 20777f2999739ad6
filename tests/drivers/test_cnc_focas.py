"""The FOCAS driver at a control: what it reads, what it refuses, and answers that are not its own."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import pytest_asyncio
from scripted_machine import GROUPS, ScriptedNc, cnc_config

from drivers.clock import SystemClock
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError, NotSentError
from drivers.focas.cnc import FocasCnc
from drivers.focas.codec import Direction, Frame, FrameBuffer, Function, Kind, encode_frame
from drivers.sim.wires.focas_server import SimulatedFocasServer
from models.records import CncMode, CncRun

pytestmark = pytest.mark.wires
DIAGNOSIS = 403
Change = Callable[[list[bytes], bytes], list[bytes]]


class Control:
    """A simulated control, and what reaches it and comes from it changed as a test says."""

    def __init__(self) -> None:
        self.nc = ScriptedNc()
        self.server = SimulatedFocasServer(self.nc, self.config(0), port=0)
        self.responder = self.server.responder

    def config(self, port: int, **changes: Any) -> Any:
        focas = {"host": "127.0.0.1", "motor_temperature_diagnosis": DIAGNOSIS} | changes.pop("focas", {})
        return cnc_config(focas=focas | ({"port": port} if port else {}), **changes)

    def open(self, **changes: Any) -> FocasCnc:
        return FocasCnc(self.config(self.server.port, **changes), SystemClock())

    async def connected(self, **changes: Any) -> FocasCnc:
        cnc = self.open(**changes)
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
    assert (sample.spindle_speed_rpm, sample.motor_temperature_degc) == (5000.0, 32.0)
    assert sample.macros == {503: -0.0125, 501: None}
    assert (cnc.identity, cnc.security) == (SIMULATED_CNC_IDENTITY, "insecure")
    control.nc.alarm, control.nc.run, control.nc.mode = 100, 0, 77
    later = await cnc.read([])
    assert later.alarm and later.run is CncRun.RESET and later.mode is CncMode.UNKNOWN
    assert later.clock_s > sample.clock_s and later.power_on_count == sample.power_on_count
    await cnc.close()


@pytest.mark.parametrize("most", [5, 12])
async def test_a_control_that_takes_few_blocks_at_once_is_asked_in_parts(control: Control, most: int) -> None:
    control.responder.most_blocks = most
    cnc = await control.connected()
    await cnc.write_macros(GROUPS)
    sample = await cnc.read([number for group in GROUPS for number, _ in group])
    assert sample.macros == {number: value for group in GROUPS for number, value in group}
    assert (sample.program, sample.sequence_number, sample.tool_number) == (1000, 20, 3)
    control.responder.most_blocks = 4
    with pytest.raises(LinkError, match="a request was answered with 2103"):
        await cnc.read([])
    await cnc.close()


async def test_a_power_on_ends_the_link_and_is_another_number(control: Control) -> None:
    cnc = await control.connected()
    before = await cnc.read([])
    control.nc.power_on_count += 1
    control.nc._clock_s = 1.0
    with pytest.raises(LinkError, match="ended the connection"):
        await cnc.read([])
    await cnc.close()
    again = await control.connected()
    after = await again.read([])
    assert after.power_on_count > before.power_on_count
    await again.close()


async def test_what_a_control_does_not_have_is_said_with_its_reason_and_no_number(control: Control) -> None:
    control.responder.refused_functions[Function.SPINDLE_SPEED] = 1
    cnc = await control.connected(focas={"motor_temperature_diagnosis": 404})
    sample = await cnc.read([])
    assert sample.spindle_speed_rpm != sample.spindle_speed_rpm
    assert sample.motor_temperature_degc != sample.motor_temperature_degc
    assert (
        cnc.cannot["spindle_speed"]
        == "the control says: it does not have this function, or not in this state (error 1)"
    )
    assert cnc.cannot["motor_temperature"].startswith("the control says: it has no such number")
    await cnc.close()


@pytest.mark.parametrize(
    ("error", "remedy"), [(6, "an option is missing"), (7, "turn the key of the memory protection"), (13, "background")]
)
async def test_a_refused_write_names_the_macros_and_the_remedy_and_changes_nothing(
    control: Control, error: int, remedy: str
) -> None:
    cnc = await control.connected()
    for function in (Function.WRITE_MACRO, Function.WRITE_MACROS):
        control.responder.refused_functions[function] = error
    with pytest.raises(FatalDriverError, match=rf"#500 = 1.0.*{remedy}") as refused:
        await cnc.write_macros(GROUPS)
    assert not isinstance(refused.value, NotSentError)
    assert control.nc.macros.written == []
    assert await cnc.read_macros([500]) == {500: None}, "the connection stands"
    await cnc.close()


@pytest.mark.parametrize(("error", "cause"), [(-1, "it is busy"), (10, "its buffer is full")])
async def test_a_control_that_is_busy_has_refused_nothing_for_good(control: Control, error: int, cause: str) -> None:
    cnc = await control.connected()
    for function in (Function.WRITE_MACRO, Function.WRITE_MACROS):
        control.responder.refused_functions[function] = error
    with pytest.raises(LinkError, match=rf"#500 = 1.0.*{cause}; try again"):
        await cnc.write_macros(GROUPS)
    assert control.nc.macros.written == []
    await cnc.close()


async def test_an_older_control_is_written_one_by_one(control: Control) -> None:
    control.responder.refused_functions[Function.WRITE_MACROS] = 1
    cnc = await control.connected()
    await cnc.write_macros(GROUPS)
    await cnc.write_macros(GROUPS)
    numbers = [number for number, _ in control.nc.macros.written]
    assert numbers == 2 * [500, 100, 501, 502, 503, 504, 506, 505]
    assert await cnc.read_macros([503, 506]) == {503: 0.0105, 506: 29_813.0}
    await cnc.close()


async def test_a_missing_state_is_refused_with_what_is_missing(control: Control) -> None:
    control.responder.refused_functions[Function.SEQUENCE_NUMBER] = 6
    with pytest.raises(FatalDriverError, match="let the sequence number be read: an option is missing"):
        await control.connected()
    control.responder.refused_functions.clear()
    with pytest.raises(FatalDriverError, match=r"the path does not exist: check cnc\.focas\.path"):
        await control.connected(focas={"path": 2})
    with pytest.raises(LinkError, match=r"#550 is vacant, and the machine's state needs it"):
        await control.connected(focas={"tool_macro": 550})
    control.nc.macros.set(551, 2.5)
    with pytest.raises(LinkError, match=r"#551 holds 2\.5, which is no whole number"):
        await (await control.connected(focas={"tool_macro": 551})).read([])


async def test_a_sixth_session_is_told_what_to_end(control: Control) -> None:
    others = [await control.connected() for _ in range(5)]
    with pytest.raises(LinkError, match="no session left: a control has five"):
        await control.connected()
    await others[0].close()
    others[0] = await control.connected()
    for cnc in others:
        await cnc.close()
    await control.server.stop()
    with pytest.raises(LinkError, match=r"refuses the connection: check cnc\.focas\.port"):
        await control.connected()


async def test_a_clock_that_stands_still_is_a_lost_link(control: Control) -> None:
    cnc = await control.connected(stale_after_s=0.05, poll_period_s=0.01)
    control.nc.clock_runs = False
    with pytest.raises(LinkError, match="its clock stands still"):
        while True:
            await cnc.read([])
            await asyncio.sleep(0.01)
    await cnc.close()


class Disturber:
    """Stands between driver and control; `change` turns each answer into what the driver gets."""

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._kept: list[bytes] = []
        self.change: Change = lambda kept, answer: [answer]

    async def __aenter__(self) -> "Disturber":
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        control, to_control = await asyncio.open_connection("127.0.0.1", self._target_port)
        buffer = FrameBuffer()

        async def requests() -> None:
            while data := await reader.read(4096):
                to_control.write(data)

        up = asyncio.create_task(requests())
        with contextlib.suppress(ConnectionError):
            while data := await control.read(4096):
                for frame in buffer.feed(data):
                    answer = encode_frame(frame)
                    for sent in self.change(self._kept, answer):
                        writer.write(sent)
                    self._kept.append(answer)
        up.cancel()
        writer.close()
        to_control.close()


CHANGES: dict[str, Change] = {
    "the one before": lambda kept, answer: [kept[-1]],
    "the one before, then its own": lambda kept, answer: [kept[-1], answer],
    "its own twice": lambda kept, answer: [answer, answer],
    "half of it": lambda kept, answer: [answer[: len(answer) // 2]],
    "none": lambda kept, answer: [],
    "something else": lambda kept, answer: [b"HTTP/1.1 400 Bad Request\r\n\r\n"],
    "another block count": lambda kept, answer: [answer[:10] + b"\0\1" + answer[12:]],
    "a refusal": lambda kept, answer: [encode_frame(Frame(Kind.DATA, Direction.REFUSED))],
    "the one of eight requests ago": lambda kept, answer: [kept[-8]],
}


@pytest.mark.parametrize("name", CHANGES)
async def test_an_answer_that_is_not_its_own_never_counts(control: Control, name: str) -> None:
    async with Disturber(control.server.port) as between:
        cnc = FocasCnc(control.config(between.port, timeout_s=0.5), SystemClock())
        await cnc.connect()
        for value in range(12):
            control.nc.macros.set(503, float(value))
            assert await cnc.read_macros([503]) == {503: float(value)}
        control.nc.macros.set(503, 99.0)
        between.change = CHANGES[name]
        with contextlib.suppress(LinkError):
            assert await cnc.read_macros([503]) == {503: 99.0}
        with pytest.raises(LinkError):
            await cnc.read_macros([503])
        await cnc.close()
