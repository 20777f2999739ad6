"""The server: one conversation per connection, the services that it answers, and the clock of the subscriptions."""

import asyncio
import logging
import math
import socket
import time
from collections.abc import Awaitable, Callable

from asyncua import ua
from asyncua.ua.object_ids import ObjectIds
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.ua_binary import struct_to_binary

from drivers.opcua.log import limit_library_log
from drivers.opcua.server.requests import Request, ServiceError, answer, fault, listed, too_large
from drivers.opcua.server.session import Session
from drivers.opcua.server.settings import Identity, Trusted, Users
from drivers.opcua.server.space import Space
from drivers.opcua.server.subscriptions import Publisher
from drivers.opcua.server.views import Views
from drivers.opcua.server.watching import Watching
from drivers.opcua.server.wire import Handshakes, Message, Wire, WireError

log = logging.getLogger(__name__)

FIRST_S = 10.0
"""Whoever connects, or has logged out, has logged in within this, or is cut off [s]."""
MOST_UNSENT = 262_144
"""While a client has not taken so much, nothing more is published to it [byte]."""
LONGEST_SLEEP_S = 3600.0
Service = Callable[[Request], Awaitable[bytes | None]]


def _number(service: str, what: str) -> int:
    return int(getattr(ObjectIds, f"{service}{what}_Encoding_DefaultBinary"))


class TagServer:
    """Serves a space to those who log in; of connections it knows only those that are handed to it."""

    def __init__(
        self,
        identity: Identity,
        trusted: Trusted,
        users: Users,
        space: Space,
        refresh: Callable[[], None],
        *,
        sessions: int,
    ) -> None:
        """`refresh` brings the variables up to date; it is called when somebody looks, and not otherwise."""
        limit_library_log()
        self.identity, self.trusted, self.users = identity, trusted, users
        self.space, self.refresh = space, refresh
        self.handshakes = Handshakes()
        self.most_sessions = sessions
        self.open: set[Conversation] = set()
        """Those with somebody logged in."""
        self._wake = asyncio.Event()
        self.turn = asyncio.Lock()

    def wake(self) -> None:
        """Look at what is due: a subscription was made or changed."""
        self._wake.set()

    async def publish(self) -> None:
        """Send to every subscriber what is due, until cancelled."""
        while True:
            now_s = time.monotonic()
            due = [each for each in self.open if each.publisher.next_s() <= now_s]
            if due:
                self.refresh()
            for each in due:
                each.publish(now_s)
                await asyncio.sleep(0)
            self._wake.clear()
            next_s = min((each.publisher.next_s() for each in self.open), default=math.inf)
            wait_s = min(max(next_s - time.monotonic(), 0.0), LONGEST_SLEEP_S)
            try:
                async with asyncio.timeout(wait_s):
                    await self._wake.wait()
            except TimeoutError:
                continue

    async def converse(self, connection: socket.socket, on_session: Callable[[bool], None]) -> None:
        """Serve one connection until it ends; `on_session` is told whether somebody is logged in."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        address = str(connection.getpeername()[0])
        reader, writer = await asyncio.open_connection(sock=connection)
        wire = Wire(reader, writer, self.identity, self.trusted, self.handshakes)
        conversation = Conversation(self, wire, address, on_session)
        try:
            await conversation.run()
        except WireError as error:
            log.info("OPC UA connection from %s ended: %s", address, error)
            wire.end(error)
            await wire.drained()
            writer.close()
        except asyncio.IncompleteReadError:
            pass  # the client has closed it
        finally:
            self.open.discard(conversation)
            conversation.session.left()
            wire.abort()


class Conversation:
    """One connection with its session."""

    def __init__(self, server: TagServer, wire: Wire, address: str, on_session: Callable[[bool], None]) -> None:
        self._server, self._wire, self._on_session = server, wire, on_session
        self._until_s = time.monotonic() + FIRST_S
        product = "Toolpoint"
        self.session = Session(wire, server.identity, server.users, product, address)
        self.publisher = Publisher(self._send, self._room)
        self._views = Views(server.space, server.refresh)
        watching = Watching(server.space, self.publisher, server.wake)
        named: dict[str, Service] = {
            "Read": lambda request: self._views.read(request, self.session.person),
            "Write": self._views.write,
            "Browse": self._views.browse,
            "BrowseNext": self._views.browse_next,
            "TranslateBrowsePathsToNodeIds": self._views.translate,
            "RegisterNodes": self._views.registered,
            "UnregisterNodes": self._nothing,
            "Call": lambda request: self._views.call(request, self.session.person),
            "CreateSubscription": watching.create,
            "ModifySubscription": watching.modify,
            "SetPublishingMode": watching.set_publishing,
            "DeleteSubscriptions": watching.delete,
            "Publish": watching.publish,
            "Republish": watching.republish,
            "CreateMonitoredItems": watching.watch,
            "ModifyMonitoredItems": watching.modify_items,
            "SetMonitoringMode": watching.set_mode,
            "DeleteMonitoredItems": watching.unwatch,
        }
        self._services = {_number(name, "Request"): (_number(name, "Response"), each) for name, each in named.items()}
        first: dict[str, Service] = {
            "FindServers": self._find_servers,
            "GetEndpoints": self._get_endpoints,
            "CreateSession": self._create_session,
            "ActivateSession": self._activate_session,
            "CloseSession": self._close_session,
        }
        self._first = {_number(name, "Request"): (_number(name, "Response"), each) for name, each in first.items()}

    async def run(self) -> None:
        """Answer requests until the client goes, or says nothing for too long."""
        while True:
            logged_in = self.session.person is not None
            patience_s = self.session.idle_s if logged_in else self._until_s - time.monotonic()
            try:
                message = await self._wire.receive(patience_s)
            except TimeoutError:
                raise WireError(StatusCodes.BadTimeout, "nothing was asked for too long") from None
            if message is None:
                return
            async with self._server.turn:  # one request in a turn of the loop, however many have arrived
                await asyncio.sleep(0)
            await self._answer(message)
            await self._wire.drained()

    def publish(self, now_s: float) -> None:
        """Send what is due; a client whose account is gone gets nothing more."""
        person = self.session.person
        if person is None or self._server.users.present(person) is None:
            self._wire.abort()
            return
        self.publisher.due(now_s)

    async def _answer(self, message: Message) -> None:
        handle = 0
        try:
            request = Request(message.request, message.body)
            handle = request.handle
            if (found := self._first.get(request.service)) is None:
                self.session.check(request)
                found = self._services.get(request.service)
            if found is None:
                raise ServiceError(StatusCodes.BadServiceUnsupported)
            number, service = found
            body = await service(request)
        except ServiceError as refusal:
            self._send(fault(handle, refusal.status), message.request)
            return
        if body is not None:
            self._send(answer(number, handle, body), message.request)

    def _send(self, body: bytes, number: int) -> None:
        self._wire.send(body if len(body) <= self._wire.longest_answer else too_large(body), number)

    def _room(self) -> float:
        return self._wire.longest_answer if self._wire.unsent < MOST_UNSENT else 0.0

    async def _nothing(self, request: Request) -> bytes:
        return b""

    async def _find_servers(self, request: Request) -> bytes:
        asked = request.structure(ua.FindServersParameters).EndpointUrl
        return listed([struct_to_binary(self.session.description(asked))])

    async def _get_endpoints(self, request: Request) -> bytes:
        asked = request.structure(ua.GetEndpointsParameters).EndpointUrl
        return listed([struct_to_binary(each) for each in self.session.endpoints(asked)])

    async def _create_session(self, request: Request) -> bytes:
        if len(self._server.open) >= self._server.most_sessions:
            raise ServiceError(StatusCodes.BadTooManySessions)
        return self.session.create(request)

    async def _activate_session(self, request: Request) -> bytes:
        if self not in self._server.open and len(self._server.open) >= self._server.most_sessions:
            raise ServiceError(StatusCodes.BadTooManySessions)
        body = await self.session.activate(request)
        self._server.open.add(self)
        self._on_session(True)
        return body

    async def _close_session(self, request: Request) -> bytes:
        self.session.check_token(request)
        for number in list(self.publisher.subscriptions):
            self.publisher.delete(number)
        self._server.open.discard(self)
        self.session.left()
        self._on_session(False)
        self._until_s = time.monotonic() + FIRST_S
        return b""
