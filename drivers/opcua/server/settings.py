"""What a server is given: its certificate and key, whom it trusts, who its users are, how much of it there may be."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from drivers.contract import FatalDriverError
from drivers.opcua.certificates import load_certificate, load_pair

LEAST_KEY_BITS = 2048


class LoginRefusedError(Exception):
    """Name or password is wrong, or nobody may try now."""


class Users(Protocol):
    """Who may log in. A person is what `login` returns; the server knows no other right than theirs."""

    async def login(self, name: str, password: str, address: str) -> Any:
        """Return the person; raises LoginRefusedError."""

    def present(self, person: Any) -> Any:
        """Return the person as the accounts are now, None when they may no longer log in."""

    def left(self, person: Any) -> None:
        """Note that a person's session has ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """The server's certificate and key."""

    certificate: x509.Certificate
    private_key: rsa.RSAPrivateKey = field(repr=False)
    application_uri: str
    der: bytes = field(repr=False)


def load_identity(certificate_path: Path, key_path: Path) -> Identity:
    """Read certificate and key; raises FatalDriverError that names the file and what to do."""
    certificate, key, uri = load_pair(certificate_path, key_path)
    der = certificate.public_bytes(serialization.Encoding.DER)
    return Identity(certificate=certificate, private_key=key, application_uri=uri, der=der)


class Trusted:
    """Certificates of the clients that may connect: the files of a folder, read again when one is put in or out."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: object = None
        self._known: dict[bytes, x509.Certificate] = {}
        self.problems: tuple[str, ...] = ()
        """Files that are no certificate, and why."""

    def find(self, der: bytes) -> x509.Certificate | None:
        """Return the trusted certificate with which these bytes begin, None when it is none of them."""
        try:
            seen = sorted((path.name, path.stat().st_mtime_ns) for path in self._folder.iterdir())
        except OSError as error:
            self._seen, self._known = None, {}
            self.problems = (f"{self._folder}: cannot be read ({error.strerror}); no client is trusted",)
            return None
        if seen != self._seen:
            self._seen = seen
            self._read()
        return next((each for known, each in self._known.items() if der[: len(known)] == known), None)

    def _read(self) -> None:
        self._known, problems = {}, []
        for path in sorted(self._folder.iterdir()):
            try:
                certificate = load_certificate(path)
                key = certificate.public_key()
                if not isinstance(key, rsa.RSAPublicKey) or key.key_size < LEAST_KEY_BITS:
                    raise FatalDriverError(f"{path} has no RSA key of {LEAST_KEY_BITS} bits or more")
            except FatalDriverError as error:
                problems.append(str(error))
                continue
            self._known[certificate.public_bytes(serialization.Encoding.DER)] = certificate
        self.problems = tuple(problems)
