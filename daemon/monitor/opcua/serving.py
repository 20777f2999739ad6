"""Serves the tags at the configured place: certificate, trusted clients, users, bounded connections."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from importlib.metadata import version

import structlog

from config.schema import Configuration
from daemon.history.writer import HistoryWriter
from daemon.monitor.accounts import Accounts
from daemon.monitor.commands import CommandDesk
from daemon.monitor.connections import BoundedConnections, Conversation
from daemon.monitor.listening import in_url, listening
from daemon.monitor.opcua.actions import Actions
from daemon.monitor.opcua.tags import NAMESPACE, Tags
from daemon.monitor.opcua.users import AccountUsers
from daemon.snapshots import SnapshotBoard
from drivers.contract import FatalDriverError
from drivers.opcua.server.server import TagServer
from drivers.opcua.server.settings import Trusted, load_identity
from drivers.opcua.server.standard import standard_space

log = structlog.get_logger(__name__)
SPARE_CONNECTIONS = 6
"""So many more than there are sessions are open at a time: of those who log in, or look for the endpoints."""
WAITING_CONNECTIONS = 16
AT_ONCE = 10
"""So many sensors are added before the loop turns to other work."""


class OpcUaService:
    """The OPC UA server of one daemon."""

    def __init__(
        self, configuration: Configuration, board: SnapshotBoard, desk: CommandDesk, history: HistoryWriter
    ) -> None:
        self._configuration, self._board, self._desk, self._history = configuration, board, desk, history

    async def serve(self, on_serving: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled; raises OSError when port, certificate or key cannot be used."""
        server = await self.prepared()
        section = self._configuration.opcua_server
        assert section is not None
        most = section.sessions + SPARE_CONNECTIONS
        connections = BoundedConnections("OPC UA server", _serving(server), most=most)
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
            identity = await asyncio.to_thread(load_identity, section.certificate, section.private_key)
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


def _serving(server: TagServer) -> Callable[[socket.socket, Conversation], Awaitable[None]]:
    async def serve(connection: socket.socket, conversation: Conversation) -> None:
        def on_session(logged_in: bool) -> None:
            conversation.busy = logged_in  # it is not ended in favour of one that has not logged in

        await server.converse(connection, on_session)

    return serve
