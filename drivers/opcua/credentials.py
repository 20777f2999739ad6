"""What the daemon shows to the CNC's OPC UA server, read from the files that the configuration names."""

import stat
from dataclasses import dataclass, field
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import rsa

from config.schema.cnc_drivers import OpcUaSecurityConfig
from drivers.contract import FatalDriverError
from drivers.opcua.certificates import application_uri, load_certificate, load_private_key, read_file


@dataclass(frozen=True, slots=True, kw_only=True)
class OpcUaCredentials:
    """User, keys and the one server certificate that is accepted."""

    user_name: str
    password: str = field(repr=False)
    application_uri: str
    certificate: x509.Certificate
    private_key: rsa.RSAPrivateKey = field(repr=False)
    server_certificate: x509.Certificate


def load_credentials(config: OpcUaSecurityConfig) -> OpcUaCredentials:
    """Read all files of the security section; raises FatalDriverError that names the file and what to do."""
    certificate = load_certificate(config.certificate)
    uri = application_uri(certificate)
    if uri is None:
        raise FatalDriverError(
            f"the certificate {config.certificate} carries no application URI in its subject alternative name, so "
            "OPC UA servers refuse it; make a new one"
        )
    private_key = load_private_key(config.private_key)
    _refuse_readable_by_others(config.private_key, "private key")
    return OpcUaCredentials(
        user_name=config.user_name,
        password=_read_password(config.password_file),
        application_uri=uri,
        certificate=certificate,
        private_key=private_key,
        server_certificate=load_certificate(config.server_certificate),
    )


def _read_password(path: Path) -> str:
    content = read_file(path, "password file")
    _refuse_readable_by_others(path, "password file")
    try:
        password = content.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise FatalDriverError(f"the password file {path} is not UTF-8 text (byte {error.start})") from error
    if not password:
        raise FatalDriverError(f"the password file {path} is empty")
    return password


def _refuse_readable_by_others(path: Path, what: str) -> None:
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & stat.S_IRWXO:
        raise FatalDriverError(
            f"the {what} {path} is open to every user of this computer (mode {mode:o}); run: chmod o-rwx {path}"
        )
