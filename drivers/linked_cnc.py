"""What drivers with a protocol of their own to a CNC share: one link, its time-outs, and how an error ends it."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Coroutine, Mapping, Sequence
from typing import Any, ClassVar, Generic, NoReturn, Protocol, TypeVar

from config.schema.cnc import CncConfig
from drivers.clock import Clock
from drivers.contract import ClockWatch, LinkError, Security, refuse_forbidden, what_broke
from models.records import CncSample

T = TypeVar("T")


class Link(Protocol):
    """A connection that is lost for good once it has been aborted."""

    lost: str | None
    """Why the link is lost; None while it stands."""

    def abort(self, reason: str) -> None:
        """End the connection at once; who waits gets a LinkError with the first reason."""

    async def ended(self) -> None:
        """Wait until it is closed; call after `abort`."""


Answer = TypeVar("Answer")


class AnsweredLink(asyncio.Protocol, Generic[Answer]):
    """One TCP connection on which one request at a time waits for its answer."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._waiting: asyncio.Future[Answer] | None = None
        self._transport: asyncio.Transport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self.lost: str | None = None
        """Why the link is lost; None while it stands."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def connection_lost(self, error: Exception | None) -> None:
        """Tell who waits that the connection has ended."""
        self.abort(f"{self._name} ended the connection" + (f": {error}" if error else ""))
        if not self._closed.done():
            self._closed.set_result(None)

    @property
    def _waits(self) -> bool:
        return self._waiting is not None and not self._waiting.done()

    async def _answer_to(self, request: bytes) -> Answer:
        """Send a request and return its answer; given up, it ends the link. Raises LinkError."""
        if self.lost is not None or self._transport is None:
            raise LinkError(self.lost or f"{self._name}: never connected")
        waiting: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting = waiting
        try:
            self._transport.write(request)
            answer = await waiting
        except asyncio.CancelledError:
            self.abort(f"{self._name}: an answer was given up")
            raise
        finally:
            self._waiting = None
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


AnyLink = TypeVar("AnyLink", bound=Link)


class LinkedCnc(ABC, Generic[AnyLink]):
    """`drivers.contract.Cnc` over a link; the protocol's own part says how to connect, read and write."""

    wrong_answers: ClassVar[tuple[type[Exception], ...]]
    """Errors that mean an answer was not the one to what was asked."""

    def __init__(self, config: CncConfig, clock: Clock, name: str, security: Security = "insecure") -> None:
        self._config = config
        self._clock = clock
        self._name = name
        self._watch = ClockWatch(name, config.stale_after_s)
        self._used = False
        self._link: AnyLink | None = None
        self.identity = ""
        self.security: Security = security

    @property
    @abstractmethod
    def cannot(self) -> Mapping[str, str]:
        """What this control does not give, with the reason (known after connect)."""

    @abstractmethod
    async def _connect(self) -> None:
        """Build `_link`, and check that the control gives its state and the macro variables of the map."""

    @abstractmethod
    async def _sample(self, macros: Sequence[int]) -> CncSample: ...

    @abstractmethod
    async def _macros(self, macros: Sequence[int]) -> dict[int, float | None]: ...

    @abstractmethod
    async def _write(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None: ...

    async def connect(self) -> None:
        """Connect, and check that the control gives its state and the macro variables of the map."""
        if self._used:
            raise LinkError(f"{self._name}: this connection was used up; build a new one")
        self._used = True
        try:
            await self._call("connecting", self._begin())
        except BaseException:
            await self._drop()
            raise

    async def read(self, macros: Sequence[int]) -> CncSample:
        """Read the machine's state and the given macro variables."""
        self._standing()
        sample = await self._call("reading", self._sample(macros))
        if stands := self._watch.stands_still(sample):
            self._lose(stands)
        return sample

    async def read_macros(self, macros: Sequence[int]) -> dict[int, float | None]:
        """Read macro variables; None where a variable is vacant."""
        self._standing()
        return await self._call("reading macro variables", self._macros(macros))

    async def write_macros(self, groups: Sequence[Sequence[tuple[int, float]]]) -> None:
        """Write groups of (macro, value), each after the one before was accepted; raises as `Cnc` says."""
        refuse_forbidden(groups, self._config, self.security)
        self._standing()
        await self._call("writing macro variables", self._write(groups))

    async def close(self) -> None:
        """Close the link; never raises, never waits longer than the time-out."""
        await self._drop()

    async def _begin(self) -> None:
        await self._connect()
        self._watch.stands_still(await self._sample(self._config.macros.block))

    async def _drop(self) -> None:
        link, self._link = self._link, None
        self._used = True
        if link is not None:
            link.abort(f"{self._name}: closed")
            await link.ended()

    def _present(self, number: int, value: float | None) -> float:
        """Return the value of a system variable that the state needs; raises LinkError where it is vacant."""
        if value is None:
            self._lose(f"{self._name}: system variable #{number} is vacant, and the machine's state needs it")
        return value

    def _whole(self, number: int, value: float) -> int:
        """Return the value of a system variable that counts; raises LinkError where it has a fraction."""
        if not value.is_integer():
            self._lose(f"{self._name}: system variable #{number} holds {value:g}, which is no whole number")
        return int(value)

    def _standing(self) -> AnyLink:
        """Return the link, which stands; raises LinkError."""
        link = self._link
        if link is None or link.lost is not None:
            lost = link.lost if link is not None else None
            raise LinkError(f"{self._name}: not connected ({lost or 'closed or never connected'})")
        return link

    def _lose(self, reason: str, cause: BaseException | None = None) -> NoReturn:
        if (link := self._link) is not None:
            link.abort(reason)
        raise LinkError(reason) from cause

    async def _call(self, what: str, call: Coroutine[Any, Any, T]) -> T:
        """Await a call within the time-out; what goes wrong with the connection ends it."""
        try:
            async with asyncio.timeout(self._config.timeout_s):
                return await call
        except TimeoutError as error:
            self._lose(f"{self._name} did not answer within {self._config.timeout_s:g} s while {what}", error)
        except self.wrong_answers as error:
            self._lose(f"{self._name} gave an answer that does not fit while {what}: {error}", error)
        except UnicodeError as error:  # of a host's name, before anything is sent
            self._lose(f"{self._name} is no address that can be looked up: see that no dot stands twice", error)
        except OSError as error:
            self._lose(f"{self._name} was lost while {what}: {what_broke(error)}", error)
