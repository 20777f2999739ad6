"""Certificates for OPC UA applications."""

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from drivers.contract import FatalDriverError
from drivers.opcua.certificates import (
    application_uri,
    load_certificate,
    load_private_key,
)
from drivers.opcua.new_certificate import create_application_certificate


@pytest.mark.parametrize("name", ["client.der", "client.pem"])
def test_made_certificate_carries_what_opc_ua_asks_for(tmp_path: Path, name: str) -> None:
    certificate, key = tmp_path / "new" / name, tmp_path / "new" / "client.key"
    made = create_application_certificate(certificate, key, application_uri="urn:pc:toolpoint", host_name="pc", days=30)
    assert load_certificate(certificate) == made
    assert (b"BEGIN CERTIFICATE" in certificate.read_bytes()) == name.endswith(".pem")
    assert application_uri(made) == "urn:pc:toolpoint"
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["pc"]
    usage = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert timedelta(days=29) < made.not_valid_after_utc - datetime.now(UTC) <= timedelta(days=30)
    assert load_private_key(key).public_key() == made.public_key()
    assert stat.S_IMODE(key.stat().st_mode) == 0o600


@pytest.mark.parametrize("existing", ["client.der", "client.key"])
def test_nothing_is_overwritten(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("precious")
    with pytest.raises(FatalDriverError, match="exists already and is not overwritten"):
        create_application_certificate(
            tmp_path / "client.der", tmp_path / "client.key", application_uri="urn:x", host_name="x"
        )
    assert (tmp_path / existing).read_text() == "precious"
    assert len(list(tmp_path.iterdir())) == 1
