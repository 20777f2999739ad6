"""The CNC over FOCAS2/Ethernet, with no library of the vendor.

One object is one connection: a control offers five sessions in all, so there is one here, used by one task. The
protocol numbers neither requests nor macro variables in its answers. So that no answer counts for another request,
every read carries a tag of three blocks whose order changes from request to request, and the control's clock, which
must not go back; a group of writes ends with such a read. What does not fit ends the connection.
"""

import asyncio
import logging
import struct
from collections.abc import Coroutine, Sequence
from typing import Any, NoReturn, TypeVar

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import FocasConfig
from drivers.clock import Clock
from drivers.contract import (
    MODES,
    RUNS,
    SIMULATED_CNC_IDENTITY,
    ClockWatch,
    FatalDriverError,
    LinkError,
    Security,
    refuse_forbidden,
)
from drivers.focas.codec import (
    Answer,
    Ask,
    Direction,
    FocasFormatError,
    Frame,
    Function,
    Kind,
    encode_asks,
    parse_answers,
)
from drivers.focas.link import FocasLink
from drivers.focas.requests import (
    ADDITIONAL_OFFSET,
    CLOCK,
    DATE,
    NO_FUNCTION,
    NO_OPTION,
    WORK_OFFSET,
    StateRequest,
    SystemInfo,
    macro_asks,
    macro_values,
    power_on_count,
    power_on_utc_s,
    refusal,
    write_asks,
)
from models.records import CncMode, CncRun, CncSample

T = TypeVar("T")
log = logging.getLogger(__name__)

OPEN_BODY = struct.pack(">H", 2)
"""The socket that carries data; the vendor's library opens one more, which nothing needs."""
MOST_BLOCKS = 28
"""Blocks of one request besides its tag [to verify]; more are split."""
TAG_BITS = 3
CLOCK_ASK = Ask(Function.READ_MACRO, (CLOCK, CLOCK))
SIMULATED_SYSTEM = "TP-SM-TOOL-PNT0"
"""What the simulated control says of itself."""


class FocasCnc:
    """Implements `drivers.contract.Cnc` over FOCAS2/Ethernet."""

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._focas = config.connection_as(FocasConfig)
        self._name = self._focas.address
        self._link: FocasLink | None = None
        self._state: StateRequest | None = None
        self._watch = ClockWatch(self._name, config.stale_after_s)
        self._used = False
        self._asked = 0
        self._clock_ms = 0.0
        self._power_on_count: int | None = None
        self._doubles = True
        self.identity = ""
        self.security: Security = "insecure"

    @property
    def cannot(self) -> dict[str, str]:
        """What this control does not give, with the reason (known after connect)."""
        return {} if self._state is None else dict(self._state.cannot)

    async def connect(self) -> None:
        """Open the session and check that the control gives its state and the macro variables of the map."""
        if self._used:
            raise LinkError(f"{self._name}: this connection was used up; build a new one")
        self._used = True
        try:
            await self._call("connecting", self._connect())
        except BaseException:
            await self._drop()
            raise

    async def read(self, macros: Sequence[int]) -> CncSample:
        """Read the machine's state and the given macro variables in one request."""
        self._connected()
        sample = await self._call("reading", self._sample(macros))
        if stands := self._watch.stands_still(sample):
            self._lose(stands)
        return sample

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables; None where a variable is vacant."""
        self._connected()
        return await self._call("reading macro variables", self._macros(macros))

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Write groups of (macro, value), each block of neighbours as one request, after the one before was accepted.

        Raises NotSentError before anything is sent when the connection, a macro or a value must not be written;
        LinkError on a lost link; FatalDriverError when the control refuses a value.
        """
        refuse_forbidden(groups, self._config, self.security)
        self._connected()
        await self._call("writing macro variables", self._write(groups))

    async def close(self) -> None:
        """Close the session and the socket; never raises, never waits longer than the time-out."""
        link = self._link
        if link is not None and link.lost is None:
            try:
                async with asyncio.timeout(self._config.timeout_s):
                    await link.exchange(Frame(Kind.CLOSE, Direction.REQUEST))
            except (LinkError, TimeoutError) as error:
                log.debug("%s: the session could not be closed properly: %r", self._name, error)
        await self._drop()

    async def _drop(self) -> None:
        link, self._link = self._link, None
        self._used = True
        if link is not None:
            link.abort(f"{self._name}: closed")
            await link.ended()

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
        (answer,) = await self._exchange([Ask(Function.SYSTEM)])
        system = SystemInfo.parse(answer)
        self.identity = SIMULATED_CNC_IDENTITY if system.text == SIMULATED_SYSTEM else f"{system.text}@{self._name}"
        self._state = StateRequest(self._focas, system)
        self._watch.stands_still(await self._sample(self._config.macros.block))

    async def _sample(self, macros: Sequence[int]) -> CncSample:
        _, request = self._connected()
        state_asks = request.asks()
        system = [DATE, DATE + 1, WORK_OFFSET, self._focas.tool_macro]
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
            tool_number=round(tool),
            macros={number: values[number] for number in macros},
        )

    async def _additional_offset(self, code: float) -> int:
        """Return G54.1 Pn as 541000 + n: one of hundreds of offsets, and none of G54 to G59."""
        values = await self._macros([ADDITIONAL_OFFSET])
        return round(code * 10) * 1000 + round(self._present(ADDITIONAL_OFFSET, values[ADDITIONAL_OFFSET]))

    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        asked = macro_asks(macros)
        values = macro_values(asked, await self._read([ask for _, ask in asked]))
        return {number: values[number] for number in macros}

    def _present(self, number: int, value: float | None) -> float:
        if value is None:
            self._lose(f"{self._name}: system variable #{number} is vacant, and the machine's state needs it")
        return value

    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        refused: FatalDriverError | None = None
        for group in groups:
            refused = await self._write_group(group)
            if refused is not None:
                break
        await self._read([])
        if refused is not None:
            raise refused

    async def _write_group(self, group: Sequence[tuple[int, float]]) -> FatalDriverError | None:
        values = dict(group)
        for run, ask in write_asks(group, doubles=self._doubles):
            (answer,) = await self._exchange([ask])
            if answer.error in (NO_FUNCTION, NO_OPTION) and self._doubles:
                self._doubles = False
                return await self._write_group([(number, values[number]) for number in values if number >= run.start])
            if answer.error:
                written = ", ".join(f"#{number} = {values[number]!r}" for number in run)
                return FatalDriverError(f"the CNC refused macro variable {written}: {refusal(answer.error)}")
        return None

    async def _read(self, asks: Sequence[Ask]) -> list[Answer]:
        """Return the answers to blocks that change nothing; raises FocasFormatError for another request's."""
        answers: list[Answer] = []
        for first in range(0, max(len(asks), 1), MOST_BLOCKS):
            self._asked += 1
            bits = (self._asked >> bit & 1 for bit in range(TAG_BITS))
            tag = [Ask(Function.SYSTEM if bit else Function.STATUS) for bit in bits]
            clock, *found = (await self._exchange([*tag, CLOCK_ASK, *asks[first : first + MOST_BLOCKS]]))[TAG_BITS:]
            clock_ms = macro_values(macro_asks([CLOCK]), [clock])[CLOCK]
            if clock_ms is None or clock_ms < self._clock_ms:
                raise FocasFormatError(
                    f"its clock (#{CLOCK}) stands at {clock_ms} ms after {self._clock_ms} ms: this is a late answer, "
                    f"or a program has set #{CLOCK}"
                )
            self._clock_ms = clock_ms
            answers += found
        return answers

    async def _exchange(self, asks: Sequence[Ask]) -> list[Answer]:
        link = self._link
        if link is None:
            raise LinkError(f"{self._name}: not connected")
        request = Frame(Kind.DATA, Direction.REQUEST, encode_asks(asks, self._focas.path))
        frame = await link.exchange(request)
        if (frame.kind, frame.direction) != (Kind.DATA, Direction.ANSWER):
            raise FocasFormatError(f"a request was answered with {frame.kind:02X}{frame.direction:02X}")
        return parse_answers(frame.body, asks, self._focas.path)

    def _connected(self) -> tuple[FocasLink, StateRequest]:
        if self._link is None or self._state is None or self._link.lost is not None:
            lost = self._link.lost if self._link is not None else None
            raise LinkError(f"{self._name}: not connected ({lost or 'closed or never connected'})")
        return self._link, self._state

    def _lose(self, reason: str, cause: BaseException | None = None) -> NoReturn:
        if self._link is not None:
            self._link.abort(reason)
        raise LinkError(reason) from cause

    async def _call(self, what: str, call: Coroutine[Any, Any, T]) -> T:
        """Await a call within the time-out; what goes wrong with the connection ends it."""
        try:
            async with asyncio.timeout(self._config.timeout_s):
                return await call
        except TimeoutError as error:
            self._lose(f"{self._name} did not answer within {self._config.timeout_s:g} s while {what}", error)
        except FocasFormatError as error:
            self._lose(f"{self._name} gave an answer that does not fit while {what}: {error}", error)
        except OSError as error:
            self._lose(f"{self._name} was lost while {what}: {error}", error)
