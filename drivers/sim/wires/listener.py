"""What the simulated servers on 127.0.0.1 share: a port, who is connected, and the end of it."""

import asyncio
from abc import ABC, abstractmethod
from typing import Generic, Protocol, TypeVar

HOST = "127.0.0.1"


class Connection(Protocol):
    def abort(self) -> None:
        """End it at once."""


C = TypeVar("C", bound=Connection)


class Listener(ABC, Generic[C]):
    """A server that knows its connections."""

    def __init__(self, port: int) -> None:
        """`port` 0 takes any free one."""
        self._port = port
        self.connections: set[C] = set()
        self._server: asyncio.Server | None = None

    @abstractmethod
    async def _listen(self, port: int) -> asyncio.Server:
        """Begin to listen."""

    @property
    def port(self) -> int:
        """The port that is listened on (known after start)."""
        return self._port

    @property
    def endpoint(self) -> str:
        """Host and port for clients (known after start)."""
        return f"{HOST}:{self._port}"

    async def start(self) -> None:
        self._server = await self._listen(self._port)
        self._port = int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Close all connections and stop listening. May be called more than once."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
            for connection in list(self.connections):
                connection.abort()
            await server.wait_closed()
