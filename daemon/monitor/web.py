"""The daemon's small web server: Prometheus metrics and a health check, one request a connection."""

import asyncio
import socket
from collections.abc import Callable

import uvicorn
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from daemon.monitor.connections import BoundedConnections, Conversation

REQUEST_S = 10.0
"""A connection is ended after this long, whatever it has sent or taken by then [s]."""
WAITING_CONNECTIONS = 64
"""So many connections wait in the kernel until they are taken."""


def metrics_application(registry: CollectorRegistry) -> Starlette:
    """Return the application that serves /metrics and /healthz."""

    async def metrics(request: Request) -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    async def healthz(request: Request) -> Response:
        return PlainTextResponse("running\n")

    return Starlette(routes=[Route("/metrics", metrics), Route("/healthz", healthz)])


class _OneRequest(H11Protocol):
    """HTTP on one connection, which says when it has ended."""

    def __init__(self, config: uvicorn.Config, state: ServerState) -> None:
        super().__init__(config=config, server_state=state, app_state={})
        self.ended = asyncio.Event()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.ended.set()


async def serve_metrics(
    registry: CollectorRegistry, host: str, port: int, on_serving: Callable[[], None] = lambda: None
) -> None:
    """Serve until cancelled; raises OSError when the port is taken."""
    config = uvicorn.Config(
        metrics_application(registry),
        http=_OneRequest,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="error",  # what a peer sends wrongly is its own affair, and would fill the log
        access_log=False,
        headers=[("connection", "close")],
    )
    config.load()
    state = ServerState()
    state.default_headers = config.encoded_headers

    async def serve(connection: socket.socket, conversation: Conversation) -> None:
        loop = asyncio.get_running_loop()
        transport, protocol = await loop.connect_accepted_socket(lambda: _OneRequest(config, state), connection)
        try:
            async with asyncio.timeout(REQUEST_S):
                await protocol.ended.wait()
        finally:
            transport.abort()

    with socket.create_server((host, port), backlog=WAITING_CONNECTIONS, reuse_port=False) as listener:
        on_serving()
        await BoundedConnections("metrics", serve).run(listener)
