"""The CNC over FOCAS2/Ethernet, with no library of the vendor; one object is one connection, used by one task.

The protocol numbers neither requests nor macro variables in its answers. So every read carries a tag of three blocks
whose order changes, and the control's clock, which must not go back; a group of writes ends with such a read.
"""

import asyncio
import logging
import struct
from collections.abc import Sequence
from typing import ClassVar

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig
from drivers.clock import Clock
from drivers.contract import MODES, RUNS, SIMULATED_CNC_IDENTITY, DriverError, FatalDriverError, LinkError
from drivers.focas.codec import (
    Answer,
    Ask,
    Direction,
    FocasFormatError,
    Frame,
    FrameBuffer,
    Function,
    Kind,
    encode_asks,
    encode_frame,
    parse_answers,
)
from drivers.focas.requests import (
    ADDITIONAL_OFFSET,
    AGAIN,
    NO_FUNCTION,
    NO_OPTION,
    WORK_OFFSET,
    StateRequest,
    SystemInfo,
    macro_asks,
    macro_values,
    refusal,
    write_asks,
)
from drivers.linked_cnc import AnsweredLink, LinkedCnc
from drivers.power_on import CLOCK, DATE, TIME, CalendarError, power_on_count, power_on_utc_s
from models.records import CncMode, CncRun, CncSample

log = logging.getLogger(__name__)

OPEN_BODY = struct.pack(">H", 2)
"""The socket that carries data; the vendor's library opens one more, which nothing needs."""
MOST_BLOCKS = 28
"""Blocks of one request besides its tag [to verify]; more are split, and fewer are asked where a control refuses."""
CLOCK_ASK = Ask(Function.READ_MACRO, (CLOCK, CLOCK))
SIMULATED_SYSTEM = "TP-SM-TOOL-PNT0"
"""What the simulated control says of itself."""


class FocasLink(AnsweredLink[Frame]):
    """The protocol numbers nothing, so order is all there is: whatever comes unasked, late or twice ends the link."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._buffer = FrameBuffer()

    def data_received(self, data: bytes) -> None:
        """Hand the answer to who waits for it."""
        try:
            for frame in self._buffer.feed(data):
                if self._waiting is None or not self._waits:
                    self.abort(f"{self._name} sent an answer that nothing was asked for")
                    return
                self._waiting.set_result(frame)
        except FocasFormatError as error:
            self.abort(f"{self._name} does not speak FOCAS2: {error}")
            return
        if self._buffer.unfinished and not self._waits:
            self.abort(f"{self._name} sent bytes that nothing was asked for")

    async def exchange(self, request: Frame) -> Frame:
        """Send a request and return the frame that comes next; given up, it ends the link. Raises LinkError."""
        return await self._answer_to(encode_frame(request))


class RefusedRequestError(FocasFormatError):
    """A whole request was refused, as one with too many blocks is."""


class FocasCnc(LinkedCnc[FocasLink]):
    """Implements `drivers.contract.Cnc` over FOCAS2/Ethernet."""

    wrong_answers: ClassVar[tuple[type[Exception], ...]] = (FocasFormatError, CalendarError)
    tag_bits = 3
    """Blocks of the tag that tells one answer from another."""

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        self._focas = config.connection_as(FocasConfig)
        super().__init__(config, clock, self._focas.address)
        self._state: StateRequest | None = None
        self._asked = 0
        self._most_blocks = MOST_BLOCKS
        self._clock_ms = 0.0
        self._power_on_count: int | None = None
        self._doubles = True

    @property
    def cannot(self) -> dict[str, str]:
        """What this control does not give, with the reason (known after connect)."""
        return {} if self._state is None else dict(self._state.cannot)

    async def close(self) -> None:
        """Close the session and the socket; never raises, never waits longer than the time-out."""
        link = self._link
        if link is not None and link.lost is None:
            try:
                async with asyncio.timeout(self._config.timeout_s):
                    await link.exchange(Frame(Kind.CLOSE, Direction.REQUEST))
            except (LinkError, TimeoutError) as error:
                log.debug("%s: the session could not be closed properly: %r", self._name, error)
        await super().close()

    async def _connect(self) -> None:
        try:
            loop = asyncio.get_running_loop()
            create = loop.create_connection(lambda: FocasLink(self._name), self._focas.host, self._focas.port)
            _, self._link = await create
        except ConnectionRefusedError as error:
            raise LinkError(
                f"{self._name} refuses the connection: check cnc.focas.port and that the control's FOCAS2/Ethernet "
                "server is on; a control with some thirty open connections refuses every other one, so end those"
            ) from error
        opened = await self._link.exchange(Frame(Kind.OPEN, Direction.REQUEST, OPEN_BODY))
        if (opened.kind, opened.direction) == (Kind.OPEN, Direction.REFUSED):
            raise LinkError(
                f"{self._name} has no session left: a control has five, which data collectors and the vendor's "
                "library share; end one of them"
            )
        if (opened.kind, opened.direction) != (Kind.OPEN, Direction.ANSWER):
            raise FocasFormatError(f"opening was answered with {opened.kind:02X}{opened.direction:02X}")
        await self._introduced()

    async def _introduced(self) -> None:
        """Ask the control what it is."""
        (answer,) = await self._exchange([Ask(Function.SYSTEM)])
        system = SystemInfo.parse(answer)
        self.identity = SIMULATED_CNC_IDENTITY if system.text == SIMULATED_SYSTEM else f"{system.text}@{self._name}"
        self._state = StateRequest(self._focas, system, self._config.axis_positions)

    async def _sample(self, macros: Sequence[int]) -> CncSample:
        request = self._state
        assert request is not None
        state_asks = request.asks()
        system = [DATE, TIME, WORK_OFFSET, self._focas.tool_macro]
        asked = macro_asks([*system, *macros])
        answers = await self._read([*state_asks, *(ask for _, ask in asked)])
        now = self._clock.now()
        clock_ms = self._clock_ms
        state = request.parse(state_asks, answers[: len(state_asks)])
        values = macro_values(asked, answers[len(state_asks) :])
        date, time, offset, tool = (self._present(number, values[number]) for number in system)
        self._power_on_count = power_on_count(power_on_utc_s(date, time, clock_ms), self._power_on_count)
        return CncSample(
            time=now,
            mode=MODES.get(state.mode, CncMode.UNKNOWN),
            run=RUNS.get(state.run, CncRun.UNKNOWN),
            alarm=state.alarm,
            program=state.program,
            sequence_number=state.sequence_number,
            spindle_speed_rpm=state.spindle_speed_rpm,
            motor_temperature_degc=state.motor_temperature_degc,
            clock_s=clock_ms / 1000.0,
            power_on_count=self._power_on_count,
            work_offset=int(offset) if offset.is_integer() else await self._additional_offset(offset),
            tool_number=self._whole(self._focas.tool_macro, tool),
            macros={number: values[number] for number in macros},
            positions_mm=state.positions_mm,
        )

    async def _additional_offset(self, code: float) -> int:
        """Return G54.1 Pn as 541000 + n: one of hundreds of offsets, and none of G54 to G59."""
        values = await self._macros([ADDITIONAL_OFFSET])
        return round(code * 10) * 1000 + round(self._present(ADDITIONAL_OFFSET, values[ADDITIONAL_OFFSET]))

    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        asked = macro_asks(macros)
        values = macro_values(asked, await self._read([ask for _, ask in asked]))
        return {number: values[number] for number in macros}

    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        refused: DriverError | None = None
        for group in groups:
            refused = await self._write_group(group)
            if refused is not None:
                break
        await self._read([])
        if refused is not None:
            raise refused

    async def _write_group(self, group: Sequence[tuple[int, float]]) -> DriverError | None:
        values = dict(group)
        for run, ask in write_asks(group, doubles=self._doubles):
            (answer,) = await self._exchange([ask])
            if answer.error in (NO_FUNCTION, NO_OPTION) and self._doubles:
                self._doubles = False
                return await self._write_group([(number, values[number]) for number in values if number >= run.start])
            if answer.error:
                written = ", ".join(f"#{number} = {values[number]!r}" for number in run)
                text = f"the CNC refused macro variable {written}: {refusal(answer.error)}"
                return LinkError(text) if answer.error in AGAIN else FatalDriverError(text)
        return None

    async def _read(self, asks: Sequence[Ask]) -> list[Answer]:
        """Return the answers to blocks that change nothing; raises FocasFormatError for another request's."""
        answers: list[Answer] = []
        while True:
            self._asked += 1
            bits = (self._asked >> bit & 1 for bit in range(self.tag_bits))
            tag = [Ask(Function.SYSTEM if bit else Function.STATUS) for bit in bits]
            part = asks[len(answers) : len(answers) + self._most_blocks]
            try:
                clock, *found = (await self._exchange([*tag, CLOCK_ASK, *part]))[self.tag_bits :]
            except RefusedRequestError:
                if len(part) < 2:
                    raise
                self._most_blocks = len(part) // 2
                continue
            clock_ms = macro_values(macro_asks([CLOCK]), [clock])[CLOCK]
            if clock_ms is None or clock_ms < self._clock_ms:
                raise FocasFormatError(
                    f"its clock (#{CLOCK}) stands at {clock_ms} ms after {self._clock_ms} ms: this is a late answer, "
                    f"or a program has set #{CLOCK}"
                )
            self._clock_ms = clock_ms
            answers += found
            if len(answers) >= len(asks):
                return answers

    async def _exchange(self, asks: Sequence[Ask]) -> list[Answer]:
        link = self._link
        if link is None:
            raise LinkError(f"{self._name}: not connected")
        request = Frame(Kind.DATA, Direction.REQUEST, encode_asks(asks, self._focas.path))
        frame = await link.exchange(request)
        if (frame.kind, frame.direction) != (Kind.DATA, Direction.ANSWER):
            wrong = RefusedRequestError if frame.direction == Direction.REFUSED else FocasFormatError
            raise wrong(f"a request was answered with {frame.kind:02X}{frame.direction:02X}")
        return parse_answers(frame.body, asks, self._focas.path)
