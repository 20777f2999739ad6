"""Takes the connections of a listening socket, a bounded number at a time, so that the machine's links keep theirs.

The daemon has a limited number of file descriptors. Whoever connects and says nothing must not use them up:
the CNC and the serial lines could then not be opened again.
"""

import asyncio
import contextlib
import resource
import socket
from collections.abc import Awaitable, Callable, Iterator

import structlog

from daemon.rate_limit import RateLimit

log = structlog.get_logger(__name__)

MOST_CONNECTIONS = 32
"""So many connections to one socket are open at a time."""
SHARE_OF_DESCRIPTORS = 16
"""But no more than the process's limit of descriptors divided by this, where that limit is low."""
ACCEPT_RETRY_S = 1.0
"""Wait after a connection could not be taken, because no descriptor is free [s]."""

Serve = Callable[[socket.socket, "Conversation"], Awaitable[None]]


class Conversation:
    """What the bound needs to know of one connection; its server says when a request is under way."""

    def __init__(self) -> None:
        self.busy = False
        """A request is being carried out: the connection is not ended in favour of another."""
        self.on_request: Callable[[], None] = lambda: None

    @contextlib.contextmanager
    def request(self) -> Iterator[None]:
        """Carry out a request that has arrived as a whole."""
        self.busy = True
        self.on_request()
        try:
            yield
        finally:
            self.busy = False


def most_connections(most: int = MOST_CONNECTIONS, share_of_descriptors: int = SHARE_OF_DESCRIPTORS) -> int:
    """Return how many connections to one socket may be open at a time, by this process's limit of descriptors."""
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if descriptors == resource.RLIM_INFINITY:
        return most
    return max(2, min(most, descriptors // share_of_descriptors))


class BoundedConnections:
    """Serves each connection in a task; when too many are open, the one that was quiet longest is ended."""

    def __init__(
        self, name: str, serve: Serve, *, most: int = MOST_CONNECTIONS, share_of_descriptors: int = SHARE_OF_DESCRIPTORS
    ) -> None:
        """`serve` ends by itself when its connection does; the connection is closed after it."""
        self._name = name
        self._serve = serve
        self._most = most_connections(most, share_of_descriptors)
        self._open: dict[asyncio.Task[None], Conversation] = {}
        self._report = RateLimit[str](self._say)

    async def run(self, listener: socket.socket) -> None:
        """Take connections until cancelled; those that are open are then ended."""
        loop = asyncio.get_running_loop()
        listener.setblocking(False)
        try:
            while True:
                try:
                    connection, _ = await loop.sock_accept(listener)
                except OSError as error:
                    self._report(f"a connection could not be taken: {error}")
                    await asyncio.sleep(ACCEPT_RETRY_S)
                    continue
                self._take(connection)
                await asyncio.sleep(0)  # where others connect faster than this takes them, the loop has its turn
        finally:
            self._report.flush()
            for task in self._open:
                task.cancel()
            await asyncio.gather(*self._open, return_exceptions=True)

    def _take(self, connection: socket.socket) -> None:
        if len(self._open) >= self._most:
            self._report(f"more than {self._most} connections: the one that was quiet longest is closed")
            quiet = next((task for task, conversation in self._open.items() if not conversation.busy), None)
            if quiet is None:
                connection.close()
                return
            del self._open[quiet]
            quiet.cancel()
        conversation = Conversation()
        task = asyncio.get_running_loop().create_task(self._converse(connection, conversation))
        self._open[task] = conversation
        conversation.on_request = lambda: self._heard(task)
        task.add_done_callback(lambda done: self._ended(done, connection))

    def _ended(self, task: asyncio.Task[None], connection: socket.socket) -> None:
        """Close the connection, also of a task that was cancelled before it began."""
        self._open.pop(task, None)
        connection.close()

    async def _converse(self, connection: socket.socket, conversation: Conversation) -> None:
        try:
            await self._serve(connection, conversation)
        except (OSError, TimeoutError, ValueError) as error:
            self._report(f"a connection was ended: {error or 'it said nothing for too long'}")
        except Exception as error:
            log.exception("connection.defect", socket=self._name)
            self._report(f"a connection was ended: unexpected {type(error).__name__}")

    def _heard(self, task: asyncio.Task[None]) -> None:
        """Put a connection behind those that have been quiet for longer."""
        if (conversation := self._open.pop(task, None)) is not None:
            self._open[task] = conversation

    def _say(self, problem: str, left_out: int) -> None:
        log.warning("connections", socket=self._name, problem=problem, **({"left_out": left_out} if left_out else {}))
