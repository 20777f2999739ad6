"""The local socket: commands to a running daemon, one JSON object a line, peer identity known."""

import asyncio
import errno
import grp
import json
import os
import pwd
import socket
import struct
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import structlog

from daemon.monitor.connections import BoundedConnections, Conversation
from daemon.rate_limit import RateLimit
from models.json_values import all_printable, printable

log = structlog.get_logger(__name__)

LONGEST_REQUEST = 65536
"""A longer line than this is refused [byte]."""
LONGEST_REFUSAL = 2000
REQUEST_S = 10.0
"""A request that has begun must end within this, and its answer must be taken within this [s]."""
WAITING_CONNECTIONS = 64
"""So many connections wait in the kernel until they are taken."""

PROBE_S = 1.0
"""A process that serves the socket already accepts a connection within this [s]."""

Handler = Callable[[dict[str, Any], str], Awaitable[dict[str, Any]]]


class RequestError(Exception):
    """A request that cannot be taken; the text goes back to the person."""


def peer_name(connection: socket.socket) -> str:
    """Return who is at the other end, as 'name (uid N, pid M)', from the kernel."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = "unknown"
    return f"{printable(name)} (uid {uid}, pid {pid})"


def clear_the_way(path: Path) -> None:
    """Remove a socket that is no longer served; raises OSError when a process answers there, and for another file."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PROBE_S)
        try:
            probe.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:
            if not path.is_socket():
                raise OSError(errno.EEXIST, "what is there is no socket, and stays; name another place") from None
            path.unlink(missing_ok=True)
            return
        except (TimeoutError, BlockingIOError):
            pass  # the connection is not accepted at once, but a process listens
    raise OSError(errno.EADDRINUSE, "another daemon serves this socket; stop it, or give this one a socket of its own")


def identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, None when it is gone."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


class ControlSocket:
    """Serves the socket; every request is answered with one line."""

    def __init__(self, path: Path, group: str | None, handle: Handler) -> None:
        self._path = path
        self._group = group
        self._handle = handle
        self._refused = RateLimit[tuple[str, str]](_say_refused)
        self._turn = asyncio.Lock()

    async def run(self, on_serving: Callable[[], None] = lambda: None) -> None:
        """Serve until cancelled; `on_serving` is called when people can connect."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        await asyncio.to_thread(clear_the_way, self._path)
        connections = BoundedConnections("control", self._serve)
        made: tuple[int, int] | None = None
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            try:
                made = self._open(listener)
                on_serving()
                await connections.run(listener)
            finally:
                self._refused.flush()
                if made is not None and identity(self._path) == made:
                    self._path.unlink(missing_ok=True)

    def _open(self, listener: socket.socket) -> tuple[int, int] | None:
        """Make the socket's file, for its owner and group alone, and listen; return which file it is."""
        old_mask = os.umask(0o177)
        try:
            listener.bind(str(self._path))
        finally:
            os.umask(old_mask)
        made = identity(self._path)
        try:
            if self._group is not None:
                os.chown(self._path, -1, grp.getgrnam(self._group).gr_gid)
                self._path.chmod(0o660)
            listener.listen(WAITING_CONNECTIONS)
        except (OSError, KeyError):
            self._path.unlink(missing_ok=True)
            raise
        return made

    async def _serve(self, connection: socket.socket, conversation: Conversation) -> None:
        person = peer_name(connection)
        reader, writer = await asyncio.open_unix_connection(sock=connection, limit=LONGEST_REQUEST)
        try:
            while first := await reader.read(1):
                async with asyncio.timeout(REQUEST_S):
                    line = first if first == b"\n" else first + await _rest_of_line(reader)
                async with self._turn:  # one request in a turn of the loop, however many have arrived
                    await asyncio.sleep(0)
                with conversation.request():
                    answer = await self._answer(line, person)
                async with asyncio.timeout(REQUEST_S):
                    writer.write(json.dumps(answer, allow_nan=False).encode() + b"\n")
                    await writer.drain()
            writer.close()
            async with asyncio.timeout(REQUEST_S):
                await writer.wait_closed()
        finally:
            writer.transport.abort()

    async def _answer(self, line: bytes, person: str) -> dict[str, Any]:
        if len(line) > LONGEST_REQUEST:
            return {"ok": False, "error": f"the request is longer than {LONGEST_REQUEST} byte"}
        try:
            request = all_printable(json.loads(line))
        except (ValueError, RecursionError) as error:
            return {"ok": False, "error": f"the request is not JSON: {error}"}
        try:
            if not isinstance(request, dict):
                raise RequestError("a request is one JSON object")
            return {"ok": True, **await self._handle(request, person)}
        except RequestError as error:
            why = str(error)[:LONGEST_REFUSAL]
            self._refused((person, why))
            return {"ok": False, "error": why}


async def _rest_of_line(reader: asyncio.StreamReader) -> bytes:
    """Return what comes before the end of the line; of one that is too long only a piece that is too long."""
    too_long = b""
    while True:
        try:
            line = await reader.readuntil(b"\n")
            return too_long or line
        except asyncio.IncompleteReadError as end:
            return too_long or end.partial
        except asyncio.LimitOverrunError as error:
            too_long = await reader.read(error.consumed)


def _say_refused(refusal: tuple[str, str], left_out: int) -> None:
    person, why = refusal
    log.warning("request.refused", person=person, why=why, **({"left_out": left_out} if left_out else {}))
