"""Peers that connect and say nothing, or half of something, take nothing from the machine's links."""

import asyncio
import contextlib
import resource
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from starlette.responses import PlainTextResponse, StreamingResponse
from structlog.testing import capture_logs

from daemon.monitor import connections, control_socket
from daemon.monitor.control_client import ControlClient
from daemon.monitor.control_socket import ControlSocket
from daemon.monitor.listening import listening
from daemon.monitor.web import server
from daemon.monitor.web.server import serve_web
from daemon.simulation.processes import free_port

MANY = 200
FLOOD_REPORTS = 30
"""Far fewer than the connections: what comes in a flood is summed up."""


async def status(request: dict[str, Any], person: str) -> dict[str, Any]:
    return {"asked": request, "person": person}


healthy = PlainTextResponse("running\n")


@contextlib.asynccontextmanager
async def running(serve: Callable[[Callable[[], None]], Awaitable[None]]) -> AsyncIterator[None]:
    serving = asyncio.Event()
    task = asyncio.ensure_future(serve(serving.set))
    await serving.wait()
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def own_ends(served: int | Path) -> int:
    """Return how many sockets of this process are bound to the port or path that is served, with the listening one."""
    kind = "tcp" if isinstance(served, int) else "unix"
    bound = (one.laddr for one in psutil.Process().net_connections(kind))
    return sum(str(served) == str(address.port if hasattr(address, "port") else address) for address in bound)


async def half_said(connect: Callable[[], Awaitable[Any]], words: bytes) -> list[asyncio.StreamWriter]:
    """Open many connections that send `words` and then nothing; return the peers' ends."""
    writers = []
    for _ in range(MANY):
        _, writer = await connect()
        writer.write(words)
        writers.append(writer)
        await asyncio.sleep(0)
    return writers


async def ended(writers: list[asyncio.StreamWriter]) -> None:
    for writer in writers:
        writer.transport.abort()
    await asyncio.sleep(0)


async def get(number: int) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", number)
    writer.write(b"GET /healthz HTTP/1.1\r\nHost: toolpoint\r\n\r\n")
    answer = await reader.readuntil(b"running\n")
    writer.close()
    return answer


async def test_half_sent_http_requests_are_bounded_and_others_are_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MOST_CONNECTIONS", 8)
    number = free_port()
    with capture_logs() as logs:
        async with running(lambda on: serve_web(healthy, "127.0.0.1", number, None, on)):
            peers = await half_said(lambda: asyncio.open_connection("127.0.0.1", number), b"GET /metrics HTTP/1.1\r\nX")
            assert (await get(number)).startswith(b"HTTP/1.1 200")
            assert 0 < own_ends(number) <= 8 + 5
            await ended(peers)
    assert 0 < len(logs) <= FLOOD_REPORTS
    assert own_ends(number) == 0


async def test_an_answer_that_nobody_takes_does_not_stay_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of 256 viewers could ask for megabytes of a series and read none of them: more than the service may have."""
    monkeypatch.setattr(server, "SEND_S", 0.3)
    number, large = free_port(), PlainTextResponse("x" * 20_000_000)
    async with running(lambda on: serve_web(large, "127.0.0.1", number, None, on)), asyncio.timeout(60):
        with socket.create_connection(("127.0.0.1", number)) as dead:
            dead.sendall(b"GET / HTTP/1.1\r\nHost: toolpoint\r\n\r\n")
            while own_ends(number) < 2:
                await asyncio.sleep(0.01)
            while own_ends(number) > 1:
                await asyncio.sleep(0.05)


async def most_in_a_turn(count: Callable[[], int], until: int) -> int:
    """Return how much was done at most between two turns of the loop, until so much is done."""
    most = 0
    while (before := count()) < until:
        await asyncio.sleep(0)
        most = max(most, count() - before)
    return most


async def test_connections_that_wait_are_taken_one_in_a_turn_of_the_loop() -> None:
    """While others connect faster than they are taken, the loop had no turn at all."""
    taken = 0

    async def serve(connection: socket.socket, conversation: connections.Conversation) -> None:
        await asyncio.Event().wait()

    class Counted(connections.BoundedConnections):
        def _take(self, connection: socket.socket) -> None:
            nonlocal taken
            taken += 1
            super()._take(connection)

    with socket.create_server(("127.0.0.1", 0), backlog=128) as listener, contextlib.ExitStack() as stack:
        for _ in range(60):
            stack.enter_context(socket.create_connection(listener.getsockname()))
        task = asyncio.ensure_future(Counted("test", serve).run(listener))
        assert await most_in_a_turn(lambda: taken, 60) <= 2
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_requests_that_arrive_together_on_the_control_socket_leave_the_control_its_turn(tmp_path: Path) -> None:
    path, asked = tmp_path / "s", 0

    async def counted(request: dict[str, Any], person: str) -> dict[str, Any]:
        nonlocal asked
        asked += 1
        return request

    async with running(ControlSocket(path, None, counted).run), asyncio.timeout(60):
        writers = [(await asyncio.open_unix_connection(path))[1] for _ in range(5)]
        for writer in writers:
            writer.write(b"{}\n" * 400)
        assert await most_in_a_turn(lambda: asked, 2000) <= 2
        await ended(writers)


async def test_a_slow_viewer_gets_the_answer_that_follows_a_large_one_on_the_same_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What waits then is of the next answer, and is more than there was, though all of the first was taken."""
    monkeypatch.setattr(server, "SEND_S", 1.0)
    number, large = free_port(), PlainTextResponse("x" * 12_000_000)

    async def pieces() -> AsyncIterator[bytes]:
        yield b"y" * 20_000_000
        yield b"end"

    async def application(scope: Any, receive: Any, send: Any) -> None:
        await (large if scope["path"] == "/" else StreamingResponse(pieces()))(scope, receive, send)

    async with running(lambda on: serve_web(application, "127.0.0.1", number, None, on)), asyncio.timeout(120):
        reader, writer = await asyncio.open_connection("127.0.0.1", number)
        writer.write(b"GET / HTTP/1.1\r\nHost: toolpoint\r\n\r\n")
        await reader.readuntil(b"\r\n\r\n")
        await reader.readexactly(12_000_000)
        writer.write(b"GET /pieces HTTP/1.1\r\nHost: toolpoint\r\n\r\n")
        await reader.readuntil(b"\r\n\r\n")
        for _ in range(20):
            await asyncio.sleep(0.1)
            await reader.readexactly(1000)
        rest = b""
        while not rest.endswith(b"end\r\n0\r\n\r\n"):
            rest += (more := await reader.read(1_000_000))
            assert more, "it was broken off"
        writer.close()


async def test_as_many_as_are_served_may_connect_at_once() -> None:
    """One is taken in a turn of the loop: whom the kernel has no room for meanwhile is silent for a second."""
    with (
        listening("127.0.0.1", free_port(), server.WAITING_CONNECTIONS) as listener,
        contextlib.ExitStack() as open_ones,
    ):
        for _ in range(server.MOST_CONNECTIONS):
            open_ones.enter_context(socket.create_connection(listener.getsockname(), timeout=0.9))


async def test_half_said_requests_on_the_control_socket_are_bounded_and_others_are_answered(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with capture_logs() as logs:
        async with running(ControlSocket(path, None, status).run):
            peers = await half_said(lambda: asyncio.open_unix_connection(path), b'{"command": "sta')
            client = await asyncio.to_thread(ControlClient, path)
            assert (await asyncio.to_thread(client.ask, "status"))["asked"] == {"command": "status"}
            client.close()
            assert 0 < own_ends(path) <= connections.MOST_CONNECTIONS + 5
            await ended(peers)
    assert 0 < len(logs) <= FLOOD_REPORTS


@pytest.mark.parametrize("words", [b"{", b'{"command": "status"'])
async def test_a_request_that_is_not_finished_in_time_is_ended(
    tmp_path: Path, words: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_socket, "REQUEST_S", 0.01)
    async with running(ControlSocket(tmp_path / "s", None, status).run):
        reader, writer = await asyncio.open_unix_connection(tmp_path / "s")
        writer.write(words)
        assert await reader.read() == b""
        writer.close()


async def test_without_a_free_descriptor_it_is_said_once_and_served_again_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "ACCEPT_RETRY_S", 0.01)
    path, limits = tmp_path / "s", resource.getrlimit(resource.RLIMIT_NOFILE)
    with capture_logs() as logs, contextlib.ExitStack() as spare:
        async with running(ControlSocket(path, None, status).run):
            peer = spare.enter_context(socket.socket(socket.AF_UNIX))
            resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, fds())) + 1, limits[1]))
            try:
                with contextlib.suppress(OSError):
                    while True:
                        spare.enter_context(socket.socket(socket.AF_UNIX))
                peer.connect(str(path))
                peer.sendall(b'{"command": "status"}\n')
                while not logs:
                    await asyncio.sleep(0.01)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            peer.settimeout(30)
            assert b'"ok": true' in await asyncio.to_thread(peer.recv, 65536)
    assert "Too many open files" in logs[0]["problem"]
    assert len(logs) <= FLOOD_REPORTS


def fds() -> list[str]:
    return [entry.name for entry in Path("/proc/self/fd").iterdir()]


async def test_text_that_cannot_be_stored_or_would_act_on_a_terminal_is_written_as_its_escape(tmp_path: Path) -> None:
    path = tmp_path / "s"
    async with running(ControlSocket(path, None, status).run):
        client = await asyncio.to_thread(ControlClient, path)
        answer = await asyncio.to_thread(client.ask, "enable", axes=["\ud800", "\x1b]0;owned\x07", "z"])
        client.close()
    assert answer["asked"]["axes"] == ["\\ud800", "\\x1b]0;owned\\x07", "z"]
