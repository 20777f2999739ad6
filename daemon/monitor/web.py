"""The daemon's small web server: Prometheus metrics and a health check."""

import contextlib
import socket
from collections.abc import Callable, Iterator

import uvicorn
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route


def metrics_application(registry: CollectorRegistry) -> Starlette:
    """Return the application that serves /metrics and /healthz."""

    async def metrics(request: Request) -> Response:
        return Response(generate_latest(registry), media_type=CONTENT_TYPE_LATEST)

    async def healthz(request: Request) -> Response:
        return PlainTextResponse("running\n")

    return Starlette(routes=[Route("/metrics", metrics), Route("/healthz", healthz)])


class _EmbeddedServer(uvicorn.Server):
    """A server that leaves signals to the daemon."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve_metrics(
    registry: CollectorRegistry, host: str, port: int, on_serving: Callable[[], None] = lambda: None
) -> None:
    """Serve until cancelled; raises OSError when the port is taken."""
    listener = socket.create_server((host, port), reuse_port=False)
    on_serving()
    config = uvicorn.Config(
        metrics_application(registry), log_config=None, access_log=False, lifespan="off", loop="none", ws="none"
    )
    server = _EmbeddedServer(config)
    try:
        await server.serve(sockets=[listener])
    finally:
        listener.close()
