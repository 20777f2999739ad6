"""One TCP connection to a Haas control: one query at a time, among answers that others have asked for."""

import asyncio
from collections.abc import Callable

from drivers.contract import LinkError
from drivers.haas.codec import Answer, HaasFormatError, LineBuffer, Query, Unknown, parse_answer

Fits = Callable[[Answer], bool]


class HaasLink(asyncio.Protocol):
    """What the control answers goes to all who are connected, so an answer counts only where it fits a query.

    A control that names the variable in its answers tells whose they are: another's are passed over. One that does not
    leaves only the order, so there everything that was not asked for ends the connection.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._buffer = LineBuffer()
        self._fits: Fits | None = None
        self._waiting: asyncio.Future[Answer] | None = None
        self._transport: asyncio.Transport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self._taken: dict[int, float | None] = {}
        self.numbered: bool | None = None
        """Whether answers name their variable; None until the first one."""
        self.contradicted = False
        """Two answers for the same variable have differed since `begin`."""
        self.not_understood = False
        """The control has answered since `begin` that it does not understand a line, this client's or another's."""
        self.lost: str | None = None
        """Why the link is lost; None while it stands."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Take every answer that these bytes complete."""
        try:
            for line in self._buffer.feed(data):
                if self.lost is None:
                    self._take(parse_answer(line))
        except HaasFormatError as error:
            self.abort(f"{self._name} gave an answer that cannot be: {error}")

    def connection_lost(self, error: Exception | None) -> None:
        """Tell who waits that the connection has ended."""
        self.abort(f"{self._name} ended the connection" + (f": {error}" if error else ""))
        if not self._closed.done():
            self._closed.set_result(None)

    def begin(self) -> None:
        """Begin a batch: what was taken before contradicts nothing."""
        self._taken.clear()
        self.contradicted = self.not_understood = False

    async def ask(self, lines: bytes, fits: Fits) -> Answer:
        """Send lines and return the first answer that fits; given up, it ends the link. Raises LinkError."""
        if self.lost is not None or self._transport is None:
            raise LinkError(self.lost or f"{self._name}: never connected")
        waiting: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting, self._fits = waiting, fits
        try:
            self._transport.write(lines)
            answer = await waiting
        except asyncio.CancelledError:
            self.abort(f"{self._name}: an answer was given up")
            raise
        finally:
            self._waiting = self._fits = None
        if self.lost is not None:
            raise LinkError(self.lost)
        return answer

    def abort(self, reason: str) -> None:
        """End the connection at once; who waits gets a LinkError with the first reason."""
        self.lost = self.lost or reason
        if self._transport is not None:
            self._transport.abort()
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_exception(LinkError(self.lost))

    async def ended(self) -> None:
        """Wait until the socket is closed; call after `abort`."""
        if self._transport is not None:
            await self._closed

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
