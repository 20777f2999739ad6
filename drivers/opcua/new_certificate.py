"""Makes a self-signed certificate for an OPC UA application; the daemon itself makes none."""

import os
from pathlib import Path

from asyncua.crypto.cert_gen import dump_private_key_as_pem, generate_private_key, generate_self_signed_app_certificate
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.x509.oid import ExtendedKeyUsageOID

from drivers.contract import FatalDriverError

DEFAULT_DAYS = 3650


def create_application_certificate(
    certificate: Path,
    private_key: Path,
    *,
    application_uri: str,
    host_name: str,
    days: int = DEFAULT_DAYS,
    server: bool = False,
) -> x509.Certificate:
    """Make a key (PEM, mode 600) and a self-signed certificate (DER by its ending .der) in new files."""
    for path in (certificate, private_key):
        if path.exists():
            raise FatalDriverError(f"{path} exists already and is not overwritten; move it away first")
    key = generate_private_key()
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(application_uri), x509.DNSName(host_name)]
    usage = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
    made = generate_self_signed_app_certificate(key, application_uri, {}, names, extended=[usage], days=days)
    encoding = serialization.Encoding.DER if certificate.suffix.lower() == ".der" else serialization.Encoding.PEM
    _write_new(private_key, dump_private_key_as_pem(key), 0o600)
    _write_new(certificate, made.public_bytes(encoding), 0o644)
    return made


def _write_new(path: Path, content: bytes, mode: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
