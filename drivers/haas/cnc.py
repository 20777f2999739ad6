"""A Haas control over its machine data collection (MDC), as text over TCP.

A control sends every answer to both of its connections, so an answer counts by the variable that it names. A written
value is accepted once it has been read back. The last query of every read is the clock: what came before it is whole.
"""

import asyncio
import math
import random
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from config.schema.cnc import CncConfig
from config.schema.cnc_drivers import HaasConfig
from drivers.clock import Clock
from drivers.contract import SIMULATED_CNC_IDENTITY, FatalDriverError, LinkError, NotSentError
from drivers.haas.codec import (
    Answer,
    HaasFormatError,
    LineBuffer,
    Query,
    Unknown,
    encode_query,
    encode_write,
    parse_answer,
    value_text,
)
from drivers.haas.requests import ProgramState, StateVariables, mode_of
from drivers.linked_cnc import AnsweredLink, LinkedCnc
from drivers.power_on import CLOCK, DATE, TIME, CalendarError, power_on_count, power_on_utc_s
from models.records import CncSample

TAG = (Query.SERIAL_NUMBER, Query.SOFTWARE, Query.MODEL)
"""Queries whose answers name themselves; in changing order they end a read where macro variables have no number."""
TAG_LENGTH = 3
MOST_ROUNDS = 3
"""A read in which two answers for one variable differ is made again so often."""
SIMULATED_SERIAL_NUMBER = "TOOLPOINT SIMULATED"


Fits = Callable[[Answer], bool]


class HaasLink(AnsweredLink[Answer]):
    """What the control answers goes to all who are connected, so an answer counts only where it fits a query.

    A control that names the variable in its answers tells whose they are: another's are passed over. One that does not
    leaves only the order, so there everything that was not asked for ends the connection.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._buffer = LineBuffer()
        self._fits: Fits | None = None
        self._taken: dict[int, float | None] = {}
        self.numbered: bool | None = None
        """Whether answers name their variable; None until the first one."""
        self.contradicted = False
        """Two answers for the same variable have differed since `begin`."""
        self.not_understood = False
        """The control has answered since `begin` that it does not understand a line, this client's or another's."""

    def data_received(self, data: bytes) -> None:
        """Take every answer that these bytes complete."""
        try:
            for line in self._buffer.feed(data):
                if self.lost is None:
                    self._take(parse_answer(line))
        except HaasFormatError as error:
            self.abort(f"{self._name} gave an answer that cannot be: {error}")

    def begin(self) -> None:
        """Begin a batch: what was taken before contradicts nothing."""
        self._taken.clear()
        self.contradicted = self.not_understood = False

    async def ask(self, lines: bytes, fits: Fits) -> Answer:
        """Send lines and return the first answer that fits; given up, it ends the link. Raises LinkError."""
        self._fits = fits
        try:
            return await self._answer_to(lines)
        finally:
            self._fits = None

    def _take(self, answer: Answer | Unknown | None) -> None:
        if isinstance(answer, Unknown):
            self.not_understood = True
        if not isinstance(answer, Answer):
            return
        if answer.query is Query.MACRO and not self._one_form(answer):
            return
        if answer.number is not None and answer.number in self._taken:
            known = self._taken[answer.number]
            self.contradicted |= known != answer.value
        if self._waiting is not None and not self._waiting.done() and self._fits is not None and self._fits(answer):
            if answer.number is not None:
                self._taken[answer.number] = answer.value
            self._waiting.set_result(answer)
        elif self.numbered is False:
            self.abort(
                f"{self._name} names no macro variable in its answers, and gave one that nothing was asked for: end "
                "the other client, the daemon must be the only one there"
            )

    def _one_form(self, answer: Answer) -> bool:
        numbered = answer.number is not None
        if self.numbered is None:
            self.numbered = numbered
        if self.numbered != numbered:
            self.abort(f"{self._name} names the macro variable in some answers and not in others")
        return self.numbered == numbered


def is_value(answer: Answer, number: int) -> bool:
    """Return whether an answer is the value of a macro variable, as far as it says."""
    return answer.query is Query.MACRO and (answer.number is None or answer.number == number)


class HaasCnc(LinkedCnc[HaasLink]):
    """Implements `drivers.contract.Cnc` over MDC."""

    wrong_answers = (HaasFormatError, CalendarError)

    def __init__(self, config: CncConfig, clock: Clock) -> None:
        self._haas = config.connection_as(HaasConfig)
        super().__init__(config, clock, self._haas.address)
        self._state = StateVariables(self._haas, config.axis_positions)
        self._random = random.Random()
        self._clock_ms = 0.0
        self._power_on_count: int | None = None
        self._spaced = False
        self._asking = ""
        of_nc = (config.macros.echo_time, config.macros.request_macros.get("counter"), config.macros.safe_flag)
        self._marks = [number for number in of_nc if number is not None]

    @property
    def cannot(self) -> Mapping[str, str]:
        """What this control does not give, with the reason (known after connect)."""
        return dict(self._state.cannot)

    async def _connect(self) -> None:
        try:
            loop = asyncio.get_running_loop()
            create = loop.create_connection(lambda: HaasLink(self._name), self._haas.host, self._haas.port)
            _, self._link = await create
        except ConnectionRefusedError as error:
            raise LinkError(
                f"{self._name} refuses the connection: check cnc.haas.port, which is setting 143 of the control"
            ) from error
        try:
            serial = await self._ask(Query.SERIAL_NUMBER, before=encode_query(Query.SERIAL_NUMBER))
        except LinkError as error:
            raise LinkError(
                f"{error}, before it had answered: a control takes two connections; end one of the others"
            ) from error
        number = serial.fields[1]
        self.identity = SIMULATED_CNC_IDENTITY if number == SIMULATED_SERIAL_NUMBER else f"haas:{number}"
        self._state.judge(await self._macros(self._state.numbers))

    async def _sample(self, macros: Sequence[int]) -> CncSample:
        """Read state and macro variables, again where the program has gone on in between: they belong together."""
        state = self._state
        marks = [number for number in (*state.marks, *self._marks) if number in state.marks or number in macros]
        for _ in range(MOST_ROUNDS):
            program = await self._ask(Query.PROGRAM)
            mode = mode_of(await self._ask(Query.MODE))
            values = await self._macros([DATE, TIME, *state.numbers, *macros])
            after = await self._macros(marks)
            if all(after[number] == values[number] for number in marks):
                break
        now = self._clock.now()
        told = ProgramState.of(program)
        date, time, tool = (self._present(number, values[number]) for number in (DATE, TIME, state.tool))
        self._power_on_count = power_on_count(power_on_utc_s(date, time, self._clock_ms), self._power_on_count)
        return CncSample(
            time=now,
            mode=mode,
            run=told.run,
            alarm=told.alarm,
            program=self._whole(state.program, values.get(state.program) or told.program or 0.0),
            sequence_number=self._whole(state.sequence_number, values.get(state.sequence_number) or 0.0),
            spindle_speed_rpm=state.speed_rpm(values),
            motor_temperature_degc=math.nan,
            clock_s=self._clock_ms / 1000.0,
            power_on_count=self._power_on_count,
            work_offset=state.work_offset(values),
            tool_number=self._whole(state.tool, tool),
            macros={number: values[number] for number in macros},
            positions_mm=state.positions_mm(values),
        )

    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables, then the clock; again where two answers for the same variable differ."""
        link = self._standing()
        for _ in range(MOST_ROUNDS):
            link.begin()
            values = {number: await self._value(number) for number in dict.fromkeys(macros)}
            await self._read_clock()
            if not link.contradicted:
                return values
        raise HaasFormatError("it answers differently for the same macro variable, time after time")

    async def _value(self, number: int) -> float | None:
        link = self._standing()
        self._asking = f"?Q600 {number}"
        return (await link.ask(encode_query(Query.MACRO, number), lambda answer: is_value(answer, number))).value

    async def _read_clock(self) -> None:
        """End a read: the clock goes on, or an answer is late; where answers have no number their order is proved."""
        clock_ms = await self._value(CLOCK)
        if clock_ms is None or clock_ms < self._clock_ms:
            raise HaasFormatError(
                f"its clock (#{CLOCK}) stands at {clock_ms} ms after {self._clock_ms} ms: this is a late answer, "
                f"or a program has set #{CLOCK}"
            )
        self._clock_ms = clock_ms
        if not self._standing().numbered:
            for query in self._random.choices(TAG, k=TAG_LENGTH):
                await self._ask(query)

    async def _ask(self, query: Query, before: bytes = b"") -> Answer:
        """Ask for what is no macro variable; its answer begins with the query's own word."""
        link = self._standing()
        return await link.ask(before + encode_query(query), lambda answer: answer.query is query)

    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        for number, value in (entry for group in groups for entry in group):
            try:
                value_text(value)
            except OverflowError as error:
                raise NotSentError(f"macro variable #{number}: {error}; nothing was sent") from error
        for group in groups:
            for number, value in group:
                await self._write_one(number, value)
            await self._read_clock()

    async def _write_one(self, number: int, value: float) -> None:
        """Write one value and read it back; raises FatalDriverError where the control holds another one then."""
        link = self._standing()
        found: float | None = None
        for spaced in (self._spaced, not self._spaced):
            link.begin()
            lines = encode_write(number, value, spaced=spaced) + encode_query(Query.MACRO, number)
            self._asking = f"?Q600 {number}"
            found = (await link.ask(lines, lambda answer: is_value(answer, number))).value
            understood = not link.not_understood
            if not self._same(found, value):  # another's answer, from before the write
                found = (await self._macros([number]))[number]
            if self._same(found, value):
                self._spaced = spaced
                return
            if understood:
                break
        raise FatalDriverError(
            f"the CNC refused macro variable #{number} = {value!r}: it holds {found!r} afterwards; see that the "
            "variable exists and is not the probing system's (#150-#199, #550-#599), and that no setting protects it"
        )

    def _lose(self, reason: str, cause: BaseException | None = None) -> NoReturn:
        link = self._link
        if isinstance(cause, TimeoutError) and link is not None and link.not_understood:
            reason += f"; it does not understand {self._asking}: check cnc.macros and the variables of cnc.haas"
        super()._lose(reason, cause)

    def _same(self, found: float | None, value: float) -> bool:
        return found is not None and abs(found - value) <= self._config.macros.tolerance
