"""Serves the monitor at the configured place: certificate, names by which it is reached, application, sockets."""

from collections.abc import Callable

import structlog
from cryptography import x509

from config.files import read_whole
from daemon.monitor.listening import in_url
from daemon.monitor.web.application import MonitorParts, monitor_application
from daemon.monitor.web.server import Certificate, serve_web

log = structlog.get_logger(__name__)


async def serve_monitor(parts: MonitorParts, on_serving: Callable[[], None] = lambda: None) -> None:
    """Serve until cancelled; raises OSError when the port is taken or the certificate cannot be used."""
    service = parts.configuration.service
    assert service.http_port is not None
    certificate, names = None, {service.http_host}
    if service.tls_certificate is not None and service.tls_key is not None:
        try:
            certificate = Certificate(service.tls_certificate, service.tls_key)
            names |= names_of_certificate(read_whole(service.tls_certificate))
        except (OSError, ValueError) as error:
            raise OSError(f"{service.tls_certificate} and its key cannot be used ({error})") from error
    application = monitor_application(parts, names)
    address = f"{'http' if certificate is None else 'https'}://{in_url(service.http_host, service.http_port)}/"

    def serving() -> None:
        log.info("monitor.serving", pages=address)
        on_serving()

    await serve_web(application, service.http_host, service.http_port, certificate, serving)


def names_of_certificate(pem: bytes) -> set[str]:
    """Return the names and addresses that a certificate is for; raises ValueError when it is none."""
    certificate = x509.load_pem_x509_certificate(pem)
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    addresses = {str(address) for address in found.get_values_for_type(x509.IPAddress)}
    return {name.lower() for name in found.get_values_for_type(x509.DNSName)} | addresses
