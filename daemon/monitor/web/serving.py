"""Serves the monitor at the configured place: certificate, names by which it is reached, application, sockets."""

from collections.abc import Callable

import structlog

from daemon.monitor.listening import in_url
from daemon.monitor.web.application import MonitorParts, monitor_application
from daemon.monitor.web.server import Certificate, serve_web

log = structlog.get_logger(__name__)


async def serve_monitor(parts: MonitorParts, on_serving: Callable[[], None] = lambda: None) -> None:
    """Serve until cancelled; raises OSError when the port is taken or the certificate cannot be used."""
    service = parts.configuration.service
    assert service.http_port is not None
    certificate = None
    if service.tls_certificate is not None and service.tls_key is not None:
        try:
            certificate = Certificate(service.tls_certificate, service.tls_key)
        except (OSError, ValueError) as error:
            raise OSError(f"{service.tls_certificate} and its key cannot be used ({error})") from error
    proxies = [str(address) for address in service.trusted_proxies]
    address = f"{'http' if certificate is None else 'https'}://{in_url(service.http_host, service.http_port)}/"

    def serving() -> None:
        log.info("monitor.serving", pages=address)
        on_serving()

    application = monitor_application(
        parts, lambda: {service.http_host.lower(), *(certificate.names if certificate else ())}
    )
    await serve_web(application, service.http_host, service.http_port, certificate, serving, proxies)
