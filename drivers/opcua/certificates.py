"""Certificates of OPC UA applications, with user and password: reading what is there.

OPC UA identifies an application by a URI that must stand in the certificate's subject alternative
name, equal to the URI that the application calls itself.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.ua.status_codes import StatusCodes
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from config.files import read_closed, read_whole
from config.schema.cnc_drivers import OpcUaSecurityConfig
from drivers.contract import FatalDriverError

REFUSALS = {
    StatusCodes.BadUserAccessDenied: "refuses the user name or password",
    StatusCodes.BadIdentityTokenRejected: "refuses the user name or password",
    StatusCodes.BadIdentityTokenInvalid: "refuses the user name or password",
    StatusCodes.BadSecurityChecksFailed: "refuses the daemon's certificate; it must be trusted there",
    StatusCodes.BadCertificateUntrusted: "does not trust the daemon's certificate; it must be trusted there",
    StatusCodes.BadCertificateTimeInvalid: "says that the daemon's certificate has expired or is not yet valid",
    StatusCodes.BadCertificateUriInvalid: "says that the certificate's application URI differs from the daemon's",
    StatusCodes.BadCertificateUseNotAllowed: "says that the daemon's certificate is not meant for a client",
    StatusCodes.BadCertificateInvalid: "says that the daemon's certificate is invalid",
    StatusCodes.BadCertificateRevoked: "says that the daemon's certificate is revoked",
    StatusCodes.BadSecurityPolicyRejected: "does not accept the security policy Basic256Sha256",
    StatusCodes.BadSecurityModeRejected: "does not accept signed and encrypted messages",
}
"""What a server answers when trying again cannot help."""


def load_certificate(path: Path) -> x509.Certificate:
    """Return the certificate in a file, PEM or DER whatever its name; raises FatalDriverError."""
    content = read_file(path, "certificate")
    load = x509.load_pem_x509_certificate if b"-----BEGIN" in content else x509.load_der_x509_certificate
    try:
        return load(content)
    except ValueError as error:
        raise FatalDriverError(f"{path} is not a certificate in PEM or DER form: {error}") from error


def load_private_key(path: Path) -> rsa.RSAPrivateKey:
    """Return the RSA key in a file, PEM or DER and unencrypted; raises FatalDriverError."""
    content = read_file(path, "private key", read_closed)
    load = serialization.load_pem_private_key if b"-----BEGIN" in content else serialization.load_der_private_key
    try:
        key = load(content, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise FatalDriverError(f"{path} is not an unencrypted private key in PEM or DER form: {error}") from error
    if not isinstance(key, rsa.RSAPrivateKey):
        raise FatalDriverError(f"{path} is not an RSA key, which Basic256Sha256 needs")
    return key


def application_uri(certificate: x509.Certificate) -> str | None:
    """Return the application URI that a certificate carries, None where it carries none."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return None
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), None)


def thumbprint(certificate: x509.Certificate) -> str:
    """Return a certificate's SHA-256 thumbprint as people compare it."""
    return certificate.fingerprint(hashes.SHA256()).hex().upper()


def chain_thumbprint(chain: bytes) -> str:
    """Return the thumbprint of the first certificate of a chain in DER form, as servers show it."""
    try:
        header = 2 + (chain[1] & 0x7F) if chain[1] & 0x80 else 2
        length = int.from_bytes(chain[2:header]) if chain[1] & 0x80 else chain[1]
    except IndexError:
        return "none"
    return hashlib.sha256(chain[: header + length]).hexdigest().upper()


def read_file(path: Path, what: str, read: Callable[[Path], bytes] = read_whole) -> bytes:
    """Return a file's bytes; raises FatalDriverError that says what it was wanted for."""
    try:
        return read(path)
    except OSError as error:
        raise FatalDriverError(f"cannot read the {what} {path}: {error.strerror or error}") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class OpcUaCredentials:
    """User, keys and the one server certificate that is accepted."""

    user_name: str
    password: str = field(repr=False)
    application_uri: str
    certificate: x509.Certificate
    private_key: rsa.RSAPrivateKey = field(repr=False)
    server_certificate: x509.Certificate

    def secure(self, client: Any) -> None:
        """Prepare the client (Any: the library declares its policy attribute as the policy None)."""
        make_policy: Any = SecurityPolicyBasic256Sha256
        client.application_uri = self.application_uri
        client.security_policy = make_policy(
            self.server_certificate, self.certificate, self.private_key, ua.MessageSecurityMode.SignAndEncrypt
        )
        client.uaclient.set_security(client.security_policy)

    def check_shown(self, endpoint: str, chain: bytes | None, key: str) -> None:
        """Raise FatalDriverError where a server shows another certificate than the trusted one."""
        found, trusted = chain_thumbprint(chain or b""), thumbprint(self.server_certificate)
        if found != trusted:
            raise FatalDriverError(
                f"{endpoint} shows another certificate than the one that is trusted "
                f"({key}.server_certificate): SHA-256 {found}, trusted {trusted}"
            )


def load_pair(certificate_path: Path, key_path: Path) -> tuple[x509.Certificate, rsa.RSAPrivateKey, str]:
    """Return a certificate, its key and its application URI; raises FatalDriverError that names the file."""
    certificate, key = load_certificate(certificate_path), load_private_key(key_path)
    if (uri := application_uri(certificate)) is None:
        raise FatalDriverError(
            f"the certificate {certificate_path} carries no application URI (subject alternative name); make a new one"
        )
    if key.public_key() != certificate.public_key():
        raise FatalDriverError(
            f"the private key {key_path} does not belong to the certificate {certificate_path}: put its own key there; "
            "one that the service manager hands over is read at the start of the service"
        )
    return certificate, key, uri


Credentials = OpcUaCredentials | None
"""None: an insecure, anonymous connection."""


def load_credentials(config: OpcUaSecurityConfig) -> OpcUaCredentials:
    """Read all files of the security section; raises FatalDriverError that names the file and what to do."""
    certificate, private_key, uri = load_pair(config.certificate, config.private_key)
    return OpcUaCredentials(
        user_name=config.user_name,
        password=_read_password(config.password_file),
        application_uri=uri,
        certificate=certificate,
        private_key=private_key,
        server_certificate=load_certificate(config.server_certificate),
    )


def _read_password(path: Path) -> str:
    content = read_file(path, "password file", read_closed)
    try:
        password = content.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise FatalDriverError(f"the password file {path} is not UTF-8 text (byte {error.start})") from error
    if not password:
        raise FatalDriverError(f"the password file {path} is empty")
    return password
