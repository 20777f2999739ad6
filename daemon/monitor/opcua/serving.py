"""Serves the tags at the configured place: certificate, trusted clients, users, bounded connections."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from importlib.metadata import version
from typing import Any

import structlog
from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from config.files import stamp_of
from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.monitor.accounts import Accounts, Role
from daemon.monitor.commands import CommandDesk
from daemon.monitor.connections import BoundedConnections, Conversation
from daemon.monitor.control_socket import RequestError
from daemon.monitor.listening import in_url, listening
from daemon.monitor.opcua.tags import INDEX, NAMESPACE, Tags
from daemon.monitor.opcua.users import AccountUsers, OpcUaPerson, Report
from daemon.snapshots import SnapshotBoard
from drivers.contract import FatalDriverError
from drivers.opcua.server.encoding import Encoded, Kind, variant
from drivers.opcua.server.server import TagServer
from drivers.opcua.server.settings import Identity, Trusted, load_identity
from drivers.opcua.server.space import COMPONENT, CallRefusedError, Method, Space
from drivers.opcua.server.standard import add_arguments, standard_space

log = structlog.get_logger(__name__)
SPARE_CONNECTIONS = 6
"""So many more than there are sessions are open at a time: of those who log in, or look for the endpoints."""
WAITING_CONNECTIONS = 16
AT_ONCE = 10
"""So many sensors are added before the loop turns to other work."""


def _argument(name: str, kind: Kind, words: str, rank: int = -1) -> ua.Argument:
    data_type = ua.NodeId(ua.Int32(kind))
    return ua.Argument(Name=name, DataType=data_type, ValueRank=rank, Description=ua.LocalizedText(words))


AXES = _argument("Axes", Kind.STRING, "names of the axes; an empty list: every axis", rank=1)
ZERO = _argument("Zero", Kind.BOOLEAN, "retreat to zero, not to where the reference left it; with no axes")
FAULT = _argument("Fault", Kind.UINT32, "number of the FAULT that is meant: state.fault")
OUTPUTS = [
    _argument("Decided", Kind.BOOLEAN, "false: look at the state"),
    _argument("State", Kind.STRING, "state of the output"),
    _argument("Reason", Kind.STRING, "why"),
]
METHODS: dict[str, tuple[str, list[ua.Argument], tuple[type, ...]]] = {
    "reference": ("set the reference now, as after work positioning", [], ()),
    "enable": ("switch compensation on", [AXES], (list,)),
    "disable": ("switch compensation off; the offset retreats", [AXES, ZERO], (list, bool)),
    "acknowledge": ("clear a latched FAULT after its cause is gone", [FAULT], (int,)),
}


class Actions:
    """Adds the methods to a space and carries them out."""

    def __init__(self, desk: CommandDesk, report: Report, tags: Tags) -> None:
        self._desk, self._report, self._tags = desk, report, tags

    def add_all(self, space: Space) -> None:
        for name, (words, inputs, types) in METHODS.items():
            method = Method((INDEX, name), name, words, self._doing(name), inputs=types, may=_may)
            space.add(method, self._tags.machine, COMPONENT)
            add_arguments(space, method, inputs, OUTPUTS)

    def _doing(self, name: str) -> Any:
        async def call(person: OpcUaPerson, values: list[Any]) -> list[Encoded]:
            return await self._act(name, person, values)

        return call

    async def _act(self, name: str, person: OpcUaPerson, values: list[Any]) -> list[Encoded]:
        """Hand a command to the desk that serves the local socket and the monitor too."""
        if not _may(person):
            self._report("access", f"refused: OPC UA method {name} takes the role {Role.OPERATOR}", person.in_audit)
            sentence = f"{person.name} is {person.role}; this takes the role {Role.OPERATOR}"
            raise self._refused(name, int(StatusCodes.BadUserAccessDenied), sentence)
        given = {each.Name.lower(): value for each, value in zip(METHODS[name][1], values, strict=True) if value}
        try:
            outcome = await self._desk.handle({"command": name, **given}, person.in_audit)
        except RequestError as error:
            raise self._refused(name, int(StatusCodes.BadInvalidState), str(error)) from error
        return [
            variant(Kind.BOOLEAN, bool(outcome["decided"])),
            variant(Kind.STRING, outcome.get("state", "")),
            variant(Kind.STRING, outcome.get("reason", "")),
        ]

    def _refused(self, name: str, status: int, sentence: str) -> CallRefusedError:
        self._tags.refuse(f"{name}: {sentence}")
        return CallRefusedError(status, sentence)


def _may(person: OpcUaPerson) -> bool:
    return person.role.covers(Role.OPERATOR)


class OpcUaService:
    """The OPC UA server of one daemon."""

    def __init__(
        self, configuration: Configuration, board: SnapshotBoard, desk: CommandDesk, history: HistoryWriter
    ) -> None:
        self._configuration, self._board, self._desk, self._history = configuration, board, desk, history
        self._seen: object = None

    async def serve(self, on_serving: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled; raises OSError when port, certificate or key cannot be used."""
        server = await self.prepared()
        section = self._configuration.opcua_server
        assert section is not None
        most = section.sessions + SPARE_CONNECTIONS
        connections = BoundedConnections("OPC UA server", self._serving(server), most=most)
        with listening(section.host, section.port, WAITING_CONNECTIONS) as listener:
            endpoint = f"opc.tcp://{in_url(section.host, listener.getsockname()[1])}/"
            log.info("opcua_server.serving", endpoint=endpoint)
            on_serving()
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(server.publish())
                tasks.create_task(connections.run(listener))

    async def prepared(self) -> TagServer:
        """Return the server with all its tags; raises OSError when certificate or key cannot be used."""
        section, service = self._configuration.opcua_server, self._configuration.service
        assert section is not None
        assert service.users is not None
        try:
            identity = await asyncio.to_thread(self._identity)
        except FatalDriverError as error:
            raise OSError(str(error)) from error
        namespaces = [identity.application_uri, NAMESPACE]
        space, objects = standard_space(identity.application_uri, namespaces, "Toolpoint", version("toolpoint"))
        tags = Tags(self._configuration, self._board, space, objects)
        for place, _ in enumerate(tags.add_all()):
            if place % AT_ONCE == 0:
                await asyncio.sleep(0)
        Actions(self._desk, self._history.event, tags).add_all(space)
        trusted = Trusted(section.trusted_clients)
        trusted.find(b"")
        for problem in trusted.problems:
            log.warning("opcua_server.trusted_clients", problem=problem)
        users = AccountUsers(Accounts(service.users), self._history.event)
        return TagServer(identity, trusted, users, space, tags.refresh, sessions=section.sessions)

    def _identity(self) -> Identity:
        section = self._configuration.opcua_server
        assert section is not None
        self._seen = stamp_of(section.certificate, section.private_key)
        return load_identity(section.certificate, section.private_key)

    async def _renew(self, server: TagServer) -> None:
        """Take up certificate and key that were replaced on the disk; what does not fit leaves the old ones in use."""
        section = self._configuration.opcua_server
        assert section is not None
        if stamp_of(section.certificate, section.private_key) == self._seen:
            return
        try:
            identity = await asyncio.to_thread(self._identity)
            if identity.application_uri != server.identity.application_uri:
                raise FatalDriverError(f"{section.certificate} has another application URI: restart the daemon")
            server.identity = identity
        except (FatalDriverError, OSError) as error:
            log.warning("opcua_server.certificate_not_taken", problem=str(error))

    def _serving(self, server: TagServer) -> Callable[[socket.socket, Conversation], Awaitable[None]]:
        async def serve(connection: socket.socket, conversation: Conversation) -> None:
            def on_session(logged_in: bool) -> None:
                conversation.busy = logged_in  # it is not ended in favour of one that has not logged in

            await self._renew(server)
            await server.converse(connection, on_session)

        return serve
