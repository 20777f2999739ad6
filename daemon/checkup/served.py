"""What people and programs are served with: certificates, keys and accounts that the configuration names."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from cryptography import x509

from config.schema import Configuration
from config.schema.service import OpcUaServerConfig
from daemon.checkup.finding import Finding
from daemon.monitor.accounts import read_accounts
from drivers.opcua.certificates import load_certificate
from drivers.opcua.server.settings import Trusted, load_identity
from models.errors import RefusedInputError

CREDENTIALS = Path("/run/credentials")
"""Here the service manager puts what it hands to the service, and to nobody else."""


def served(configuration: Configuration) -> Iterator[Finding]:
    """Yield whether these files can be used."""
    service, tags = configuration.service, configuration.opcua_server
    if service.http_port is not None and (certificate := service.tls_certificate) and (key := service.tls_key):
        yield _tried("monitor", [certificate, key], lambda: _monitor(certificate, key))
    if (users := service.users) is not None:
        yield _tried("accounts", [users], lambda: f"{len(read_accounts(users))} may log in")
    if tags is not None:
        yield _tried("opcua_server", [tags.certificate, tags.private_key], lambda: _tags(tags))


def _tried(subject: str, files: list[Path], look: Callable[[], str]) -> Finding:
    """Return what was found; a credential of the service is looked at by the service alone."""
    for path in files:
        if path.is_relative_to(CREDENTIALS) and not path.exists():
            return Finding(subject=subject, passed=True, detail=f"{path} is handed to the service, and not looked at")
    try:
        return Finding(subject=subject, passed=True, detail=look())
    except (RefusedInputError, OSError, ValueError) as error:
        return Finding(subject=subject, passed=False, detail=str(error))


def _monitor(certificate: Path, key: Path) -> str:
    from daemon.monitor.web.server import Certificate  # noqa: PLC0415 (a web server is loaded only where there is one)

    found = load_certificate(certificate)
    try:
        Certificate(certificate, key)
    except OSError as error:
        raise ValueError(f"{key} cannot be read, or is not the key of {certificate} ({error})") from error
    return _valid(certificate, found)


def _tags(section: OpcUaServerConfig) -> str:
    identity, trusted = load_identity(section.certificate, section.private_key), Trusted(section.trusted_clients)
    trusted.find(b"")
    if trusted.problems:
        raise ValueError("; ".join(trusted.problems))
    return _valid(section.certificate, identity.certificate)


def _valid(path: Path, certificate: x509.Certificate) -> str:
    """Return until when a certificate is valid; raises ValueError where that is not now."""
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not begins <= datetime.now(UTC) <= ends:
        raise ValueError(f"{path} is valid from {begins:%Y-%m-%d} to {ends:%Y-%m-%d}: make a new one, or set the clock")
    return f"{path}, valid until {ends:%Y-%m-%d}"
